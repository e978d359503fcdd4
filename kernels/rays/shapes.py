"""Intersection of a ray with one shape: a sphere, a box, a plane or a mesh, in the shape's own coordinates.

Spheres, boxes and planes are intersected analytically, meshes through Warp's BVH in local space
(``kernels/rays/mesh_walk.py``). Ray parameters ``t`` are in multiples of the direction's length, which need not be 1;
every test accepts 0 < t < t_max.

References:
    [WBW13] Woop, Benthin, Wald, "Watertight Ray/Triangle Intersection", JCGT 2(1), 2013.
    [Ize13] Ize, "Robust BVH Ray Traversal", JCGT 2(2), 2013.
    [HHO19] Haines, Guenther, Akenine-Moeller, "Precision Improvements for Ray/Sphere Intersection", Ray Tracing Gems
    ch. 7, 2019.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.rays.mesh_walk import find_closest_face, meets_any_face
from warp_ar.kernels.structs import BOX, MESH, Hit, RayScene, Shape

wp.set_module_options({"enable_backward": False})

FACES = wp.constant(8)
"""Number of keys of each proxy: ``surface_key`` is its index times this number, plus the number of the face."""
MESH_KEY = wp.constant(7)
"""Number of the face in the ``surface_key`` of a mesh, which has one key for all its faces."""
# Half the spacing of float32 at 1: the relative error of one rounding.
ROUNDING = wp.constant(wp.float32(2.0**-24))
FAR = wp.constant(wp.float32(3.0e38))


@wp.struct
class Contact:
    """Intersection of a ray with one shape."""

    t: wp.float32  # FAR: not at all
    face: wp.int32  # of a mesh
    u: wp.float32  # barycentric weights of the face's first and second corner
    v: wp.float32


@wp.func
def to_rigid_point(shape: Shape, point: wp.vec3) -> wp.vec3:
    """Return a world point in the local coordinates of a shape that is not stretched."""
    return wp.transpose(shape.rotation) * (point - shape.position) / shape.scale


@wp.func
def to_rigid_vector(shape: Shape, direction: wp.vec3) -> wp.vec3:
    """Return a world direction in the local coordinates of a shape that is not stretched, divided by its scale."""
    return wp.transpose(shape.rotation) * direction / shape.scale


@wp.func
def to_local_point(shape: Shape, point: wp.vec3) -> wp.vec3:
    """Return a world point in the shape's local coordinates."""
    if shape.stretch != 0.0:
        return shape.inverse * (point - shape.position) / shape.scale
    return to_rigid_point(shape, point)


@wp.func
def to_local_vector(shape: Shape, direction: wp.vec3) -> wp.vec3:
    """Return a world direction in the shape's local coordinates, divided by its scale so that t is unchanged."""
    if shape.stretch != 0.0:
        return shape.inverse * direction / shape.scale
    return to_rigid_vector(shape, direction)


@wp.func
def to_world_normal(shape: Shape, normal: wp.vec3) -> wp.vec3:
    """Return the unit world normal for a local one, by the transpose of the inverse map."""
    if shape.stretch != 0.0:
        return wp.normalize(wp.transpose(shape.inverse) * normal)
    return shape.rotation * normal


@wp.func
def to_rigid_normal(shape: Shape, normal: wp.vec3) -> wp.vec3:
    """Return the unit world normal for a local one of a shape that is not stretched."""
    return shape.rotation * normal


@wp.func
def intersect_sphere(radius: wp.float32, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.float32:
    """Return the smallest t on a sphere around the origin, FAR if none.

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
    """Return the smallest t on a box around the origin, FAR if none; rays along a face count as inside (no 0 * inf)."""
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
    """Return t on the rectangle |x| <= half.x, |y| <= half.y of the plane z = 0, from either side; FAR if none."""
    if direction[2] == 0.0:
        return FAR
    t = -origin[2] / direction[2]
    x = origin[0] + t * direction[0]
    y = origin[1] + t * direction[1]
    return wp.where(t > 0.0 and t < t_max and wp.abs(x) <= half[0] and wp.abs(y) <= half[1], t, FAR)


@wp.func
def enter_mesh(half: wp.vec3, origin: wp.vec3, direction: wp.vec3) -> wp.float32:
    """Return t at which a ray enters a mesh's bounding sphere, 0 if it starts inside, FAR if it misses."""
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


# No ray may slip through the shared edge of two triangles. The test of a triangle is watertight [WBW13], Warp's
# test of a node's box is not: it neither widens the interval by the rounding of its products [Ize13] nor leaves a
# margin around triangles, and so loses rays that run through edges which are box faces as well.
# ``warp_ar.scene.ray_mesh.make_ray_mesh`` therefore builds the BVH over boxes that are larger by 2^-18 of the mesh's
# radius than their triangles. That margin covers the rounding 2 * 3 * 2^-24 * |box - origin| of a slab's two bounds, if
# the origin is near; ``intersect_mesh`` first moves it to the mesh's bounding sphere, after which |box - origin| is at
# most two radii.
@wp.func
def intersect_mesh(shape: Shape, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> Contact:
    """Return the ``Contact`` with the closest triangle of a mesh, hit from either side; the test is watertight."""
    contact = Contact()
    contact.t = FAR
    start = enter_mesh(shape.extent, origin, direction)
    if start < t_max:
        entry = origin + start * direction
        near = find_closest_face(shape.mesh, entry, direction, t_max - start)
        contact.face = wp.cast(near[3], wp.int32)
        if contact.face >= 0:
            contact.t = start + near[0]
            contact.u = near[1]
            contact.v = near[2]
    return contact


@wp.func
def meets_mesh(shape: Shape, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.bool:
    """Return whether any face of a mesh lies before t_max."""
    start = enter_mesh(shape.extent, origin, direction)
    if start >= t_max:
        return False
    return meets_any_face(shape.mesh, origin + start * direction, direction, t_max - start)


@wp.func
def box_normal(half: wp.vec3, point: wp.vec3) -> wp.vec3:
    """Return the outward normal of the box face nearest to a point, in local coordinates."""
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
    """Return texture coordinates 0..1 on a box face: along the next two axes, with u mirrored on negative faces."""
    p = wp.cw_div(point, half)
    if normal[0] != 0.0:
        return wp.vec2(0.5 + 0.5 * normal[0] * p[1], 0.5 + 0.5 * p[2])
    if normal[1] != 0.0:
        return wp.vec2(0.5 + 0.5 * normal[1] * p[2], 0.5 + 0.5 * p[0])
    return wp.vec2(0.5 + 0.5 * normal[2] * p[0], 0.5 + 0.5 * p[1])


@wp.func
def onto_box(half: wp.vec3, normal: wp.vec3, point: wp.vec3) -> wp.vec3:
    """Return a point near a box, projected onto the face with the given normal."""
    return wp.vec3(
        wp.where(normal[0] != 0.0, normal[0] * half[0], point[0]),
        wp.where(normal[1] != 0.0, normal[1] * half[1], point[1]),
        wp.where(normal[2] != 0.0, normal[2] * half[2], point[2]),
    )


@wp.func
def plane_uv(half: wp.vec3, point: wp.vec3) -> wp.vec2:
    """Return texture coordinates 0..1 on a plane."""
    return wp.vec2(0.5 + 0.5 * point[0] / half[0], 0.5 + 0.5 * point[1] / half[1])


@wp.func
def sphere_uv(normal: wp.vec3) -> wp.vec2:
    """Return texture coordinates of a sphere: u along longitude, as columns of a latlong map, v from -z to +z."""
    phi = wp.atan2(normal[1], normal[0])
    theta = wp.atan2(wp.sqrt(normal[0] * normal[0] + normal[1] * normal[1]), normal[2])
    return wp.vec2(0.5 + phi / (2.0 * wp.pi), 1.0 - theta / wp.pi)


@wp.func
def surface_key(scene: RayScene, hit: Hit) -> wp.int32:
    """Return a number that identifies the surface of a proxy: a plane, a face of a box, or a mesh; -1 for no hit."""
    if hit.shape < 0:
        return -1
    shape = scene.proxies[hit.shape]
    key = FACES * hit.shape
    if shape.kind == MESH:
        key += MESH_KEY
    if shape.kind == BOX:
        local = wp.transpose(shape.rotation) * hit.geometric_normal
        for axis in range(3):
            if wp.abs(local[axis]) > 0.7:
                key += 2 * axis + wp.where(local[axis] > 0.0, 1, 0)
    return key
