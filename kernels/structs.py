"""Structures that stages share. What may change from frame to frame lives in the arrays of ``FrameBlock``.

Lengths are metres in the world (marker) frame, angles radians, colours linear RGB.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

vec8 = wp.types.vector(length=8, dtype=wp.float32)

# Kinds of geometry, shared by proxies and instances.
PLANE = 0
BOX = 1
MESH = 2
SPHERE = 3

# Kinds of light.
POINT = 0
SPOT = 1
DIRECTIONAL = 2

# Material models.
LAMBERT = 0
PHONG = 1
METALLIC_ROUGHNESS = 2
MIRROR = 3

# What alpha does.
OPAQUE = 0
MASKED = 1
BLENDED = 2

# What lies beyond a picture's border.
REPEATED = wp.constant(0)
CLAMP = wp.constant(1)
MIRRORED = wp.constant(2)


@wp.struct
class FrameParams:
    """Values that change per frame; kernels get an array of one."""

    camera_position: wp.vec3  # world
    world_from_camera: wp.mat33
    focal: wp.vec2  # fx, fy in pixels
    principal: wp.vec2  # cx, cy, pixel centres at integers
    distortion: vec8  # OpenCV's k1 k2 p1 p2 k3 k4 k5 k6
    exposure_scale: wp.float32
    time: wp.float32  # seconds since the first frame
    time_step: wp.float32  # seconds since the previous frame
    frame_index: wp.int32
    environment_reset: wp.int32  # 1: forget the accumulated environment
    object_rect: wp.vec4i  # row_start, row_stop, col_start, col_stop: where virtual objects can be on screen
    light_rect: wp.vec4i  # the same for virtual light and shadow on the physical
    direct_rect: wp.vec4i  # the part of light_rect that light reaches without a bounce
    shadow_rect: wp.vec4i  # the same for what virtual objects do to the environment on the physical
    ball_rect: wp.vec4i  # the same for mirror balls, and for receivers that mirror where there are any


@wp.struct
class Probe:
    """A mirror ball."""

    center: wp.vec3
    radius: wp.float32
    reflectance: wp.vec3


@wp.struct
class Light:
    """A virtual light; fields that its kind does not use are zero."""

    kind: wp.int32  # POINT, SPOT or DIRECTIONAL
    position: wp.vec3
    direction: wp.vec3  # unit, the way the light travels
    intensity: wp.vec3  # color * intensity: radiant intensity (point, spot) or irradiance (directional), per channel
    inner_angle: wp.float32  # half angles of a spot
    outer_angle: wp.float32
    attenuation: wp.vec3  # falloff = 1 / (x + y d + z d^2); (0, 0, 1) is the inverse square
    radius: wp.float32  # of the emitting sphere (point, spot), metres; 0 is a point


@wp.struct
class Shape:
    """A proxy or a virtual object: point_world = rotation (scale point_local) + position."""

    kind: wp.int32  # PLANE, BOX, MESH or SPHERE
    rotation: wp.mat33  # of a stretched MESH any linear map under which no vector grows
    stretch: wp.float32  # 0: a rotation; else how much longer the longest image of a unit vector is than the shortest
    inverse: wp.mat33  # of a stretched MESH's ``rotation``; else unused
    position: wp.vec3
    scale: wp.float32
    extent: (
        wp.vec3
    )  # local: half sizes (plane: x, y; box: x, y, z); radius (sphere: x); major, minor radius (torus: x, y)
    mesh: wp.uint64  # for MESH, id of the wp.Mesh in local space: corner k of triangle f is its point 3 f + k
    first_vertex: wp.int32  # where this mesh's vertices start in the vertex arrays
    material: wp.int32  # index of its first material; -1 for proxies
    smooth: wp.int32  # 1: interpolate vertex normals
    holed: wp.int32  # 1: rays may pass through some of its triangles


@wp.struct
class Material:
    """One material; a texture index of -1 means that the constant colour holds, else texel times colour."""

    model: wp.int32  # LAMBERT, PHONG, METALLIC_ROUGHNESS or MIRROR
    base_color: wp.vec3  # diffuse for PHONG
    base_texture: wp.int32
    specular: wp.vec3  # PHONG
    specular_texture: wp.int32
    shininess: wp.float32  # PHONG exponent
    metallic: wp.float32
    roughness: wp.float32  # perceptual; alpha is its square
    # What files add; a scene's own material leaves it at zero, and texture indices at -1.
    alpha_mode: wp.int32  # OPAQUE, MASKED or BLENDED
    opacity: wp.float32  # factor of alpha
    cutoff: wp.float32  # MASKED: alpha from which on there is something
    single_sided: wp.int32  # 1: not there for rays from behind, but for those that look for light
    unlit: wp.int32  # 1: shows its base colour as it is
    emission: wp.vec3  # radiance
    metallic_roughness_texture: wp.int32  # G times roughness, B times metallic
    normal_texture: wp.int32
    normal_scale: wp.float32
    occlusion_texture: wp.int32  # R
    occlusion_strength: wp.float32
    emissive_texture: wp.int32


@wp.struct
class Texture:
    """One use of a picture: where its texels lie, row 0 is v = 1 (the image's top), and how they are read."""

    offset: wp.int32  # of level 0; the others follow, each half as wide and high, rounded down, at least 1
    width: wp.int32
    height: wp.int32
    levels: wp.int32
    decode: wp.int32  # where in the table its codes' values start: 0 linear, 256 sRGB
    wrap_u: wp.int32  # REPEATED, CLAMP or MIRRORED
    wrap_v: wp.int32
    nearest: wp.int32  # 1: texels are squares where they are larger than pixels
    uv_set: wp.int32
    row_u: wp.vec3  # the picture is read at (row_u, row_v) . (u, v, 1)
    row_v: wp.vec3
    size: wp.float32  # texels per texture coordinate, along the transform's longer axis


@wp.struct
class AreaLight:
    """An object that emits, as a light that is all at one point; see ``kernels/rays/area_lights.py``."""

    object: wp.int32
    power: wp.vec3  # integral of radiance over the emitting area, local: m^2 times camera values
    facing: wp.vec3  # local: mean normal of the area by what it emits, not unit; zero where it is alike all around


@wp.struct
class RayScene:
    """All that rays can meet, and what it is made of."""

    objects: wp.array[Shape]
    proxies: wp.array[Shape]
    materials: wp.array[Material]
    textures: wp.array[Texture]
    texels: wp.array[wp.uint32]  # RGBA of 8 bits, R lowest
    decode_table: wp.array[wp.float32]  # (512,) value of a linear code, then of an sRGB-encoded one
    vertex_normals: wp.array[wp.vec3]  # of each corner, all meshes one after another
    vertex_uvs: wp.array[wp.vec2]
    # Empty where no object calls for them, else of all meshes.
    vertex_uvs_second: wp.array[wp.vec2]
    vertex_colors: wp.array[wp.vec4]
    vertex_tangents: wp.array[wp.vec4]
    triangle_materials: wp.array[wp.int32]  # to be added to ``Shape.material``
    triangle_density: wp.array[wp.vec2]  # texture coordinates of both sets per unit of the mesh
    pixel_spread: wp.float32  # angle of a pixel in the picture, radians
    # Empty where no object emits.
    area_lights: wp.array[AreaLight]  # the objects that do
    emitting_faces: wp.array[wp.vec3i]  # object; triangle of its mesh, -1: the whole sphere; 1: only its front emits
    emitting_shares: wp.array[wp.float32]  # of all that is emitted, by this face and those before it; the last is 1


@wp.struct
class Hit:
    """Intersection of a ray with the scene, in the world. Normals point out of the shape, from either side."""

    t: wp.float32
    shape: wp.int32  # index of the object or proxy, -1 for none
    point: wp.vec3
    normal: wp.vec3  # for shading: interpolated where the shape is smooth
    geometric_normal: wp.vec3  # of the surface that rays meet
    uv: wp.vec2
    corner: wp.int32  # of the triangle's first corner, among those of all meshes; -1: the shape is no mesh
    weights: wp.vec2  # barycentric, of the first and second corner
    error: wp.float32  # bound on how far rounding may have moved the point off the surface; see offset_origin


@wp.struct
class Picture:
    """The camera's frame, and where its pixels look."""

    frame: wp.array2d[wp.vec3ub]  # RGB
    decode_table: wp.array[wp.vec3]  # (256,) of ``color.decode_table``
    rays: wp.array2d[wp.vec2]  # undistorted (x / z, y / z) of each pixel's centre
    linear: wp.array2d[wp.vec3]  # linear radiance of a frame of more than 8 bits; empty: the codes are all


def filled(record: Any, **values: Any) -> Any:
    """Set the fields of a structure; one that is None stays as it is: empty."""
    for name, value in values.items():
        if value is not None:
            setattr(record, name, value)
    return record


def make_picture(
    frame: wp.array | None, decode_table: wp.array | None, rays: wp.array | None, linear: wp.array | None = None
) -> Picture:
    """The arrays of a picture together; None for what a kernel does not read."""
    return filled(Picture(), frame=frame, decode_table=decode_table, rays=rays, linear=linear)


@wp.struct
class EnvironmentView:
    """Observation of the environment, (h, w) each: in one frame, in merged exposures, or over frames."""

    radiance: wp.array2d[wp.vec3]  # linear; 0 where confidence is 0
    confidence: wp.array2d[wp.float32]  # 0..1; 0 or NaN: not seen
    clipped: wp.array2d[wp.vec3]  # share at clipping, per channel


def make_environment_view(radiance: wp.array, confidence: wp.array, clipped: wp.array) -> EnvironmentView:
    """The arrays of a view together."""
    return filled(EnvironmentView(), radiance=radiance, confidence=confidence, clipped=clipped)


@wp.struct
class KeyLight:
    """The dominant direction of the environment."""

    direction: wp.vec3  # unit, toward the light
    directionality: wp.float32  # 0 ambient environment .. 1 all light from this direction


@wp.struct
class Emitter:
    """An emitter of the environment whose light clips in the ball; distant ones are directions."""

    origin: wp.vec3  # where on the first ball the camera sees it mirrored
    direction: wp.vec3  # unit, from there, as in the environment; zero where there is no emitter
    distance: wp.float32  # metres from there, infinite for a distant one
    power: wp.vec3  # radiance times solid angle from there, beyond what was captured; * distance^2: radiant intensity


@functools.cache
def struct_dtype(struct: Any) -> np.dtype[Any]:
    """Return NumPy's type of a struct's records.

    NumPy parses text to make one, which Python 3.11 cannot do in two threads at once (CPython's issue 106905): frames
    take the type that was made when the pipeline was built.
    """
    return np.dtype(struct.numpy_dtype())


def struct_values(array: wp.array) -> npt.NDArray[Any]:
    """Return a copy of an array of structs, as records of ``struct_dtype``; ``wp.array.numpy`` would make the type."""
    dtype = struct_dtype(array.dtype)
    size = array.size * dtype.itemsize
    values = wp.array(ptr=array.ptr, dtype=wp.uint8, shape=(size,), device=array.device).numpy()
    return np.array(values).view(dtype).reshape(array.shape)
