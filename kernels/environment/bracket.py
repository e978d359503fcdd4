"""Merging of unwrapped frames of several exposures to one map of the environment.

Frame k has r_k = t_k / t_0 times the exposure time of the reference, in whose camera values radiance is given. So its
value x_k of a texel means the radiance x_k / r_k. Where no exposure clips, the estimate of least variance weights each
by its inverse variance [GAWTSL10]. With shot noise that grows with the signal and a floor of read noise and rounding,
var(x) = FLOOR^2 + SHOT x, that is

    L = sum w_k x_k / r_k / sum w_k,   w_k = c_k r_k^2 / (FLOOR^2 + SHOT x_k),

with c_k the confidence of the view. The longest unclipped exposure has nearly all the weight. A running mean keeps
equal values exactly.

In a channel that clips anywhere within ``REACH`` of the texel, an exposure has no weight. The reach is wider than the
texel's own footprint, because tracking places the ball a fraction of a pixel differently in every frame. Otherwise an
emitter that the short exposure shows half a texel beside the clipped area of the long one would lose the part over its
edge to the dark surroundings in the long exposure. With it, an emitter and its surroundings come from one exposure.

A clipped value is a lower bound of the result: if an emitter was just switched on, the latest short exposure does not
show it yet. Where all exposures clip, the shortest that observes the texel is used, with its clipped share.

References:
    [GAWTSL10] Granados, Ajdin, Wand, Theobalt, Seidel, Lensch, "Optimal HDR reconstruction with linear digital
        cameras", CVPR 2010.
"""

from __future__ import annotations

import math

import warp as wp

from warp_ar.kernels.latlong import PI
from warp_ar.kernels.launch import row_launcher
from warp_ar.kernels.safe_math import is_finite, light_confidence
from warp_ar.kernels.structs import EnvironmentView

wp.set_module_options({"enable_backward": False})

REACH = math.radians(2.0)
"""Largest angular error of a frame's map: half a pixel of a ball of 80 pixels across moves reflections by 1.8
degrees."""
FLOOR = wp.constant(wp.float32(0.002))
"""Standard deviation of a dark camera value: read noise, and rounding by half a code."""
SHOT = wp.constant(wp.float32(0.0004))
"""Variance per camera value: 2,500 electrons at clipping."""


@wp.struct
class BracketExposure:
    """Exposure of a bracketed source, whose frames alternate between several exposures."""

    ratio: wp.float32  # exposure time over the reference's
    trust: wp.float32  # 1; 0 if there was no such frame lately


@wp.struct
class ExposureStack:
    """The latest unwrapped frame of every exposure, longest first, (K, h, w) each."""

    radiance: wp.array3d[wp.vec3]  # in camera values of the exposure over the ball's reflectance
    confidence: wp.array3d[wp.float32]  # 0 or NaN: not observed
    clipped: wp.array3d[wp.vec3]  # clipped share, per channel
    spread: wp.array3d[wp.vec3]  # largest clipped share nearby, from ``spread_clipping``


@wp.kernel(enable_backward=False)
def spread_clipping_kernel(
    # In:
    row_start: wp.int32,
    reach: wp.float32,
    # In and out:
    stack_out: ExposureStack,
):
    """Find the largest clipped share near a texel along its row."""
    clipped = stack_out.clipped
    band_row, j, k = wp.tid()
    i = row_start + band_row
    height = clipped.shape[1]
    width = clipped.shape[2]
    step = 2.0 * PI / wp.float32(width) * wp.sin((wp.float32(i) + 0.5) * PI / wp.float32(height))
    columns = wp.min(wp.int32(wp.ceil(reach / step)), width / 2)
    largest = wp.vec3(0.0, 0.0, 0.0)
    for offset in range(-columns, columns + 1):
        at = (j + offset + width) % width
        if stack_out.confidence[k, i, at] > 0.0:
            share = clipped[k, i, at]
            if not is_finite(share):
                share = wp.vec3(1.0, 1.0, 1.0)
            largest = wp.max(largest, share)
    stack_out.spread[k, i, j] = largest


spread_clipping = row_launcher(
    spread_clipping_kernel, like=lambda reach, stack: (*stack.clipped.shape[1:], len(stack.clipped))
)
"""Find the largest clipped share near every texel along its row; ``merge_exposures`` searches along columns.

Args:
    reach: Radians.
    stack_out: (K, h, w); its ``spread`` is written.
"""


@wp.kernel(enable_backward=False)
def merge_exposures_kernel(
    # In:
    row_start: wp.int32,
    exposures: wp.array[BracketExposure],
    stack: ExposureStack,
    reach: wp.float32,
    # Out:
    view_out: EnvironmentView,
):
    """Merge the exposures' radiance of one texel."""
    radiance = stack.radiance
    clipped = stack.clipped
    band_row, j = wp.tid()
    i = row_start + band_row
    height = radiance.shape[1]
    reach_rows = wp.int32(wp.ceil(reach * wp.float32(height) / PI))
    first = wp.max(i - reach_rows, 0)
    last = wp.min(i + reach_rows, height - 1)

    total = wp.vec3(0.0, 0.0, 0.0)
    mean = wp.vec3(0.0, 0.0, 0.0)
    least = wp.vec3(0.0, 0.0, 0.0)
    shortest = wp.vec3(0.0, 0.0, 0.0)
    share = wp.vec3(0.0, 0.0, 0.0)
    certainty = wp.float32(0.0)
    for k in range(exposures.shape[0]):
        c = wp.float32(0.0)
        if exposures[k].trust > 0.0 and exposures[k].ratio > 0.0:
            c = light_confidence(radiance[k, i, j], stack.confidence[k, i, j])
        if c > 0.0 and is_finite(clipped[k, i, j]):
            certainty = wp.max(certainty, c)
            ratio = exposures[k].ratio
            value = radiance[k, i, j]
            brightest = wp.vec3(0.0, 0.0, 0.0)
            for row in range(first, last + 1):
                brightest = wp.max(brightest, stack.spread[k, row, j])
            for channel in range(3):
                light = value[channel] / ratio
                if brightest[channel] == 0.0:
                    weight = c * ratio * ratio / (FLOOR * FLOOR + SHOT * value[channel])
                    total[channel] += weight
                    mean[channel] += weight / total[channel] * (light - mean[channel])
                elif clipped[k, i, j][channel] > 0.0:
                    least[channel] = wp.max(least[channel], light)
                shortest[channel] = light
                share[channel] = clipped[k, i, j][channel]
    for channel in range(3):
        if total[channel] > 0.0:
            shortest[channel] = mean[channel]
            share[channel] = 0.0
        shortest[channel] = wp.max(shortest[channel], least[channel])
    view_out.radiance[i, j] = shortest
    view_out.confidence[i, j] = certainty
    view_out.clipped[i, j] = share


merge_exposures = row_launcher(merge_exposures_kernel, like=lambda *given: given[-1].radiance)
"""Merge the latest unwrapped frame of every exposure.

Args:
    exposures: ``BracketExposure`` (K), longest first; the reference, whose ratio is 1, is one of them.
    stack: (K, h, w); its ``spread`` from ``spread_clipping``, with the same ``reach``.
    reach: Radians.
    view_out: (h, w): radiance in camera values of the reference, the highest confidence of all exposures, and the share
        that clips in all of them.
"""
