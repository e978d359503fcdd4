"""Surfaces that paths meet in the local scene, their materials, and the frame's picture of them.

``LocalScene`` is all that the program knows: virtual objects, proxies, mirror balls, virtual lights, and the
environment, which is distant. ``kernels/reference/path_following.py`` goes from vertex to vertex.
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
"""Kind of thing that a ray meets."""
LEAST_WEIGHT = wp.constant(wp.float32(0.25))
"""Least bilinear weight of the four pixels around a point that show its surface, for the point to count as seen."""


@wp.struct
class LocalScene:
    """All that paths can meet."""

    rays: RayScene
    lights: wp.array[Light]
    lights_followed: wp.bool  # whether their light is followed from them, where white surfaces have it from others
    near_followed: wp.bool  # likewise light of near emitters
    probes: wp.array[Probe]
    sky: Sky
    spheres: wp.array[wp.vec4]  # centre and radius, around virtual objects; paths from lights start toward them
    dfg: wp.array2d[wp.vec2]  # of ``integrate_dfg``
    proxy_reflectance: wp.array[wp.vec3]  # of each proxy, where no pixel tells
    gloss: wp.array[wp.vec4]  # of each proxy: F0 and perceptual roughness; empty: all are matt
    picture: Picture  # rays of pixels; of the frame only the size is read
    radiance: wp.array2d[wp.vec3]  # the frame, linear; empty: there is none
    matt: wp.array2d[wp.vec3]  # the frame less what proxies mirror in it; ``radiance`` itself where none does
    reflectance: wp.array2d[wp.vec3]  # of what each pixel shows
    shown: wp.array2d[wp.int32]  # the proxy that each pixel shows, or -1


@wp.struct
class Vertex:
    """A surface that a path meets."""

    kind: wp.int32  # NOTHING, OBJECT, PROXY or BALL
    index: wp.int32  # of the ball
    hit: Hit


@wp.struct
class Seen:
    """Observation in the frame of a point of a proxy."""

    known: wp.bool
    radiance: wp.vec3
    reflectance: wp.vec3
    rays: wp.int32  # that were traced to find out


@wp.func
def from_viewer(vertex: Vertex, wo: wp.vec3) -> Vertex:
    """A vertex whose normals are on the viewer's side, the one for shading at least a little."""
    result = vertex
    normal, geometric = face_viewer(vertex.hit.normal, vertex.hit.geometric_normal, wo)
    result.hit.normal = normal
    result.hit.geometric_normal = geometric
    return result


@functools.cache
def make_find_vertex(trace: TraceConfig) -> wp.Function:
    """``find_vertex(scene, origin, direction, objects) -> Vertex``: the first; if ``objects``, of virtual ones too."""
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
            # Where object and proxy touch, the object is seen: both depths carry a few roundings.
            reach = wp.min(vertex.hit.t * (1.0 + 16.0 * ROUNDING), FAR)
            hit = closest_object(scene.rays, origin, direction, reach)
            if hit.shape >= 0:
                vertex.hit = hit
                vertex.kind = OBJECT
        return vertex

    return find_vertex


@functools.cache
def make_hidden_by_physical(trace: TraceConfig) -> wp.Function:
    """``hidden_by_physical(scene, origin, direction, t_max) -> bool``: whether a proxy or a ball is in the way."""
    occluded_by_proxies = make_trace(trace).occluded_by_proxies

    @wp.func(module="unique")
    def hidden_by_physical(scene: LocalScene, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.bool:
        if nearest_ball(scene.probes, origin, direction, t_max) >= 0:
            return True
        return occluded_by_proxies(scene.rays, origin, direction, t_max)

    return hidden_by_physical


@functools.cache
def make_see_in_frame(trace: TraceConfig) -> wp.Function:
    """``see_in_frame(params, scene, hit) -> Seen``: a proxy's point where the frame shows it, bilinear."""
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
    """Return whether a vertex is on a proxy that mirrors."""
    if vertex.kind != PROXY or scene.gloss.shape[0] == 0:
        return False
    values = scene.gloss[vertex.hit.shape]
    return wp.max(values[0], wp.max(values[1], values[2])) > 0.0


@wp.func
def polished(scene: LocalScene, vertex: Vertex, diffuse: wp.vec3) -> Surface:
    """A glossy proxy's surface: the lobe of ``gloss`` beside what is scattered."""
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
    """``look_up_material(scene, vertex, wo, reflectance) -> Surface``: what a vertex is made of, seen from ``wo``.

    The only place that knows how objects' materials are stored. ``reflectance`` is a proxy's.
    """
    surface_at = make_surface(ALL_MODELS, True)

    @wp.func(module="unique")
    def look_up_material(scene: LocalScene, vertex: Vertex, wo: wp.vec3, reflectance: wp.vec3) -> Surface:
        surface = Surface()
        if vertex.kind == OBJECT:
            hit = vertex.hit
            # A cone without an angle: samples are many, and pictures are read at their finest level.
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
    """Return whether a ray meets a surface from behind."""
    return wp.dot(vertex.hit.geometric_normal, direction) >= 0.0
