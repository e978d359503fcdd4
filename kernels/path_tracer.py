"""The picture that the local scene would give, by following paths of light: the judge of what is approximated.

The local scene is all that the program knows: virtual objects, proxies, mirror balls, virtual lights, and the
environment, which is distant. A path starts at the camera; where it meets a surface, light that arrives there straight
from the environment (a direction drawn by its light) and from every virtual light is added, and it goes on in a
direction drawn by the surface (see ``path_sampling``). Both ways to reach the environment are combined by their
densities, and so are both ways to reach the disk of a virtual light. A path ends by Russian roulette, with a chance
that its weight makes up for. Nothing is clamped: the mean over paths has no error but noise.

**The frame.** The camera has seen the physical surfaces, so a path that meets a proxy where the frame shows it knows
the radiance L0 that it has without anything virtual. What virtual content (objects and lights) changes there is [Deb98]

    L = L0 + (L_with - L_without),    both by the same random numbers.

A path is therefore in one of two states. While *whole* it carries radiance; where it meets such a point it takes L0 and
goes on as a *difference*. A difference adds nothing as long as what it meets would be there without virtual content
as well: it takes away light of the environment that virtual objects hide, adds that of virtual lights, and where it
meets a virtual object it becomes whole, less the radiance that the same ray brings without objects. Of a pixel that
nothing virtual reaches, every path gives exactly 0.

**Reflectance** of a proxy's point is pi L0 / E, E its irradiance without virtual content, gathered by the same paths:
light that arrives from the environment, and L0 of what else they meet. In a pixel that shows a proxy E and the
difference come from the same directions, so that much of their noise cancels in the ratio: with the means over samples
of the difference g and of e = E / pi, for a white surface both, of a pixel whose frame is L0,

    picture = z + rho g,    rho = L0 / e,    z the mean of all that needs no reflectance.

Its variance is, to first order, that of z + rho g - b e, b = rho g / e (0 where reflectance is held at 1), over the
number of samples: so moments of the three are summed. Deeper in a path, reflectance is read from a map that was made
before, of E averaged over 5 x 5 pixels of one surface; of a point that no pixel shows it is the mean of its proxy.

**Toward objects.** A difference begins where a path meets a virtual object, and most of what mirrors and metals throw
onto matt surfaces comes by few directions. So a matt surface draws one direction in ``GUIDED`` toward the bounding
sphere of a virtual object or a ball, or to where one of these mirrors light (``path_guides``). The density of every
direction is then that of the mixture, (1 - q) p + q g.

Where no frame is given, all paths are whole, and proxies have the reflectance that they are given.

References:
    [Deb98] Debevec 1998, Rendering Synthetic Objects into Real Scenes.
    [PBRT] Pharr, Jakob, Humphreys, Physically Based Rendering, 4th edition, sections 13.2 and 13.4.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.color import encode
from warp_ar.kernels.launch import MOST_REGISTERS, Rows, launch_rows
from warp_ar.kernels.materials import Surface, make_surface
from warp_ar.kernels.mirror_ball import nearest_ball
from warp_ar.kernels.path_guides import Guides, draw_guide, guide_count, guide_density
from warp_ar.kernels.path_sampling import (
    ALL_MODELS,
    NO_DENSITY,
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
from warp_ar.kernels.receiver import reflectance_of
from warp_ar.kernels.reflect import make_find_in_frame
from warp_ar.kernels.sampling import pcg3d_hash, uniform_from_bits
from warp_ar.kernels.shade import face_viewer
from warp_ar.kernels.shadow import has_penumbra, sample_light
from warp_ar.kernels.shapes import FAR, ROUNDING, intersect_sphere
from warp_ar.kernels.structs import LAMBERT, MIRROR, FrameParams, Hit, Light, Picture, Probe, RayScene
from warp_ar.kernels.trace import TraceConfig, make_trace, offset_origin

wp.set_module_options({"enable_backward": False})

NOTHING = wp.constant(0)
OBJECT = wp.constant(1)
PROXY = wp.constant(2)
BALL = wp.constant(3)
"""What a ray meets."""
MOST_VERTICES = wp.constant(64)
"""Surfaces on a path at most; between mirrors alone nothing else ends it."""
SURE_VERTICES = wp.constant(2)
"""Surfaces before Russian roulette begins."""
MOST_SURVIVAL = wp.constant(wp.float32(0.95))
"""Chance to go on, at most."""
LEAST_WEIGHT = wp.constant(wp.float32(0.25))
"""Of the frame's four pixels around a point, what those of its surface must have for the frame to show it."""
GUIDED = wp.constant(wp.float32(0.5))
"""Share of directions that a matt surface draws toward objects and balls."""
SMOOTHED = wp.constant(2)
"""Pixels to each side over which irradiance is averaged for the map of reflectance."""
PICK = wp.constant(0)
SCATTER = wp.constant(1)
SKY = wp.constant(2)
FIRST_LIGHT = wp.constant(3)
"""Streams of random numbers at a vertex; each virtual light has its own, as far as they go."""

WHOLE, DIFFERENCE, IRRADIANCE = 0, 1, 2
"""What is asked of pixels: radiance of the scene; what virtual content changes in the frame; or only what makes
reflectance known."""


@wp.struct
class LocalScene:
    """All that paths can meet."""

    rays: RayScene
    lights: wp.array[Light]
    probes: wp.array[Probe]
    sky: Sky
    guides: Guides
    dfg: wp.array2d[wp.vec2]  # of ``integrate_dfg``
    proxy_reflectance: wp.array[wp.vec3]  # of each proxy, where no pixel tells
    picture: Picture  # rays of pixels; of the frame only the size is read
    radiance: wp.array2d[wp.vec3]  # the frame, linear; empty: there is none
    reflectance: wp.array2d[wp.vec3]  # of what each pixel shows
    shown: wp.array2d[wp.int32]  # the proxy that each pixel shows, or -1


@wp.struct
class Moments:
    """Means of samples per pixel, and sums of products of deviations from them, (H, W) each."""

    fixed: wp.array2d[wp.vec3]  # z: what needs no reflectance
    change: wp.array2d[wp.vec3]  # g
    light: wp.array2d[wp.vec3]  # e
    proxies: wp.array2d[wp.float32]  # share of samples that show a proxy
    fixed_fixed: wp.array2d[wp.vec3]
    change_change: wp.array2d[wp.vec3]
    light_light: wp.array2d[wp.vec3]
    fixed_change: wp.array2d[wp.vec3]
    fixed_light: wp.array2d[wp.vec3]
    change_light: wp.array2d[wp.vec3]
    rays: wp.array2d[wp.int32]  # traced so far


@wp.struct
class Vertex:
    """A surface that a path meets."""

    kind: wp.int32  # NOTHING, OBJECT, PROXY or BALL
    index: wp.int32  # of the ball
    hit: Hit


@wp.struct
class Seen:
    """What the frame says of a point of a proxy."""

    known: wp.bool
    radiance: wp.vec3
    reflectance: wp.vec3
    rays: wp.int32  # that were traced to find out


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
    find_in_frame = make_find_in_frame(trace, True)

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
        else:
            surface.model = wp.static(int(LAMBERT))
            surface.diffuse = reflectance
        return surface

    return look_up_material


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
def is_turned(vertex: Vertex, direction: wp.vec3) -> wp.bool:
    """Whether a ray meets a surface from behind."""
    return wp.dot(vertex.hit.geometric_normal, direction) >= 0.0


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
    see_in_frame, look_up_material = make_see_in_frame(trace), make_look_up_material()

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
                seen = see_in_frame(params, scene, vertex.hit)
                carried.rays += seen.rays
                if seen.known:
                    carried.radiance += wp.cw_mul(weight, seen.radiance)
                    return carried
                reflectance = scene.proxy_reflectance[vertex.hit.shape]
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


@functools.cache
def make_follow_path(trace: TraceConfig) -> wp.Function:
    """``follow_path(params, scene, first, direction, difference, white, only_light, key) -> Carried``.

    What leaves the vertex ``first`` against a unit ``direction``: all radiance, or the difference that virtual content
    makes. ``white``: the first surface is one, and what it sends without virtual content is found too; ``only_light``:
    nothing else is.
    """
    find_vertex, sky_light = make_find_vertex(trace), make_sky_light(trace)
    see_in_frame, look_up_material = make_see_in_frame(trace), make_look_up_material()
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
                seen = see_in_frame(params, scene, vertex.hit)
                carried.rays += seen.rays
                reflectance = scene.proxy_reflectance[vertex.hit.shape]
                if seen.known:
                    reflectance = seen.reflectance
                    if not changes_only:
                        carried.radiance += wp.cw_mul(weight, seen.radiance)
                        changes_only = True
            vertex = from_viewer(vertex, wo)
            hit = vertex.hit
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
            physical = Carried()
            if is_white:
                physical = physical_radiance(params, scene, origin, drawn.direction, drawn.density, key, k)
                carried.light += wp.cw_mul(weight, physical.radiance)
                carried.rays += physical.rays
                if only_light:
                    return carried
            chance = survival(weight, k)
            if pick[1] >= chance:
                return carried
            weight = weight / chance
            vertex = find_vertex(scene, origin, drawn.direction, True)
            carried.rays += 1
            disks = lights_in_the_way(scene.lights, hit.point, drawn.direction, vertex.hit.t, drawn.density)
            carried.radiance += wp.cw_mul(weight, disks)
            if changes_only and vertex.kind == OBJECT:
                if not is_white:
                    physical = physical_radiance(params, scene, origin, drawn.direction, drawn.density, key, k)
                    carried.rays += physical.rays
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


@wp.func
def sum_product(i: wp.int32, j: wp.int32, before: wp.vec3, after: wp.vec3, sums: wp.array2d[wp.vec3]):
    """Add the product of one quantity's deviation from its old mean and another's from its new one [Welford]."""
    sums[i, j] = sums[i, j] + wp.cw_mul(before, after)


@wp.func
def add_sample(
    i: wp.int32, j: wp.int32, count: wp.float32, z: wp.vec3, g: wp.vec3, e: wp.vec3, shows: wp.float32, moments: Moments
):
    """Take sample number ``count`` (from 1) of a pixel into its moments."""
    dz = z - moments.fixed[i, j]
    dg = g - moments.change[i, j]
    de = e - moments.light[i, j]
    moments.fixed[i, j] = moments.fixed[i, j] + dz / count
    moments.change[i, j] = moments.change[i, j] + dg / count
    moments.light[i, j] = moments.light[i, j] + de / count
    moments.proxies[i, j] = moments.proxies[i, j] + (shows - moments.proxies[i, j]) / count
    after_g = g - moments.change[i, j]
    after_e = e - moments.light[i, j]
    sum_product(i, j, dz, z - moments.fixed[i, j], moments.fixed_fixed)
    sum_product(i, j, dg, after_g, moments.change_change)
    sum_product(i, j, de, after_e, moments.light_light)
    sum_product(i, j, dz, after_g, moments.fixed_change)
    sum_product(i, j, dz, after_e, moments.fixed_light)
    sum_product(i, j, dg, after_e, moments.change_light)


@functools.cache
def make_trace_paths_kernel(trace: TraceConfig) -> wp.Kernel:
    """Kernel of ``trace_paths`` for the kinds of shape in ``trace``."""
    find_vertex, follow_path = make_find_vertex(trace), make_follow_path(trace)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def trace_paths_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        scene: LocalScene,
        asked: wp.int32,
        seed: wp.int32,
        first: wp.int32,
        done: wp.int32,
        count: wp.int32,
        # Out:
        moments_out: Moments,
    ):
        i, j = wp.tid()
        i += row_start
        whole = asked == wp.static(WHOLE)
        rays = scene.picture.rays
        key = PathKey()
        key.pixel = wp.uint32(i * rays.shape[1] + j)
        key.seed = wp.uint32(seed)
        for k in range(count):
            key.sample = wp.uint32(first + k)
            # A stream of its own: the vertices of the path use those from 0 on.
            bits = pcg3d_hash(key.pixel, key.sample, ~key.seed)
            x = rays[i, j][0] + (uniform_from_bits(bits[0]) - 0.5) / params[0].focal[0]
            y = rays[i, j][1] + (uniform_from_bits(bits[1]) - 0.5) / params[0].focal[1]
            direction = wp.normalize(params[0].world_from_camera * wp.vec3(x, y, 1.0))
            vertex = find_vertex(scene, params[0].camera_position, direction, True)
            z = wp.vec3(0.0, 0.0, 0.0)
            g = wp.vec3(0.0, 0.0, 0.0)
            e = wp.vec3(0.0, 0.0, 0.0)
            shows = float(0.0)
            carried = Carried()
            if whole:
                if vertex.kind == NOTHING:
                    z = sky_radiance(scene.sky, direction, NO_DENSITY)
                else:
                    carried = follow_path(params[0], scene, vertex, direction, False, False, False, key)
                    z = carried.radiance
            elif vertex.kind == OBJECT:
                if asked == wp.static(DIFFERENCE):
                    carried = follow_path(params[0], scene, vertex, direction, False, False, False, key)
                    z = carried.radiance
            else:
                z = scene.radiance[i, j]
                # A face that is seen from behind is not the surface that the camera sees.
                if vertex.kind == PROXY and not is_turned(vertex, direction):
                    only_light = asked == wp.static(IRRADIANCE)
                    carried = follow_path(params[0], scene, vertex, direction, True, True, only_light, key)
                    g = carried.radiance
                    e = carried.light
                    shows = 1.0
                elif vertex.kind == BALL and asked == wp.static(DIFFERENCE):
                    carried = follow_path(params[0], scene, vertex, direction, True, False, False, key)
                    z += carried.radiance
            moments_out.rays[i, j] = moments_out.rays[i, j] + carried.rays + 1
            add_sample(i, j, wp.float32(done + k + 1), z, g, e, shows, moments_out)

    return trace_paths_kernel


@functools.cache
def make_find_shown_kernel(trace: TraceConfig) -> wp.Kernel:
    """Kernel of ``find_shown`` for the kinds of shape in ``trace``."""
    find_vertex = make_find_vertex(trace)

    @wp.kernel(module="unique", enable_backward=False)
    def find_shown_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        scene: LocalScene,
        # Out:
        shown_out: wp.array2d[wp.int32],
    ):
        i, j = wp.tid()
        i += row_start
        ray = scene.picture.rays[i, j]
        direction = wp.normalize(params[0].world_from_camera * wp.vec3(ray[0], ray[1], 1.0))
        vertex = find_vertex(scene, params[0].camera_position, direction, False)
        shown = wp.int32(-1)
        if vertex.kind == PROXY and not is_turned(vertex, direction):
            shown = vertex.hit.shape
        shown_out[i, j] = shown

    return find_shown_kernel


@wp.func
def reflectance_under(radiance: wp.vec3, light: wp.vec3) -> wp.vec3:
    """Reflectance of what looks like ``radiance`` where a white surface would send ``light``."""
    return wp.vec3(
        reflectance_of(radiance[0], wp.pi * light[0]),
        reflectance_of(radiance[1], wp.pi * light[1]),
        reflectance_of(radiance[2], wp.pi * light[2]),
    )


@wp.kernel(enable_backward=False)
def map_reflectance_kernel(
    # In:
    row_start: wp.int32,
    radiance: wp.array2d[wp.vec3],
    shown: wp.array2d[wp.int32],
    light: wp.array2d[wp.vec3],
    proxies: wp.array2d[wp.float32],
    # Out:
    reflectance_out: wp.array2d[wp.vec3],
):
    """Reflectance of every pixel that shows a proxy, from light averaged over its neighbours on the same one."""
    i, j = wp.tid()
    i += row_start
    reflectance = wp.vec3(0.0, 0.0, 0.0)
    own = shown[i, j]
    if own >= 0:
        total = wp.vec3(0.0, 0.0, 0.0)
        count = float(0.0)
        for a in range(wp.max(i - SMOOTHED, 0), wp.min(i + SMOOTHED + 1, shown.shape[0])):
            for b in range(wp.max(j - SMOOTHED, 0), wp.min(j + SMOOTHED + 1, shown.shape[1])):
                if shown[a, b] == own:
                    total += light[a, b]
                    count += proxies[a, b]
        if count > 0.0:
            reflectance = reflectance_under(radiance[i, j], total / count)
    reflectance_out[i, j] = reflectance


@wp.kernel(enable_backward=False)
def finish_picture_kernel(
    # In:
    row_start: wp.int32,
    radiance: wp.array2d[wp.vec3],
    encode_table: wp.array[wp.vec3],
    moments: Moments,
    count: wp.float32,
    exposure: wp.float32,
    # Out:
    radiance_out: wp.array2d[wp.vec3],
    error_out: wp.array2d[wp.vec3],
    image_out: wp.array2d[wp.vec3ub],
):
    """The picture and its standard error, from the moments of ``count`` samples."""
    i, j = wp.tid()
    i += row_start
    z = moments.fixed[i, j]
    zz = moments.fixed_fixed[i, j]
    picture = z
    variance = zz
    if moments.proxies[i, j] > 0.0:
        g = moments.change[i, j]
        e = moments.light[i, j]
        gg = moments.change_change[i, j]
        ee = moments.light_light[i, j]
        zg = moments.fixed_change[i, j]
        ze = moments.fixed_light[i, j]
        ge = moments.change_light[i, j]
        rho = reflectance_under(radiance[i, j], e / moments.proxies[i, j])
        for c in range(3):
            slope = float(0.0)
            if rho[c] < 1.0 and e[c] > 0.0:
                slope = rho[c] * g[c] / e[c]
            picture[c] = z[c] + rho[c] * g[c]
            variance[c] = (
                zz[c]
                + rho[c] * rho[c] * gg[c]
                + slope * slope * ee[c]
                + 2.0 * (rho[c] * zg[c] - slope * ze[c] - rho[c] * slope * ge[c])
            )
    radiance_out[i, j] = wp.max(picture, wp.vec3(0.0, 0.0, 0.0))
    error = wp.vec3(0.0, 0.0, 0.0)
    for c in range(3):
        if count > 1.0:
            error[c] = wp.sqrt(wp.max(variance[c], 0.0) / (count * (count - 1.0)))
    error_out[i, j] = error
    image_out[i, j] = encode(encode_table, exposure * radiance_out[i, j])


# --- Launchers --------------------------------------------------------------------------------------------------------


def make_moments(shape: tuple[int, int], device: wp.DeviceLike) -> Moments:
    """Moments of no samples."""
    moments = Moments()
    for name in Moments.vars:
        dtype = {"proxies": wp.float32, "rays": wp.int32}.get(name, wp.vec3)
        setattr(moments, name, wp.zeros(shape, dtype=dtype, device=device))
    return moments


def trace_paths(
    trace: TraceConfig,
    params: wp.array[FrameParams],
    scene: LocalScene,
    moments_out: Moments,
    *,
    asked: int,
    seed: int,
    first: int,
    done: int,
    count: int,
    rows: Rows | None = None,
) -> None:
    """Add ``count`` samples to every pixel's moments.

    Args:
        trace: Kinds of shape in the scene.
        params: (1,) FrameParams: the camera.
        scene: All that paths meet.
        moments_out: (H, W).
        asked: ``WHOLE``, ``DIFFERENCE`` or ``IRRADIANCE``; all but the first need the frame's radiance.
        seed: Of the random numbers.
        first: Number of the first sample among those of the seed.
        done: Samples that the moments hold already.
        count: Samples per pixel.
        rows: Band of rows; None means all.
    """
    rays = scene.picture.rays
    inputs = [params, scene, asked, seed, first, done, count]
    launch_rows(make_trace_paths_kernel(trace), rays.shape, inputs, [moments_out], rows=rows, device=rays.device)


def find_shown(
    trace: TraceConfig,
    params: wp.array[FrameParams],
    scene: LocalScene,
    shown_out: wp.array2d[wp.int32],
    *,
    rows: Rows | None = None,
) -> None:
    """Write which proxy the frame shows in the middle of every pixel, -1 for none; (H, W)."""
    shape, device = shown_out.shape, shown_out.device
    launch_rows(make_find_shown_kernel(trace), shape, [params, scene], [shown_out], rows=rows, device=device)


def map_reflectance(scene: LocalScene, moments: Moments, reflectance_out: wp.array2d[wp.vec3]) -> None:
    """Write the reflectance of what every pixel shows, by moments of ``IRRADIANCE``; (H, W), 0 without a proxy."""
    shape, device = reflectance_out.shape, reflectance_out.device
    inputs = [scene.radiance, scene.shown, moments.light, moments.proxies]
    launch_rows(map_reflectance_kernel, shape, inputs, [reflectance_out], rows=None, device=device)


def finish_picture(
    scene: LocalScene,
    moments: Moments,
    count: int,
    encode_table: wp.array[wp.vec3],
    radiance_out: wp.array2d[wp.vec3],
    error_out: wp.array2d[wp.vec3],
    image_out: wp.array2d[wp.vec3ub],
    *,
    exposure: float = 1.0,
) -> None:
    """Write what the moments of ``count`` samples say.

    Args:
        scene: Whose frame's radiance is read where proxies are shown.
        moments: (H, W).
        count: Samples per pixel.
        encode_table: Of ``color.encode_table``.
        radiance_out: (H, W) linear radiance in camera values, not clipped.
        error_out: (H, W) its standard error, per channel.
        image_out: (H, W) encoded.
        exposure: Factor on the radiance that is encoded.
    """
    outputs = [radiance_out, error_out, image_out]
    inputs = [scene.radiance, encode_table, moments, float(count), exposure]
    launch_rows(finish_picture_kernel, image_out.shape, inputs, outputs, rows=None, device=image_out.device)
