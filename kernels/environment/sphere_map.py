"""Sphere map: the mirror ball's picture as a texture, filtered and looked up as in [DH04] sections 3.1 and 3.2.

The square of the frame around the ball's outline is copied into a texture, whose corners hold the background. Mip
levels are box-filtered with the corners included: "the background pixels are blended in, subtly changing the color at
silhouette edges". The light from a direction d, in eye coordinates (x right, y up, z toward the viewer), is looked up
by OpenGL's sphere mapping, which assumes that viewer and light are infinitely far and that the ball lies on the
camera's axis:

    m = 2 sqrt(d_x^2 + d_y^2 + (d_z + 1)^2),   (s, t) = (d_x, d_y) / m + 1/2.

This is the point whose normal bisects the angle between d and the viewer. Values are not divided by the ball's
reflectance, because "the acquired environment map can be used as is". The method ``area`` of the stage ``unwrap`` is
exact where this one is approximate.

References:
    [DH04] DiVerdi, Hoellerer, "Combining Dynamic Physical and Virtual Illumination in Augmented Reality", 2004.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.camera import project
from warp_ar.kernels.color import is_clipped
from warp_ar.kernels.environment.unwrap import mix
from warp_ar.kernels.latlong import direction_from_latlong
from warp_ar.kernels.launch import Rows, launch, launch_rows, row_launcher
from warp_ar.kernels.pixels import clip_levels, is_at_clipping, pixel_radiance
from warp_ar.kernels.structs import FrameParams, Probe

wp.set_module_options({"enable_backward": False})

SIZE = 64
"""Side of the texture, a power of two, texels: about the diameter of the ball in the bundled clips, in pixels."""
_SIZE = wp.constant(SIZE)
DIFFUSE_SIZE = 4
"""Side of the level used for diffuse light, texels: the smallest level that still separates all directions."""


def glossy_level(lobe: int, lobes: int) -> int:
    """Return the mip level used for lobe number ``lobe`` of ``lobes``, whose width alpha is 2^(lobe - (lobes - 1)).

    The mirror and lobes narrower than a texel use level 0; the widest lobe uses the level of 2x2 texels.
    """
    return 0 if lobe == 0 else max(SIZE.bit_length() - 2 - (lobes - 1 - lobe), 0)


def level_count() -> int:
    """Return the number of levels, down to one texel."""
    return SIZE.bit_length()


def level_size(level: int) -> int:
    """Return the side of a level, texels; 1 for levels after the last."""
    return max(SIZE >> level, 1)


def level_offset(level: int) -> int:
    """Return the index of a level's first texel."""
    return sum(level_size(below) ** 2 for below in range(level))


def map_texels() -> int:
    """Return the number of texels of all levels."""
    return level_offset(level_count())


@wp.struct
class Disc:
    """Outline of the ball in the frame."""

    center: wp.vec2  # column and row
    radius: wp.vec2  # horizontal and vertical, pixels; 0 if the ball is not in front of the camera


@wp.func
def find_disc(camera: FrameParams, probe: Probe) -> Disc:
    """Return the outline of a ball as if it lay on the camera's axis: a circle of the ball's angular radius."""
    disc = Disc()
    from_camera = probe.center - camera.camera_position
    pixel = project(camera, from_camera)
    beyond = wp.dot(from_camera, from_camera) - probe.radius * probe.radius
    if pixel[2] > 0.0 and beyond > 0.0:
        disc.center = wp.vec2(pixel[0], pixel[1])
        disc.radius = camera.focal * (probe.radius / wp.sqrt(beyond))
    return disc


@wp.func
def sphere_coordinates(world_from_camera: wp.mat33, direction: wp.vec3) -> wp.vec2:
    """Return the texture coordinates, -1..1 across the ball (columns, rows), of the light from a world direction."""
    d = wp.transpose(world_from_camera) * direction
    # The camera looks along +z here, so the viewer is at -z; rows grow downward, against the eye's y.
    normal = wp.vec3(d[0], d[1], d[2] - 1.0)
    length = wp.length(normal)
    if length < 1.0e-6:
        return wp.vec2(1.0, 0.0)  # light from straight behind the ball is seen along the whole outline; take one point
    return wp.vec2(normal[0] / length, normal[1] / length)


@wp.kernel(enable_backward=False)
def copy_ball_kernel(
    row_start: wp.int32,
    # In:
    params: wp.array[FrameParams],
    probes: wp.array[Probe],
    frame: wp.array2d[wp.vec3ub],
    decode_table: wp.array[wp.vec3],
    linear: wp.array2d[wp.vec3],
    # Out:
    sphere_map_out: wp.array[wp.vec3],
):
    """Sample the frame bilinearly at one texel centre of level 0; the frame's border pixels continue outside it."""
    band_row, column = wp.tid()
    row = row_start + band_row
    disc = find_disc(params[0], probes[0])
    value = wp.vec3(0.0, 0.0, 0.0)
    if disc.radius[0] > 0.0:
        u = (2.0 * wp.float32(column) + 1.0) / wp.float32(_SIZE) - 1.0
        v = (2.0 * wp.float32(row) + 1.0) / wp.float32(_SIZE) - 1.0
        x = wp.clamp(disc.center[0] + u * disc.radius[0], 0.0, wp.float32(frame.shape[1] - 1))
        y = wp.clamp(disc.center[1] + v * disc.radius[1], 0.0, wp.float32(frame.shape[0] - 1))
        i = wp.int32(y)
        j = wp.int32(x)
        i1 = wp.min(i + 1, frame.shape[0] - 1)
        j1 = wp.min(j + 1, frame.shape[1] - 1)
        fx = x - wp.float32(j)
        left = pixel_radiance(frame, decode_table, linear, i, j)
        top = mix(left, pixel_radiance(frame, decode_table, linear, i, j1), fx)
        left = pixel_radiance(frame, decode_table, linear, i1, j)
        bottom = mix(left, pixel_radiance(frame, decode_table, linear, i1, j1), fx)
        value = mix(top, bottom, y - wp.float32(i))
    sphere_map_out[row * _SIZE + column] = value


@wp.kernel(enable_backward=False)
def halve_level_kernel(
    # In:
    above: wp.int32,
    here: wp.int32,
    size: wp.int32,
    # Out:
    sphere_map_out: wp.array[wp.vec3],
):
    """Average four texels of the finer level, which begins at ``above``, to one texel of a level."""
    i, j = wp.tid()
    first = above + 4 * i * size + 2 * j
    below = first + 2 * size
    left = mix(sphere_map_out[first], sphere_map_out[below], 0.5)
    right = mix(sphere_map_out[first + 1], sphere_map_out[below + 1], 0.5)
    sphere_map_out[here + i * size + j] = mix(left, right, 0.5)


@wp.func
def sample_level(sphere_map: wp.array[wp.vec3], offset: wp.int32, size: wp.int32, at: wp.vec2) -> wp.vec3:
    """Return the bilinear sample of a level at coordinates in -1..1; border texels continue outside."""
    last = wp.float32(size - 1)
    x = wp.clamp(0.5 * (at[0] + 1.0) * wp.float32(size) - 0.5, 0.0, last)
    y = wp.clamp(0.5 * (at[1] + 1.0) * wp.float32(size) - 0.5, 0.0, last)
    i = wp.int32(y)
    j = wp.int32(x)
    i1 = wp.min(i + 1, size - 1)
    j1 = wp.min(j + 1, size - 1)
    fx = x - wp.float32(j)
    top = mix(sphere_map[offset + i * size + j], sphere_map[offset + i * size + j1], fx)
    bottom = mix(sphere_map[offset + i1 * size + j], sphere_map[offset + i1 * size + j1], fx)
    return mix(top, bottom, y - wp.float32(i))


@wp.kernel(enable_backward=False)
def look_up_level_kernel(
    row_start: wp.int32,
    # In:
    params: wp.array[FrameParams],
    sphere_map: wp.array[wp.vec3],
    offset: wp.int32,
    size: wp.int32,
    height: wp.int32,
    width: wp.int32,
    scale: wp.float32,
    first: wp.int32,
    # Out:
    latlong_out: wp.array[wp.vec3],
):
    """Write one texel of a latlong map, which begins at ``first``, from a level of the sphere map."""
    band_row, column = wp.tid()
    row = row_start + band_row
    light = direction_from_latlong(wp.float32(row) + 0.5, wp.float32(column) + 0.5, height, width)
    at = sphere_coordinates(params[0].world_from_camera, light)
    latlong_out[first + row * width + column] = scale * sample_level(sphere_map, offset, size, at)


@wp.kernel(enable_backward=False)
def trust_ball_kernel(
    row_start: wp.int32,
    # In:
    params: wp.array[FrameParams],
    probes: wp.array[Probe],
    frame: wp.array2d[wp.vec3ub],
    linear: wp.array2d[wp.vec3],
    linear_clip: wp.array[wp.vec3],
    # Out:
    confidence_out: wp.array2d[wp.float32],
    clipped_out: wp.array2d[wp.vec3],
):
    """Write one texel's confidence, 1 if the ball is in front of the camera, and the clipped channels of its pixel."""
    band_row, column = wp.tid()
    row = row_start + band_row
    disc = find_disc(params[0], probes[0])
    confidence = wp.float32(0.0)
    clipped = wp.vec3(0.0, 0.0, 0.0)
    if disc.radius[0] > 0.0:
        confidence = wp.float32(1.0)
        height = confidence_out.shape[0]
        width = confidence_out.shape[1]
        light = direction_from_latlong(wp.float32(row) + 0.5, wp.float32(column) + 0.5, height, width)
        at = sphere_coordinates(params[0].world_from_camera, light)
        x = wp.clamp(disc.center[0] + at[0] * disc.radius[0], 0.0, wp.float32(frame.shape[1] - 1))
        y = wp.clamp(disc.center[1] + at[1] * disc.radius[1], 0.0, wp.float32(frame.shape[0] - 1))
        i = wp.int32(wp.round(y))
        j = wp.int32(wp.round(x))
        if linear.shape[0] > 0:
            clipped = is_at_clipping(linear[i, j], clip_levels(linear_clip))
        else:
            clipped = is_clipped(frame[i, j])
    confidence_out[row, column] = confidence
    clipped_out[row, column] = clipped


copy_ball = row_launcher(copy_ball_kernel, like=lambda *_: (SIZE, SIZE))
"""Copy the first ball's square of the frame into level 0 of a sphere map.

Args:
    params: (1,) FrameParams: the camera.
    probes: (P,) Probe; only the first is used.
    frame: (H, W) vec3ub, RGB codes.
    decode_table: (256,) vec3, linear value of each code.
    linear: (H, W) vec3, radiance of a frame of more than 8 bits, read instead of its codes; else empty.
    sphere_map_out: (map_texels(),) vec3; ``SIZE`` squared texels are written, zeros if the ball is not in front of the
        camera.
"""


def halve_levels(sphere_map: wp.array) -> None:
    """Fill all levels but the first, in place: each texel is the mean of four texels of the finer level.

    Args:
        sphere_map: (map_texels(),) vec3, with level 0 written by ``copy_ball``.
    """
    for level in range(1, level_count()):
        size = level_size(level)
        inputs = [level_offset(level - 1), level_offset(level), size]
        launch(halve_level_kernel, (size, size), inputs, [sphere_map])


def look_up_level(
    params: wp.array,
    sphere_map: wp.array,
    level: int,
    shape: tuple[int, int],
    latlong_out: wp.array,
    *,
    first: int = 0,
    scale: float = 1.0,
    rows: Rows | None = None,
) -> None:
    """Write a latlong map of the light from every direction, sampled from one level.

    Args:
        params: (1,) FrameParams: the camera's rotation.
        sphere_map: (map_texels(),) vec3, all levels.
        level: Number of the level; larger numbers mean the last level.
        shape: Rows and columns of the latlong map.
        latlong_out: Flat array of vec3 with at least ``first + rows * columns`` texels.
        first: Index of the map's first texel.
        scale: Factor on every texel.
        rows: Band of rows of the map; None means all.
    """
    level = min(level, level_count() - 1)
    inputs = [params, sphere_map, level_offset(level), level_size(level), *shape, scale, first]
    launch_rows(look_up_level_kernel, shape, inputs, [latlong_out], rows=rows)


trust_ball = row_launcher(trust_ball_kernel, outputs=2)
"""Write the confidence and the clipped channels of a sphere map for every direction of a latlong map.

Args:
    params: (1,) FrameParams: the camera.
    probes: (P,) Probe; only the first is used.
    frame: (H, W) vec3ub, RGB codes.
    linear: (H, W) vec3, radiance of a frame of more than 8 bits, read instead of its codes; else empty.
    linear_clip: (2,) vec3, radiance from which a channel of ``linear`` counts as clipped: alone, and if another
        channel of the pixel is clipped.
    confidence_out: (h, 2 h) float32: 1, or 0 if the ball is not in front of the camera.
    clipped_out: (h, 2 h) vec3: 1 in each clipped channel of the nearest pixel.
"""
