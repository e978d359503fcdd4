"""Surfaces that paths meet in the local scene, their materials, and their radiance in the frame.

``LocalScene`` holds virtual objects, proxies, mirror balls, virtual lights, and the distant environment.
``kernels/reference/path_following.py`` extends paths from vertex to vertex.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.materials import Surface, make_surface
from warp_ar.kernels.objects.reflect import make_find_in_frame
from warp_ar.kernels.objects.shade import face_viewer
from warp_ar.kernels.rays.shapes import FAR, ROUNDING, intersect_sphere
from warp_ar.kernels.rays.trace import TraceConfig, make_trace
from warp_ar.kernels.receiver.mirror_ball import nearest_ball
from warp_ar.kernels.reference.path_sampling import ALL_MODELS, Sky
from warp_ar.kernels.structs import (
    LAMBERT,
    METALLIC_ROUGHNESS,
    MIRROR,
    FrameParams,
    Hit,
    Light,
    Picture,
    Probe,
    RayScene,
)

wp.set_module_options({"enable_backward": False})

NOTHING = wp.constant(0)
OBJECT = wp.constant(1)
PROXY = wp.constant(2)
BALL = wp.constant(3)
"""Kind of surface: a mirror ball."""
LEAST_WEIGHT = wp.constant(wp.float32(0.25))
"""Least sum of bilinear weights of pixels that show a point's surface, for the frame to show the point."""


@wp.struct
class LocalScene:
    """Surfaces and lights that paths can meet, and the frame."""

    rays: RayScene
    lights: wp.array[Light]
    lights_followed: wp.bool  # whether paths from lights add light that white surfaces receive by polished objects
    near_followed: wp.bool  # whether paths from near emitters do the same
    probes: wp.array[Probe]
    sky: Sky
    spheres: wp.array[wp.vec4]  # centre and radius of spheres around objects, toward which paths from lights start
    dfg: wp.array2d[wp.vec2]  # from ``integrate_dfg``
    proxy_reflectance: wp.array[wp.vec3]  # of each proxy, for points that no pixel shows
    gloss: wp.array[wp.vec4]  # of each proxy: F0 and perceptual roughness; empty: all are matt
    picture: Picture  # rays of pixels; of the frame only the size is read
    radiance: wp.array2d[wp.vec3]  # the frame, linear; empty: there is none
    matt: wp.array2d[wp.vec3]  # the frame less specular reflections of proxies; ``radiance`` if all are matt
    reflectance: wp.array2d[wp.vec3]  # of the surface in each pixel
    shown: wp.array2d[wp.int32]  # index of the proxy in each pixel, or -1


@wp.struct
class Vertex:
    """A surface that a path meets."""

    kind: wp.int32  # NOTHING, OBJECT, PROXY or BALL
    index: wp.int32  # index of the ball
    hit: Hit


@wp.struct
class Seen:
    """Radiance and reflectance of a proxy's point in the frame."""

    known: wp.bool  # whether the frame shows the point
    radiance: wp.vec3
    reflectance: wp.vec3
    rays: wp.int32  # number of rays traced to find them


@wp.func
def from_viewer(vertex: Vertex, wo: wp.vec3) -> Vertex:
    """Return a vertex whose normals face the viewer; the shading normal has at least a small positive cosine."""
    result = vertex
    normal, geometric = face_viewer(vertex.hit.normal, vertex.hit.geometric_normal, wo)
    result.hit.normal = normal
    result.hit.geometric_normal = geometric
    return result


@functools.cache
def make_find_vertex(trace: TraceConfig) -> wp.Function:
    """Return the function ``find_vertex(scene, origin, direction, objects) -> Vertex``: first surface on a ray.

    Virtual objects count if ``objects``.
    """
    functions = make_trace(trace)
    closest_object, closest_proxy = functions.closest_object, functions.closest_proxy

    @wp.func(module="unique")
    def find_vertex(scene: LocalScene, origin: wp.vec3, direction: wp.vec3, objects: wp.bool) -> Vertex:
        vertex = Vertex()
        vertex.kind = NOTHING
        vertex.hit = closest_proxy(scene.rays, origin, direction, FAR)
        if vertex.hit.shape >= 0:
            vertex.kind = PROXY
        ball = nearest_ball(scene.probes, origin, direction, vertex.hit.t)
        if ball >= 0:
            probe = scene.probes[ball]
            hit = Hit()
            hit.t = intersect_sphere(probe.radius, origin - probe.center, direction, vertex.hit.t)
            hit.geometric_normal = wp.normalize(origin - probe.center + hit.t * direction)
            hit.normal = hit.geometric_normal
            hit.point = probe.center + probe.radius * hit.normal
            hit.error = ROUNDING * (8.0 * wp.max(wp.abs(hit.point)) + 32.0 * probe.radius)
            vertex.hit = hit
            vertex.kind = BALL
            vertex.index = ball
        if objects:
            # Where object and proxy touch, the object is visible: both depths have rounding errors.
            reach = wp.min(vertex.hit.t * (1.0 + 16.0 * ROUNDING), FAR)
            hit = closest_object(scene.rays, origin, direction, reach)
            if hit.shape >= 0:
                vertex.hit = hit
                vertex.kind = OBJECT
        return vertex

    return find_vertex


@functools.cache
def make_hidden_by_physical(trace: TraceConfig) -> wp.Function:
    """Return the function ``hidden_by_physical(scene, origin, direction, t_max) -> bool``: a proxy or ball is met."""
    occluded_by_proxies = make_trace(trace).occluded_by_proxies

    @wp.func(module="unique")
    def hidden_by_physical(scene: LocalScene, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.bool:
        if nearest_ball(scene.probes, origin, direction, t_max) >= 0:
            return True
        return occluded_by_proxies(scene.rays, origin, direction, t_max)

    return hidden_by_physical


@functools.cache
def make_see_in_frame(trace: TraceConfig) -> wp.Function:
    """Return the function ``see_in_frame(params, scene, hit) -> Seen``: a proxy's point in the frame, bilinearly."""
    find_in_frame = make_find_in_frame(trace)

    @wp.func(module="unique")
    def see_in_frame(params: FrameParams, scene: LocalScene, hit: Hit) -> Seen:
        seen = Seen()
        if scene.radiance.shape[0] == 0:
            return seen
        seen.rays = 1
        at = find_in_frame(params, scene.picture, scene.rays, scene.probes, hit)
        if at[0] < 0.0:
            return seen
        j = wp.min(wp.int32(at[0]), scene.radiance.shape[1] - 2)
        i = wp.min(wp.int32(at[1]), scene.radiance.shape[0] - 2)
        fx = at[0] - wp.float32(j)
        fy = at[1] - wp.float32(i)
        total = float(0.0)
        for k in range(4):
            row = i + k / 2
            column = j + k % 2
            if scene.shown[row, column] == hit.shape:
                weight = wp.where(k / 2 == 1, fy, 1.0 - fy) * wp.where(k % 2 == 1, fx, 1.0 - fx)
                total += weight
                seen.radiance += weight * scene.radiance[row, column]
                seen.reflectance += weight * scene.reflectance[row, column]
        if total >= LEAST_WEIGHT:
            seen.known = True
            seen.radiance = seen.radiance / total
            seen.reflectance = seen.reflectance / total
        return seen

    return see_in_frame


@wp.func
def is_glossy(scene: LocalScene, vertex: Vertex) -> wp.bool:
    """Return whether a vertex lies on a glossy proxy."""
    if vertex.kind != PROXY or scene.gloss.shape[0] == 0:
        return False
    values = scene.gloss[vertex.hit.shape]
    return wp.max(values[0], wp.max(values[1], values[2])) > 0.0


@wp.func
def polished(scene: LocalScene, vertex: Vertex, diffuse: wp.vec3) -> Surface:
    """Return a glossy proxy's surface: its specular lobe, as the stage ``gloss`` models it, and ``diffuse``."""
    values = scene.gloss[vertex.hit.shape]
    surface = Surface()
    surface.model = wp.static(int(METALLIC_ROUGHNESS))
    surface.diffuse = diffuse
    surface.f0 = wp.vec3(values[0], values[1], values[2])
    surface.reflectance = surface.f0
    surface.f90 = wp.vec3(1.0, 1.0, 1.0)
    surface.roughness = values[3]
    return surface


@functools.cache
def make_look_up_material() -> wp.Function:
    """Return ``look_up_material(scene, vertex, wo, reflectance) -> Surface``: material of a vertex seen from ``wo``.

    ``reflectance`` is used for a proxy. No other function reads how objects' materials are stored.
    """
    surface_at = make_surface(ALL_MODELS, True)

    @wp.func(module="unique")
    def look_up_material(scene: LocalScene, vertex: Vertex, wo: wp.vec3, reflectance: wp.vec3) -> Surface:
        surface = Surface()
        if vertex.kind == OBJECT:
            hit = vertex.hit
            # A ray cone of angle 0: samples are many, so textures are read at their finest level.
            surface = surface_at(scene.rays, scene.dfg, hit, wp.dot(hit.normal, wo), 0.0)
        elif vertex.kind == BALL:
            surface.model = wp.static(int(MIRROR))
            surface.reflectance = scene.probes[vertex.index].reflectance
        elif is_glossy(scene, vertex):
            surface = polished(scene, vertex, reflectance)
        else:
            surface.model = wp.static(int(LAMBERT))
            surface.diffuse = reflectance
        return surface

    return look_up_material


@wp.func
def is_turned(vertex: Vertex, direction: wp.vec3) -> wp.bool:
    """Return whether a ray of ``direction`` meets the surface at a vertex from behind."""
    return wp.dot(vertex.hit.geometric_normal, direction) >= 0.0
