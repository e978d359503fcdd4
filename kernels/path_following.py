"""One path through the local scene: the light that arrives at its surfaces, and where it goes on.

Where a path meets a surface, light that arrives there straight from the environment (a direction drawn by its light)
and from every virtual light is added, and it goes on in a direction drawn by the surface (see ``path_sampling``). Both
ways to reach the environment are combined by their densities, and so are both ways to reach the disk of a virtual
light. A path ends by Russian roulette, with a chance that its weight makes up for. Nothing is clamped: the mean over
paths has no error but noise.

References:
    [Deb98] Debevec 1998, Rendering Synthetic Objects into Real Scenes.
    [PBRT] Pharr, Jakob, Humphreys, Physically Based Rendering, 4th edition, sections 13.2 and 13.4.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.materials import Surface
from warp_ar.kernels.path_guides import draw_guide, guide_count, guide_density
from warp_ar.kernels.path_sampling import (
    STREAMS,
    Drawn,
    PathKey,
    Sky,
    balance,
    draw_on_light,
    draw_reflected,
    draw_sky,
    lights_in_the_way,
    lobe_chance,
    near_radiance,
    random_triple,
    reflect_direct,
    sky_radiance,
    surface_density,
)
from warp_ar.kernels.path_vertices import (
    NOTHING,
    OBJECT,
    PROXY,
    LocalScene,
    Vertex,
    from_viewer,
    is_glossy,
    make_find_vertex,
    make_hidden_by_physical,
    make_look_up_material,
    make_see_in_frame,
    polished,
)
from warp_ar.kernels.shadow import has_penumbra, sample_light
from warp_ar.kernels.structs import LAMBERT, MIRROR, FrameParams, Hit
from warp_ar.kernels.trace import TraceConfig, make_trace, offset_origin

wp.set_module_options({"enable_backward": False})

MOST_VERTICES = wp.constant(64)
"""Surfaces on a path at most; between mirrors alone nothing else ends it."""
SURE_VERTICES = wp.constant(2)
"""Surfaces before Russian roulette begins."""
MOST_SURVIVAL = wp.constant(wp.float32(0.95))
"""Chance to go on, at most."""
GUIDED = wp.constant(wp.float32(0.5))
"""Share of directions that a matt surface draws toward objects and balls."""
PICK = wp.constant(0)
SCATTER = wp.constant(1)
SKY = wp.constant(2)
FIRST_LIGHT = wp.constant(3)
"""Streams of random numbers at a vertex; each virtual light has its own, as far as they go."""


@wp.struct
class Carried:
    """What a path brings to the camera."""

    radiance: wp.vec3  # or the difference that virtual content makes
    light: wp.vec3  # what a white first surface would send without virtual content
    rays: wp.int32  # that were traced for it


@wp.struct
class SkyLight:
    """Light of the environment from one direction, as a surface reflects it."""

    reaches: wp.bool  # whether nothing physical is in the way
    radiance: wp.vec3
    origin: wp.vec3  # of the ray to it
    direction: wp.vec3
    distance: wp.float32
    rays: wp.int32  # that were traced for it


# Toward objects. A difference begins where a path meets a virtual object, and most of what mirrors and metals throw
# onto matt surfaces comes by few directions. So a matt surface draws one direction in ``GUIDED`` toward the bounding
# sphere of a virtual object or a ball, or to where one of these mirrors light (``path_guides``). The density of every
# direction is then that of the mixture, (1 - q) p + q g.
@wp.func
def guided_chance(scene: LocalScene, surface: Surface, changes_only: wp.bool) -> wp.float32:
    """Chance of a direction to be drawn toward an object or a ball."""
    if guide_count(scene.guides, changes_only) == 0 or surface.model == wp.static(int(MIRROR)):
        return 0.0
    return GUIDED * (1.0 - lobe_chance(surface))


@wp.func
def next_density(
    scene: LocalScene, hit: Hit, surface: Surface, wo: wp.vec3, wi: wp.vec3, changes_only: wp.bool
) -> wp.float32:
    """Density with which ``draw_next`` gives a direction."""
    chance = guided_chance(scene, surface, changes_only)
    density = (1.0 - chance) * surface_density(surface, hit.normal, wo, wi)
    if chance > 0.0:
        density += chance * guide_density(scene.guides, scene.sky, hit.point, wi, changes_only)
    return density


@wp.func
def draw_next(
    scene: LocalScene, hit: Hit, surface: Surface, wo: wp.vec3, pick: wp.vec3, u: wp.vec2, changes_only: wp.bool
) -> Drawn:
    """Direction in which a path goes on, with its weight and density; ``pick``'s first and last number choose how."""
    chance = guided_chance(scene, surface, changes_only)
    if chance <= 0.0:
        return draw_reflected(surface, hit.normal, hit.geometric_normal, wo, pick[0], u)
    drawn = Drawn()
    if pick[2] < chance:
        drawn.direction = draw_guide(scene.guides, scene.sky, hit.point, pick[2] / chance, u, changes_only)
    else:
        drawn = draw_reflected(surface, hit.normal, hit.geometric_normal, wo, pick[0], u)
    wi = drawn.direction
    drawn.weight = wp.vec3(0.0, 0.0, 0.0)
    if wp.dot(wi, hit.geometric_normal) > 0.0:
        drawn.density = next_density(scene, hit, surface, wo, wi, changes_only)
        drawn.weight = reflect_direct(surface, hit.normal, wo, wi) / wp.max(drawn.density, 1.0e-20)
    return drawn


@wp.func
def survival(weight: wp.vec3, vertices: wp.int32) -> wp.float32:
    """Chance of a path to go on after so many surfaces."""
    if vertices < SURE_VERTICES:
        return 1.0
    return wp.min(wp.max(weight), MOST_SURVIVAL)


@wp.func
def light_along(sky: Sky, origin: wp.vec3, direction: wp.vec3, vertex: Vertex, density: wp.float32) -> wp.vec3:
    """The environment's light on a ray to ``vertex`` that was drawn with ``density``: its share beside ``draw_sky``."""
    light = near_radiance(sky, origin, direction, vertex.hit.t, density)
    if vertex.kind == NOTHING:
        light += sky_radiance(sky, direction, density)
    return light


@wp.struct
class SeenProxy:
    """What the frame tells of a point of a proxy."""

    reflectance: wp.vec3
    shows: wp.bool  # whether what the camera sees of it is what it sends everywhere
    radiance: wp.vec3  # that it has without virtual content, if the frame shows it
    rays: wp.int32  # that were traced for it


@functools.cache
def make_see_proxy(trace: TraceConfig) -> wp.Function:
    """``see_proxy(params, scene, vertex) -> SeenProxy``."""
    see_in_frame = make_see_in_frame(trace)

    @wp.func(module="unique")
    def see_proxy(params: FrameParams, scene: LocalScene, vertex: Vertex) -> SeenProxy:
        out = SeenProxy()
        seen = see_in_frame(params, scene, vertex.hit)
        out.rays = seen.rays
        out.radiance = seen.radiance
        out.reflectance = scene.proxy_reflectance[vertex.hit.shape]
        if seen.known:
            out.reflectance = seen.reflectance
            # What a glossy surface sends the camera is not what it sends elsewhere.
            out.shows = not is_glossy(scene, vertex)
        return out

    return see_proxy


@wp.func
def white_surface(scene: LocalScene, vertex: Vertex, lobe: wp.bool) -> Surface:
    """A first surface that tells how much light arrives: white, or the gloss of its proxy alone."""
    surface = Surface()
    if lobe:
        surface = polished(scene, vertex, wp.vec3(0.0, 0.0, 0.0))
    else:
        surface.model = wp.static(int(LAMBERT))
        surface.diffuse = wp.vec3(1.0, 1.0, 1.0)
    return surface


@functools.cache
def make_sky_light(trace: TraceConfig) -> wp.Function:
    """``sky_light(scene, hit, surface, wo, guided, changes_only, key, k) -> SkyLight``: reflected, of one direction.

    The direction is drawn by the environment's light; its share is that which balances with going on by ``draw_next``
    if ``guided``, else by ``draw_reflected``.
    """
    hidden_by_physical = make_hidden_by_physical(trace)

    @wp.func(module="unique")
    def sky_light(
        scene: LocalScene,
        hit: Hit,
        surface: Surface,
        wo: wp.vec3,
        guided: wp.bool,
        changes_only: wp.bool,
        key: PathKey,
        k: wp.int32,
    ) -> SkyLight:
        light = SkyLight()
        u = random_triple(key, k, SKY)
        sky = draw_sky(scene.sky, hit.point, wp.vec2(u[0], u[1]), u[2])
        reflected = reflect_direct(surface, hit.normal, wo, sky.direction)
        if wp.max(reflected) > 0.0 and wp.dot(hit.geometric_normal, sky.direction) > 0.0:
            light.origin = offset_origin(hit.point, hit.geometric_normal, sky.direction, hit.error)
            light.direction = sky.direction
            light.distance = sky.distance
            light.rays = 1
            if not hidden_by_physical(scene, light.origin, sky.direction, sky.distance):
                other = float(0.0)
                if guided:
                    other = next_density(scene, hit, surface, wo, sky.direction, changes_only)
                else:
                    other = surface_density(surface, hit.normal, wo, sky.direction)
                light.reaches = True
                light.radiance = balance(sky.density, other) / sky.density * wp.cw_mul(reflected, sky.radiance)
        return light

    return sky_light


@functools.cache
def make_physical_radiance(trace: TraceConfig) -> wp.Function:
    """``physical_radiance(params, scene, origin, direction, density, key, first) -> Carried``: without virtual content.

    What a ray brings that was drawn with ``density`` at vertex ``first`` of a path; of the environment the share that
    balances with drawing it by its light.
    """
    find_vertex, sky_light = make_find_vertex(trace), make_sky_light(trace)
    see_proxy, look_up_material = make_see_proxy(trace), make_look_up_material()

    @wp.func(module="unique")
    def physical_radiance(
        params: FrameParams,
        scene: LocalScene,
        origin: wp.vec3,
        direction: wp.vec3,
        density: wp.float32,
        key: PathKey,
        first: wp.int32,
    ) -> Carried:
        carried = Carried()
        weight = wp.vec3(1.0, 1.0, 1.0)
        at = origin
        toward = direction
        drawn_with = density
        k = first + 1
        while k < MOST_VERTICES:
            vertex = find_vertex(scene, at, toward, False)
            carried.rays += 1
            carried.radiance += wp.cw_mul(weight, light_along(scene.sky, at, toward, vertex, drawn_with))
            if vertex.kind == NOTHING:
                return carried
            wo = -toward
            reflectance = wp.vec3(0.0, 0.0, 0.0)
            if vertex.kind == PROXY:
                seen = see_proxy(params, scene, vertex)
                carried.rays += seen.rays
                if seen.shows:
                    carried.radiance += wp.cw_mul(weight, seen.radiance)
                    return carried
                reflectance = seen.reflectance
            vertex = from_viewer(vertex, wo)
            hit = vertex.hit
            surface = look_up_material(scene, vertex, wo, reflectance)
            if vertex.kind == PROXY:
                lit = sky_light(scene, hit, surface, wo, False, False, key, k)
                carried.rays += lit.rays
                carried.radiance += wp.cw_mul(weight, lit.radiance)
            u = random_triple(key, k, SCATTER)
            pick = random_triple(key, k, PICK)
            drawn = draw_reflected(surface, hit.normal, hit.geometric_normal, wo, pick[0], wp.vec2(u[0], u[1]))
            weight = wp.cw_mul(weight, drawn.weight)
            if wp.max(weight) <= 0.0:
                return carried
            chance = survival(weight, k)
            if pick[1] >= chance:
                return carried
            weight = weight / chance
            at = offset_origin(hit.point, hit.geometric_normal, drawn.direction, hit.error)
            toward = drawn.direction
            drawn_with = drawn.density
            k += 1
        return carried

    return physical_radiance


@functools.cache
def make_virtual_light(trace: TraceConfig) -> wp.Function:
    """``virtual_light(scene, hit, surface, wo, changes_only, key, k) -> Carried``: reflected, of all virtual lights."""
    hidden_by_physical = make_hidden_by_physical(trace)
    occluded_by_objects = make_trace(trace).occluded_by_objects

    @wp.func(module="unique")
    def virtual_light(
        scene: LocalScene,
        hit: Hit,
        surface: Surface,
        wo: wp.vec3,
        changes_only: wp.bool,
        key: PathKey,
        k: wp.int32,
    ) -> Carried:
        carried = Carried()
        for index in range(scene.lights.shape[0]):
            light = sample_light(scene.lights[index], hit.point)
            if wp.max(light.irradiance_normal) > 0.0:
                u = random_triple(key, k, FIRST_LIGHT + index % (STREAMS - FIRST_LIGHT))
                away = draw_on_light(scene.lights[index], light, wp.vec2(u[0], u[1]))
                wi = wp.vec3(away[0], away[1], away[2])
                reflected = reflect_direct(surface, hit.normal, wo, wi)
                if wp.max(reflected) > 0.0 and wp.dot(hit.geometric_normal, wi) > 0.0:
                    start = offset_origin(hit.point, hit.geometric_normal, wi, hit.error)
                    # Short of the light, so that a light on a surface is not hidden by that surface.
                    reach = away[3] - 2.0 * hit.error
                    carried.rays += 1
                    if not hidden_by_physical(scene, start, wi, reach):
                        if not occluded_by_objects(scene.rays, start, wi, reach):
                            share = float(1.0)
                            if has_penumbra(scene.lights[index], light):
                                cosine = light.distance / away[3]
                                radius = scene.lights[index].radius
                                own = away[3] * away[3] / (wp.pi * radius * radius * cosine)
                                share = balance(own, next_density(scene, hit, surface, wo, wi, changes_only))
                            carried.radiance += share * wp.cw_mul(reflected, light.irradiance_normal)
        return carried

    return virtual_light


# The frame. The camera has seen the physical surfaces, so a path that meets a proxy where the frame shows it knows the
# radiance L0 that it has without anything virtual. What virtual content (objects and lights) changes there is [Deb98]
#
#     L = L0 + (L_with - L_without),    both by the same random numbers.
#
# A path is therefore in one of two states. While *whole* it carries radiance; where it meets such a point it takes L0
# and goes on as a *difference*. A difference adds nothing as long as what it meets would be there without virtual
# content as well: it takes away light of the environment that virtual objects hide, adds that of virtual lights, and
# where it meets a virtual object it becomes whole, less the radiance that the same ray brings without objects. Of a
# pixel that nothing virtual reaches, every path gives exactly 0.
@functools.cache
def make_follow_path(trace: TraceConfig) -> wp.Function:
    """``follow_path(params, scene, first, direction, difference, white, lobe, only_light, key) -> Carried``.

    What leaves the vertex ``first`` against a unit ``direction``: all radiance, or the difference that virtual content
    makes. ``white``: the first surface is one, and what it sends without virtual content is found too; ``only_light``:
    nothing else is. ``lobe``: it is not white but the gloss of its proxy alone.
    """
    find_vertex, sky_light = make_find_vertex(trace), make_sky_light(trace)
    see_proxy, look_up_material = make_see_proxy(trace), make_look_up_material()
    physical_radiance, virtual_light = make_physical_radiance(trace), make_virtual_light(trace)
    occluded_by_objects = make_trace(trace).occluded_by_objects

    @wp.func(module="unique")
    def follow_path(
        params: FrameParams,
        scene: LocalScene,
        first: Vertex,
        direction: wp.vec3,
        difference: wp.bool,
        white: wp.bool,
        lobe: wp.bool,
        only_light: wp.bool,
        key: PathKey,
    ) -> Carried:
        carried = Carried()
        weight = wp.vec3(1.0, 1.0, 1.0)
        vertex = first
        wo = -direction
        changes_only = difference
        k = wp.int32(0)
        while k < MOST_VERTICES:
            is_white = white and k == 0
            reflectance = wp.vec3(1.0, 1.0, 1.0)
            if vertex.kind == PROXY and not is_white:
                seen = see_proxy(params, scene, vertex)
                carried.rays += seen.rays
                reflectance = seen.reflectance
                if seen.shows and not changes_only:
                    carried.radiance += wp.cw_mul(weight, seen.radiance)
                    changes_only = True
            vertex = from_viewer(vertex, wo)
            hit = vertex.hit
            surface = Surface()
            if is_white:
                surface = white_surface(scene, vertex, lobe)
            else:
                surface = look_up_material(scene, vertex, wo, reflectance)
            if not only_light:
                carried.radiance += wp.cw_mul(weight, surface.emission)
            if surface.model != wp.static(int(MIRROR)):
                arriving = sky_light(scene, hit, surface, wo, True, changes_only, key, k)
                carried.rays += arriving.rays
                if arriving.reaches:
                    light = wp.cw_mul(weight, arriving.radiance)
                    if is_white:
                        carried.light += light
                    if not only_light:
                        if occluded_by_objects(scene.rays, arriving.origin, arriving.direction, arriving.distance):
                            if changes_only:
                                carried.radiance -= light
                        elif not changes_only:
                            carried.radiance += light
                if not only_light:
                    lit = virtual_light(scene, hit, surface, wo, changes_only, key, k)
                    carried.radiance += wp.cw_mul(weight, lit.radiance)
                    carried.rays += lit.rays
            u = random_triple(key, k, SCATTER)
            pick = random_triple(key, k, PICK)
            drawn = draw_next(scene, hit, surface, wo, pick, wp.vec2(u[0], u[1]), changes_only)
            weight = wp.cw_mul(weight, drawn.weight)
            if wp.max(weight) <= 0.0:
                return carried
            origin = offset_origin(hit.point, hit.geometric_normal, drawn.direction, hit.error)
            also_without = is_white
            if not only_light:
                chance = survival(weight, k)
                if pick[1] >= chance:
                    return carried
                weight = weight / chance
                vertex = find_vertex(scene, origin, drawn.direction, True)
                carried.rays += 1
                disks = lights_in_the_way(scene.lights, hit.point, drawn.direction, vertex.hit.t, drawn.density)
                carried.radiance += wp.cw_mul(weight, disks)
                also_without = is_white or (changes_only and vertex.kind == OBJECT)
            physical = Carried()
            if also_without:
                physical = physical_radiance(params, scene, origin, drawn.direction, drawn.density, key, k)
                carried.rays += physical.rays
            if is_white:
                carried.light += wp.cw_mul(weight, physical.radiance)
                if only_light:
                    return carried
            if changes_only and vertex.kind == OBJECT:
                carried.radiance -= wp.cw_mul(weight, physical.radiance)
                changes_only = False
            if not changes_only:
                light = light_along(scene.sky, origin, drawn.direction, vertex, drawn.density)
                carried.radiance += wp.cw_mul(weight, light)
            if vertex.kind == NOTHING:
                return carried
            wo = -drawn.direction
            k += 1
        return carried

    return follow_path
