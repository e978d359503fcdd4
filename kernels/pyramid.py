"""Box pyramids of latlong maps: every level holds the mean radiance over its texels' solid angles.

A pyramid is one packed ``wp.array[wp.vec3]``: level l has (max(H >> l, 1), max(W >> l, 1)) texels in row-major order
and follows the levels before it; there are ``level_count(H, W)``, down to one row or column. Level 0 is the map itself,
made safe: see ``safe_radiance``.

A texel of level l is the mean of level l - 1 over the area that it covers. Sizes need not be even: the overlap of
texels is counted in integers (texel i of h spans [i H, (i + 1) H] where texel r of H spans [r h, (r + 1) h]), its solid
angle is a product

    (phi1 - phi0) (cos theta0 - cos theta1),
    cos theta0 - cos theta1 = 2 sin((theta0 + theta1) / 2) sin((theta1 - theta0) / 2).

So every level keeps the energy.

For even sizes that is the 2x2 box with its solid angles as weights: the paper's filter (section 3.2), which also is
what a graphics library's mipmap generation does but for the weights.

An *isotropic* pyramid counts columns over a wider span: near the poles a texel of a latlong map is much narrower than
high, so that a box of texels blurs along meridians only. There a texel averages over W' / (w sin theta) columns instead
of W' / w, at most over all of them: its footprint is as wide as high. Rows are blurred around the axis only, which
moves no energy from row to row: energy is still kept.

References:
    [AG02] Ashikhmin, Ghosh 2002, Simple Blurry Reflections with Environment Maps.
"""

from __future__ import annotations

import math

import warp as wp

from warp_ar.kernels.latlong import latlong_from_direction, wrap_texel
from warp_ar.kernels.launch import Rows, launch_rows

wp.set_module_options({"enable_backward": False})

PI = wp.constant(wp.float32(math.pi))
MAX_RADIANCE = wp.constant(wp.float32(1.0e8))
"""Radiance that an infinite or larger texel counts as, in camera values: sums over any map stay finite in float32."""


def level_size(height: int, width: int, level: int) -> tuple[int, int]:
    """Rows and columns of a level."""
    return max(height >> level, 1), max(width >> level, 1)


def level_count(height: int, width: int) -> int:
    """Levels of a pyramid, the map itself among them: the last has one row or one column."""
    return min(height, width).bit_length()


def level_offset(height: int, width: int, level: int) -> int:
    """Index of a level's first texel in the packed array."""
    return sum(rows * columns for rows, columns in (level_size(height, width, below) for below in range(level)))


def packed_texels(height: int, width: int) -> int:
    """Texels of a whole pyramid."""
    return level_offset(height, width, level_count(height, width))


@wp.func
def safe_channel(value: wp.float32) -> wp.float32:
    """NaN and negative values to 0, infinity and anything beyond ``MAX_RADIANCE`` to that."""
    if value > 0.0:  # false for NaN
        return wp.min(value, MAX_RADIANCE)
    return 0.0


@wp.func
def safe_radiance(radiance: wp.vec3) -> wp.vec3:
    """Radiance that a filter can take: NaN and negative to 0, infinity to ``MAX_RADIANCE``."""
    return wp.vec3(safe_channel(radiance[0]), safe_channel(radiance[1]), safe_channel(radiance[2]))


@wp.func
def sample_packed(
    levels: wp.array[wp.vec3], offset: wp.int32, height: wp.int32, width: wp.int32, row: wp.float32, column: wp.float32
):
    """Bilinear sample of one packed level at continuous coordinates, across the seam and the poles."""
    y = row - 0.5
    x = column - 0.5
    i = wp.int32(wp.floor(y))
    j = wp.int32(wp.floor(x))
    fy = y - wp.float32(i)
    fx = x - wp.float32(j)
    if i >= 0 and i + 1 < height and j >= 0 and j + 1 < width:
        at = offset + i * width + j
        top = levels[at] * (1.0 - fx) + levels[at + 1] * fx
        bottom = levels[at + width] * (1.0 - fx) + levels[at + width + 1] * fx
        return top * (1.0 - fy) + bottom * fy
    t00 = wrap_texel(i, j, height, width)
    t01 = wrap_texel(i, j + 1, height, width)
    t10 = wrap_texel(i + 1, j, height, width)
    t11 = wrap_texel(i + 1, j + 1, height, width)
    top = levels[offset + t00[0] * width + t00[1]] * (1.0 - fx) + levels[offset + t01[0] * width + t01[1]] * fx
    bottom = levels[offset + t10[0] * width + t10[1]] * (1.0 - fx) + levels[offset + t11[0] * width + t11[1]] * fx
    return top * (1.0 - fy) + bottom * fy


@wp.func
def sample_packed_smooth(
    levels: wp.array[wp.vec3], offset: wp.int32, height: wp.int32, width: wp.int32, row: wp.float32, column: wp.float32
):
    """Sample of one packed level through quadratic B-splines: shows no blocks.

    Nine texels, per axis (1/2 - t)^2 / 2, 3/4 - t^2, (1/2 + t)^2 / 2 at offset t from the nearest centre; the variance
    that this adds is a quarter of a texel's width squared, per axis.
    """
    i = wp.int32(wp.floor(row))
    j = wp.int32(wp.floor(column))
    ty = row - wp.float32(i) - 0.5
    tx = column - wp.float32(j) - 0.5
    wy = wp.vec3(0.5 * (0.5 - ty) * (0.5 - ty), 0.75 - ty * ty, 0.5 * (0.5 + ty) * (0.5 + ty))
    wx = wp.vec3(0.5 * (0.5 - tx) * (0.5 - tx), 0.75 - tx * tx, 0.5 * (0.5 + tx) * (0.5 + tx))
    if i >= 1 and i + 1 < height and j >= 1 and j + 1 < width:
        up = offset + (i - 1) * width + j
        at = up + width
        down = at + width
        return (
            (levels[up - 1] * wx[0] + levels[up] * wx[1] + levels[up + 1] * wx[2]) * wy[0]
            + (levels[at - 1] * wx[0] + levels[at] * wx[1] + levels[at + 1] * wx[2]) * wy[1]
            + (levels[down - 1] * wx[0] + levels[down] * wx[1] + levels[down + 1] * wx[2]) * wy[2]
        )
    total = wp.vec3()
    for di in range(3):
        for dj in range(3):
            texel = wrap_texel(i + di - 1, j + dj - 1, height, width)
            total += levels[offset + texel[0] * width + texel[1]] * (wy[di] * wx[dj])
    return total


@wp.func
def sample_pyramid(
    levels: wp.array[wp.vec3], direction: wp.vec3, level: wp.float32, height: wp.int32, width: wp.int32
) -> wp.vec3:
    """Trilinear sample of a pyramid of a (height, width) map; ``level`` is clamped to those that exist."""
    size = wp.min(height, width)
    last = wp.int32(0)
    while (size >> (last + 1)) > 0:
        last += 1
    clamped = wp.clamp(level, 0.0, wp.float32(last))
    below = wp.min(wp.int32(clamped), wp.max(last - 1, 0))
    fraction = clamped - wp.float32(below)
    offset = wp.int32(0)
    for l in range(below):
        offset += (height >> l) * (width >> l)
    h = height >> below
    w = width >> below
    at = latlong_from_direction(direction, height, width)
    v = at[0] / wp.float32(height)
    u = at[1] / wp.float32(width)
    fine = sample_packed(levels, offset, h, w, v * wp.float32(h), u * wp.float32(w))
    if fraction == 0.0:
        return fine
    offset += h * w
    h = height >> (below + 1)
    w = width >> (below + 1)
    coarse = sample_packed(levels, offset, h, w, v * wp.float32(h), u * wp.float32(w))
    return fine * (1.0 - fraction) + coarse * fraction


@wp.kernel(enable_backward=False)
def copy_safe_kernel(
    row_start: wp.int32,
    # In:
    environment: wp.array2d[wp.vec3],
    # Out:
    levels_out: wp.array[wp.vec3],
):
    """Level 0."""
    i, j = wp.tid()
    i += row_start
    levels_out[i * environment.shape[1] + j] = safe_radiance(environment[i, j])


@wp.kernel(enable_backward=False)
def reduce_level_kernel(
    row_start: wp.int32,
    # In:
    source_offset: wp.int32,
    source_height: wp.int32,
    source_width: wp.int32,
    offset: wp.int32,
    height: wp.int32,
    width: wp.int32,
    isotropic: wp.int32,
    # Out (and in: the source level):
    levels_out: wp.array[wp.vec3],
):
    """One texel of a level from the level before it."""
    i, j = wp.tid()
    i += row_start
    # Rows in units of 1 / (source_height * height) of the map's height, columns likewise.
    row_first = i * source_height
    row_last = row_first + source_height
    unit = PI / (wp.float32(source_height) * wp.float32(height))
    column_first = j * source_width
    column_last = column_first + source_width
    if isotropic != 0:
        sin_theta = wp.sin(PI * (wp.float32(i) + 0.5) / wp.float32(height))
        # Variances of boxes add: the source's own, widened already, gives about a quarter of what is wanted.
        wanted = wp.min(1.0 / sin_theta, wp.float32(width))
        wider = wp.sqrt(1.0 + 0.75 * (wanted * wanted - 1.0))
        # Every column must count equally often: boxes of whole texels do, and any symmetric box over pairs of columns.
        half = wp.int32(0.5 * wp.float32(source_width) * (wider - 1.0))
        column_first -= half
        column_last += half
        if source_width != 2 * width:
            column_last = column_first + source_width * wp.int32(wider + 0.5)
    total = wp.vec3()
    total_weight = wp.float32(0.0)
    r = row_first / height
    while r * height < row_last:
        low = wp.max(row_first, r * height)
        high = wp.min(row_last, (r + 1) * height)
        # cos theta0 - cos theta1 as a product: exact near the poles.
        row_weight = wp.sin(0.5 * unit * wp.float32(low + high)) * wp.sin(0.5 * unit * wp.float32(high - low))
        row_total = wp.vec3()
        c = column_first / width
        if column_first < 0 and c * width > column_first:
            c -= 1  # integer division rounds toward zero
        while c * width < column_last:
            overlap = wp.min(column_last, (c + 1) * width) - wp.max(column_first, c * width)
            wrapped = c % source_width
            if wrapped < 0:
                wrapped += source_width
            row_total += levels_out[source_offset + r * source_width + wrapped] * wp.float32(overlap)
            c += 1
        total += row_total * row_weight
        total_weight += row_weight
        r += 1
    levels_out[offset + i * width + j] = total / (total_weight * wp.float32(column_last - column_first))


@wp.kernel(enable_backward=False)
def reduce_latlong_kernel(
    # In:
    radiance: wp.array2d[wp.vec3],
    scale: wp.float32,
    # Out:
    reduced_out: wp.array2d[wp.vec3],
):
    """One texel of a smaller map straight from the whole one."""
    i, j = wp.tid()
    source_height = radiance.shape[0]
    source_width = radiance.shape[1]
    height = reduced_out.shape[0]
    width = reduced_out.shape[1]
    unit = PI / (wp.float32(source_height) * wp.float32(height))
    row_first = i * source_height
    row_last = row_first + source_height
    column_first = j * source_width
    column_last = column_first + source_width
    total = wp.vec3()
    total_weight = wp.float32(0.0)
    r = row_first / height
    while r * height < row_last:
        low = wp.max(row_first, r * height)
        high = wp.min(row_last, (r + 1) * height)
        row_weight = wp.sin(0.5 * unit * wp.float32(low + high)) * wp.sin(0.5 * unit * wp.float32(high - low))
        row_total = wp.vec3()
        c = column_first / width
        while c * width < column_last:
            overlap = wp.min(column_last, (c + 1) * width) - wp.max(column_first, c * width)
            row_total += safe_radiance(radiance[r, c]) * wp.float32(overlap)
            c += 1
        total += row_total * row_weight
        total_weight += row_weight
        r += 1
    reduced_out[i, j] = total * (scale / (total_weight * wp.float32(source_width)))


def copy_safe(environment: wp.array2d[wp.vec3], levels_out: wp.array[wp.vec3], *, rows: Rows | None = None) -> None:
    """Write level 0 of a packed array: the environment with bad texels made safe.

    Args:
        environment: (H, W) radiance.
        levels_out: At least H W texels.
        rows: Band of rows; None means all.
    """
    launch_rows(copy_safe_kernel, environment.shape, [environment], [levels_out], rows=rows, device=environment.device)


def reduce_level(
    height: int,
    width: int,
    level: int,
    levels_out: wp.array[wp.vec3],
    *,
    isotropic: bool = False,
    rows: Rows | None = None,
) -> None:
    """Write one level of a pyramid from the level before it.

    Args:
        height: Rows of level 0.
        width: Columns of level 0.
        level: The level to write, at least 1.
        levels_out: Packed pyramid, (packed_texels(height, width),).
        isotropic: Widen footprints near the poles.
        rows: Band of the level's rows; None means all.
    """
    source = level_size(height, width, level - 1)
    size = level_size(height, width, level)
    inputs = [
        level_offset(height, width, level - 1),
        *source,
        level_offset(height, width, level),
        *size,
        int(isotropic),
    ]
    launch_rows(reduce_level_kernel, size, inputs, [levels_out], rows=rows, device=levels_out.device)


def build_pyramid(environment: wp.array2d[wp.vec3], levels_out: wp.array[wp.vec3], *, isotropic: bool = False) -> None:
    """Write a whole pyramid: one launch per level, each from the one before.

    Args:
        environment: (H, W) radiance, any size.
        levels_out: Packed pyramid, (packed_texels(H, W),).
        isotropic: Widen footprints near the poles.
    """
    height, width = environment.shape
    copy_safe(environment, levels_out)
    for level in range(1, level_count(height, width)):
        reduce_level(height, width, level, levels_out, isotropic=isotropic)


def reduce_latlong(radiance: wp.array2d[wp.vec3], reduced_out: wp.array2d[wp.vec3], *, scale: float = 1.0) -> None:
    """Mean radiance over the texels of a smaller map of any size, times ``scale``.

    Args:
        radiance: (H, W).
        reduced_out: (h, w), h <= H and w <= W.
        scale: Factor on the result.
    """
    wp.launch(
        reduce_latlong_kernel,
        dim=reduced_out.shape,
        inputs=[radiance, scale],
        outputs=[reduced_out],
        device=radiance.device,
    )
