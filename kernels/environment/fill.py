"""Completion of the environment where no ball shows it.

Missing texels are filled from their confident neighbours by push-pull [GGSC96]. Coarser levels of a pyramid hold means
of radiance weighted by confidence and solid angle; then, from coarse to fine, each texel is completed from its coarser
level in proportion to its missing trust. Both steps are normalised, in forms that are exact for equal values, so a
constant environment stays constant under any mask. Coarser texels weight finer ones by their exact overlap, so maps may
have any size. Without any confidence the map is zero.

References:
    [GGSC96] Gortler, Grzeszczuk, Szeliski, Cohen, "The Lumigraph", SIGGRAPH 1996, section 3.4.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import warp as wp

from warp_ar.kernels.latlong import PI, neighbours_in_row
from warp_ar.kernels.launch import Rows, launch_rows, row_launcher
from warp_ar.kernels.safe_math import smooth_ramp, usable_confidence

wp.set_module_options({"enable_backward": False})

FULL_TRUST = wp.constant(wp.float32(0.5))
"""Confidence above which a texel is kept as it is."""
SUPPORT = wp.constant(wp.float32(4.0))
"""Trust of a coarser texel, at most 1, over the mean trust of its finer texels; above 1, nearby texels fill gaps."""


@wp.func
def band_solid_angle(start: wp.float32, stop: wp.float32, height: wp.int32) -> wp.float32:
    """Return the solid angle of the rows from start to stop, per radian of longitude, without cancellation."""
    half = 0.5 * PI / wp.float32(height)
    return 2.0 * wp.sin((start + stop) * half) * wp.sin((stop - start) * half)


@wp.func
def sample_level_row(
    levels: wp.array[wp.vec4], offset: wp.int32, height: wp.int32, width: wp.int32, row: wp.int32, x: wp.float32
) -> wp.vec3:
    """Sample one row of a level linearly, across the seam and the poles; see ``latlong.neighbours_in_row``."""
    first, second, t = neighbours_in_row(row, x, height, width)
    a = levels[offset + first[0] * width + first[1]]
    b = levels[offset + second[0] * width + second[1]]
    return wp.vec3(a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]), a[2] + t * (b[2] - a[2]))


@wp.kernel(enable_backward=False)
def seed_fill_kernel(
    # In:
    row_start: wp.int32,
    radiance: wp.array2d[wp.vec3],
    confidence: wp.array2d[wp.float32],
    # Out:
    levels_out: wp.array[wp.vec4],  # radiance and trust
):
    """Write a texel of level 0 of the pyramid: radiance, and trust in it (0..1)."""
    band_row, j = wp.tid()
    i = row_start + band_row
    value = radiance[i, j]
    trust = smooth_ramp(0.0, FULL_TRUST, usable_confidence(value, confidence[i, j]))
    if trust == 0.0:
        value = wp.vec3(0.0, 0.0, 0.0)
    value = wp.max(value, wp.vec3(0.0, 0.0, 0.0))
    levels_out[i * radiance.shape[1] + j] = wp.vec4(value[0], value[1], value[2], trust)


@wp.func
def pulled(
    levels: wp.array[wp.vec4],
    i: wp.int32,
    j: wp.int32,
    fine_offset: wp.int32,
    fine_height: wp.int32,
    fine_width: wp.int32,
    height: wp.int32,
    width: wp.int32,
    most: wp.float32,
) -> wp.vec4:
    """Return (R, G, B, trust) of a texel of the next coarser level: means over its area, of radiance up to ``most``."""
    top = wp.float32(i * fine_height) / wp.float32(height)
    bottom = wp.float32((i + 1) * fine_height) / wp.float32(height)
    left = wp.float32(j * fine_width) / wp.float32(width)
    right = wp.float32((j + 1) * fine_width) / wp.float32(width)
    mean = wp.vec3(0.0, 0.0, 0.0)
    total = wp.float32(0.0)
    area = wp.float32(0.0)
    for r in range(wp.int32(top), wp.min(wp.int32(wp.ceil(bottom)), fine_height)):
        band = band_solid_angle(wp.max(top, wp.float32(r)), wp.min(bottom, wp.float32(r + 1)), fine_height)
        for c in range(wp.int32(left), wp.min(wp.int32(wp.ceil(right)), fine_width)):
            part = band * (wp.min(right, wp.float32(c + 1)) - wp.max(left, wp.float32(c)))
            texel = levels[fine_offset + r * fine_width + c]
            area += part
            weight = part * texel[3]
            if weight > 0.0:
                total += weight
                value = wp.vec3(wp.min(texel[0], most), wp.min(texel[1], most), wp.min(texel[2], most))
                mean += (weight / total) * (value - mean)
    return wp.vec4(mean[0], mean[1], mean[2], wp.min(1.0, SUPPORT * total / area))


@wp.kernel(enable_backward=False)
def pull_level_kernel(
    # In:
    row_start: wp.int32,
    fine_offset: wp.int32,
    fine_height: wp.int32,
    fine_width: wp.int32,
    offset: wp.int32,
    height: wp.int32,
    width: wp.int32,
    most: wp.float32,
    # Out:
    levels_out: wp.array[wp.vec4],
):
    """Write a texel of the next coarser level."""
    band_row, j = wp.tid()
    i = row_start + band_row
    levels_out[offset + i * width + j] = pulled(
        levels_out, i, j, fine_offset, fine_height, fine_width, height, width, most
    )


@wp.func
def completed(
    levels: wp.array[wp.vec4],
    i: wp.int32,
    j: wp.int32,
    offset: wp.int32,
    height: wp.int32,
    width: wp.int32,
    coarse_offset: wp.int32,
    coarse_height: wp.int32,
    coarse_width: wp.int32,
) -> wp.vec3:
    """Return the radiance of a texel, completed from the coarser level in proportion to its missing trust."""
    texel = levels[offset + i * width + j]
    value = wp.vec3(texel[0], texel[1], texel[2])
    if texel[3] < 1.0 and coarse_height > 0:
        y = (wp.float32(i) + 0.5) * wp.float32(coarse_height) / wp.float32(height) - 0.5
        x = (wp.float32(j) + 0.5) * wp.float32(coarse_width) / wp.float32(width) - 0.5
        row = wp.floor(y)
        above = sample_level_row(levels, coarse_offset, coarse_height, coarse_width, wp.int32(row), x)
        below = sample_level_row(levels, coarse_offset, coarse_height, coarse_width, wp.int32(row) + 1, x)
        value += (1.0 - texel[3]) * (above + (y - row) * (below - above) - value)
    return value


@wp.kernel(enable_backward=False)
def push_level_kernel(
    # In:
    row_start: wp.int32,
    offset: wp.int32,
    height: wp.int32,
    width: wp.int32,
    coarse_offset: wp.int32,
    coarse_height: wp.int32,
    coarse_width: wp.int32,
    # Out:
    levels_out: wp.array[wp.vec4],
):
    """Complete one texel of a level from the coarser level, in place."""
    band_row, j = wp.tid()
    i = row_start + band_row
    value = completed(levels_out, i, j, offset, height, width, coarse_offset, coarse_height, coarse_width)
    # Trust is not read again.
    levels_out[offset + i * width + j] = wp.vec4(value[0], value[1], value[2], 1.0)


@wp.kernel(enable_backward=False)
def finish_fill_kernel(
    # In:
    row_start: wp.int32,
    levels: wp.array[wp.vec4],
    coarse_offset: wp.int32,
    coarse_height: wp.int32,
    coarse_width: wp.int32,
    # Out:
    environment_out: wp.array2d[wp.vec3],
):
    """Complete one texel of level 0, and write it to the environment map."""
    band_row, j = wp.tid()
    i = row_start + band_row
    environment_out[i, j] = completed(
        levels, i, j, 0, environment_out.shape[0], environment_out.shape[1], coarse_offset, coarse_height, coarse_width
    )


def fill_level_shapes(height: int, width: int) -> tuple[tuple[int, int], ...]:
    """Return rows and columns of the fill pyramid's levels, from the map itself to a single texel."""
    shapes = [(height, width)]
    while shapes[-1] != (1, 1):
        rows, columns = shapes[-1]
        shapes.append(((rows + 1) // 2, (columns + 1) // 2))
    return tuple(shapes)


def fill_level_offsets(height: int, width: int) -> tuple[int, ...]:
    """Return the index of each level's first texel in the packed array, then the array's length."""
    return (0, *itertools.accumulate(rows * columns for rows, columns in fill_level_shapes(height, width)))


seed_fill = row_launcher(seed_fill_kernel, like=lambda radiance, *_: radiance)
"""Write level 0 of the fill pyramid.

Args:
    radiance: Partly known light, ``wp.vec3`` (h, w).
    confidence: ``wp.float32`` (h, w) in 0..1.
    levels_out: ``wp.vec4`` (``fill_level_offsets(h, w)[-1]``): radiance and trust.
"""


def push_pull(levels_out: wp.array, height: int, width: int, *, most: float = math.inf) -> None:
    """Build the coarser levels of a fill pyramid from level 0, then fill the holes of each from the next coarser one.

    Level 0 keeps its holes; ``finish_fill`` fills them.

    Args:
        levels_out: Written by ``seed_fill``; changed in place.
        height: Rows of level 0.
        width: Columns of level 0.
        most: Upper bound to which radiance is clamped before texels are averaged for a coarser level, so that an
            emitter does not spread over missing neighbours.
    """
    shapes, offsets = fill_level_shapes(height, width), fill_level_offsets(height, width)
    levels: list[tuple[Any, ...]] = [(offset, *shape) for offset, shape in zip(offsets, shapes, strict=False)]
    for fine, coarse in itertools.pairwise(levels):
        launch_rows(pull_level_kernel, coarse[1:], [*fine, *coarse, most], [levels_out], rows=None)
    for coarse, fine in itertools.pairwise(reversed(levels[1:])):
        launch_rows(push_level_kernel, fine[1:], [*fine, *coarse], [levels_out], rows=None)


def finish_fill(levels: wp.array, environment_out: wp.array, *, rows: Rows | None = None) -> None:
    """Complete level 0 and write it as the environment map.

    Args:
        levels: Written by ``push_pull``.
        environment_out: ``wp.vec3`` (h, w): finite, not negative; zero if no texel is known.
        rows: Band of rows, None for all.
    """
    height, width = environment_out.shape
    shapes, offsets = fill_level_shapes(height, width), fill_level_offsets(height, width)
    coarse = (offsets[1], *shapes[1]) if len(shapes) > 1 else (0, 0, 0)
    launch_rows(finish_fill_kernel, environment_out.shape, [levels, *coarse], [environment_out], rows=rows)
