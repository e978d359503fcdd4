"""Light that virtual objects reflect to the receiver, along a ray that met an object.

Method ``traced`` sends another ray into one of the object's two lobes, picked by their reflectance. The diffuse lobe
gives albedo E(n) / pi, times a factor by the first surface on the ray: 1 for none; for another object, its colour; for
the receiver, 1 if a ray from there leaves the scene, else a share of the object's reflectance. So light between an
object and the ground falls off with each reflection, the more slowly the whiter the object. The glossy lobe gives the
radiance in the mirror direction.

Method ``estimated`` needs no other ray. Both lobes reflect the distant environment, in which the receiver replaces the
half-space behind the cell's own surface. Let h be the share of the cell's light that objects hide, u the light that
objects reflect of the environment, and d the light that they would reflect of an unshaded receiver. The receiver that
objects reflect is near the cell and shaded like it, so the ratio r satisfies

    r = 1 - h + u + d r,    r = (1 - h + u) / (1 - d),

which includes all interreflection between object and ground. White objects in a white environment (u + d = h) give 1,
black objects 1 - h, and a cell that sees only objects which reflect only the ground (u = 0, h = 1) gets 0.

In both methods the receiver is at most as bright as a white one, E / pi. Otherwise an environment that was captured too
dark would make the receiver glow next to the object.
"""

from __future__ import annotations

import dataclasses
import functools

import warp as wp

from warp_ar.kernels.environment.lobes import level_from_alpha
from warp_ar.kernels.materials import Surface, lobe_axis, make_surface, reflect
from warp_ar.kernels.objects.reflect import (
    RAY_SPREAD,
    DistantLight,
    DistantLightConfig,
    knows_irradiance,
    knows_levels,
    look_up,
    make_distant_irradiance,
    make_find_in_frame,
    make_radiance_along,
    make_reflected_radiance,
    make_shade_unoccluded,
)
from warp_ar.kernels.rays.shapes import FAR
from warp_ar.kernels.rays.trace import make_trace, offset_origin
from warp_ar.kernels.sampling import frame_from_normal, sample_cosine_hemisphere, uniform_from_bits
from warp_ar.kernels.structs import SPHERE, FrameParams, Hit, Picture, RayScene, Shape

wp.set_module_options({"enable_backward": False})

CAUSTIC_ALPHA = wp.constant(wp.float32(0.35))
"""Least GGX width alpha of an object's lobe when it lights a nearby point of the receiver.

A mirror's caustic on the receiver is too fine for the few rays, and would come out as specks. The wider lobe blurs it
and keeps its energy. Far from the object fewer rays meet it and each stands for a larger part of it, so the width grows
with the distance over the object's size.
"""
MAX_BRIGHTNESS = wp.constant(wp.float32(2.0))
"""Upper bound of an object's estimated radiance, over the mean radiance in the hemisphere above the cell's surface.

An emitter may light a small part of an object that few samples meet: brighter values would show as specks.
"""
FURTHER = wp.constant(wp.float32(0.5))
"""Factor on the light that a shaded receiver reflects to an object above it: half of it is lost in the shadow."""


@wp.func
def bounding_radius(shape: Shape) -> wp.float32:
    """Return the radius, metres, of a sphere around a shape's position that encloses it."""
    if shape.kind == SPHERE:
        return shape.scale * shape.extent[0]
    return shape.scale * wp.length(shape.extent)


@wp.func
def caustic_alpha(shape: Shape, point: wp.vec3) -> wp.float32:
    """Return the least lobe width alpha of an object for light on a point of the receiver."""
    return wp.clamp(CAUSTIC_ALPHA * wp.length(shape.position - point) / bounding_radius(shape), CAUSTIC_ALPHA, 1.0)


@wp.struct
class Meeting:
    """Point at which a ray from the receiver meets an object, and the weight of the object's radiance."""

    hit: Hit
    direction: wp.vec3
    alpha: wp.float32  # least width of the object's lobe
    stands_for: wp.float32  # weight of the radiance, summed over all samples that the ray represents


@wp.func
def meet_object(scene: RayScene, other: Hit, point: wp.vec3, direction: wp.vec3, stands_for: wp.float32) -> Meeting:
    """Return the ``Meeting`` of a ray from a point of the receiver with an object at the hit ``other``."""
    meeting = Meeting()
    meeting.hit = other
    meeting.direction = direction
    meeting.alpha = caustic_alpha(scene.objects[other.shape], point)
    meeting.stands_for = stands_for
    return meeting


@wp.struct
class ReflectedLight:
    """Weighted radiance that objects reflect to a point of the receiver, by its origin."""

    sent: wp.vec3  # light that came from the environment
    returned: wp.vec3  # light that came from the receiver


@wp.struct
class Before:
    """Light in the hemisphere above a cell's surface; the method ``estimated`` finds the light of objects from it."""

    up: wp.vec3  # the surface's normal, on the side that light comes from
    from_receiver: wp.vec3  # irradiance of a surface that faces the receiver
    most: wp.vec3  # largest radiance of the receiver, that of a white one
    brightest: wp.float32  # upper bound of an object's radiance


@functools.cache
def make_look_wide(config: DistantLightConfig) -> wp.Function:
    """Return the function ``look_wide(environment, point, direction) -> vec3``: blurred radiance of the environment.

    Emitters are in the directions in which the balls show them.
    """
    unplaced = dataclasses.replace(config, emitters=False)
    distant_irradiance, radiance_along = make_distant_irradiance(unplaced), make_radiance_along(unplaced)

    @wp.func(module="unique")
    def look_wide(distant: DistantLight, point: wp.vec3, direction: wp.vec3) -> wp.vec3:
        radiance = wp.vec3(0.0)
        if wp.static(config.diffuse != "none"):
            if knows_irradiance(distant) and not knows_levels(distant):
                radiance = distant_irradiance(distant, point, direction) / wp.pi
        if wp.static(config.specular):
            if knows_levels(distant):
                level = level_from_alpha(CAUSTIC_ALPHA, distant.level_height)
                radiance = radiance_along(distant, point, direction, level)
        return radiance

    return look_wide


@functools.cache
def make_reflect_estimated(config: DistantLightConfig) -> wp.Function:
    """Return the function ``reflect_estimated(distant, meeting, surface, before, so_far) -> ReflectedLight``.

    Its result is ``so_far`` plus the light that both lobes of an object reflect, found without another ray.
    The glossy lobe has at least the width ``meeting.alpha``. The receiver fills the directions below ``before.up``.
    Radiance is limited to ``before.brightest``.
    """
    reflected_radiance = make_reflected_radiance(config)
    distant_irradiance = make_distant_irradiance(config)

    @wp.func(module="unique")
    def reflect_estimated(
        distant: DistantLight, meeting: Meeting, surface: Surface, before: Before, so_far: ReflectedLight
    ) -> ReflectedLight:
        out = so_far
        hit = meeting.hit
        wo = -meeting.direction
        normal = hit.normal
        of_environment = wp.vec3(0.0)
        of_receiver = wp.vec3(0.0)  # light that the object would reflect of a receiver without shadows
        if wp.static(config.diffuse != "none"):
            irradiance = distant_irradiance(distant, hit.point, normal)
            if wp.static(config.textures):
                irradiance *= surface.occlusion
            # A uniform receiver gives a surface of normal n the irradiance of one that faces it, times (1 - n.up) / 2.
            seen = 0.5 * (1.0 - wp.dot(normal, before.up))
            received = wp.min(seen * before.from_receiver, irradiance)
            of_receiver = wp.cw_mul(surface.diffuse, wp.min(received, seen * wp.pi * before.most)) / wp.pi
            of_environment = wp.cw_mul(surface.diffuse, irradiance - received) / wp.pi
        if wp.static(config.specular):
            if knows_levels(distant):
                wi = lobe_axis(surface, reflect(wo, normal), normal)
                floor = level_from_alpha(meeting.alpha, distant.level_height)
                reflected = reflected_radiance(
                    distant, surface.model, surface.roughness, surface.shininess, hit.point, wi, floor
                )
                share = wp.clamp(0.5 - 0.5 * wp.dot(wi, before.up) / CAUSTIC_ALPHA, 0.0, 1.0)
                of_it = wp.min(share * wp.max(reflected, before.from_receiver / wp.pi), reflected)
                of_receiver += wp.cw_mul(surface.reflectance, wp.min(of_it, share * before.most))
                of_environment += wp.cw_mul(surface.reflectance, reflected - of_it)
        brightness = wp.max(of_environment + of_receiver)
        weight = meeting.stands_for * wp.min(before.brightest / wp.max(brightness, 1.0e-20), 1.0)
        out.sent += weight * of_environment
        out.returned += weight * of_receiver
        return out

    return reflect_estimated


@functools.cache
def make_reflect_traced(config: DistantLightConfig) -> wp.Function:
    """Return ``reflect_traced(params, picture, scene, distant, meeting, surface, seed, so_far) -> ReflectedLight``.

    Its result is ``so_far`` plus the light that an object reflects, estimated by one random ray into one lobe. The
    glossy lobe is at least ``meeting.alpha`` wide.
    """
    trace = make_trace(config.trace)
    closest_object, closest_proxy = trace.closest_object, trace.closest_proxy
    occluded_by_objects = trace.occluded_by_objects
    find_in_frame = make_find_in_frame(config.trace)
    shade_unoccluded = make_shade_unoccluded(config)
    reflected_radiance = make_reflected_radiance(config)
    distant_irradiance, captured_along = make_distant_irradiance(config), make_radiance_along(config, captured=True)

    @wp.func(module="unique")
    def reflect_traced(
        params: FrameParams,
        picture: Picture,
        scene: RayScene,
        distant: DistantLight,
        meeting: Meeting,
        surface: Surface,
        seed: wp.vec3ui,
        so_far: ReflectedLight,
    ) -> ReflectedLight:
        out = so_far
        hit = meeting.hit
        wo = -meeting.direction
        normal, geometric = hit.normal, hit.geometric_normal
        rough = surface.diffuse[0] + surface.diffuse[1] + surface.diffuse[2]
        glossy = surface.reflectance[0] + surface.reflectance[1] + surface.reflectance[2]
        if wp.static(config.diffuse == "none") or not knows_irradiance(distant):
            rough = float(0.0)
        if wp.static(not config.specular) or not knows_levels(distant):
            glossy = float(0.0)
        if rough + glossy <= 0.0:
            return out
        rough_share = rough / (rough + glossy)
        u = wp.vec2(uniform_from_bits(seed[0]), uniform_from_bits(seed[1]))
        is_rough = uniform_from_bits(seed[2]) < rough_share
        weight = surface.reflectance / wp.max(1.0 - rough_share, 1.0e-6)
        wi = reflect(wo, normal)
        if is_rough:
            weight = surface.diffuse / rough_share
            wi = frame_from_normal(normal) * sample_cosine_hemisphere(u)
        if wp.dot(wi, geometric) <= 0.0:
            return out

        received = wp.vec3(0.0)
        origin = offset_origin(hit.point, geometric, wi, hit.error)
        other = closest_object(scene, origin, wi, FAR)
        proxy = closest_proxy(scene, origin, wi, other.t)
        if is_rough and (proxy.shape >= 0 or other.shape < 0):
            received = distant_irradiance(distant, hit.point, normal) / wp.pi
        if proxy.shape >= 0:
            # The receiver counts as fully lit if a ray from the point on it leaves the scene.
            up = proxy.geometric_normal
            if wp.dot(up, wi) > 0.0:
                up = -up
            leaving = frame_from_normal(up) * sample_cosine_hemisphere(wp.vec2(u[1], u[0]))
            start = offset_origin(proxy.point, up, leaving, proxy.error)
            if not is_rough:
                at = find_in_frame(params, picture, scene, distant.probes, proxy)
                if at[0] >= 0.0:
                    received = look_up(picture, at[0], at[1])
                else:
                    received = captured_along(distant, proxy.point, wi, 0.0)
            received = wp.min(received, distant_irradiance(distant, proxy.point, up) / wp.pi)
            if occluded_by_objects(scene, start, leaving, FAR):
                received = wp.cw_mul(received, FURTHER * (surface.diffuse + surface.reflectance))
        elif other.shape >= 0:
            received = shade_unoccluded(scene, distant, other, wi, RAY_SPREAD)
        elif not is_rough:
            if wp.static(config.specular):
                floor = level_from_alpha(meeting.alpha, distant.level_height)
                received = reflected_radiance(
                    distant, surface.model, surface.roughness, surface.shininess, hit.point, wi, floor
                )
        out.sent += meeting.stands_for * wp.cw_mul(weight, received)
        return out

    return reflect_traced


@functools.cache
def make_look_before(config: DistantLightConfig) -> wp.Function:
    """Return ``look_before(environment, point, normal, direction) -> Before``: light on ``direction``'s side."""
    distant_irradiance = make_distant_irradiance(dataclasses.replace(config, emitters=False))

    @wp.func(module="unique")
    def look_before(distant: DistantLight, point: wp.vec3, normal: wp.vec3, direction: wp.vec3) -> Before:
        before = Before()
        before.up = normal
        if wp.dot(normal, direction) < 0.0:
            before.up = -normal
        before.from_receiver = distant_irradiance(distant, point, -before.up)
        before.most = distant_irradiance(distant, point, before.up) / wp.pi
        before.brightest = MAX_BRIGHTNESS * wp.max(before.most)
        return before

    return look_before


@functools.cache
def make_reflect_back(config: DistantLightConfig, traced: bool) -> wp.Function:
    """Return ``reflect_back(params, picture, scene, distant, met, before, seed, so_far) -> ReflectedLight``.

    The result is ``so_far`` plus the light that the object reflects. The light is found by another ray if ``traced``,
    else it is estimated from ``before``.
    """
    surface_at = make_surface(config.models, config.textures)
    reflect_traced = make_reflect_traced(config) if traced else None
    reflect_estimated = None if traced else make_reflect_estimated(config)

    @wp.func(module="unique")
    def reflect_back(
        params: FrameParams,
        picture: Picture,
        scene: RayScene,
        distant: DistantLight,
        met: Meeting,
        before: Before,
        seed: wp.vec3ui,
        so_far: ReflectedLight,
    ) -> ReflectedLight:
        out = so_far
        meeting = met
        if wp.dot(meeting.hit.geometric_normal, meeting.direction) > 0.0:
            meeting.hit.normal = -meeting.hit.normal
            meeting.hit.geometric_normal = -meeting.hit.geometric_normal
        cosine = wp.max(-wp.dot(meeting.hit.normal, meeting.direction), 0.0)
        surface = surface_at(scene, distant.dfg, meeting.hit, cosine, RAY_SPREAD)
        if wp.static(config.textures and config.gathered):
            out.sent += meeting.stands_for * surface.emission
        if wp.static(traced):
            out = reflect_traced(params, picture, scene, distant, meeting, surface, seed, out)
        else:
            out = reflect_estimated(distant, meeting, surface, before, out)
        return out

    return reflect_back
