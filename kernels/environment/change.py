"""Whether the environment has changed since its readers last saw it."""

from __future__ import annotations

from collections.abc import Sequence

import warp as wp

from warp_ar.kernels.launch import Rows, launch_rows

wp.set_module_options({"enable_backward": False})

CHANGE_FLOOR = 0.0005
CHANGE_SHARE = 0.01
"""An environment has changed once some texel moved by more than ``CHANGE_FLOOR + CHANGE_SHARE * value``, about one
8-bit step. Any normalised filter F of the map with weights that are not negative (a mirror's sample, a glossy lobe,
irradiance / pi) is then off by at most ``CHANGE_FLOOR + CHANGE_SHARE * F`` while its readers do not run."""


@wp.kernel(enable_backward=False)
def measure_difference_kernel(
    # In:
    row_start: wp.int32,
    environment: wp.array2d[wp.vec3],
    published: wp.array2d[wp.vec3],
    floor: wp.float32,
    share: wp.float32,
    # Out:
    difference_out: wp.array[wp.float32],
):
    """Largest change of one row a thread."""
    i = row_start + wp.tid()
    largest = wp.float32(0.0)
    for j in range(environment.shape[1]):
        new = environment[i, j]
        old = published[i, j]
        for channel in range(3):
            largest = wp.max(largest, wp.abs(new[channel] - old[channel]) / (floor + share * wp.abs(old[channel])))
    difference_out[i] = largest


def measure_difference(
    environment: wp.array,
    published: wp.array,
    difference_out: wp.array,
    *,
    floor: float = CHANGE_FLOOR,
    share: float = CHANGE_SHARE,
    rows: Rows | None = None,
) -> None:
    """Largest change of each row against a map that readers have seen, in units of what is tolerated.

    Args:
        environment: ``wp.vec3`` (h, w).
        published: ``wp.vec3`` (h, w).
        difference_out: ``wp.float32`` (h): largest |difference| / (floor + share * published); above 1 it has changed.
        floor: Tolerated change of a black texel.
        share: Tolerated relative change.
        rows: Band of rows, None for all.
    """
    launch_rows(
        measure_difference_kernel,
        (environment.shape[0],),
        [environment, published, floor, share],
        [difference_out],
        rows=rows,
        device=environment.device,
    )


@wp.kernel(enable_backward=False)
def scale_radiance_kernel(
    # In:
    factor: wp.vec3,
    # Out:
    radiance_out: wp.array2d[wp.vec3],
):
    """One texel a thread."""
    i, j = wp.tid()
    radiance_out[i, j] = wp.cw_mul(radiance_out[i, j], factor)


def scale_radiance(radiance_out: wp.array, factor: Sequence[float]) -> None:
    """Multiply a map.

    Args:
        radiance_out: ``wp.vec3`` (h, w).
        factor: RGB.
    """
    wp.launch(scale_radiance_kernel, radiance_out.shape, [wp.vec3(*factor)], [radiance_out], device=radiance_out.device)
