"""Level of recovered light: its radiance now over that in the estimate's frame, measured on the printed white card.

An estimate of clipped light takes effect some frames after the frame from which it was made, and the next follows later
still. A lamp may be dimmed in between and still clip in the ball. Let E be the irradiance of the card, e the part of it
that the environment map contains, and let ' mark values of the current frame. The level of the rest is

    f = (E' - e') / (E - e) = (r - q (1 - s)) / s,    r = E' / E,  q = e' / e,  s = (E - e) / E.

r is the median over points of the card of their radiance now over their radiance then. q is computed from the map, as
the irradiance of a surface that faces upward. s comes with the estimate. If too few points of the card agree (a hand
covers some, or a shadow's edge passes), the level does not change.

To keep noise from flickering, a change of r / (1 - s + s f) below ``STILL`` is ignored, one above ``FOLLOWED`` is
followed in full, and one between them in proportion.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.latlong import PI, texel_solid_angle
from warp_ar.kernels.launch import launch, launch_tiles, tile_kernel
from warp_ar.kernels.recovery.recover import Observation
from warp_ar.kernels.structs import Emitter

wp.set_module_options({"enable_backward": False})

STILL = wp.constant(wp.float32(0.01))
"""Relative change of the card's light up to which the level stays."""
FOLLOWED = wp.constant(wp.float32(0.03))
"""Relative change of the card's light from which the level follows it in full."""
LEAST_SHARE = wp.constant(wp.float32(0.1))
"""Least share s of the card's light that the map lacks; a smaller one is within the map's error."""
LEAST_POINTS = wp.constant(wp.int32(8))
"""Least number of the card's points that both frames show."""
AGREEING = wp.constant(wp.float32(0.7))
"""Least share of the card's points whose ratio of radiance agrees with the median."""
SPREAD = wp.constant(wp.float32(0.1))
"""Largest relative difference from the median at which a point's ratio of radiance agrees with it."""
MOST = wp.constant(wp.float32(2.5))
"""Highest level: that of a lamp that was dimmed to 40 % in the estimate's frame and is now at full power. A larger rise
is probably due to another lamp."""
DARK = wp.constant(wp.float32(0.0016))
"""Radiance below which a point is not used, because of quantisation."""


@tile_kernel
def sum_upward_kernel(
    # In:
    radiance: wp.array2d[wp.vec3],
    # Out:
    upward_out: wp.array[wp.vec3],
):
    """Sum the irradiance that each row of the upper half gives a surface facing upward."""
    i, lane = wp.tid()
    height = radiance.shape[0]
    width = radiance.shape[1]
    total = wp.vec3(0.0, 0.0, 0.0)
    for j in range(lane, width, wp.block_dim()):
        total += radiance[i, j]
    sums = wp.tile_sum(wp.tile(total, preserve_type=True))
    if lane == 0:
        cosine = wp.cos(PI * (wp.float32(i) + 0.5) / wp.float32(height))
        upward_out[i] = texel_solid_angle(i, height, width) * cosine * sums[0]


@wp.kernel(enable_backward=False)
def add_rows_kernel(
    # In:
    rows: wp.array[wp.vec3],
    # Out:
    upward_out: wp.array[wp.float32],
):
    """Sum the irradiance of all rows to that of the whole map, in the order of the rows."""
    c = wp.tid()
    total = wp.float32(0.0)
    for i in range(rows.shape[0]):
        total += rows[i][c]
    upward_out[c] = total


def sum_upward(radiance: wp.array, rows: wp.array, upward_out: wp.array) -> None:
    """Sum the irradiance that a map gives a surface facing upward.

    Args:
        radiance: Latlong, ``wp.vec3`` (h, w).
        rows: Scratch, ``wp.vec3`` (h / 2).
        upward_out: Irradiance, float32 (3).
    """
    launch_tiles(sum_upward_kernel, rows.shape, [radiance], [rows], block_dim=64)
    launch(add_rows_kernel, 3, [rows], [upward_out])


@wp.func
def change_of(now: Observation, then: Observation, c: wp.int32) -> wp.float32:
    """Return a point's radiance now over that in the estimate's frame, in channel c; negative if either is unknown."""
    seen = wp.min(now.visible, then.visible) > 0.8 and wp.max(now.clipped[c], then.clipped[c]) < 0.01
    if seen and now.radiance[c] > DARK and then.radiance[c] > DARK:
        return now.radiance[c] / then.radiance[c]
    return -1.0


@wp.kernel(enable_backward=False)
def follow_level_kernel(
    # In:
    now: wp.array[Observation],
    then: wp.array[Observation],
    upward_now: wp.array[wp.float32],
    upward_then: wp.array[wp.float32],
    share: wp.array[wp.float32],
    # Out:
    level_out: wp.array[wp.float32],
):
    """Write the level of one channel; only the thread whose point has the median ratio of radiance writes."""
    c, own = wp.tid()
    change = change_of(now[own], then[own], c)
    unseen = share[c]
    if change < 0.0 or unseen < LEAST_SHARE:
        return
    count = wp.int32(0)
    below = wp.int32(0)
    alike = wp.int32(0)
    for k in range(now.shape[0]):
        other = change_of(now[k], then[k], c)
        if other >= 0.0:
            count += 1
            if other < change or (other == change and k < own):
                below += 1
            if wp.abs(other - change) <= SPREAD * change:
                alike += 1
    if count < LEAST_POINTS or below != count / 2 or wp.float32(alike) < AGREEING * wp.float32(count):
        return
    shown = wp.where(upward_then[c] > 0.0, upward_now[c] / wp.max(upward_then[c], 1.0e-9), 1.0)
    # Ratio r that the card would have at level 1.
    expected = unseen + (1.0 - unseen) * shown
    off = change / expected - 1.0
    follows = wp.clamp((wp.abs(off) - STILL) / (FOLLOWED - STILL), 0.0, 1.0)
    level_out[c] = wp.clamp(1.0 + follows * off * expected / unseen, 0.0, MOST)


def follow_level(
    now: wp.array, then: wp.array, upward: tuple[wp.array, wp.array], share: wp.array, level_out: wp.array
) -> None:
    """Update the level of recovered light from the card; it does not change if points disagree or are too few.

    Args:
        now: Radiance of the card's points in the current frame, ``Observation`` (n).
        then: Their radiance in the estimate's frame, ``Observation`` (n).
        upward: From ``sum_upward``, now and then.
        share: Share s of the card's light in the estimate's frame that the map lacks, by channel, float32 (3).
        level_out: Radiance of recovered light over that of the estimate, by channel, float32 (3).
    """
    launch(follow_level_kernel, (3, now.shape[0]), [now, then, *upward, share], [level_out], block_dim=32)


@wp.kernel(enable_backward=False)
def apply_level_kernel(
    # In:
    recovered: wp.array2d[wp.vec3],
    emitters: wp.array[Emitter],
    level: wp.array[wp.float32],
    # Out:
    recovered_out: wp.array2d[wp.vec3],
    emitters_out: wp.array[Emitter],
):
    """Multiply recovered radiance and emitters by the level."""
    row, column = wp.tid()
    factor = wp.vec3(level[0], level[1], level[2])
    recovered_out[row, column] = wp.cw_mul(factor, recovered[row, column])
    if row == 0 and column < emitters.shape[0]:
        emitter = emitters[column]
        emitter.power = wp.cw_mul(factor, emitter.power)
        emitters_out[column] = emitter


def apply_level(
    recovered: wp.array, emitters: wp.array, level: wp.array, recovered_out: wp.array, emitters_out: wp.array
) -> None:
    """Scale the light of an estimate to its current level.

    Args:
        recovered: Radiance that a wholly clipped texel lacks, per cell, ``wp.vec3`` (rows, columns).
        emitters: ``Emitter`` (k), at most as many as there are columns of cells.
        level: From ``follow_level``, float32 (3).
        recovered_out: Scaled radiance, of the shape of ``recovered``.
        emitters_out: Scaled emitters, of the shape of ``emitters``.
    """
    launch(apply_level_kernel, recovered.shape, [recovered, emitters, level], [recovered_out, emitters_out])
