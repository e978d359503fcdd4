"""Rays through the scene: the closest hit and any hit among objects and proxies.

``make_trace`` makes functions that intersect rays with the scene, specialised to its kinds of shape: code for a scene
of spheres contains no meshes. ``kernels/rays/shapes.py`` intersects single shapes. ``offset_origin`` moves the origin
of a ray off its surface, ``meets_probe`` tests mirror balls.

References:
    [WB19] Waechter, Binder, "A Fast and Robust Method for Avoiding Self-Intersection", Ray Tracing Gems ch. 6, 2019.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import warp as wp

from warp_ar.kernels.rays.mesh_detail import bumped, intersect_solid
from warp_ar.kernels.rays.shapes import (
    FAR,
    ROUNDING,
    Contact,
    box_normal,
    box_uv,
    intersect_box,
    intersect_mesh,
    intersect_plane,
    intersect_sphere,
    meets_mesh,
    onto_box,
    plane_uv,
    sphere_uv,
    to_local_point,
    to_local_vector,
    to_rigid_normal,
    to_rigid_point,
    to_rigid_vector,
    to_world_normal,
)
from warp_ar.kernels.structs import BOX, MESH, PLANE, SPHERE, Hit, Probe, RayScene, Shape

wp.set_module_options({"enable_backward": False})

ALL_KINDS = tuple(sorted(map(int, (SPHERE, BOX, PLANE, MESH))))
"""All kinds of shapes."""


@wp.func
def meets_probe(probes: wp.array[Probe], origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.bool:
    """Return whether a ray meets a mirror ball before ``t_max``."""
    for index in range(probes.shape[0]):
        probe = probes[index]
        if intersect_sphere(probe.radius, origin - probe.center, direction, t_max) < t_max:
            return True
    return False


@wp.func
def offset_origin(point: wp.vec3, geometric_normal: wp.vec3, direction: wp.vec3, error: wp.float32) -> wp.vec3:
    """Return the origin of a ray that leaves a surface: moved along the normal, to the side of ``direction``.

    An offset of ``Hit.error`` keeps the ray from meeting the surface that it leaves, at any scale and distance from the
    world's origin. [WB19] use units in the last place of the point alone. These vanish near the world's origin, where
    the error of a point computed relative to its shape does not, so [WB19] need a fixed distance there. ``Hit.error``
    includes the shape's size.
    """
    return point + wp.where(wp.dot(geometric_normal, direction) < 0.0, -error, error) * geometric_normal


class Trace(NamedTuple):
    """Functions that trace rays in kernels, with arguments ``(scene, origin, direction, t_max)``."""

    closest_object: wp.Function
    """Returns the ``Hit`` of the closest virtual object."""
    closest_proxy: wp.Function
    """Returns the ``Hit`` of the closest proxy."""
    occluded_by_objects: wp.Function
    """Returns True if the ray meets a virtual object before ``t_max``."""
    occluded_by_proxies: wp.Function
    """Returns True if the ray meets a proxy before ``t_max``."""
    occluded: wp.Function
    """Returns True if the ray meets a virtual object or a proxy before ``t_max``."""


@dataclasses.dataclass(frozen=True)
class TraceConfig:
    """Kinds of shape that exist; the others are not compiled in. Kinds are sorted and unique."""

    objects: tuple[int, ...]
    """Kinds among the virtual objects."""
    proxies: tuple[int, ...]
    """Kinds among the proxies."""
    detail: bool = False
    """True if any object's triangles let rays pass or have normal maps."""
    stretched: bool = False
    """True if any object may be stretched."""

    def general(self) -> TraceConfig:
        """Return a configuration for all kinds of shape, with the same detail; kinds are tested at run time."""
        return TraceConfig(ALL_KINDS, ALL_KINDS, self.detail, self.stretched)


@functools.cache
def _ways(stretched: bool) -> tuple[wp.Function, wp.Function, wp.Function]:
    """Return functions that map points and vectors into a shape's coordinates, and normals from these to the world."""
    if stretched:
        return to_local_point, to_local_vector, to_world_normal
    return to_rigid_point, to_rigid_vector, to_rigid_normal


def _label(kinds: tuple[int, ...], detail: bool, stretched: bool) -> str:
    """Return a label that distinguishes functions for different kinds of shape in one module."""
    return "_".join(map(str, (*kinds, int(detail), int(stretched))))


@functools.cache
def _make_closest(kinds: tuple[int, ...], detail: bool, stretched: bool) -> wp.Function:
    """Return a function that finds the closest hit among shapes of the given kinds."""
    local_point, local_vector, world_normal = _ways(stretched)

    # One long function: on a CPU arguments are copied for every function that is called.
    @wp.func(name=f"closest_hit_{_label(kinds, detail, stretched)}", module="unique")
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
                # Each kind projects the point onto its surface, which removes the error of t, large for a far origin.
                if wp.static(SPHERE in kinds):
                    if shape.kind == SPHERE:
                        geometric = wp.normalize(p)
                        p = shape.extent[0] * geometric
                        normal = geometric
                        hit.uv = sphere_uv(geometric)
                if wp.static(BOX in kinds):
                    if shape.kind == BOX:
                        geometric = box_normal(shape.extent, p)
                        p = onto_box(shape.extent, geometric, p)
                        normal = geometric
                        hit.uv = box_uv(shape.extent, geometric, p)
                if wp.static(PLANE in kinds):
                    if shape.kind == PLANE:
                        p = wp.vec3(p[0], p[1], 0.0)
                        hit.uv = plane_uv(shape.extent, p)
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
    """Return a function that tests a ray against one shape, of one of the given kinds."""
    local_point, local_vector, _ = _ways(stretched)

    @wp.func(name=f"meets_{_label(kinds, detail, stretched)}", module="unique")
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
    """Return a function that tests a ray against all shapes of an array, of the given kinds."""
    meets = _make_meets(kinds, detail, stretched)

    @wp.func(name=f"any_hit_{_label(kinds, detail, stretched)}", module="unique")
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
    """Return a function that tests a ray against objects and proxies, in one loop to compile the mesh code once."""
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
    """Return functions that trace rays through scenes with the kinds of shape in ``config``, shared by equal ones."""
    closest_object, any_object = _through_objects(config)
    closest_proxy, any_proxy = _through_proxies(config.proxies)
    if config.objects == config.proxies:
        occluded = _make_any_of_both(config.objects, config.detail, config.stretched)
    else:

        @wp.func(module="unique")
        def occluded(scene: RayScene, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.bool:
            if any_object(scene, origin, direction, t_max):
                return True
            return any_proxy(scene, origin, direction, t_max)

    return Trace(closest_object, closest_proxy, any_object, any_proxy, occluded)


def _through_objects(config: TraceConfig) -> tuple[wp.Function, wp.Function]:
    """Return functions for the closest and for any hit among objects."""
    closest, any_hit = make_walks(config.objects, config.detail, config.stretched)

    @wp.func(module="unique")
    def closest_object(scene: RayScene, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> Hit:
        return closest(scene, scene.objects, origin, direction, t_max)

    @wp.func(module="unique")
    def occluded_by_objects(scene: RayScene, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.bool:
        return any_hit(scene, scene.objects, origin, direction, t_max)

    return closest_object, occluded_by_objects


def _through_proxies(kinds: tuple[int, ...]) -> tuple[wp.Function, wp.Function]:
    """Return functions for the closest and for any hit among proxies."""
    closest, any_hit = make_walks(kinds, False, False)

    @wp.func(module="unique")
    def closest_proxy(scene: RayScene, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> Hit:
        return closest(scene, scene.proxies, origin, direction, t_max)

    @wp.func(module="unique")
    def occluded_by_proxies(scene: RayScene, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.bool:
        return any_hit(scene, scene.proxies, origin, direction, t_max)

    return closest_proxy, occluded_by_proxies


def make_walks(kinds: tuple[int, ...], detail: bool, stretched: bool) -> tuple[wp.Function, wp.Function]:
    """Return functions for the closest and any hit in an array ``shapes``.

    Each takes ``(scene, shapes, origin, direction, t_max)``.

    Args:
        kinds: Kinds of the shapes.
        detail: True if triangles may let rays pass or have normal maps.
        stretched: True if shapes may be stretched.
    """
    return _make_closest(kinds, detail, stretched), _make_any(kinds, detail, stretched)
