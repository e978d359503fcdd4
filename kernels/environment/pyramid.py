"""Isotropic pyramids of latlong maps: texels hold mean radiance over footprints that are about as wide as high.

A pyramid is one packed ``wp.array[wp.vec3]``: level l has (max(H >> l, 1), max(W >> l, 1)) texels in row-major order
and follows the levels before it. There are ``level_count(H, W)`` levels, down to one row or column. Level 0 is the map
itself after ``safe_radiance``.

A texel of level l is the mean of level l - 1 over the area that it covers. Sizes need not be even: overlaps of texels
are computed in integers (texel i of h spans [i H, (i + 1) H] where texel r of H spans [r h, (r + 1) h]). The solid
angle of an overlap is

    (phi1 - phi0) (cos theta0 - cos theta1),
    cos theta0 - cos theta1 = 2 sin((theta0 + theta1) / 2) sin((theta1 - theta0) / 2).

So every level keeps the energy.

Near the poles a texel of a latlong map is much narrower than high, and a box of texels would blur along meridians only.
To make footprints as wide as high, a texel averages over W' / (w sin theta) columns of the level before it instead of
W' / w, at most over all of them. This additional blur acts within rows, so it moves no energy between rows, and energy
is still kept.

References:
    [AG02] Ashikhmin, Ghosh 2002, Simple Blurry Reflections with Environment Maps.
"""

from __future__ import annotations

import math

import warp as wp

from warp_ar.kernels.latlong import wrap_texel
from warp_ar.kernels.launch import launch, row_launcher
from warp_ar.kernels.safe_math import safe_radiance

wp.set_module_options({"enable_backward": False})

PI = wp.constant(wp.float32(math.pi))


def level_size(height: int, width: int, level: int) -> tuple[int, int]:
    """Return the rows and columns of a level."""
    return max(height >> level, 1), max(width >> level, 1)


def level_count(height: int, width: int) -> int:
    """Return the number of levels, the map itself included; the last has one row or one column."""
    return min(height, width).bit_length()


def level_offset(height: int, width: int, level: int) -> int:
    """Return the index of a level's first texel in the packed array."""
    return sum(rows * columns for rows, columns in (level_size(height, width, below) for below in range(level)))


def packed_texels(height: int, width: int) -> int:
    """Return the number of texels of a pyramid."""
    return level_offset(height, width, level_count(height, width))


@wp.func
def sample_packed(
    levels: wp.array[wp.vec3], offset: wp.int32, height: wp.int32, width: wp.int32, row: wp.float32, column: wp.float32
):
    """Return the bilinear sample of one packed level at continuous coordinates, across seam and poles."""
    y = row - 0.5
    x = column - 0.5
    i = wp.int32(wp.floor(y))
    j = wp.int32(wp.floor(x))
    fy = y - wp.float32(i)
    fx = x - wp.float32(j)
    # The places of the four texels come first, so that the code that reads and mixes them is compiled once. A loop for
    # texels across the border has the same reason.
    above_left = offset + i * width + j
    above_right = above_left + 1
    below_left = above_left + width
    below_right = below_left + 1
    if i < 0 or i + 1 >= height or j < 0 or j + 1 >= width:
        corner = wp.int32(0)
        while corner < 4:
            texel = wrap_texel(i + corner / 2, j + corner % 2, height, width)
            place = offset + texel[0] * width + texel[1]
            if corner == 0:
                above_left = place
            elif corner == 1:
                above_right = place
            elif corner == 2:
                below_left = place
            else:
                below_right = place
            corner += 1
    top = levels[above_left] * (1.0 - fx) + levels[above_right] * fx
    bottom = levels[below_left] * (1.0 - fx) + levels[below_right] * fx
    return top * (1.0 - fy) + bottom * fy


@wp.func
def sample_packed_smooth(
    levels: wp.array[wp.vec3], offset: wp.int32, height: wp.int32, width: wp.int32, row: wp.float32, column: wp.float32
):
    """Return the sample of one packed level through quadratic B-splines, which hide the texel grid.

    Nine texels have the weights (1/2 - t)^2 / 2, 3/4 - t^2, (1/2 + t)^2 / 2 per axis at offset t from the nearest
    centre. Per axis this adds a variance of a quarter of a squared texel width.
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
        texel = wrap_texel(i + di - 1, j - 1, height, width)
        row_offset = offset + texel[0] * width
        middle = texel[1] + 1
        if middle == width:
            middle = 0
        right = middle + 1
        if right == width:
            right = 0
        total += (
            levels[row_offset + texel[1]] * wx[0]
            + levels[row_offset + middle] * wx[1]
            + levels[row_offset + right] * wx[2]
        ) * wy[di]
    return total


@wp.func
def last_mip(height: wp.int32, width: wp.int32) -> wp.int32:
    """Return the index of the last level of a pyramid."""
    size = wp.min(height, width)
    last = wp.int32(0)
    while (size >> (last + 1)) > 0:
        last += 1
    return last


@wp.func
def sample_mips(
    levels: wp.array[wp.vec3],
    v: wp.float32,
    u: wp.float32,
    level: wp.float32,
    last: wp.int32,
    height: wp.int32,
    width: wp.int32,
) -> wp.vec3:
    """Return the trilinear sample of the pyramid of a (height, width) map.

    Args:
        levels: Packed levels.
        v: Row divided by the map's height.
        u: Column divided by the map's width.
        level: Fractional level, clamped to the existing levels.
        last: Result of ``last_mip``, which callers compute once for many samples.
        height: Rows of level 0.
        width: Columns of level 0.
    """
    clamped = wp.clamp(level, 0.0, wp.float32(last))
    below = wp.min(wp.int32(clamped), wp.max(last - 1, 0))
    fraction = clamped - wp.float32(below)
    offset = wp.int32(0)
    for l in range(below):
        offset += (height >> l) * (width >> l)
    h = height >> below
    w = width >> below
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
    """Write one texel of level 0."""
    i, j = wp.tid()
    i += row_start
    levels_out[i * environment.shape[1] + j] = safe_radiance(environment[i, j])


@wp.func
def row_share(low: wp.int32, high: wp.int32, whole: wp.int32) -> wp.float32:
    """Return half of cos theta0 - cos theta1 between two rows, given in units of 1 / whole of the map's height.

    It is a product of sines, with the angle from the nearer pole, so that it is exact near both poles.
    """
    unit = 0.5 * PI / wp.float32(whole)
    middle = wp.min(low + high, 2 * whole - low - high)
    return wp.sin(unit * wp.float32(middle)) * wp.sin(unit * wp.float32(high - low))


@wp.func
def sum_columns(
    levels: wp.array[wp.vec3],
    row_offset: wp.int32,
    source_width: wp.int32,
    width: wp.int32,
    column_first: wp.int32,
    column_last: wp.int32,
) -> wp.vec3:
    """Return the sum of a row's texels weighted by their overlaps with a range of columns.

    Columns and overlaps are integers in units of 1 / width of a texel.
    """
    first = column_first / width
    if first * width > column_first:
        first -= 1  # integer division rounds toward zero
    last = (column_last - 1) / width
    if last * width > column_last - 1:
        last -= 1
    c = first % source_width
    if c < 0:
        c += source_width
    total = levels[row_offset + c] * wp.float32(wp.min(column_last, (first + 1) * width) - column_first)
    if last > first:
        inner = wp.vec3()
        for _ in range(last - first - 1):
            c += 1
            if c == source_width:
                c = 0
            inner += levels[row_offset + c]
        total += inner * wp.float32(width)
        c += 1
        if c == source_width:
            c = 0
        total += levels[row_offset + c] * wp.float32(column_last - last * width)
    return total


# A footprint that is as wide as high needs a box of w = 1 / sin theta times the texel's own width. A texel of the
# source level is half as wide and was averaged over w times its own width already, which adds (w^2 - 1) / 4 to the
# squared width, in units of a target texel. So the box taken here has the squared width
# w^2 - (w^2 - 1) / 4 = 1 + 3/4 (w^2 - 1).
@wp.func
def reduce_texel(
    levels: wp.array[wp.vec3],
    source_offset: wp.int32,
    source_height: wp.int32,
    source_width: wp.int32,
    height: wp.int32,
    width: wp.int32,
    i: wp.int32,
    j: wp.int32,
) -> wp.vec3:
    """Return texel (i, j) of a (height, width) level, averaged from the level before it."""
    # Rows in units of 1 / (source_height * height) of the map's height, columns likewise.
    row_first = i * source_height
    row_last = row_first + source_height
    column_first = j * source_width
    column_last = column_first + source_width
    sin_theta = wp.sin(PI * (wp.float32(i) + 0.5) / wp.float32(height))
    # Variances of boxes add: the source's own widening gives about a quarter of the wanted one.
    wanted = wp.min(1.0 / sin_theta, wp.float32(width))
    wider = wp.sqrt(1.0 + 0.75 * (wanted * wanted - 1.0))
    # The total weight of every source column must be equal. This holds for boxes of whole texels, and for any symmetric
    # box over pairs of columns.
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
        row_weight = row_share(low, high, source_height * height)
        row_offset = source_offset + r * source_width
        total += sum_columns(levels, row_offset, source_width, width, column_first, column_last) * row_weight
        total_weight += row_weight
        r += 1
    return total / (total_weight * wp.float32(column_last - column_first))


@wp.kernel(enable_backward=False)
def reduce_level_kernel(
    # In:
    source_offset: wp.int32,
    source_height: wp.int32,
    source_width: wp.int32,
    height: wp.int32,
    width: wp.int32,
    # Out:
    levels_out: wp.array[wp.vec3],
):
    """Write one texel of a level, which follows the level before it in the packed array."""
    i, j = wp.tid()
    offset = source_offset + source_height * source_width
    levels_out[offset + i * width + j] = reduce_texel(
        levels_out, source_offset, source_height, source_width, height, width, i, j
    )


@wp.kernel(enable_backward=False)
def reduce_latlong_kernel(
    # In:
    radiance: wp.array2d[wp.vec3],
    scale: wp.float32,
    # Out:
    reduced_out: wp.array2d[wp.vec3],
):
    """Write one texel of a smaller map as the mean of the texels that it covers."""
    i, j = wp.tid()
    source_height = radiance.shape[0]
    source_width = radiance.shape[1]
    height = reduced_out.shape[0]
    width = reduced_out.shape[1]
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
        row_weight = row_share(low, high, source_height * height)
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


copy_safe = row_launcher(copy_safe_kernel, like=lambda environment, _: environment)
"""Write level 0 of a packed array: the environment with bad texels made safe.

Args:
    environment: Radiance, (H, W).
    levels_out: Packed array of at least H W texels.
"""


def build_pyramid(environment: wp.array2d[wp.vec3], levels_out: wp.array[wp.vec3]) -> None:
    """Write a whole pyramid, each level from the level before it.

    Args:
        environment: Radiance, (H, W), of any size.
        levels_out: Packed pyramid, (packed_texels(H, W),).
    """
    copy_safe(environment, levels_out)
    for level in range(1, level_count(*environment.shape)):
        source, shape = level_size(*environment.shape, level - 1), level_size(*environment.shape, level)
        inputs = [level_offset(*environment.shape, level - 1), *source, *shape]
        launch(reduce_level_kernel, shape, inputs, [levels_out])


def reduce_latlong(radiance: wp.array2d[wp.vec3], reduced_out: wp.array2d[wp.vec3], *, scale: float = 1.0) -> None:
    """Write the mean radiance over each texel of a smaller map of any size, times ``scale``.

    Args:
        radiance: Radiance, (H, W).
        reduced_out: Smaller map, (h, w) with h <= H and w <= W.
        scale: Factor on the result.
    """
    launch(reduce_latlong_kernel, dim=reduced_out.shape, inputs=[radiance, scale], outputs=[reduced_out])
