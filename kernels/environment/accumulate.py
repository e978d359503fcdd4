"""Accumulation of the environment over time.

Every texel keeps a radiance m and a confidence k. It approaches the radiance x, of confidence c, of the current frame:

    m += a (x - m),   a = a0 c / (a0 c + (1 - a0) k),   a0 = 1 - exp(-time_step / tau):

an exponential mean if c = k, faster if the new view is the more confident one, slower if it is the less confident, and
without effect at c = 0. A texel that was never observed takes x. The form m + a (x - m) is exact if x = m, so nothing
drifts. k approaches c in the same way, and fades with ``FORGET_TIME``, so that light that has not been observed for
long is soon replaced.

tau is ``FOLLOW_TIME``, and falls toward ``FOLLOW_TIME / HASTE`` where the light changes. Noise and the jitter of the
tracked pose cause large differences of both signs in single texels. A change of the environment has one sign over a
neighbourhood, and lasts. So the signed mean of x - m is taken over sectors of ``SECTOR_SIZE`` texels squared. The
smaller of its values in two successive frames is used, if both have one sign, so that a single corrupt frame does not
shorten tau.

In a clipped channel x is only a lower bound. If the camera's gain drifts, earlier frames of a lower gain have shown
more: m, scaled by the change of gain since, lies above x. Then m and its clipped share are kept, so that the light does
not fall because the exposure rises. Without a drift m does not lie above a clipped x.
"""

from __future__ import annotations

from collections.abc import Sequence

import warp as wp

from warp_ar.kernels.color import brightness
from warp_ar.kernels.latlong import texel_solid_angle
from warp_ar.kernels.launch import launch_tiles, row_launcher, tile_kernel
from warp_ar.kernels.safe_math import is_finite, light_confidence, smooth_ramp, usable_confidence
from warp_ar.kernels.structs import EnvironmentView, FrameParams

wp.set_module_options({"enable_backward": False})

FOLLOW_TIME = wp.constant(wp.float32(0.15))
"""Time constant of accumulation in seconds: after half a second 4 % of a small change are left."""
HASTE = wp.constant(wp.float32(6.0))
"""Factor by which a significant change is followed faster."""
FORGET_TIME = wp.constant(wp.float32(20.0))
"""Time constant, seconds, with which the confidence of texels that are not observed fades."""
SECTOR_SIZE = 8
"""Texels along the side of a sector in which change is measured."""
LEAST_CHANGE = wp.constant(wp.float32(0.03))
MOST_CHANGE = wp.constant(wp.float32(0.15))
"""Relative change of a sector's mean at which tau is shortest; it begins to fall at ``LEAST_CHANGE``."""
DARK = wp.constant(wp.float32(0.01))
"""Radiance below which changes count as noise."""
LEAST_EXCESS = wp.constant(wp.float32(0.02))
MOST_EXCESS = wp.constant(wp.float32(0.1))
"""Relative excess of m over a clipped x at which m is kept in full; it begins to be kept at ``LEAST_EXCESS``."""
ALL_CLIPPED = wp.constant(wp.float32(0.9))
"""Clipped share from which on a texel counts as wholly clipped; below it x - m has noise of both signs."""


@wp.func
def known_beyond_clipping(x: wp.vec3, m: wp.vec3, clipped: wp.vec3) -> wp.vec3:
    """Return the degree, 0..1, to which the known radiance m of each channel exceeds its clipped value x."""
    beyond = wp.vec3(0.0, 0.0, 0.0)
    for channel in range(3):
        excess = m[channel] - x[channel]
        if excess > 0.0 and clipped[channel] > ALL_CLIPPED:
            beyond[channel] = smooth_ramp(LEAST_EXCESS, MOST_EXCESS, excess / wp.max(x[channel], DARK))
            beyond[channel] *= smooth_ramp(ALL_CLIPPED, 1.0, clipped[channel])
    return beyond


@tile_kernel
def measure_change_kernel(
    # In:
    view: EnvironmentView,
    environment: EnvironmentView,
    # Out:
    change_out: wp.array2d[wp.vec2],  # this frame's signed relative change, and the one before
):
    """Write the mean of x - m, relative to the radiance, over one sector; one block of threads computes a sector."""
    sector_row, sector_column, lane = wp.tid()
    height = view.radiance.shape[0]
    width = view.radiance.shape[1]
    first_row = sector_row * height // change_out.shape[0]
    first_column = sector_column * width // change_out.shape[1]
    rows = (sector_row + 1) * height // change_out.shape[0] - first_row
    columns = (sector_column + 1) * width // change_out.shape[1] - first_column
    total = wp.vec2(0.0, 0.0)  # difference and level
    for item in range(lane, rows * columns, wp.block_dim()):
        i = first_row + item // columns
        j = first_column + item % columns
        m = environment.radiance[i, j]
        seen = view.radiance[i, j]
        x = seen + wp.cw_mul(known_beyond_clipping(seen, m, view.clipped[i, j]), m - seen)
        certainty = usable_confidence(m, environment.confidence[i, j])
        weight = wp.min(light_confidence(seen, view.confidence[i, j]), certainty)
        if weight > 0.0:
            weight *= texel_solid_angle(i, height, width)
            new = brightness(x)
            old = brightness(m)
            total += weight * wp.vec2(new - old, wp.max(new, old) + DARK)
    sums = wp.tile_sum(wp.tile(total, preserve_type=True))
    if lane == 0:
        change = wp.float32(0.0)
        if sums[0][1] > 0.0:
            change = sums[0][0] / sums[0][1]
        if not wp.isfinite(change):
            change = 0.0
        change_out[sector_row, sector_column] = wp.vec2(change, change_out[sector_row, sector_column][0])


@wp.func
def lasting_change(change: wp.array2d[wp.vec2], row: wp.int32, column: wp.int32) -> wp.float32:
    """Return the smaller absolute change of a sector in two successive frames, or 0 if their signs differ.

    Rows are clamped to the map, columns wrap around.
    """
    width = change.shape[1]
    c = change[wp.clamp(row, 0, change.shape[0] - 1), (column + width) % width]
    if c[0] * c[1] <= 0.0:
        return 0.0
    return wp.min(wp.abs(c[0]), wp.abs(c[1]))


@wp.kernel(enable_backward=False)
def accumulate_environment_kernel(
    # In:
    row_start: wp.int32,
    view: EnvironmentView,
    change: wp.array2d[wp.vec2],
    params: wp.array[FrameParams],
    # In and out:
    environment_out: EnvironmentView,
):
    """Move one texel's radiance and confidence toward those of the current frame, in place."""
    band_row, j = wp.tid()
    i = row_start + band_row
    x = view.radiance[i, j]
    clipped = view.clipped
    c = light_confidence(x, view.confidence[i, j])
    if wp.min(clipped[i, j]) < 0.0 or not is_finite(clipped[i, j]):
        c = 0.0
    m = environment_out.radiance[i, j]
    share = environment_out.clipped[i, j]
    k = usable_confidence(m, environment_out.confidence[i, j])
    if params[0].environment_reset != 0 or k == 0.0 or not is_finite(share):
        k = 0.0
        m = wp.vec3(0.0, 0.0, 0.0)
        share = wp.vec3(0.0, 0.0, 0.0)
    time_step = params[0].time_step
    if not (time_step > 0.0):
        time_step = 0.0

    # Sectors are blended bilinearly: no edges between them.
    y = (wp.float32(i) + 0.5) * wp.float32(change.shape[0]) / wp.float32(clipped.shape[0]) - 0.5
    z = (wp.float32(j) + 0.5) * wp.float32(change.shape[1]) / wp.float32(clipped.shape[1]) - 0.5
    row = wp.int32(wp.floor(y))
    column = wp.int32(wp.floor(z))
    fz = z - wp.floor(z)
    above = wp.lerp(lasting_change(change, row, column), lasting_change(change, row, column + 1), fz)
    below = wp.lerp(lasting_change(change, row + 1, column), lasting_change(change, row + 1, column + 1), fz)
    significance = smooth_ramp(LEAST_CHANGE, MOST_CHANGE, wp.lerp(above, below, y - wp.floor(y)))

    rate = 1.0 - wp.exp(-time_step / FOLLOW_TIME * (1.0 + (HASTE - 1.0) * significance))
    a = wp.float32(0.0)
    if c > 0.0:
        a = 1.0
        if k > 0.0:
            a = rate * c / (rate * c + (1.0 - rate) * k)
        beyond = known_beyond_clipping(x, m, clipped[i, j])
        m = m + a * wp.cw_mul(wp.vec3(1.0, 1.0, 1.0) - beyond, x - m)
        share = share + a * wp.cw_mul(wp.vec3(1.0, 1.0, 1.0) - beyond, clipped[i, j] - share)
    k = k * wp.exp(-time_step / FORGET_TIME)
    environment_out.radiance[i, j] = m
    environment_out.confidence[i, j] = k + a * (c - k)
    environment_out.clipped[i, j] = share


def change_shape(height: int, width: int) -> tuple[int, int]:
    """Return the rows and columns of sectors in which change is measured, for a map of this size."""
    return max(1, height // SECTOR_SIZE), max(1, width // SECTOR_SIZE)


def measure_change(view: EnvironmentView, environment: EnvironmentView, change_out: wp.array) -> None:
    """Measure the signed relative change of each sector between the accumulated light and a frame's.

    Args:
        view: (h, w) this frame's light.
        environment: (h, w) accumulated light.
        change_out: ``wp.vec2`` of ``change_shape(h, w)``: the change in -1..1, and that of the previous frame.
    """
    launch_tiles(measure_change_kernel, change_out.shape, [view, environment], [change_out], block_dim=SECTOR_SIZE**2)


accumulate_environment = row_launcher(accumulate_environment_kernel, like=lambda *given: given[-1].radiance)
"""Move the accumulated light toward a frame's light; outputs are updated in place and start at zero.

Args:
    view: (h, w) this frame's light.
    change: From ``measure_change``.
    params: ``FrameParams`` (1): ``time_step`` and ``environment_reset``.
    environment_out: (h, w) accumulated light.
"""


@wp.kernel(enable_backward=False)
def scale_radiance_kernel(
    # In:
    factor: wp.vec3,
    # Out:
    radiance_out: wp.array2d[wp.vec3],
):
    """Multiply the radiance of one texel by a colour."""
    i, j = wp.tid()
    radiance_out[i, j] = wp.cw_mul(radiance_out[i, j], factor)


def scale_radiance(radiance_out: wp.array, factor: Sequence[float]) -> None:
    """Multiply a map by a colour.

    Args:
        radiance_out: ``wp.vec3`` (h, w).
        factor: RGB.
    """
    wp.launch(scale_radiance_kernel, radiance_out.shape, [wp.vec3(*factor)], [radiance_out], device=radiance_out.device)
