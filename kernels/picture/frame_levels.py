"""Mip levels of the camera's frame, and look-ups filtered over the footprint of a reflected ray.

One pixel of a curved mirror shows many pixels of the frame. If each of its few rays read a single point, fine texture
of the receiver would become moiré, and flicker in motion. So a ray carries its differentials: the change of its origin
O and direction D over the part of the pixel that it stands for [Ige99]. On a surface of normal n at distance t its
footprint along each of two axes is

    dP = dO + t dD + dt D,    dt = -(dO + t dD).n / D.n,

which the camera projects to the vectors A and B in the frame. The ellipse of the matrix A A' + B B' is sampled at up to
``MOST_TAPS`` points along its longer axis. Each sample is as wide as the shorter axis, or as its part of the longer
axis if that is wider, and is interpolated between the two levels nearest to that width.

A texel of level l is the mean of 2^l x 2^l pixels, or of those that there are at the border. Levels hold the frame with
virtual shadows and virtual light, as mirrors reflect it.

References:
    [Ige99] Igehy 1999, Tracing Ray Differentials.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.launch import row_launcher
from warp_ar.kernels.pixels import shown_radiance
from warp_ar.kernels.rays.visibility import inside_rect
from warp_ar.kernels.structs import FrameParams, Picture

wp.set_module_options({"enable_backward": False})

LAST_LEVEL = 6
"""Coarsest level; its texels are as wide as 64 pixels."""
LAST = wp.constant(wp.int32(LAST_LEVEL))
MOST_TAPS = wp.constant(wp.int32(4))
"""Largest number of samples along the longer axis of a ray's footprint."""
LEAST_COSINE = wp.constant(wp.float32(0.02))
"""Least cosine between ray and normal, to bound the footprint of a grazing ray."""


@wp.struct
class ReceiverLayers:
    """Changes of the receiver in the frame by virtual objects and lights; layers that the scene lacks are empty."""

    shadow_ratio: wp.array2d[wp.vec3]  # factor on the frame
    added: wp.array2d[wp.vec3]  # radiance of virtual light
    levels: wp.array[wp.vec3]  # from ``shrink_frame`` and ``shrink_level``; empty without mirrors


@wp.struct
class Footprint:
    """Ray differentials: change of a ray over the part of a pixel that it stands for, along two axes."""

    origin_x: wp.vec3  # change of the origin, metres
    origin_y: wp.vec3
    turn_x: wp.vec3  # change of the unit direction
    turn_y: wp.vec3


def level_size(height: int, width: int, level: int) -> tuple[int, int]:
    """Return the rows and columns of a level, for a frame of ``height`` x ``width`` pixels."""
    return -(-height >> level), -(-width >> level)


def level_offset(height: int, width: int, level: int) -> int:
    """Return the index of a level's first texel in the array of levels, which begins with level 1."""
    return sum(rows * columns for rows, columns in (level_size(height, width, one) for one in range(1, level)))


def level_texels(height: int, width: int) -> int:
    """Return the number of texels of levels 1 to ``LAST_LEVEL``."""
    return level_offset(height, width, LAST_LEVEL + 1)


@wp.func
def rows_of(extent: wp.int32, level: wp.int32) -> wp.int32:
    """Return the rows (or columns) of a level, for a frame of ``extent`` rows (or columns)."""
    return (extent + (1 << level) - 1) >> level


@wp.func
def start_of(height: wp.int32, width: wp.int32, level: wp.int32) -> wp.int32:
    """Return the index of a level's first texel: ``level_offset`` for use in kernels."""
    start = wp.int32(0)
    for below in range(1, level):
        start += rows_of(height, below) * rows_of(width, below)
    return start


@wp.func
def composed_radiance(
    params: FrameParams, picture: Picture, layers: ReceiverLayers, i: wp.int32, j: wp.int32
) -> wp.vec3:
    """Return a pixel's radiance with virtual shadows and virtual light."""
    radiance = shown_radiance(picture, i, j)
    if layers.shadow_ratio.shape[0] > 0:
        radiance = wp.cw_mul(radiance, layers.shadow_ratio[i, j])
    if layers.added.shape[0] > 0:
        if inside_rect(i, j, params.light_rect):
            radiance += layers.added[i, j]
    return radiance


@wp.kernel(enable_backward=False)
def shrink_frame_kernel(
    row_start: wp.int32,
    # In:
    params: wp.array[FrameParams],
    picture: Picture,
    layers: ReceiverLayers,
    # Out:
    levels_out: wp.array[wp.vec3],
):
    """Write a texel of level 1: the mean of 2 x 2 pixels of the frame with virtual shadows and light."""
    i, j = wp.tid()
    i += row_start
    height = picture.rays.shape[0]
    width = picture.rays.shape[1]
    total = wp.vec3(0.0)
    pixels = float(0.0)
    for y in range(2 * i, wp.min(2 * i + 2, height)):
        for x in range(2 * j, wp.min(2 * j + 2, width)):
            total += composed_radiance(params[0], picture, layers, y, x)
            pixels += 1.0
    levels_out[i * rows_of(width, 1) + j] = total / pixels


@wp.func
def pixels_of(extent: wp.int32, level: wp.int32, index: wp.int32) -> wp.float32:
    """Return the number of pixels that texel ``index`` of a level covers along an axis of ``extent`` pixels."""
    return wp.float32(wp.min((index + 1) << level, extent) - (index << level))


@wp.kernel(enable_backward=False)
def shrink_level_kernel(
    row_start: wp.int32,
    # In:
    height: wp.int32,
    width: wp.int32,
    level: wp.int32,
    # Out:
    levels_out: wp.array[wp.vec3],
):
    """Write a texel of ``level``, the mean of its texels of the next finer level."""
    i, j = wp.tid()
    i += row_start
    start = start_of(height, width, level - 1)
    columns = rows_of(width, level - 1)
    total = wp.vec3(0.0)
    pixels = float(0.0)
    for y in range(2 * i, wp.min(2 * i + 2, rows_of(height, level - 1))):
        for x in range(2 * j, wp.min(2 * j + 2, columns)):
            count = pixels_of(height, level - 1, y) * pixels_of(width, level - 1, x)
            total += count * levels_out[start + y * columns + x]
            pixels += count
    levels_out[start_of(height, width, level) + i * rows_of(width, level) + j] = total / pixels


shrink_frame = row_launcher(shrink_frame_kernel, like=lambda params, picture, *_: level_size(*picture.rays.shape, 1))
"""Write level 1 of the mip levels of the frame with virtual shadows and virtual light.

Args:
    params: (1,) FrameParams: light_rect, beyond which no virtual light is added.
    picture: (H, W) the camera's frame.
    layers: (H, W) virtual shadows and virtual light on the receiver.
    levels_out: (level_texels(H, W),) vec3, linear radiance in camera values.
"""


shrink_level = row_launcher(shrink_level_kernel, like=lambda height, width, level, _: level_size(height, width, level))
"""Write one of the levels 2 to ``LAST_LEVEL`` from the next finer level.

Args:
    height: Rows of the frame.
    width: Columns of the frame.
    level: Number of the level.
    levels_out: All levels, packed, (level_texels(H, W),) vec3; the finer level is read.
"""


@wp.func
def sample_frame_level(
    params: FrameParams, picture: Picture, layers: ReceiverLayers, x: wp.float32, y: wp.float32, level: wp.int32
) -> wp.vec3:
    """Sample a level bilinearly at (x, y), pixels of the frame, clamped at the border."""
    height = picture.rays.shape[0]
    width = picture.rays.shape[1]
    rows = rows_of(height, level)
    columns = rows_of(width, level)
    scale = 1.0 / wp.float32(1 << level)
    u = wp.clamp((x + 0.5) * scale - 0.5, 0.0, wp.float32(columns - 1))
    v = wp.clamp((y + 0.5) * scale - 0.5, 0.0, wp.float32(rows - 1))
    j = wp.max(wp.min(wp.int32(u), columns - 2), 0)
    i = wp.max(wp.min(wp.int32(v), rows - 2), 0)
    fx = u - wp.float32(j)
    fy = v - wp.float32(i)
    start = start_of(height, width, level)
    total = wp.vec3(0.0)
    for corner in range(4):
        a = corner / 2
        b = corner % 2
        weight = wp.where(a == 1, fy, 1.0 - fy) * wp.where(b == 1, fx, 1.0 - fx)
        if weight > 0.0:
            if level == 0:
                total += weight * composed_radiance(params, picture, layers, i + a, j + b)
            else:
                total += weight * layers.levels[start + (i + a) * columns + j + b]
    return total


@wp.func
def look_up_level(
    params: FrameParams, picture: Picture, layers: ReceiverLayers, at: wp.vec2, size: wp.float32
) -> wp.vec3:
    """Sample the picture over a width of ``size`` pixels around a point, interpolated between two levels."""
    level = wp.clamp(wp.log2(wp.max(size, 1.0)), 0.0, wp.float32(LAST))
    below = wp.min(wp.int32(level), LAST - 1)
    fraction = level - wp.float32(below)
    # A loop over the two levels, so that the code that reads a level is compiled once.
    last = wp.where(fraction > 0.0, below + 1, below)
    radiance = wp.vec3(0.0)
    for one in range(below, last + 1):
        sampled = sample_frame_level(params, picture, layers, at[0], at[1], one)
        radiance = wp.where(one == below, sampled, radiance + fraction * (sampled - radiance))
    return radiance


@wp.func
def covered_on(origin: wp.vec3, turn: wp.vec3, t: wp.float32, direction: wp.vec3, normal: wp.vec3) -> wp.vec3:
    """Return the ray differential dP, metres, on a surface at distance t, for a step along one image axis.

    ``origin`` and ``turn`` are the changes of the ray's origin and direction over that step.
    """
    moved = origin + t * turn
    cosine = wp.dot(direction, normal)
    cosine = wp.where(cosine < 0.0, wp.min(cosine, -LEAST_COSINE), wp.max(cosine, LEAST_COSINE))
    return moved - (wp.dot(moved, normal) / cosine) * direction


@wp.func
def shown_as(params: FrameParams, from_camera: wp.vec3, change: wp.vec3) -> wp.vec2:
    """Return the shift in the image, (x, y) pixels, of a point that moves by ``change``, without lens distortion.

    ``from_camera`` leads from the camera to the point; both are in world axes, metres.
    """
    p = wp.transpose(params.world_from_camera) * from_camera
    d = wp.transpose(params.world_from_camera) * change
    z = wp.max(p[2], 1.0e-6)
    return wp.vec2(params.focal[0] * (d[0] - d[2] * p[0] / z) / z, params.focal[1] * (d[1] - d[2] * p[1] / z) / z)


# A A' + B B' is a symmetric matrix of two rows, whose eigenvalues are the squares of the ellipse's half axes:
# (xx + yy) / 2 +- sqrt((xx - yy)^2 / 4 + xy^2).
@wp.func
def look_up_covered(
    params: FrameParams, picture: Picture, layers: ReceiverLayers, at: wp.vec2, a: wp.vec2, b: wp.vec2
) -> wp.vec3:
    """Return the picture's mean radiance over an ellipse around the point ``at``, pixels.

    ``a`` and ``b``, pixels, are the footprint's vectors A and B.
    """
    xx = a[0] * a[0] + b[0] * b[0]
    yy = a[1] * a[1] + b[1] * b[1]
    xy = a[0] * a[1] + b[0] * b[1]
    middle = 0.5 * (xx + yy)
    apart = wp.sqrt(0.25 * (xx - yy) * (xx - yy) + xy * xy)
    longer = wp.sqrt(middle + apart)
    # A footprint narrower than a pixel gives one sample of width 1, which reads level 0 alone.
    shorter = wp.max(wp.sqrt(wp.max(middle - apart, 0.0)), 1.0)
    taps = wp.clamp(wp.int32(wp.ceil(wp.min(longer / shorter, wp.float32(MOST_TAPS)))), 1, MOST_TAPS)
    # Eigenvector of the larger eigenvalue; of two forms, the one without cancellation.
    axis = wp.vec2(1.0, 0.0)
    if apart > 0.0:
        axis = wp.where(xx >= yy, wp.vec2(0.5 * (xx - yy) + apart, xy), wp.vec2(xy, 0.5 * (yy - xx) + apart))
        axis = wp.normalize(axis)
    step = wp.min(longer, 64.0 * wp.float32(MOST_TAPS)) / wp.float32(taps)
    size = wp.max(shorter, step)
    total = wp.vec3(0.0)
    for tap in range(taps):
        place = at + (step * (wp.float32(tap) - 0.5 * wp.float32(taps - 1))) * axis
        total += look_up_level(params, picture, layers, place, size)
    return total / wp.float32(taps)
