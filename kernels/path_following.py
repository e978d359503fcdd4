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
    weigh_drawn,
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
class Path:
    """Where a path is: at its surface number ``k``, or on the ray that leads to it."""

    weight: wp.vec3
    origin: wp.vec3  # of the ray
    direction: wp.vec3  # unit
    density: wp.float32  # with which the direction was drawn
    k: wp.int32
    changes_only: wp.bool  # whether it carries the difference that virtual content makes
    without: wp.bool  # whether it meets no virtual content


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
def guided_chance(scene: LocalScene, surface: Surface, path: Path) -> wp.float32:
    """Chance of a direction to be drawn toward an object or a ball."""
    if path.without or guide_count(scene.guides, path.changes_only) == 0 or surface.model == wp.static(int(MIRROR)):
        return 0.0
    return GUIDED * (1.0 - lobe_chance(surface))


@wp.func
def next_density(scene: LocalScene, hit: Hit, surface: Surface, wo: wp.vec3, wi: wp.vec3, path: Path) -> wp.float32:
    """Density with which ``draw_next`` gives a direction."""
    chance = guided_chance(scene, surface, path)
    density = (1.0 - chance) * surface_density(surface, hit.normal, wo, wi)
    if chance > 0.0:
        density += chance * guide_density(scene.guides, scene.sky, hit.point, wi, path.changes_only)
    return density


@wp.func
def draw_next(
    scene: LocalScene, hit: Hit, surface: Surface, wo: wp.vec3, pick: wp.vec3, u: wp.vec2, path: Path
) -> Drawn:
    """Direction in which a path goes on, with its weight and density; ``pick``'s first and last number choose how."""
    chance = guided_chance(scene, surface, path)
    wi = wp.vec3(0.0, 0.0, 0.0)
    if pick[2] < chance:
        wi = draw_guide(scene.guides, scene.sky, hit.point, pick[2] / chance, u, path.changes_only)
    else:
        wi = draw_reflected(surface, hit.normal, hit.geometric_normal, wo, pick[0], u)
    if wp.dot(wi, hit.geometric_normal) <= 0.0:
        return Drawn()
    return weigh_drawn(surface, hit.normal, wo, wi, next_density(scene, hit, surface, wo, wi, path))


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
    """``sky_light(scene, hit, surface, wo, path, key) -> SkyLight``: reflected, of one direction.

    The direction is drawn by the environment's light; its share is that which balances with going on by ``draw_next``.
    """
    hidden_by_physical = make_hidden_by_physical(trace)

    @wp.func(module="unique")
    def sky_light(scene: LocalScene, hit: Hit, surface: Surface, wo: wp.vec3, path: Path, key: PathKey) -> SkyLight:
        light = SkyLight()
        u = random_triple(key, path.k, SKY)
        sky = draw_sky(scene.sky, hit.point, wp.vec2(u[0], u[1]), u[2])
        reflected = reflect_direct(surface, hit.normal, wo, sky.direction)
        if wp.max(reflected) > 0.0 and wp.dot(hit.geometric_normal, sky.direction) > 0.0:
            light.origin = offset_origin(hit.point, hit.geometric_normal, sky.direction, hit.error)
            light.direction = sky.direction
            light.distance = sky.distance
            light.rays = 1
            if not hidden_by_physical(scene, light.origin, sky.direction, sky.distance):
                other = next_density(scene, hit, surface, wo, sky.direction, path)
                light.reaches = True
                light.radiance = balance(sky.density, other) / sky.density * wp.cw_mul(reflected, sky.radiance)
        return light

    return sky_light


@functools.cache
def make_virtual_light(trace: TraceConfig) -> wp.Function:
    """``virtual_light(scene, hit, surface, wo, path, key) -> Carried``: reflected, of all virtual lights."""
    hidden_by_physical = make_hidden_by_physical(trace)
    occluded_by_objects = make_trace(trace).occluded_by_objects

    @wp.func(module="unique")
    def virtual_light(scene: LocalScene, hit: Hit, surface: Surface, wo: wp.vec3, path: Path, key: PathKey) -> Carried:
        carried = Carried()
        for index in range(scene.lights.shape[0]):
            light = sample_light(scene.lights[index], hit.point)
            if wp.max(light.irradiance_normal) > 0.0:
                u = random_triple(key, path.k, FIRST_LIGHT + index % (STREAMS - FIRST_LIGHT))
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
                                share = balance(own, next_density(scene, hit, surface, wo, wi, path))
                            carried.radiance += share * wp.cw_mul(reflected, light.irradiance_normal)
        return carried

    return virtual_light


@wp.struct
class Arrived:
    """Light that arrives at a surface, as it reflects it."""

    radiance: wp.vec3  # or the difference that virtual content makes; with what the surface itself sends
    light: wp.vec3  # of the environment, without virtual content
    rays: wp.int32  # that were traced for it


@functools.cache
def make_arrive(trace: TraceConfig) -> wp.Function:
    """``arrive(scene, hit, surface, wo, path, only_light, key) -> Arrived``: straight from lights; 0 at mirrors."""
    sky_light, virtual_light = make_sky_light(trace), make_virtual_light(trace)
    occluded_by_objects = make_trace(trace).occluded_by_objects

    @wp.func(module="unique")
    def arrive(
        scene: LocalScene, hit: Hit, surface: Surface, wo: wp.vec3, path: Path, only_light: wp.bool, key: PathKey
    ) -> Arrived:
        out = Arrived()
        with_virtual = not (only_light or path.without)
        if with_virtual:
            out.radiance = surface.emission
        if surface.model != wp.static(int(MIRROR)):
            sky = sky_light(scene, hit, surface, wo, path, key)
            out.rays = sky.rays
            if sky.reaches:
                out.light = sky.radiance
                if with_virtual:
                    if occluded_by_objects(scene.rays, sky.origin, sky.direction, sky.distance):
                        if path.changes_only:
                            out.radiance -= sky.radiance
                    elif not path.changes_only:
                        out.radiance += sky.radiance
            if with_virtual:
                lit = virtual_light(scene, hit, surface, wo, path, key)
                out.radiance += lit.radiance
                out.rays += lit.rays
        return out

    return arrive


@wp.func
def go_on(scene: LocalScene, hit: Hit, surface: Surface, wo: wp.vec3, path: Path, key: PathKey) -> Path:
    """The path on its next ray; without weight where it ends."""
    u = random_triple(key, path.k, SCATTER)
    pick = random_triple(key, path.k, PICK)
    drawn = draw_next(scene, hit, surface, wo, pick, wp.vec2(u[0], u[1]), path)
    following = path
    following.weight = wp.cw_mul(path.weight, drawn.weight)
    chance = survival(following.weight, path.k)
    following.weight = wp.where(pick[1] < chance, following.weight / wp.max(chance, 1.0e-30), wp.vec3(0.0, 0.0, 0.0))
    following.origin = offset_origin(hit.point, hit.geometric_normal, drawn.direction, hit.error)
    following.direction = drawn.direction
    following.density = drawn.density
    following.k += 1
    return following


@wp.func
def start_without(path: Path) -> Path:
    """The path that leaves virtual content out, on the ray on which ``path`` is."""
    other = path
    other.weight = wp.vec3(1.0, 1.0, 1.0)
    other.changes_only = False
    other.without = True
    return other


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
#
# That radiance is found by a path of its own, for which the other waits and which meets nothing virtual. Both go round
# the same loop: threads of a warp do the same whichever of the two they follow, and what a path does at a surface
# is compiled once.
@functools.cache
def make_follow_path(trace: TraceConfig) -> wp.Function:
    """``follow_path(params, scene, first, direction, difference, white, lobe, only_light, key) -> Carried``.

    What leaves the vertex ``first`` against a unit ``direction``: all radiance, or the difference that virtual content
    makes. ``white``: the first surface is one, and what it sends without virtual content is found too; ``only_light``:
    nothing else is. ``lobe``: it is not white but the gloss of its proxy alone.
    """
    find_vertex, arrive = make_find_vertex(trace), make_arrive(trace)
    see_proxy, look_up_material = make_see_proxy(trace), make_look_up_material()

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
        vertex = first
        path = Path()
        path.weight = wp.vec3(1.0, 1.0, 1.0)
        path.direction = direction
        path.changes_only = difference
        waiting = Path()  # while one without virtual content is followed
        physical = wp.vec3(0.0, 0.0, 0.0)  # what that one brings
        is_known = bool(False)  # whether it is of the ray on which ``path`` is
        at_surface = bool(True)
        while True:
            ended = bool(False)
            if at_surface:
                is_white = white and path.k == 0
                wo = -path.direction
                reflectance = wp.vec3(1.0, 1.0, 1.0)
                if vertex.kind == PROXY and not is_white:
                    seen = see_proxy(params, scene, vertex)
                    carried.rays += seen.rays
                    reflectance = seen.reflectance
                    if seen.shows and not path.changes_only:
                        if path.without:
                            physical += wp.cw_mul(path.weight, seen.radiance)
                            ended = True
                        else:
                            carried.radiance += wp.cw_mul(path.weight, seen.radiance)
                            path.changes_only = True
                if not ended:
                    vertex = from_viewer(vertex, wo)
                    surface = Surface()
                    if is_white:
                        surface = white_surface(scene, vertex, lobe)
                    else:
                        surface = look_up_material(scene, vertex, wo, reflectance)
                    lit = arrive(scene, vertex.hit, surface, wo, path, only_light, key)
                    carried.rays += lit.rays
                    if path.without:
                        physical += wp.cw_mul(path.weight, lit.light)
                    else:
                        carried.radiance += wp.cw_mul(path.weight, lit.radiance)
                        if is_white:
                            carried.light += wp.cw_mul(path.weight, lit.light)
                    path = go_on(scene, vertex.hit, surface, wo, path, key)
                    ended = wp.max(path.weight) <= 0.0
                    if is_white and not ended:
                        waiting = path
                        path = start_without(path)
                        physical = wp.vec3(0.0, 0.0, 0.0)
            at_surface = True
            if not ended:
                vertex = find_vertex(scene, path.origin, path.direction, not path.without)
                carried.rays += 1
                meets = path.changes_only and vertex.kind == OBJECT
                if meets and not is_known:
                    waiting = path
                    path = start_without(path)
                    physical = wp.vec3(0.0, 0.0, 0.0)
                    at_surface = False
                else:
                    if not path.without:
                        disks = lights_in_the_way(scene.lights, path.origin, path.direction, vertex.hit.t, path.density)
                        carried.radiance += wp.cw_mul(path.weight, disks)
                        if meets:
                            carried.radiance -= wp.cw_mul(path.weight, physical)
                            path.changes_only = False
                        is_known = False
                    if not path.changes_only:
                        light = light_along(scene.sky, path.origin, path.direction, vertex, path.density)
                        if path.without:
                            physical += wp.cw_mul(path.weight, light)
                        else:
                            carried.radiance += wp.cw_mul(path.weight, light)
                    ended = vertex.kind == NOTHING or path.k >= MOST_VERTICES
            if ended:
                if not path.without:
                    return carried
                path = waiting
                is_known = True
                at_surface = False
                if white and path.k == 1:
                    carried.light += wp.cw_mul(path.weight, physical)
                if only_light:
                    return carried
        return carried

    return follow_path
