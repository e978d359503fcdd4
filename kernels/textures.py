"""Textures: packed texels with mip levels, samplers, and selection of levels by the footprint of a pixel.

Texels are RGBA of 8 bits in one array, level after level, texture after texture; a table maps codes to linear values.
The level is chosen by the width of the ray cone at the surface [AMNMW19]: a pixel of angle s covers the length
s t / cos of the surface, and a texel of level l the length 2^l / (density size), so

    l = log2(s t / cos * density * size).

Because of the division by the cosine, the level is that of the footprint's long axis: textures do not shimmer, but blur
at grazing angles.

References:
    [AMNMW19] Akenine-Moeller et al., "Texture Level of Detail Strategies for Real-Time Ray Tracing", Ray Tracing Gems
    ch. 20, 2019.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.structs import CLAMP, MIRRORED, RayScene, Texture

wp.set_module_options({"enable_backward": False})

# Least cosine by which a footprint is divided: 16 texels along one axis for one along the other.
MIN_SLANT = wp.constant(wp.float32(1.0 / 16.0))


@wp.struct
class SurfacePoint:
    """Point at which a ray meets a surface, with the data for texture look-ups."""

    uv: wp.vec2
    uv_second: wp.vec2
    color: wp.vec4  # factor of the base colour and of alpha
    width: wp.float32  # of the footprint in metres, along its long axis
    density: wp.vec2  # texture coordinates per metre, of both sets


@wp.func
def wrap_texel(index: wp.int32, size: wp.int32, mode: wp.int32) -> wp.int32:
    """Return the index of the texel that continues a texture at ``index``, by the mode of its border."""
    if mode == CLAMP:
        return wp.clamp(index, 0, size - 1)
    period = wp.where(mode == MIRRORED, 2 * size, size)
    k = index % period
    if k < 0:
        k += period
    return wp.where(k < size, k, period - 1 - k)


@wp.func
def wrap_coordinate(u: wp.float32, mode: wp.int32) -> wp.float32:
    """Return a coordinate near 0..1 at which the texture has its value at ``u``: indices of texels lose no digits."""
    if mode == CLAMP:
        return wp.clamp(u, -1.0, 2.0)
    if mode == MIRRORED:
        return u - 2.0 * wp.floor(0.5 * u)
    return u - wp.floor(u)


@wp.func
def fetch_texel(scene: RayScene, texture: Texture, index: wp.int32) -> wp.vec4:
    """Return the linear RGBA of a texel."""
    code = scene.texels[index]
    red = wp.int32(code & wp.uint32(255))
    green = wp.int32((code >> wp.uint32(8)) & wp.uint32(255))
    blue = wp.int32((code >> wp.uint32(16)) & wp.uint32(255))
    alpha = wp.int32(code >> wp.uint32(24))
    table = scene.decode_table
    first = texture.decode
    return wp.vec4(table[first + red], table[first + green], table[first + blue], table[alpha])


@wp.func
def sample_level(scene: RayScene, texture: Texture, uv: wp.vec2, level: wp.int32, nearest: wp.bool) -> wp.vec4:
    """Sample one level bilinearly; v points up in the image, texel centres lie at half-integers."""
    width = texture.width
    height = texture.height
    offset = texture.offset
    for _k in range(level):
        offset += width * height
        width = wp.max(width / 2, 1)
        height = wp.max(height / 2, 1)
    x = uv[0] * wp.float32(width)
    y = (1.0 - uv[1]) * wp.float32(height)
    taps = wp.int32(4)  # a variable: the loop is not unrolled, and kernels stay small
    fx = float(0.0)
    fy = float(0.0)
    if nearest:
        taps = 1
    else:
        x -= 0.5
        y -= 0.5
        fx = x - wp.floor(x)
        fy = y - wp.floor(y)
    left = wp.int32(wp.floor(x))
    top = wp.int32(wp.floor(y))
    total = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for tap in range(taps):
        right = tap % 2
        lower = tap / 2
        column = wrap_texel(left + right, width, texture.wrap_u)
        row = wrap_texel(top + lower, height, texture.wrap_v)
        weight = wp.where(right == 0, 1.0 - fx, fx) * wp.where(lower == 0, 1.0 - fy, fy)
        total += weight * fetch_texel(scene, texture, offset + row * width + column)
    return total


@wp.func
def sample_texture(scene: RayScene, index: wp.int32, point: SurfacePoint) -> wp.vec4:
    """Return the linear RGBA of a texture at a point, interpolated between the two levels nearest to its footprint."""
    texture = scene.textures[index]
    given = point.uv
    density = point.density[0]
    if texture.uv_set != 0:
        given = point.uv_second
        density = point.density[1]
    one = wp.vec3(given[0], given[1], 1.0)
    uv = wp.vec2(
        wrap_coordinate(wp.dot(texture.row_u, one), texture.wrap_u),
        wrap_coordinate(wp.dot(texture.row_v, one), texture.wrap_v),
    )
    texels = point.width * density * texture.size
    level = float(0.0)
    if texels > 1.0:
        level = wp.min(wp.log2(texels), wp.float32(texture.levels - 1))
    lower = wp.int32(level)
    share = level - wp.float32(lower)
    count = wp.where(share > 0.0, 2, 1)
    result = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for k in range(count):
        weight = wp.where(k == 0, 1.0 - share, share)
        result += weight * sample_level(scene, texture, uv, lower + k, texture.nearest != 0 and level == 0.0)
    return result


@wp.func
def point_of_triangle(
    scene: RayScene, corner: wp.int32, weights: wp.vec2, uv: wp.vec2, width: wp.float32, scale: wp.float32
) -> SurfacePoint:
    """Return a point of a mesh, with vertex data interpolated; ``scale`` is the shape's, ``width`` in metres."""
    point = SurfacePoint()
    point.uv = uv
    point.color = wp.vec4(1.0, 1.0, 1.0, 1.0)
    point.width = width
    w = 1.0 - weights[0] - weights[1]
    if scene.vertex_uvs_second.shape[0] > 0:
        uvs = scene.vertex_uvs_second
        point.uv_second = weights[0] * uvs[corner] + weights[1] * uvs[corner + 1] + w * uvs[corner + 2]
    if scene.vertex_colors.shape[0] > 0:
        colors = scene.vertex_colors
        point.color = weights[0] * colors[corner] + weights[1] * colors[corner + 1] + w * colors[corner + 2]
    if scene.triangle_density.shape[0] > 0:
        point.density = scene.triangle_density[corner / 3] / scale
    return point


@wp.func
def slant(cosine: wp.float32) -> wp.float32:
    """Return the factor by which a footprint is lengthened by the cosine between ray and normal."""
    return 1.0 / wp.max(wp.abs(cosine), MIN_SLANT)
