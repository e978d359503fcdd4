"""One path through the local scene: the light that arrives at its surfaces, and where it goes on.

A path goes round one loop (``path_tracer``): what its ray meets (``meet``), then what happens at the surface
(``visit``). There light that arrives straight from the environment (a direction drawn by its light) and from every
virtual light is added, and it goes on in a direction drawn by the surface (see ``path_sampling``). Both ways to reach
the environment are combined by their densities, and so are both ways to reach the disk of a virtual light. A path ends
by Russian roulette, with a chance that its throughput makes up for. Nothing is clamped: the mean over paths has no
error but noise.

References:
    [Deb98] Debevec 1998, Rendering Synthetic Objects into Real Scenes.
    [PBRT] Pharr, Jakob, Humphreys, Physically Based Rendering, 4th edition, sections 13.2 and 13.4.
    [Tal05] Talbot, Cline, Egbert, Importance Resampling for Global Illumination, EGSR 2005.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.color import brightness
from warp_ar.kernels.materials import Surface
from warp_ar.kernels.rays.shadow import has_penumbra, sample_light
from warp_ar.kernels.rays.trace import TraceConfig, make_trace, offset_origin
from warp_ar.kernels.reference.path_sampling import (
    NO_DENSITY,
    STREAMS,
    PathKey,
    Sky,
    SkyLight,
    balance,
    draw_on_light,
    draw_reflected,
    draw_sky,
    lights_in_the_way,
    near_radiance,
    random_triple,
    reflect_direct,
    sky_radiance,
    surface_density,
)
from warp_ar.kernels.reference.path_vertices import (
    NOTHING,
    OBJECT,
    PROXY,
    LocalScene,
    Vertex,
    from_viewer,
    is_glossy,
    make_hidden_by_physical,
    make_look_up_material,
    make_see_in_frame,
    polished,
)
from warp_ar.kernels.structs import LAMBERT, MIRROR, FrameParams, Hit

wp.set_module_options({"enable_backward": False})

MOST_VERTICES = wp.constant(64)
"""Surfaces on a path at most; between mirrors alone nothing else ends it."""
SURE_VERTICES = wp.constant(2)
"""Surfaces before Russian roulette begins."""
MOST_SURVIVAL = wp.constant(wp.float32(0.95))
"""Chance to go on, at most."""
PICK = wp.constant(0)
SCATTER = wp.constant(1)
SKY = wp.constant(2)
CHOICE = wp.constant(3)
FIRST_LIGHT = wp.constant(4)
"""Streams of random numbers at a vertex; each virtual light has its own, as far as they go."""

CANDIDATES = wp.constant(4)
"""Directions toward the environment's light at a first surface, of which one is followed."""
GOLDEN = wp.constant(wp.float32(0.61803399))
SILVER = wp.constant(wp.float32(0.41421356))
"""Steps between candidates, which spread them evenly."""
MOST_RANDOM = wp.constant(wp.float32(0.99999994))
"""Largest random number below 1."""

SURFACE = wp.constant(0)
RAY = wp.constant(1)
ENDED = wp.constant(2)
"""Next step of a path."""


@wp.struct
class PathState:
    """State of a path: at its surface number ``depth``, or on the ray that leads to it."""

    throughput: wp.vec3
    origin: wp.vec3  # of the ray
    direction: wp.vec3  # unit
    density: wp.float32  # with which the direction was drawn
    depth: wp.int32
    changes_only: wp.bool  # whether it carries the difference that virtual content makes
    without: wp.bool  # whether it meets no virtual content
    without_near: wp.bool  # whether light straight from near emitters is no part of what its ray brings


@wp.struct
class PathPair:
    """A path from the camera, and the one without virtual content for which it waits at times."""

    path: PathState  # the one that is followed
    waiting: PathState  # while ``path`` is the one without virtual content
    physical: wp.vec3  # what the one without brings
    is_known: wp.bool  # whether it is of the ray on which ``path`` is
    next: wp.int32  # SURFACE, RAY or ENDED
    white: wp.bool  # whether the first surface is white, and what it sends without virtual content is asked for too
    lobe: wp.bool  # whether it is not white but the gloss of its proxy alone
    glossy: wp.bool  # whether there is one of either kind
    only_light: wp.bool  # whether nothing else is asked for
    radiance: wp.vec3  # that it brings to the camera, or the difference that virtual content makes
    light: wp.vec3  # what the white surface would send without virtual content
    rays: wp.int32  # that were traced for it


@wp.struct
class DirectionSample:
    """A direction at a surface: toward light, or in which the path goes on."""

    direction: wp.vec3  # unit; zero where there is none
    density: wp.float32  # per steradian; NO_DENSITY where no other way draws it
    times: wp.float32  # that density is that of so many candidates together
    distance: wp.float32  # of what sends light
    radiance: wp.vec3  # from there, or the irradiance of a surface that faces the light
    per: wp.float32  # that this is divided by: the density, or 1


@wp.func
def draw_next(hit: Hit, surface: Surface, wo: wp.vec3, path: PathState, key: PathKey) -> wp.vec3:
    """Draw the direction in which a path goes on; zero where it leads into the surface."""
    u = random_triple(key, path.depth, SCATTER)
    pick = random_triple(key, path.depth, PICK)
    return draw_reflected(surface, hit.normal, hit.geometric_normal, wo, pick[0], wp.vec2(u[0], u[1]))


@wp.func
def survival(throughput: wp.vec3, vertices: wp.int32) -> wp.float32:
    """Chance of a path to go on after so many surfaces."""
    if vertices < SURE_VERTICES:
        return 1.0
    return wp.min(wp.max(throughput), MOST_SURVIVAL)


@wp.func
def light_along(
    sky: Sky, origin: wp.vec3, direction: wp.vec3, vertex: Vertex, density: wp.float32, without_near: wp.bool
) -> wp.vec3:
    """The environment's light on a ray to ``vertex`` that was drawn with ``density``: its share beside ``draw_sky``."""
    light = wp.vec3(0.0, 0.0, 0.0)
    own = density
    if not without_near:
        light = near_radiance(sky, origin, direction, vertex.hit.t, density)
    else:
        own = density * (1.0 - sky.near_share)  # as only the distant environment is drawn
    if vertex.kind == NOTHING:
        light += sky_radiance(sky, direction, own)
    return light


@wp.func
def wrap(u: wp.float32) -> wp.float32:
    """A number's part from 0 to below 1."""
    return wp.min(u - wp.floor(u), MOST_RANDOM)


@wp.func
def reflected_from(surface: Surface, hit: Hit, wo: wp.vec3, wi: wp.vec3) -> wp.vec3:
    """Return a surface's reflection of light from ``wi``, with the cosine; a mirror's reflectance; 0 from below."""
    reflected = wp.vec3(0.0, 0.0, 0.0)
    if wp.dot(hit.geometric_normal, wi) > 0.0:
        reflected = surface.reflectance
        if surface.model != wp.static(int(MIRROR)):
            reflected = reflect_direct(surface, hit.normal, wo, wi)
    return reflected


# Light of the environment is drawn by how bright it is, not by what the surface makes of it or by where it faces. At a
# first surface, where most of a picture's noise begins, several directions are therefore drawn, and one of them is
# chosen by what the surface would reflect of it [Tal05]. With w_k what candidate k would reflect over the density with
# which it was drawn, the one that is chosen counts with the mean of all w over its own, whatever the candidates have to
# do with each other: each alone is drawn as it should be. So they are spread evenly from one random start.
@wp.func
def candidate_value(surface: Surface, hit: Hit, wo: wp.vec3, sky: SkyLight, times: wp.float32) -> wp.float32:
    """Return a surface's reflection of light along a candidate, by its share beside what the surface draws itself."""
    value = brightness(wp.cw_mul(reflected_from(surface, hit, wo, sky.direction), sky.radiance))
    if value > 0.0:
        value *= balance(times * sky.density, surface_density(surface, hit.normal, wo, sky.direction))
    return value


@wp.func
def draw_toward_sky(
    scene: LocalScene, hit: Hit, surface: Surface, wo: wp.vec3, path: PathState, without_near: wp.bool, key: PathKey
) -> DirectionSample:
    """A direction toward light of the environment, the distant one alone if ``without_near``; zero where none is."""
    out = DirectionSample()
    u = random_triple(key, path.depth, SKY)
    near_share = wp.where(without_near, scene.sky.near_share, 0.0)
    count = wp.int32(1)
    pick = float(0.0)
    if path.depth == 0:
        count = CANDIDATES
        pick = random_triple(key, path.depth, CHOICE)[0]
    out.times = wp.float32(count)
    total = float(0.0)
    chosen = float(0.0)
    k = wp.int32(0)
    while k < count:  # not unrolled
        at = wp.float32(k) / out.times
        first = wp.vec2(wrap(u[0] + at), wrap(u[1] + wp.float32(k) * GOLDEN))
        pick_near = near_share + (1.0 - near_share) * wrap(u[2] + wp.float32(k) * SILVER)
        sky = draw_sky(scene.sky, hit.point, first, pick_near)
        sky.density = sky.density / (1.0 - near_share)
        value = sky.density
        if count > 1:
            value = candidate_value(surface, hit, wo, sky, out.times)
        weight = value / sky.density
        if weight > 0.0:
            total += weight
            share = weight / total
            if pick < share:
                pick = pick / share
                chosen = value
                out.direction = sky.direction
                out.density = sky.density
                out.distance = sky.distance
                out.radiance = sky.radiance
            else:
                pick = (pick - share) / (1.0 - share)
        k += 1
    if total > 0.0:
        out.per = out.times * chosen / total
    return out


@wp.func
def draw_toward_light(
    scene: LocalScene,
    hit: Hit,
    surface: Surface,
    wo: wp.vec3,
    path: PathState,
    light: wp.int32,
    without_near: wp.bool,
    key: PathKey,
) -> DirectionSample:
    """A direction toward virtual light number ``light``, or toward light of the environment where that is -1."""
    if light < 0:
        return draw_toward_sky(scene, hit, surface, wo, path, without_near, key)
    out = DirectionSample()
    u = random_triple(key, path.depth, FIRST_LIGHT + light % (STREAMS - FIRST_LIGHT))
    sample = sample_light(scene.lights[light], hit.point)
    if wp.max(sample.irradiance_normal) > 0.0:
        away = draw_on_light(scene.lights[light], sample, wp.vec2(u[0], u[1]))
        out.direction = wp.vec3(away[0], away[1], away[2])
        out.density = NO_DENSITY
        if has_penumbra(scene.lights[light], sample):
            cosine = sample.distance / away[3]
            radius = scene.lights[light].radius
            out.density = away[3] * away[3] / (wp.pi * radius * radius * cosine)
        # Short of the light, so that a light on a surface is not hidden by that surface.
        out.distance = away[3] - 2.0 * hit.error
        out.radiance = sample.irradiance_normal
        out.times = 1.0
        out.per = 1.0
    return out


@wp.func
def extend_path(
    path: PathState,
    start: wp.vec3,
    wi: wp.vec3,
    reflected: wp.vec3,
    density: wp.float32,
    without_near: wp.bool,
    key: PathKey,
) -> PathState:
    """The path on its next ray, drawn with ``density`` (NO_DENSITY: a mirror's); without throughput where it ends."""
    following = path
    share = wp.vec3(0.0, 0.0, 0.0)
    if density > 0.0:
        share = reflected / density
    elif density < 0.0:
        share = reflected
    following.throughput = wp.cw_mul(path.throughput, share)
    chance = survival(following.throughput, path.depth)
    if random_triple(key, path.depth, PICK)[1] < chance:
        following.throughput = following.throughput / wp.max(chance, 1.0e-30)
    else:
        following.throughput = wp.vec3(0.0, 0.0, 0.0)
    following.origin = start
    following.direction = wi
    following.density = density
    following.depth += 1
    following.without_near = without_near
    return following


@wp.func
def bring(pair: PathPair, radiance: wp.vec3) -> PathPair:
    """Radiance that the path which is followed meets where it is."""
    out = pair
    if pair.path.without:
        out.physical += wp.cw_mul(pair.path.throughput, radiance)
    else:
        out.radiance += wp.cw_mul(pair.path.throughput, radiance)
    return out


@wp.func
def begin_without(pair: PathPair) -> PathPair:
    """The path waits for one that leaves virtual content out, which starts on the ray on which it is."""
    out = pair
    out.waiting = pair.path
    out.physical = wp.vec3(0.0, 0.0, 0.0)
    out.path.throughput = wp.vec3(1.0, 1.0, 1.0)
    out.path.changes_only = False
    out.path.without = True
    return out


@wp.func
def end_without(pair: PathPair) -> PathPair:
    """The path goes on that waited for one without virtual content."""
    out = pair
    out.path = pair.waiting
    out.is_known = True
    if pair.white and out.path.depth == 1:
        out.light += wp.cw_mul(out.path.throughput, pair.physical)
    out.next = wp.where(pair.only_light, ENDED, RAY)
    return out


@wp.struct
class SeenProxy:
    """Observation of a point of a proxy in the frame."""

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


@wp.struct
class DirectLight:
    """Light that reaches a surface straight from its sources, as the surface reflects it."""

    of_sky: wp.vec3  # of the environment, without virtual content
    changed: wp.vec3  # of the environment as virtual content leaves it, or its change, and the surface's own light
    of_lights: wp.vec3  # of virtual lights


@wp.func
def add_direct(
    direct: DirectLight, arriving: wp.vec3, is_sky: wp.bool, hidden: wp.bool, path: PathState, with_virtual: wp.bool
) -> DirectLight:
    """One source more: the environment or a virtual light, nothing physical in the way; ``hidden`` by an object."""
    out = direct
    if is_sky:
        out.of_sky = arriving
        if hidden and path.changes_only:
            out.changed -= arriving
        elif with_virtual and not (hidden or path.changes_only):
            out.changed += arriving
    elif not hidden:
        out.of_lights += arriving
    return out


@wp.func
def is_first_white(pair: PathPair) -> wp.bool:
    """Return whether a path is at the first surface of a pixel that tells how much light arrives."""
    return pair.white and pair.path.depth == 0


@wp.func
def bring_direct(pair: PathPair, direct: DirectLight) -> PathPair:
    """Return the part of it that the followed path asks for."""
    if pair.path.without:
        return bring(pair, direct.of_sky)
    out = bring(pair, direct.changed + direct.of_lights)
    if is_first_white(pair):
        out.light += wp.cw_mul(pair.path.throughput, direct.of_sky)
    return out


@wp.func
def with_virtual_content(pair: PathPair) -> wp.bool:
    """Return whether the path that is followed meets virtual lights and what objects send."""
    return not (pair.only_light or pair.path.without)


@wp.func
def is_polished(kind: wp.int32, surface: Surface) -> wp.bool:
    """Return whether a surface throws light by a lobe that paths from the camera rarely meet."""
    matt = surface.model == wp.static(int(LAMBERT)) or surface.model == wp.static(int(MIRROR))
    return kind == OBJECT and not matt


@wp.func
def lights_at(scene: LocalScene, kind: wp.int32, surface: Surface, pair: PathPair) -> wp.int32:
    """Return the number of virtual lights that the followed path asks for at its surface: all, or none."""
    # What they send a white surface by way of a polished one is followed from the lights (``path_photons``).
    followed = scene.lights_followed and pair.white and not pair.lobe and pair.path.depth > 0
    if (followed and is_polished(kind, surface)) or not with_virtual_content(pair):
        return 0
    return scene.lights.shape[0]


@wp.func
def are_near_followed(scene: LocalScene, kind: wp.int32, surface: Surface, pair: PathPair) -> wp.bool:
    """Return whether light of near emitters at a surface is followed from them (``path_photons``)."""
    asked = scene.near_followed and pair.white and not pair.lobe and pair.path.depth > 0
    return asked and is_polished(kind, surface)


@wp.func
def leave_surface(pair: PathPair, direct: DirectLight, following: PathState) -> PathPair:
    """The path goes from a surface to its next ray, with the light that the surface reflects of what reaches it."""
    out = bring_direct(pair, direct)
    out.path = following
    out.path.changes_only = pair.path.changes_only
    out.path.without = pair.path.without
    out.next = wp.where(wp.max(following.throughput) > 0.0, RAY, ENDED)
    if is_first_white(pair) and out.next == RAY:
        out = begin_without(out)
    return out


# At a surface there are several directions: one toward the environment's light, one toward each virtual light, and that
# in which the path goes on. Each is drawn in its own way. What the surface reflects of it, what is in the way, and with
# which density it would have been drawn otherwise are found for one after another by the same code: a copy for each
# would make the kernel larger, and NVRTC slower.
@functools.cache
def make_scatter(trace: TraceConfig) -> wp.Function:
    """``scatter(scene, kind, hit, surface, pair, key) -> PathPair``: light straight from its sources, and the next ray.

    No such light at mirrors. Of a difference it is what virtual content changes of it. The two ways to draw a direction
    to the environment, or to the disk of a light, are combined by the balance heuristic.
    """
    hidden_by_physical = make_hidden_by_physical(trace)
    occluded_by_objects = make_trace(trace).occluded_by_objects

    @wp.func(module="unique")
    def scatter(
        scene: LocalScene, kind: wp.int32, hit: Hit, surface: Surface, pair: PathPair, key: PathKey
    ) -> PathPair:
        out = pair
        path = pair.path
        following = PathState()
        wo = -path.direction
        is_mirror = surface.model == wp.static(int(MIRROR))
        with_virtual = with_virtual_content(pair)
        direct = DirectLight()
        lights = lights_at(scene, kind, surface, pair)
        if with_virtual:
            direct.changed = surface.emission
        without_near = are_near_followed(scene, kind, surface, pair)
        for index in range(wp.where(is_mirror, lights, -1), lights + 1):
            is_next = index == lights
            drawn = DirectionSample()
            if is_next:
                drawn.direction = draw_next(hit, surface, wo, path, key)
            else:
                drawn = draw_toward_light(scene, hit, surface, wo, path, index, without_near, key)
            wi = drawn.direction
            reflected = reflected_from(surface, hit, wo, wi)
            reaches = wp.max(reflected) > 0.0
            start = offset_origin(hit.point, hit.geometric_normal, wi, hit.error)
            hidden = bool(False)
            if reaches and not is_next:
                out.rays += 1
                reaches = not hidden_by_physical(scene, start, wi, drawn.distance)
                if reaches and with_virtual:
                    hidden = occluded_by_objects(scene.rays, start, wi, drawn.distance)
            density = NO_DENSITY
            if reaches and not is_mirror and (is_next or drawn.density >= 0.0):
                density = surface_density(surface, hit.normal, wo, wi)
            if reaches and is_next:
                following = extend_path(path, start, wi, reflected, density, without_near, key)
            elif reaches:
                arriving = (
                    balance(drawn.times * drawn.density, density) / drawn.per * wp.cw_mul(reflected, drawn.radiance)
                )
                direct = add_direct(direct, arriving, index < 0, hidden, path, with_virtual)
        return leave_surface(out, direct, following)

    return scatter


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
@wp.func
def meet(scene: LocalScene, vertex: Vertex, pair: PathPair) -> PathPair:
    """Return the light that a ray from a surface finds at ``vertex``, and whether its path goes on."""
    out = pair
    out.next = SURFACE
    path = pair.path
    begins = path.changes_only and vertex.kind == OBJECT
    if begins and not pair.is_known:
        out = begin_without(out)
        out.next = RAY
        return out
    if not path.without:
        out = bring(out, lights_in_the_way(scene.lights, path.origin, path.direction, vertex.hit.t, path.density))
        if begins:
            out.radiance -= wp.cw_mul(path.throughput, pair.physical)
            out.path.changes_only = False
        out.is_known = False
    if not out.path.changes_only:
        # As a first surface draws candidates, their density is so many times as large.
        density = path.density
        if path.depth == 1 and density > 0.0:
            density = density / wp.float32(CANDIDATES)
        out = bring(out, light_along(scene.sky, path.origin, path.direction, vertex, density, path.without_near))
    if vertex.kind == NOTHING or path.depth >= MOST_VERTICES:
        out.next = ENDED
    return out


@wp.func
def take_seen(pair: PathPair, seen: SeenProxy) -> PathPair:
    """Return the frame's observation of the proxy on which a path is: it ends there if nothing virtual is asked for."""
    out = pair
    out.rays += seen.rays
    if seen.shows and not pair.path.changes_only:
        out = bring(out, seen.radiance)
        if pair.path.without:
            out.next = ENDED
        else:
            out.path.changes_only = True
    return out


@functools.cache
def make_visit(trace: TraceConfig) -> wp.Function:
    """``visit(params, scene, vertex, pair, key) -> PathPair``: what happens at the surface on which a path is."""
    scatter, see_proxy, look_up_material = make_scatter(trace), make_see_proxy(trace), make_look_up_material()

    @wp.func(module="unique")
    def visit(params: FrameParams, scene: LocalScene, vertex: Vertex, pair: PathPair, key: PathKey) -> PathPair:
        out = pair
        is_white = is_first_white(pair)
        wo = -pair.path.direction
        reflectance = wp.vec3(1.0, 1.0, 1.0)
        if vertex.kind == PROXY and not is_white:
            seen = see_proxy(params, scene, vertex)
            reflectance = seen.reflectance
            out = take_seen(out, seen)
            if out.next == ENDED:
                return out
        facing = from_viewer(vertex, wo)
        surface = Surface()
        if is_white:
            surface = white_surface(scene, facing, pair.lobe)
        else:
            surface = look_up_material(scene, facing, wo, reflectance)
        return scatter(scene, facing.kind, facing.hit, surface, out, key)

    return visit
