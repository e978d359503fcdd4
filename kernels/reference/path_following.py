"""One path through the local scene: the light that arrives at its surfaces, and its next ray.

The loop of a path (``path_tracer``) alternates between ``meet``, for the surface that its ray meets, and ``visit``, for
scattering at that surface. There direct light is added, from the environment (in a direction drawn by its light) and
from every virtual light. The path continues in a direction drawn by the surface (see ``path_sampling``). Both ways to
reach the environment are combined by their densities (multiple importance sampling), and so are both ways to reach the
disk of a virtual light. Paths end by Russian roulette, which the throughput makes up for. Nothing is clamped, so the
mean over paths is unbiased.

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
"""Largest number of surfaces on a path; ends paths between mirrors alone."""
SURE_VERTICES = wp.constant(2)
"""Number of surfaces before Russian roulette begins."""
MOST_SURVIVAL = wp.constant(wp.float32(0.95))
"""Largest probability with which Russian roulette continues a path."""
PICK = wp.constant(0)
SCATTER = wp.constant(1)
SKY = wp.constant(2)
CHOICE = wp.constant(3)
FIRST_LIGHT = wp.constant(4)
"""First stream of random numbers for virtual lights at a vertex; each light has its own while streams last."""

CANDIDATES = wp.constant(4)
"""Number of directions toward the environment's light drawn at a first surface, of which one is followed."""
GOLDEN = wp.constant(wp.float32(0.61803399))
SILVER = wp.constant(wp.float32(0.41421356))
"""Step of the random number between candidates, which spreads them evenly."""
MOST_RANDOM = wp.constant(wp.float32(0.99999994))
"""Largest random number below 1."""

SURFACE = wp.constant(0)
RAY = wp.constant(1)
ENDED = wp.constant(2)
"""Next step of a path: scatter at a surface, trace a ray, or end."""


@wp.struct
class PathState:
    """State of a path: at its surface number ``depth``, or on the ray that leads to it."""

    throughput: wp.vec3
    origin: wp.vec3  # of the ray
    direction: wp.vec3  # unit
    density: wp.float32  # with which the direction was drawn
    depth: wp.int32
    changes_only: wp.bool  # whether it carries the difference that virtual content makes
    without: wp.bool  # whether virtual content does not exist for it
    without_near: wp.bool  # whether direct light of near emitters on its ray is left out


@wp.struct
class PathPair:
    """A path from the camera, and a side path without virtual content, for which the main path may wait."""

    path: PathState  # the path that is followed at present
    waiting: PathState  # the main path, while ``path`` is the side path
    physical: wp.vec3  # radiance that the side path found
    is_known: wp.bool  # whether ``physical`` is the radiance along the ray of ``path``
    next: wp.int32  # SURFACE, RAY or ENDED
    white: wp.bool  # whether the first surface is replaced by a white one (or its lobe), and ``light`` is computed
    lobe: wp.bool  # whether the first surface is replaced by its proxy's specular lobe instead
    glossy: wp.bool  # whether the first surface needs both paths, with a white surface and with the lobe
    only_light: wp.bool  # whether ``light`` alone is needed
    radiance: wp.vec3  # radiance toward the camera, or the difference that virtual content makes
    light: wp.vec3  # radiance of the replaced first surface without virtual content
    rays: wp.int32  # number of rays traced


@wp.struct
class DirectionSample:
    """A direction drawn at a surface, toward light or for the next ray, and the light from it."""

    direction: wp.vec3  # unit; zero where there is none
    density: wp.float32  # per steradian; NO_DENSITY if no other strategy can draw it
    times: wp.float32  # number of candidates of that density
    distance: wp.float32  # of the light's source
    radiance: wp.vec3  # of the source, or the irradiance of a surface that faces the light
    per: wp.float32  # divisor of ``radiance``: the density, or 1


@wp.func
def draw_next(hit: Hit, surface: Surface, wo: wp.vec3, path: PathState, key: PathKey) -> wp.vec3:
    """Draw the direction of a path's next ray; zero if it leads into the surface."""
    u = random_triple(key, path.depth, SCATTER)
    pick = random_triple(key, path.depth, PICK)
    return draw_reflected(surface, hit.normal, hit.geometric_normal, wo, pick[0], wp.vec2(u[0], u[1]))


@wp.func
def survival(throughput: wp.vec3, vertices: wp.int32) -> wp.float32:
    """Return the probability that a path continues after ``vertices`` surfaces."""
    if vertices < SURE_VERTICES:
        return 1.0
    return wp.min(wp.max(throughput), MOST_SURVIVAL)


@wp.func
def light_along(
    sky: Sky, origin: wp.vec3, direction: wp.vec3, vertex: Vertex, density: wp.float32, without_near: wp.bool
) -> wp.vec3:
    """Return the environment's light on a ray to ``vertex``, drawn with ``density``, weighted against ``draw_sky``."""
    light = wp.vec3(0.0, 0.0, 0.0)
    own = density
    if not without_near:
        light = near_radiance(sky, origin, direction, vertex.hit.t, density)
    else:
        own = density * (1.0 - sky.near_share)  # because only the distant environment is drawn
    if vertex.kind == NOTHING:
        light += sky_radiance(sky, direction, own)
    return light


@wp.func
def wrap(u: wp.float32) -> wp.float32:
    """Return the fractional part of a number, from 0 to below 1."""
    return wp.min(u - wp.floor(u), MOST_RANDOM)


@wp.func
def reflected_from(surface: Surface, hit: Hit, wo: wp.vec3, wi: wp.vec3) -> wp.vec3:
    """Return the BRDF times cosine for light from ``wi``; for a mirror its reflectance; 0 from below."""
    reflected = wp.vec3(0.0, 0.0, 0.0)
    if wp.dot(hit.geometric_normal, wi) > 0.0:
        reflected = surface.reflectance
        if surface.model != wp.static(int(MIRROR)):
            reflected = reflect_direct(surface, hit.normal, wo, wi)
    return reflected


# Directions toward the environment are drawn by its brightness, not by the surface's reflection or orientation. At a
# first surface, where most of a picture's noise arises, several candidates are therefore drawn, and one of them is
# chosen by the light that the surface would reflect [Tal05]. With w_k the reflected light of candidate k over its
# density, the chosen candidate has the weight (mean of all w) / (its own w). This holds even for dependent candidates,
# because each alone has the right density. So they are spread evenly from one random start.
@wp.func
def candidate_value(surface: Surface, hit: Hit, wo: wp.vec3, sky: SkyLight, times: wp.float32) -> wp.float32:
    """Return the brightness of a candidate's light that a surface reflects, weighted against draws by the surface."""
    value = brightness(wp.cw_mul(reflected_from(surface, hit, wo, sky.direction), sky.radiance))
    if value > 0.0:
        value *= balance(times * sky.density, surface_density(surface, hit.normal, wo, sky.direction))
    return value


@wp.func
def draw_toward_sky(
    scene: LocalScene, hit: Hit, surface: Surface, wo: wp.vec3, path: PathState, without_near: wp.bool, key: PathKey
) -> DirectionSample:
    """Draw a direction toward the environment's light, only the distant one if ``without_near``; zero for none."""
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
    """Draw a direction toward virtual light number ``light``, or toward the environment's light if that is -1."""
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
        # Shortened, so that a light on a surface is not hidden by that surface.
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
    """Return the path on its next ray, drawn with ``density`` (NO_DENSITY: a mirror); throughput 0 ends the path."""
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
    """Add the radiance found by the followed path, times its throughput, to the pair's result."""
    out = pair
    if pair.path.without:
        out.physical += wp.cw_mul(pair.path.throughput, radiance)
    else:
        out.radiance += wp.cw_mul(pair.path.throughput, radiance)
    return out


@wp.func
def begin_without(pair: PathPair) -> PathPair:
    """Store the main path as waiting, and start a side path without virtual content on the same ray."""
    out = pair
    out.waiting = pair.path
    out.physical = wp.vec3(0.0, 0.0, 0.0)
    out.path.throughput = wp.vec3(1.0, 1.0, 1.0)
    out.path.changes_only = False
    out.path.without = True
    return out


@wp.func
def end_without(pair: PathPair) -> PathPair:
    """End the side path without virtual content, and continue the main path that waited for it."""
    out = pair
    out.path = pair.waiting
    out.is_known = True
    if pair.white and out.path.depth == 1:
        out.light += wp.cw_mul(out.path.throughput, pair.physical)
    out.next = wp.where(pair.only_light, ENDED, RAY)
    return out


@wp.struct
class SeenProxy:
    """Radiance and reflectance of a proxy's point, from the frame if it shows the point."""

    reflectance: wp.vec3
    shows: wp.bool  # whether its radiance is known from the frame and the same in all directions
    radiance: wp.vec3  # without virtual content, if the frame shows it
    rays: wp.int32  # number of rays traced to find them


@functools.cache
def make_see_proxy(trace: TraceConfig) -> wp.Function:
    """Return ``see_proxy(params, scene, vertex) -> SeenProxy``: radiance and reflectance of a proxy's point."""
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
            # The radiance of a glossy surface toward the camera differs from that in other directions.
            out.shows = not is_glossy(scene, vertex)
        return out

    return see_proxy


@wp.func
def white_surface(scene: LocalScene, vertex: Vertex, lobe: wp.bool) -> Surface:
    """Return the surface that replaces a first surface to measure arriving light: white, or its proxy's lobe alone."""
    surface = Surface()
    if lobe:
        surface = polished(scene, vertex, wp.vec3(0.0, 0.0, 0.0))
    else:
        surface.model = wp.static(int(LAMBERT))
        surface.diffuse = wp.vec3(1.0, 1.0, 1.0)
    return surface


@wp.struct
class DirectLight:
    """Reflected direct light at a surface."""

    of_sky: wp.vec3  # of the environment, without virtual content
    changed: wp.vec3  # of the environment with virtual content, or its change, plus light that the surface emits
    of_lights: wp.vec3  # of virtual lights


@wp.func
def add_direct(
    direct: DirectLight, arriving: wp.vec3, is_sky: wp.bool, hidden: wp.bool, path: PathState, with_virtual: wp.bool
) -> DirectLight:
    """Add light of the environment (``is_sky``) or of a virtual light to the sums ``direct`` of a surface.

    No physical surface hides the light; ``hidden`` says whether a virtual object does.
    """
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
    """Return whether a path is at its first surface, and a white one replaces that to measure arriving light."""
    return pair.white and pair.path.depth == 0


@wp.func
def bring_direct(pair: PathPair, direct: DirectLight) -> PathPair:
    """Add the part of direct light that the followed path carries."""
    if pair.path.without:
        return bring(pair, direct.of_sky)
    out = bring(pair, direct.changed + direct.of_lights)
    if is_first_white(pair):
        out.light += wp.cw_mul(pair.path.throughput, direct.of_sky)
    return out


@wp.func
def with_virtual_content(pair: PathPair) -> wp.bool:
    """Return whether the followed path includes virtual lights and light of virtual objects."""
    return not (pair.only_light or pair.path.without)


@wp.func
def is_polished(kind: wp.int32, surface: Surface) -> wp.bool:
    """Return whether a surface is an object's with a glossy lobe, whose caustics paths from the camera rarely find."""
    matt = surface.model == wp.static(int(LAMBERT)) or surface.model == wp.static(int(MIRROR))
    return kind == OBJECT and not matt


@wp.func
def lights_at(scene: LocalScene, kind: wp.int32, surface: Surface, pair: PathPair) -> wp.int32:
    """Return the number of virtual lights that the path samples at its present surface: all of the scene's, or 0."""
    # Their light on a white surface by way of a polished one is found by paths from the lights (``path_photons``).
    followed = scene.lights_followed and pair.white and not pair.lobe and pair.path.depth > 0
    if (followed and is_polished(kind, surface)) or not with_virtual_content(pair):
        return 0
    return scene.lights.shape[0]


@wp.func
def are_near_followed(scene: LocalScene, kind: wp.int32, surface: Surface, pair: PathPair) -> wp.bool:
    """Return whether paths from near emitters find their light at a surface (``path_photons``)."""
    asked = scene.near_followed and pair.white and not pair.lobe and pair.path.depth > 0
    return asked and is_polished(kind, surface)


@wp.func
def leave_surface(pair: PathPair, direct: DirectLight, following: PathState) -> PathPair:
    """Add direct light at a surface, and put the path on its next ray."""
    out = bring_direct(pair, direct)
    out.path = following
    out.path.changes_only = pair.path.changes_only
    out.path.without = pair.path.without
    out.next = wp.where(wp.max(following.throughput) > 0.0, RAY, ENDED)
    if is_first_white(pair) and out.next == RAY:
        out = begin_without(out)
    return out


# At a surface several directions are drawn: one toward the environment's light, one toward each virtual light, and that
# of the next ray. Each has its own way of drawing. Reflection, occlusion and the density of the other strategy are
# computed for one after another by the same code: a copy for each would make the kernel larger, and NVRTC slower.
@functools.cache
def make_scatter(trace: TraceConfig) -> wp.Function:
    """Return ``scatter(scene, kind, hit, surface, pair, key) -> PathPair``: add direct light, and draw the next ray.

    Mirrors get no direct light. A path that carries a difference gets the change of direct light by virtual content.
    The two ways to draw a direction to the environment, or to the disk of a light, are combined by the balance
    heuristic.
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


# The frame. If a path meets a proxy's point that the frame shows, its radiance L0 without virtual content is known.
# With virtual content (objects and lights) it is [Deb98]
#
#     L = L0 + (L_with - L_without),    both by the same random numbers.
#
# A path is therefore in one of two states. While *whole* it carries radiance. At such a point it adds L0 and continues
# as a *difference*. A difference subtracts light of the environment that virtual objects hide, and adds that of virtual
# lights. Where it meets a virtual object it becomes whole again, and the radiance of the same ray without objects is
# subtracted. In a pixel that virtual content does not affect, every path gives exactly 0.
#
# The radiance of the ray without objects is found by a side path, which meets no virtual content, while the main path
# waits. Both use the same loop, so that threads of a warp execute the same code for either, and the code for a surface
# is compiled once.
@wp.func
def meet(scene: LocalScene, vertex: Vertex, pair: PathPair) -> PathPair:
    """Add the light that a ray from a surface finds at ``vertex``, and set the path's next step."""
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
        # A first surface draws several candidates, so their total density is larger by that factor.
        density = path.density
        if path.depth == 1 and density > 0.0:
            density = density / wp.float32(CANDIDATES)
        out = bring(out, light_along(scene.sky, path.origin, path.direction, vertex, density, path.without_near))
    if vertex.kind == NOTHING or path.depth >= MOST_VERTICES:
        out.next = ENDED
    return out


@wp.func
def take_seen(pair: PathPair, seen: SeenProxy) -> PathPair:
    """Add a proxy's radiance in the frame to a path that meets it; a path without virtual content ends at the proxy."""
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
    """Return ``visit(params, scene, vertex, pair, key) -> PathPair``: a path, scattered at the surface that it met."""
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
