"""What rays meet: shapes, the closest hit, any hit, and the primary rays of a frame.

Spheres, boxes and planes are intersected analytically, meshes through a BVH in local space: Warp's own on CUDA, one of
eight children per node on CPU (``kernels/wide_bvh.py``). Functions that walk
the scene come from ``make_trace``, specialised to the kinds of shape that are there: a scene of spheres holds no mesh
code. Ray parameters ``t`` are in multiples of the direction's length, which need not be 1; every test accepts 0 < t <
t_max.

No ray may slip through the shared edge of two triangles. Warp's own test of a triangle is watertight [WBW13], its test
of a node's box is not: it neither widens the interval by the rounding of its products [Ize13] nor leaves a margin
around triangles, and so loses rays that run through edges which are box faces as well.
``warp_ar.scene.ray_scene.make_ray_mesh`` therefore builds the BVH over boxes that are larger by 2^-18 of the mesh's
radius than their triangles. That margin covers the rounding 2 * 3 * 2^-24 * |box - origin| of a slab's two bounds, if
the origin is near; ``intersect_mesh`` first moves it to the mesh's bounding sphere, after which |box - origin| is at
most two radii.

References:
    [WBW13] Woop, Benthin, Wald, "Watertight Ray/Triangle Intersection", JCGT 2(1), 2013.
    [Ize13] Ize, "Robust BVH Ray Traversal", JCGT 2(2), 2013.
    [HHO19] Haines, Guenther, Akenine-Moeller, "Precision Improvements for Ray/Sphere Intersection", Ray Tracing Gems
    ch. 7, 2019.
    [WM17] Wyman, McGuire, "Hashed Alpha Testing", I3D 2017.
    [WB19] Waechter, Binder, "A Fast and Robust Method for Avoiding Self-Intersection", Ray Tracing Gems ch. 6, 2019.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import NamedTuple

import warp as wp

from warp_ar.kernels.launch import QUICK_TO_COMPILE, Rows, launch_rows
from warp_ar.kernels.sampling import pcg3d_hash, uniform_from_bits
from warp_ar.kernels.structs import (
    BLENDED,
    BOX,
    MESH,
    OPAQUE,
    PLANE,
    SPHERE,
    FrameParams,
    Hit,
    Probe,
    RayScene,
    Shape,
)
from warp_ar.kernels.textures import point_of_triangle, sample_texture, slant
from warp_ar.kernels.wide_bvh import walk_any, walk_closest

wp.set_module_options({"enable_backward": False})

ALL_KINDS = tuple(sorted(map(int, (SPHERE, BOX, PLANE, MESH))))
"""Of shapes."""
FACES = wp.constant(8)
"""Numbers of ``surface_key`` per shape."""
MESH_KEY = wp.constant(7)
"""``surface_key`` modulo ``FACES`` of a mesh."""
# Half the spacing of float32 at 1: the relative error of one rounding.
ROUNDING = wp.constant(wp.float32(2.0**-24))
FAR = wp.constant(wp.float32(3.0e38))
MOST_LAYERS = wp.constant(64)
"""Triangles of one mesh that a ray passes; behind them it sees nothing of it."""


@wp.struct
class Contact:
    """Where a ray meets one shape."""

    t: wp.float32  # FAR: not at all
    face: wp.int32  # of a mesh
    u: wp.float32  # barycentric weights of the face's first and second corner
    v: wp.float32


@wp.struct
class VisibleObjects:
    """The virtual objects that pixels show."""

    objects: wp.array2d[wp.int32]  # index of the object; -1 where there is none
    hits: wp.array2d[Hit]  # defined only where there is an object


@wp.func
def to_rigid_point(shape: Shape, point: wp.vec3) -> wp.vec3:
    """World point in the coordinates of a shape that is not stretched."""
    return wp.transpose(shape.rotation) * (point - shape.position) / shape.scale


@wp.func
def to_rigid_vector(shape: Shape, direction: wp.vec3) -> wp.vec3:
    """World direction in the coordinates of a shape that is not stretched; as ``to_local_vector``."""
    return wp.transpose(shape.rotation) * direction / shape.scale


@wp.func
def to_local_point(shape: Shape, point: wp.vec3) -> wp.vec3:
    """World point in the shape's coordinates."""
    if shape.stretch != 0.0:
        return shape.inverse * (point - shape.position) / shape.scale
    return to_rigid_point(shape, point)


@wp.func
def to_local_vector(shape: Shape, direction: wp.vec3) -> wp.vec3:
    """World direction in the shape's coordinates, divided by the scale so that t keeps its meaning."""
    if shape.stretch != 0.0:
        return shape.inverse * direction / shape.scale
    return to_rigid_vector(shape, direction)


@wp.func
def to_world_normal(shape: Shape, normal: wp.vec3) -> wp.vec3:
    """Unit normal of the shape in the world: normals go by the inverse's transpose."""
    if shape.stretch != 0.0:
        return wp.normalize(wp.transpose(shape.inverse) * normal)
    return shape.rotation * normal


@wp.func
def to_rigid_normal(shape: Shape, normal: wp.vec3) -> wp.vec3:
    """Unit normal of a shape that is not stretched in the world."""
    return shape.rotation * normal


@wp.func
def intersect_sphere(radius: wp.float32, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.float32:
    """Smallest t on a sphere around the origin, FAR if none.

    The discriminant is r^2 - |closest point|^2, not b^2 - ac, and the roots are q / a and c / q: neither cancels
    [HHO19].
    """
    a = wp.dot(direction, direction)
    b = -wp.dot(origin, direction)
    nearest = origin + (b / a) * direction
    discriminant = radius * radius - wp.dot(nearest, nearest)
    if discriminant < 0.0:
        return FAR
    distance = wp.length(origin)
    c = (distance - radius) * (distance + radius)
    q = b + wp.where(b < 0.0, -1.0, 1.0) * wp.sqrt(a * discriminant)
    t0 = q / a
    t1 = t0
    if q != 0.0:
        t1 = c / q
    near = wp.min(t0, t1)
    if near <= 0.0:
        near = wp.max(t0, t1)
    return wp.where(near > 0.0 and near < t_max, near, FAR)


@wp.func
def intersect_box(half: wp.vec3, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.float32:
    """Smallest t on a box around the origin, FAR if none; a ray along a face counts as inside, never as 0 * inf."""
    t_near = -FAR
    t_far = FAR
    for axis in range(3):
        if direction[axis] == 0.0:
            if wp.abs(origin[axis]) > half[axis]:
                return FAR
        else:
            inverse = 1.0 / direction[axis]
            t0 = (-half[axis] - origin[axis]) * inverse
            t1 = (half[axis] - origin[axis]) * inverse
            t_near = wp.max(t_near, wp.min(t0, t1))
            t_far = wp.min(t_far, wp.max(t0, t1))
    if t_near > t_far:
        return FAR
    t = wp.where(t_near > 0.0, t_near, t_far)
    return wp.where(t > 0.0 and t < t_max, t, FAR)


@wp.func
def intersect_plane(half: wp.vec3, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.float32:
    """T on the rectangle |x| <= half.x, |y| <= half.y of the plane z = 0, from either side; FAR if none."""
    if direction[2] == 0.0:
        return FAR
    t = -origin[2] / direction[2]
    x = origin[0] + t * direction[0]
    y = origin[1] + t * direction[1]
    return wp.where(t > 0.0 and t < t_max and wp.abs(x) <= half[0] and wp.abs(y) <= half[1], t, FAR)


@wp.func
def enter_mesh(half: wp.vec3, origin: wp.vec3, direction: wp.vec3) -> wp.float32:
    """T at which a ray enters the bounding sphere of a mesh, 0 if it starts inside, FAR if it passes by."""
    a = wp.dot(direction, direction)
    b = -wp.dot(origin, direction)
    nearest = origin + (b / a) * direction
    # A little more than the radius: covers the rounding of `nearest`, which grows with the origin's distance.
    radius = 1.001 * wp.length(half) + 8.0 * ROUNDING * wp.length(origin)
    discriminant = radius * radius - wp.dot(nearest, nearest)
    if discriminant < 0.0:
        return FAR
    reach = wp.sqrt(a * discriminant)
    if b + reach < 0.0:
        return FAR
    return wp.max((b - reach) / a, 0.0)


@wp.func
def intersect_mesh(shape: Shape, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> Contact:
    """Closest face of a mesh from either side; see the module's notes on watertightness."""
    contact = Contact()
    contact.t = FAR
    start = enter_mesh(shape.extent, origin, direction)
    if start < t_max:
        entry = origin + start * direction
        if shape.tree != wp.uint64(0):
            near = walk_closest(shape.tree, entry, direction, t_max - start)
            contact.face = wp.cast(near[3], wp.int32)
            if contact.face >= 0:
                contact.t = start + near[0]
                contact.u = near[1]
                contact.v = near[2]
        else:
            query = wp.mesh_query_ray(shape.mesh, entry, direction, t_max - start)
            if query.result:
                contact.t = start + query.t
                contact.face = query.face
                contact.u = query.u
                contact.v = query.v
    return contact


@wp.func
def meets_mesh(shape: Shape, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.bool:
    """Whether any face of a mesh lies before t_max."""
    start = enter_mesh(shape.extent, origin, direction)
    if start >= t_max:
        return False
    entry = origin + start * direction
    if shape.tree != wp.uint64(0):
        return walk_any(shape.tree, entry, direction, t_max - start)
    return wp.mesh_query_ray_anyhit(shape.mesh, entry, direction, t_max - start)


@wp.func
def is_there(
    scene: RayScene, shape: Shape, contact: Contact, origin: wp.vec3, direction: wp.vec3, sided: wp.bool
) -> wp.bool:
    """Whether a triangle holds up a ray in the shape's coordinates; ``sided``: not from behind, if it is seen so.

    Blended triangles hold up as large a share of rays as their alpha says, by a threshold for each cell of space that
    is about a pixel wide: it stays with the surface when the camera moves [WM17].
    """
    corner = shape.first_vertex + 3 * contact.face
    index = shape.material
    if scene.triangle_materials.shape[0] > 0:
        index += scene.triangle_materials[corner / 3]
    material = scene.materials[index]
    if sided and material.single_sided != 0:
        if wp.dot(wp.mesh_eval_face_normal(shape.mesh, contact.face), direction) > 0.0:
            return False
    if material.alpha_mode == OPAQUE:
        return True
    uvs = scene.vertex_uvs
    w = 1.0 - contact.u - contact.v
    uv = contact.u * uvs[corner] + contact.v * uvs[corner + 1] + w * uvs[corner + 2]
    weights = wp.vec2(contact.u, contact.v)
    width = scene.pixel_spread * contact.t
    point = point_of_triangle(scene, corner, weights, uv, width, shape.scale)
    alpha = material.opacity * point.color[3]
    if material.base_texture >= 0:
        alpha *= sample_texture(scene, material.base_texture, point)[3]
    if material.alpha_mode == BLENDED:
        place = origin + contact.t * direction
        finest = 1.0e-6 * wp.length(shape.extent) + 1.0e-30
        cells = wp.pow(2.0, -wp.ceil(wp.log2(wp.max(width / shape.scale, finest))))
        cell = place * cells
        bits = pcg3d_hash(
            wp.uint32(wp.int32(wp.floor(cell[0]))),
            wp.uint32(wp.int32(wp.floor(cell[1]))),
            wp.uint32(wp.int32(wp.floor(cell[2]))),
        )
        return uniform_from_bits(bits[0]) < alpha
    return alpha >= material.cutoff


@wp.func
def intersect_solid(
    scene: RayScene, shape: Shape, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32, sided: wp.bool
) -> Contact:
    """Closest face of a mesh that holds up a ray: those that do not are passed, ``MOST_LAYERS`` at most.

    A ray goes on a little behind what it passed: further than rounding could have put it before, so that it does not
    meet the same face for ever.
    """
    found = Contact()
    found.t = FAR
    step = 64.0 * ROUNDING * wp.length(shape.extent) / wp.length(direction)
    start = float(0.0)
    layer = wp.int32(0)
    while layer < MOST_LAYERS and start < t_max:
        contact = intersect_mesh(shape, origin + start * direction, direction, t_max - start)
        if contact.t >= t_max - start:
            layer = MOST_LAYERS
        else:
            contact.t += start
            if is_there(scene, shape, contact, origin, direction, sided):
                found = contact
                layer = MOST_LAYERS
            start = contact.t * (1.0 + 8.0 * ROUNDING) + step
        layer += 1
    return found


@wp.func
def bumped(scene: RayScene, shape: Shape, hit: Hit, normal: wp.vec3, direction: wp.vec3) -> wp.vec3:
    """Unit normal of a mesh in its own coordinates as its normal map tilts it, if it has one."""
    index = shape.material
    if scene.triangle_materials.shape[0] > 0:
        index += scene.triangle_materials[hit.corner / 3]
    material = scene.materials[index]
    if material.normal_texture < 0 or scene.vertex_tangents.shape[0] == 0:
        return normal
    frames = scene.vertex_tangents
    corner = hit.corner
    w = 1.0 - hit.weights[0] - hit.weights[1]
    frame = hit.weights[0] * frames[corner] + hit.weights[1] * frames[corner + 1] + w * frames[corner + 2]
    tangent = wp.vec3(frame[0], frame[1], frame[2])
    tangent -= wp.dot(tangent, normal) * normal
    length = wp.length(tangent)
    if length < 1.0e-6:
        return normal
    tangent = tangent / length
    bitangent = wp.where(frame[3] < 0.0, -1.0, 1.0) * wp.cross(normal, tangent)
    cosine = wp.dot(normal, wp.normalize(direction))
    width = scene.pixel_spread * hit.t * slant(cosine)
    point = point_of_triangle(scene, corner, hit.weights, hit.uv, width, shape.scale)
    texel = sample_texture(scene, material.normal_texture, point)
    x = material.normal_scale * (2.0 * texel[0] - 1.0)
    y = material.normal_scale * (2.0 * texel[1] - 1.0)
    tilted = x * tangent + y * bitangent + (2.0 * texel[2] - 1.0) * normal
    size = wp.length(tilted)
    if size < 1.0e-6:
        return normal
    return tilted / size


@wp.func
def meets_probe(probes: wp.array[Probe], origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.bool:
    """Whether a mirror ball lies in the way."""
    for index in range(probes.shape[0]):
        probe = probes[index]
        if intersect_sphere(probe.radius, origin - probe.center, direction, t_max) < t_max:
            return True
    return False


@wp.func
def box_normal(half: wp.vec3, point: wp.vec3) -> wp.vec3:
    """Outward normal of the face that a point on a box is nearest to."""
    x = wp.abs(point[0]) - half[0]
    y = wp.abs(point[1]) - half[1]
    z = wp.abs(point[2]) - half[2]
    if x >= y and x >= z:
        return wp.vec3(wp.where(point[0] < 0.0, -1.0, 1.0), 0.0, 0.0)
    if y >= z:
        return wp.vec3(0.0, wp.where(point[1] < 0.0, -1.0, 1.0), 0.0)
    return wp.vec3(0.0, 0.0, wp.where(point[2] < 0.0, -1.0, 1.0))


@wp.func
def box_uv(half: wp.vec3, normal: wp.vec3, point: wp.vec3) -> wp.vec2:
    """Texture coordinates 0..1 on each face: u and v run along the next two axes, mirrored in u on negative faces."""
    p = wp.cw_div(point, half)
    if normal[0] != 0.0:
        return wp.vec2(0.5 + 0.5 * normal[0] * p[1], 0.5 + 0.5 * p[2])
    if normal[1] != 0.0:
        return wp.vec2(0.5 + 0.5 * normal[1] * p[2], 0.5 + 0.5 * p[0])
    return wp.vec2(0.5 + 0.5 * normal[2] * p[0], 0.5 + 0.5 * p[1])


@wp.func
def sphere_uv(normal: wp.vec3) -> wp.vec2:
    """Texture coordinates of a sphere: u runs as a latlong map's columns, v from -z to +z."""
    phi = wp.atan2(normal[1], normal[0])
    theta = wp.atan2(wp.sqrt(normal[0] * normal[0] + normal[1] * normal[1]), normal[2])
    return wp.vec2(0.5 + phi / (2.0 * wp.pi), 1.0 - theta / wp.pi)


@wp.func
def offset_origin(point: wp.vec3, geometric_normal: wp.vec3, direction: wp.vec3, error: wp.float32) -> wp.vec3:
    """Origin of a ray that leaves a surface: moved off it along the normal, to the side that ``direction`` goes to.

    A ray along the normal by ``Hit.error`` cannot meet the surface it leaves, at any scale and distance from the
    world's origin. [WB19] count units in the last place of the point alone, and so need a fixed distance near the
    origin, where those vanish but the error of a point that was computed relative to its shape does not; ``Hit.error``
    knows the shape.
    """
    return point + wp.where(wp.dot(geometric_normal, direction) < 0.0, -error, error) * geometric_normal


@wp.func
def surface_key(shape: Shape, index: wp.int32, geometric_normal: wp.vec3) -> wp.int32:
    """Number that points on one flat surface share: the shape's ``index``, and the face of a box."""
    key = FACES * index
    if shape.kind == MESH:
        key += MESH_KEY
    if shape.kind == BOX:
        local = wp.transpose(shape.rotation) * geometric_normal
        for axis in range(3):
            if wp.abs(local[axis]) > 0.7:
                key += 2 * axis + wp.where(local[axis] > 0.0, 1, 0)
    return key


class Trace(NamedTuple):
    """Functions for kernels, each taking ``(scene: RayScene, origin: vec3, direction: vec3, t_max: float32)``."""

    closest_object: wp.Function
    """Closest virtual object: ``Hit``."""
    closest_proxy: wp.Function
    """Closest proxy: ``Hit``."""
    occluded_by_objects: wp.Function
    """Whether any virtual object lies in the way: ``bool``."""
    occluded_by_proxies: wp.Function
    """Whether any proxy lies in the way: ``bool``."""
    occluded: wp.Function
    """Either of the two."""


@dataclasses.dataclass(frozen=True)
class TraceConfig:
    """Which kinds of shape exist; the others are not compiled in. Kinds are sorted and unique."""

    objects: tuple[int, ...]
    """Kinds among the virtual objects."""
    proxies: tuple[int, ...]
    """Kinds among the proxies."""
    detail: bool = False
    """Whether any object's triangles let rays pass or have normal maps."""
    stretched: bool = False
    """Whether any object may be stretched."""

    def general(self) -> TraceConfig:
        """For any scene with such triangles or without: each shape's kind is asked for as it is met."""
        return TraceConfig(ALL_KINDS, ALL_KINDS, self.detail, self.stretched)


@functools.cache
def _ways(stretched: bool) -> tuple[wp.Function, wp.Function, wp.Function]:
    """Into a shape's coordinates, points and vectors, and normals out of them."""
    if stretched:
        return to_local_point, to_local_vector, to_world_normal
    return to_rigid_point, to_rigid_vector, to_rigid_normal


@functools.cache
def _make_closest(kinds: tuple[int, ...], detail: bool, stretched: bool) -> wp.Function:
    """Closest hit among shapes of the given kinds."""
    label = "_".join(map(str, (*kinds, int(detail), int(stretched))))
    local_point, local_vector, world_normal = _ways(stretched)

    @wp.func(name=f"closest_hit_{label}", module="unique")
    def closest_hit(
        scene: RayScene,
        shapes: wp.array[Shape],
        origin: wp.vec3,
        direction: wp.vec3,
        t_max: wp.float32,
    ) -> Hit:
        vertex_normals = scene.vertex_normals
        vertex_uvs = scene.vertex_uvs
        hit = Hit()
        hit.shape = -1
        hit.corner = -1
        hit.t = t_max
        if wp.static(len(kinds) > 0):
            contact = Contact()
            for index in range(shapes.shape[0]):
                shape = shapes[index]
                o = local_point(shape, origin)
                d = local_vector(shape, direction)
                t = FAR
                if wp.static(SPHERE in kinds):
                    if shape.kind == SPHERE:
                        t = intersect_sphere(shape.extent[0], o, d, hit.t)
                if wp.static(BOX in kinds):
                    if shape.kind == BOX:
                        t = intersect_box(shape.extent, o, d, hit.t)
                if wp.static(PLANE in kinds):
                    if shape.kind == PLANE:
                        t = intersect_plane(shape.extent, o, d, hit.t)
                if wp.static(MESH in kinds):
                    if shape.kind == MESH:
                        met = Contact()
                        if wp.static(detail):
                            if shape.holed != 0:
                                met = intersect_solid(scene, shape, o, d, hit.t, True)
                            else:
                                met = intersect_mesh(shape, o, d, hit.t)
                        else:
                            met = intersect_mesh(shape, o, d, hit.t)
                        t = met.t
                        if t < hit.t:
                            contact = met
                if t < hit.t:
                    hit.t = t
                    hit.shape = index

            if hit.shape >= 0:
                shape = shapes[hit.shape]
                p = local_point(shape, origin) + hit.t * local_vector(shape, direction)
                geometric = wp.vec3(0.0, 0.0, 1.0)
                normal = wp.vec3(0.0, 0.0, 1.0)
                # Each kind puts the point back onto its surface: the error of t, large for a far origin, ends here.
                if wp.static(SPHERE in kinds):
                    if shape.kind == SPHERE:
                        geometric = wp.normalize(p)
                        p = shape.extent[0] * geometric
                        normal = geometric
                        hit.uv = sphere_uv(geometric)
                if wp.static(BOX in kinds):
                    if shape.kind == BOX:
                        geometric = box_normal(shape.extent, p)
                        p = wp.vec3(
                            wp.where(geometric[0] != 0.0, geometric[0] * shape.extent[0], p[0]),
                            wp.where(geometric[1] != 0.0, geometric[1] * shape.extent[1], p[1]),
                            wp.where(geometric[2] != 0.0, geometric[2] * shape.extent[2], p[2]),
                        )
                        normal = geometric
                        hit.uv = box_uv(shape.extent, geometric, p)
                if wp.static(PLANE in kinds):
                    if shape.kind == PLANE:
                        p = wp.vec3(p[0], p[1], 0.0)
                        hit.uv = wp.vec2(0.5 + 0.5 * p[0] / shape.extent[0], 0.5 + 0.5 * p[1] / shape.extent[1])
                if wp.static(MESH in kinds):
                    if shape.kind == MESH:
                        p = wp.mesh_eval_position(shape.mesh, contact.face, contact.u, contact.v)
                        geometric = wp.mesh_eval_face_normal(shape.mesh, contact.face)
                        w = 1.0 - contact.u - contact.v
                        corner = shape.first_vertex + 3 * contact.face
                        normal = geometric
                        if shape.smooth != 0:
                            normal = wp.normalize(
                                contact.u * vertex_normals[corner]
                                + contact.v * vertex_normals[corner + 1]
                                + w * vertex_normals[corner + 2]
                            )
                            # Opposed corner normals can cancel; zero is no direction.
                            if wp.dot(normal, normal) < 0.5:
                                normal = geometric
                        hit.uv = contact.u * vertex_uvs[corner] + contact.v * vertex_uvs[corner + 1]
                        hit.uv += w * vertex_uvs[corner + 2]
                        hit.corner = corner
                        hit.weights = wp.vec2(contact.u, contact.v)
                        if wp.static(detail):
                            normal = bumped(scene, shape, hit, normal, local_vector(shape, direction))
                arm = shape.rotation * (shape.scale * p)
                hit.point = arm + shape.position
                hit.normal = world_normal(shape, normal)
                hit.geometric_normal = world_normal(shape, geometric)
                # World coordinates are rounded once on the way out and twice on the way back into the shape; within the
                # shape, rotating there and back, placing the point and testing the surface again take some 20 roundings
                # of its size.
                size = shape.scale * wp.length(shape.extent)
                if wp.static(stretched):
                    if shape.stretch != 0.0:
                        size *= shape.stretch  # what is rounded along the shortest way counts along the longest
                hit.error = ROUNDING * (8.0 * wp.max(wp.abs(hit.point)) + 32.0 * size)
        return hit

    return closest_hit


@functools.cache
def _make_meets(kinds: tuple[int, ...], detail: bool, stretched: bool) -> wp.Function:
    """Whether a ray meets a shape of one of the given kinds."""
    label = "_".join(map(str, (*kinds, int(detail), int(stretched))))
    local_point, local_vector, _ = _ways(stretched)

    @wp.func(name=f"meets_{label}", module="unique")
    def meets(scene: RayScene, shape: Shape, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.bool:
        o = local_point(shape, origin)
        d = local_vector(shape, direction)
        if wp.static(SPHERE in kinds):
            if shape.kind == SPHERE:
                return intersect_sphere(shape.extent[0], o, d, t_max) < t_max
        if wp.static(BOX in kinds):
            if shape.kind == BOX:
                return intersect_box(shape.extent, o, d, t_max) < t_max
        if wp.static(PLANE in kinds):
            if shape.kind == PLANE:
                return intersect_plane(shape.extent, o, d, t_max) < t_max
        if wp.static(MESH in kinds):
            if shape.kind == MESH:
                if wp.static(detail):
                    if shape.holed != 0:
                        return intersect_solid(scene, shape, o, d, t_max, False).t < t_max
                return meets_mesh(shape, o, d, t_max)
        return False

    return meets


@functools.cache
def _make_any(kinds: tuple[int, ...], detail: bool, stretched: bool) -> wp.Function:
    """Whether a ray meets any of the shapes of the given kinds."""
    meets = _make_meets(kinds, detail, stretched)
    label = "_".join(map(str, (*kinds, int(detail), int(stretched))))

    @wp.func(name=f"any_hit_{label}", module="unique")
    def any_hit(
        scene: RayScene, shapes: wp.array[Shape], origin: wp.vec3, direction: wp.vec3, t_max: wp.float32
    ) -> wp.bool:
        if wp.static(len(kinds) > 0):
            for index in range(shapes.shape[0]):
                if meets(scene, shapes[index], origin, direction, t_max):
                    return True
        return False

    return any_hit


@functools.cache
def _make_any_of_both(kinds: tuple[int, ...], detail: bool, stretched: bool) -> wp.Function:
    """Whether a ray meets any object or proxy, both of the given kinds: one loop, for the walks in it are long code."""
    meets = _make_meets(kinds, detail, stretched)

    @wp.func(module="unique")
    def occluded(scene: RayScene, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.bool:
        objects = scene.objects.shape[0]
        for index in range(objects + scene.proxies.shape[0]):
            shape = Shape()  # no ternary: in a kernel it reads both arrays, beyond their ends
            if index < objects:  # noqa: SIM108
                shape = scene.objects[index]
            else:
                shape = scene.proxies[index - objects]
            if meets(scene, shape, origin, direction, t_max):
                return True
        return False

    return occluded


@functools.cache
def make_trace(config: TraceConfig) -> Trace:
    """Functions that trace rays through a scene with the kinds of shape in ``config``; equal configs share them."""
    closest_shape_object = _make_closest(config.objects, config.detail, config.stretched)
    closest_shape_proxy = _make_closest(config.proxies, False, False)
    any_object = _make_any(config.objects, config.detail, config.stretched)
    any_proxy = _make_any(config.proxies, False, False)

    @wp.func(module="unique")
    def closest_object(scene: RayScene, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> Hit:
        return closest_shape_object(scene, scene.objects, origin, direction, t_max)

    @wp.func(module="unique")
    def closest_proxy(scene: RayScene, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> Hit:
        return closest_shape_proxy(scene, scene.proxies, origin, direction, t_max)

    @wp.func(module="unique")
    def occluded_by_objects(scene: RayScene, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.bool:
        return any_object(scene, scene.objects, origin, direction, t_max)

    @wp.func(module="unique")
    def occluded_by_proxies(scene: RayScene, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.bool:
        return any_proxy(scene, scene.proxies, origin, direction, t_max)

    if config.objects == config.proxies:
        occluded = _make_any_of_both(config.objects, config.detail, config.stretched)
    else:

        @wp.func(module="unique")
        def occluded(scene: RayScene, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.bool:
            if any_object(scene, scene.objects, origin, direction, t_max):
                return True
            return any_proxy(scene, scene.proxies, origin, direction, t_max)

    return Trace(closest_object, closest_proxy, occluded_by_objects, occluded_by_proxies, occluded)


@wp.func
def inside_rect(row: wp.int32, column: wp.int32, rect: wp.vec4i) -> wp.bool:
    """Whether a pixel lies in a rectangle (row_start, row_stop, column_start, column_stop)."""
    return row >= rect[0] and row < rect[1] and column >= rect[2] and column < rect[3]


@functools.cache
def make_primary(config: TraceConfig) -> wp.Function:
    """``closest_visible(scene, origin, direction) -> Hit``: the closest object if no proxy hides it, else shape -1."""
    trace = make_trace(config)
    closest_object, occluded_by_proxies = trace.closest_object, trace.occluded_by_proxies

    @wp.func(module="unique")
    def closest_visible(scene: RayScene, origin: wp.vec3, direction: wp.vec3) -> Hit:
        hit = closest_object(scene, origin, direction, FAR)
        if wp.static(len(config.proxies) > 0):
            if hit.shape >= 0:
                # Where object and proxy touch, the object is seen: both depths carry a few roundings.
                if occluded_by_proxies(scene, origin, direction, hit.t * (1.0 - 16.0 * ROUNDING)):
                    hit.shape = -1
        return hit

    return closest_visible


@functools.cache
def make_visible_proxy(config: TraceConfig, probes: bool) -> wp.Function:
    """``visible_proxy(params, ray, scene, probes) -> Hit``: the proxy that a pixel shows, or shape -1.

    A face that is seen from behind, or a mirror ball before it, is not what the camera sees of it.
    """
    closest_proxy = make_trace(config).closest_proxy

    @wp.func(module="unique")
    def visible_proxy(params: FrameParams, ray: wp.vec2, scene: RayScene, balls: wp.array[Probe]) -> Hit:
        direction = params.world_from_camera * wp.vec3(ray[0], ray[1], 1.0)
        hit = closest_proxy(scene, params.camera_position, direction, FAR)
        if hit.shape >= 0:
            if wp.dot(hit.geometric_normal, direction) >= 0.0:
                hit.shape = -1
            if wp.static(probes):
                if meets_probe(balls, params.camera_position, direction, hit.t):
                    hit.shape = -1
        return hit

    return visible_proxy


def check_edge_samples(count: int) -> None:
    """Raise an error unless ``make_sample_direction`` can place so many samples.

    Raises:
        ValueError: It is no square number.
    """
    if count < 1 or math.isqrt(count) ** 2 != count:
        raise ValueError(f"edge_samples is {count}; expected a square number such as 1, 4 or 16")


@functools.cache
def make_sample_direction(count: int) -> wp.Function:
    """``sample_direction(params, ray, sample) -> vec3``: where a pixel's sample looks in the world, not unit.

    Args:
        count: Samples of a pixel, a square number; the only one is at the centre.
    """
    side = math.isqrt(count)

    @wp.func(module="unique")
    def sample_direction(params: wp.array[FrameParams], ray: wp.vec2, sample: wp.int32) -> wp.vec3:
        inner = wp.vec3(ray[0], ray[1], 1.0)
        if wp.static(side > 1):
            n = wp.static(float(side))
            a = wp.float32(sample % wp.static(side))
            b = wp.float32(sample / wp.static(side))
            inner[0] += ((a + (b + 0.5) / n) / n - 0.5) / params[0].focal[0]
            inner[1] += ((b + (n - 0.5 - a) / n) / n - 0.5) / params[0].focal[1]
        return params[0].world_from_camera * inner

    return sample_direction


def make_visible(objects: wp.array, hits: wp.array) -> VisibleObjects:
    """The arrays of ``trace_pixels`` together."""
    visible = VisibleObjects()
    visible.objects, visible.hits = objects, hits
    return visible


@functools.cache
def make_trace_pixels_kernel(config: TraceConfig) -> wp.Kernel:
    """Kernel of ``trace_pixels``, specialised to the kinds of shape that exist."""
    closest_visible = make_primary(config)

    @wp.kernel(module="unique", enable_backward=False, module_options=QUICK_TO_COMPILE)
    def trace_pixels_kernel(
        row_start: wp.int32,
        # In:
        params: wp.array[FrameParams],
        rays: wp.array2d[wp.vec2],
        scene: RayScene,
        # Out:
        visible_out: VisibleObjects,
    ):
        i, j = wp.tid()
        i += row_start
        found = wp.int32(-1)
        if inside_rect(i, j, params[0].object_rect):
            ray = rays[i, j]
            direction = params[0].world_from_camera * wp.vec3(ray[0], ray[1], 1.0)
            hit = closest_visible(scene, params[0].camera_position, direction)
            if hit.shape >= 0:
                found = hit.shape
                visible_out.hits[i, j] = hit
        visible_out.objects[i, j] = found

    return trace_pixels_kernel


def trace_pixels(
    config: TraceConfig,
    params: wp.array[FrameParams],
    rays: wp.array2d[wp.vec2],
    scene: RayScene,
    visible_out: VisibleObjects,
    *,
    rows: Rows | None = None,
) -> None:
    """Trace a ray through the centre of every pixel of ``params.object_rect``.

    Args:
        config: Kinds of shape in ``scene``.
        params: Frame values: camera and object_rect.
        rays: (H, W) undistorted x / z and y / z of each pixel centre.
        scene: What rays meet.
        visible_out: (H, W) the objects and hits.
        rows: Band of rows; None means all.
    """
    launch_rows(
        make_trace_pixels_kernel(config),
        rays.shape,
        [params, rays, scene],
        [visible_out],
        rows=rows,
        device=rays.device,
    )
