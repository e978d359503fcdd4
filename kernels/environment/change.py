"""Change of the environment since the stages that read it last ran."""

from __future__ import annotations

from collections.abc import Sequence

import warp as wp

from warp_ar.kernels.launch import row_launcher

wp.set_module_options({"enable_backward": False})

CHANGE_FLOOR = 0.0005
CHANGE_SHARE = 0.01
"""Relative change that is tolerated. An environment has changed if some texel changed by more than ``CHANGE_FLOOR +
CHANGE_SHARE * value``, about one 8-bit step. Until then, any normalised filter F of the map with weights that are not
negative (a mirror's sample, a glossy lobe, irradiance / pi) is off by at most ``CHANGE_FLOOR + CHANGE_SHARE * F``."""


@wp.kernel(enable_backward=False)
def measure_difference_kernel(
    # In:
    row_start: wp.int32,
    environment: wp.array2d[wp.vec3],
    published: wp.array2d[wp.vec3],
    # Out:
    difference_out: wp.array[wp.float32],
):
    """Find the largest change of one row."""
    i = row_start + wp.tid()
    largest = wp.float32(0.0)
    for j in range(environment.shape[1]):
        new = environment[i, j]
        old = published[i, j]
        for channel in range(3):
            tolerated = wp.static(CHANGE_FLOOR) + wp.static(CHANGE_SHARE) * wp.abs(old[channel])
            largest = wp.max(largest, wp.abs(new[channel] - old[channel]) / tolerated)
    difference_out[i] = largest


measure_difference = row_launcher(measure_difference_kernel)
"""Measure the largest change of each row against the map that was last read, over the tolerated change.

Args:
    environment: ``wp.vec3`` (h, w).
    published: ``wp.vec3`` (h, w), the map that was last read.
    difference_out: ``wp.float32`` (h): largest |difference| over the tolerated one; above 1 the map has changed.
"""


@wp.kernel(enable_backward=False)
def scale_radiance_kernel(
    # In:
    factor: wp.vec3,
    # Out:
    radiance_out: wp.array2d[wp.vec3],
):
    """Scale one texel."""
    i, j = wp.tid()
    radiance_out[i, j] = wp.cw_mul(radiance_out[i, j], factor)


def scale_radiance(radiance_out: wp.array, factor: Sequence[float]) -> None:
    """Multiply a map by a colour.

    Args:
        radiance_out: ``wp.vec3`` (h, w).
        factor: RGB.
    """
    wp.launch(scale_radiance_kernel, radiance_out.shape, [wp.vec3(*factor)], [radiance_out], device=radiance_out.device)
