"""Structures that stages share. Values that change from frame to frame stand in the arrays of ``FrameBlock``.

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

# Alpha modes of a material.
OPAQUE = 0
MASKED = 1
BLENDED = 2

# Continuations of a texture beyond its border.
REPEATED = wp.constant(0)
CLAMP = wp.constant(1)
MIRRORED = wp.constant(2)


@wp.struct
class FrameParams:
    """Values that change per frame. Kernels receive an array with one record."""

    camera_position: wp.vec3  # world
    world_from_camera: wp.mat33
    focal: wp.vec2  # fx, fy in pixels
    principal: wp.vec2  # cx, cy, pixel centres at integers
    distortion: vec8  # OpenCV's k1 k2 p1 p2 k3 k4 k5 k6
    exposure_scale: wp.float32
    time: wp.float32  # seconds since the first frame
    time_step: wp.float32  # seconds since the previous frame
    environment_reset: wp.int32  # 1: forget the accumulated environment
    # Rectangles of pixels: row_start, row_stop, col_start, col_stop.
    object_rect: wp.vec4i  # bounds the virtual objects
    light_rect: wp.vec4i  # bounds virtual light and its shadows on physical surfaces
    direct_rect: wp.vec4i  # part of light_rect that virtual light reaches without a bounce
    shadow_rect: wp.vec4i  # bounds environment shadows of virtual objects, and light they bounce, on physical surfaces
    ball_rect: wp.vec4i  # bounds mirror balls and glossy receivers


@wp.struct
class Probe:
    """A mirror ball."""

    center: wp.vec3
    radius: wp.float32
    reflectance: wp.vec3


@wp.struct
class Light:
    """A virtual light. Fields that do not apply to its kind are zero."""

    kind: wp.int32  # POINT, SPOT or DIRECTIONAL
    position: wp.vec3
    direction: wp.vec3  # unit, the way the light travels
    intensity: wp.vec3  # color * intensity: radiant intensity (point, spot) or irradiance (directional), per channel
    inner_angle: wp.float32  # half angle of a spot's full intensity
    outer_angle: wp.float32  # half angle at which a spot's intensity reaches zero
    attenuation: wp.vec3  # falloff = 1 / (x + y d + z d^2); (0, 0, 1) is the inverse square
    radius: wp.float32  # of the emitting sphere (point, spot), metres; 0 is a point


@wp.struct
class Shape:
    """A proxy or a virtual object: point_world = rotation (scale point_local) + position."""

    kind: wp.int32  # PLANE, BOX, MESH or SPHERE
    rotation: wp.mat33  # a rotation; for a stretched MESH any linear map that lengthens no vector
    stretch: wp.float32  # 0 for a rotation; else the ratio of the map's largest to its smallest singular value
    inverse: wp.mat33  # inverse of ``rotation`` for a stretched MESH; else unused
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
    """One material. A texture's value is multiplied by the constant beside it; index -1 means that there is none."""

    model: wp.int32  # LAMBERT, PHONG, METALLIC_ROUGHNESS or MIRROR
    base_color: wp.vec3  # diffuse for PHONG
    base_texture: wp.int32
    specular: wp.vec3  # PHONG
    specular_texture: wp.int32
    shininess: wp.float32  # PHONG exponent
    metallic: wp.float32
    roughness: wp.float32  # perceptual; alpha is its square
    # Properties that only model files set. Materials of scene files leave them at zero, and texture indices at -1.
    alpha_mode: wp.int32  # OPAQUE, MASKED or BLENDED
    opacity: wp.float32  # factor of alpha
    cutoff: wp.float32  # MASKED: least alpha of a point that exists
    single_sided: wp.int32  # 1: rays from behind pass, except shadow rays
    unlit: wp.int32  # 1: its radiance is its base colour
    emission: wp.vec3  # radiance
    metallic_roughness_texture: wp.int32  # G times roughness, B times metallic
    normal_texture: wp.int32
    normal_scale: wp.float32
    occlusion_texture: wp.int32  # in its R channel
    occlusion_strength: wp.float32
    emissive_texture: wp.int32


@wp.struct
class Texture:
    """A texture: the place of its texels and the way to sample them. Row 0 is v = 1, the top of the image."""

    offset: wp.int32  # first texel of level 0; each next level is half as wide and high, rounded down, at least 1
    width: wp.int32
    height: wp.int32
    levels: wp.int32
    decode: wp.int32  # start of its codes' values in ``RayScene.decode_table``: 0 linear, 256 sRGB
    wrap_u: wp.int32  # REPEATED, CLAMP or MIRRORED
    wrap_v: wp.int32
    nearest: wp.int32  # 1: texels larger than pixels are shown as squares, without interpolation
    uv_set: wp.int32
    row_u: wp.vec3  # first row of the map of texture coordinates: sampled at (row_u, row_v) . (u, v, 1)
    row_v: wp.vec3  # second row
    size: wp.float32  # texels per texture coordinate, along the transform's longer axis


@wp.struct
class AreaLight:
    """An emitting object, approximated by a light at one point; see ``kernels/rays/area_lights.py``."""

    object: wp.int32
    power: wp.vec3  # integral of radiance over the emitting area, local: m^2 times camera values
    facing: wp.vec3  # local: mean normal weighted by emission, not unit; zero if it emits to all sides alike


@wp.struct
class RayScene:
    """Shapes that rays can meet, with their materials and textures."""

    objects: wp.array[Shape]
    proxies: wp.array[Shape]
    materials: wp.array[Material]
    textures: wp.array[Texture]
    texels: wp.array[wp.uint32]  # RGBA of 8 bits, R lowest
    decode_table: wp.array[wp.float32]  # (512,) values of the 256 linear codes, then of the 256 sRGB codes
    vertex_normals: wp.array[wp.vec3]  # one per triangle corner, all meshes one after another
    vertex_uvs: wp.array[wp.vec2]
    # Given for all meshes if any object uses them, else empty:
    vertex_uvs_second: wp.array[wp.vec2]
    vertex_colors: wp.array[wp.vec4]
    vertex_tangents: wp.array[wp.vec4]
    triangle_materials: wp.array[wp.int32]  # to be added to ``Shape.material``
    triangle_density: wp.array[wp.vec2]  # texture coordinates per unit of length of the mesh, for both sets
    pixel_spread: wp.float32  # angle of a pixel in the picture, radians
    # Empty where no object emits:
    area_lights: wp.array[AreaLight]  # the emitting objects
    emitting_faces: wp.array[wp.vec3i]  # object; triangle of its mesh, -1 for a whole sphere; 1: only the front emits
    emitting_shares: wp.array[wp.float32]  # cumulative shares of the emitted power by face; the last is 1


@wp.struct
class Hit:
    """Intersection of a ray with the scene, in the world. Normals point out of the shape, even if it is hit inside."""

    t: wp.float32
    shape: wp.int32  # index of the object or proxy, -1 for none
    point: wp.vec3
    normal: wp.vec3  # for shading: interpolated where the shape is smooth
    geometric_normal: wp.vec3  # of the surface itself
    uv: wp.vec2
    corner: wp.int32  # index of the triangle's first corner among the corners of all meshes; -1: not a mesh
    weights: wp.vec2  # barycentric, of the first and second corner
    error: wp.float32  # bound on the distance of the point from the surface by rounding; see offset_origin


@wp.struct
class Picture:
    """The camera's frame and the rays of its pixels, (H, W)."""

    frame: wp.array2d[wp.vec3ub]  # RGB
    decode_table: wp.array[wp.vec3]  # (256,) of ``color.decode_table``
    rays: wp.array2d[wp.vec2]  # undistorted (x / z, y / z) of each pixel's centre
    linear: wp.array2d[wp.vec3]  # linear radiance of a frame of more than 8 bits; empty for one of 8 bits


def filled(record: Any, **values: Any) -> Any:
    """Set the given fields of a new structure and return it; a field given as None keeps its empty default."""
    for name, value in values.items():
        if value is not None:
            setattr(record, name, value)
    return record


def make_picture(
    frame: wp.array | None, decode_table: wp.array | None, rays: wp.array | None, linear: wp.array | None = None
) -> Picture:
    """Return a ``Picture`` of these arrays; None leaves one out that the kernel does not read."""
    return filled(Picture(), frame=frame, decode_table=decode_table, rays=rays, linear=linear)


@wp.struct
class EnvironmentView:
    """Observation of the environment, (h, w) each: of one frame, of merged exposures, or accumulated over frames."""

    radiance: wp.array2d[wp.vec3]  # linear; 0 where confidence is 0
    confidence: wp.array2d[wp.float32]  # 0..1; 0 or NaN: not observed
    clipped: wp.array2d[wp.vec3]  # share of clipped samples, per channel


def make_environment_view(radiance: wp.array, confidence: wp.array, clipped: wp.array) -> EnvironmentView:
    """Return an ``EnvironmentView`` of these arrays."""
    return filled(EnvironmentView(), radiance=radiance, confidence=confidence, clipped=clipped)


@wp.struct
class KeyLight:
    """The dominant direction of the environment."""

    direction: wp.vec3  # unit, toward the light
    directionality: wp.float32  # 0 ambient environment .. 1 all light from this direction


@wp.struct
class Emitter:
    """An emitter of the environment whose image in the ball is clipped."""

    origin: wp.vec3  # point of the first ball at which the camera sees its reflection
    direction: wp.vec3  # unit, from the origin, its direction in the environment; zero where there is no emitter
    distance: wp.float32  # metres from the origin; infinite for a distant emitter
    power: wp.vec3  # radiance above the captured one, times solid angle from the origin; * distance^2: intensity


@functools.cache
def struct_dtype(struct: Any) -> np.dtype[Any]:
    """Return the NumPy dtype of a Warp struct's records.

    NumPy parses text to make a dtype, which Python 3.11 cannot do in two threads at once (CPython's issue 106905).
    So dtypes are made while the pipeline is built, and frames use the cached ones.
    """
    return np.dtype(struct.numpy_dtype())


def struct_values(array: wp.array) -> npt.NDArray[Any]:
    """Copy an array of structs to NumPy records of ``struct_dtype``; ``wp.array.numpy`` would make a new dtype."""
    dtype = struct_dtype(array.dtype)
    size = array.size * dtype.itemsize
    values = wp.array(ptr=array.ptr, dtype=wp.uint8, shape=(size,), device=array.device).numpy()
    return np.array(values).view(dtype).reshape(array.shape)
