"""Near field of virtual objects: light from the receiver that they stand on, from other objects, and from themselves.

Per pixel of an object, two values replace the light of the distant environment alone in ``shade``:

*Irradiance* is the sum over one set of the environment's samples, for each of which a ray is traced. A ray that meets a
proxy returns its radiance in the frame (see ``reflect``), with the shadows of virtual objects and with virtual light. A
ray that meets an object returns the object's radiance under the distant environment. So an object's underside receives
light from its own shadow, not from an unshaded receiver. A sum of few samples is noisy. Then the result is the
environment's irradiance, which is known, plus the changes by those samples that meet something: without noise where
nothing is near.

*Reflected* is the radiance of near surfaces, and a share: ``shade`` adds (1 - share) of the prefiltered environment. A
mirror sends rays from several points of the pixel, because neighbouring pixels of a curved mirror may show distant
points. Each ray is filtered over its part of the pixel, in the environment as well, and the share is 1. A glossy lobe
sends a few rays, different ones from each pixel of a tile. Near surfaces hide part of the lobe, and that part may be
darker than the rest: where a receiver cuts a window off just outside its edge, half of the rays meet the receiver and
hardly any light is lost. So every ray reads the environment as well. With the means over the rays

    s  share of the rays that meet something near,      N  their radiance, 0 for the others,
    B  the environment along all rays,                  M  the environment along those that meet nothing,

the lobe reflects N + M. M is noisy where much of the lobe is open. There L, the environment prefiltered with the whole
lobe, serves: M = (|M| / |B|) L, since L is B without noise. Where little of the lobe is open, the noise of M is a small
part of the sum, and most of L may be hidden. Hence the reflected radiance is

    | N + s M + (1 - s) (|M| / |B|) L |,    |.| the brightness: share = 1 - (1 - s) |M| / |B|.

Both values are averaged over neighbours on the same object with similar normals, in a window of a tile's size, as in
``environment_shadow``. Mirrors are not averaged. If a pixel has enough rays of its own, its neighbours' lobes have the
weight exp(-theta^2 / (2 alpha^2)), theta the angle between the normals and alpha the lobe's width (with 1 - cos theta =
theta^2 / 2). Otherwise a thin tube, whose normals turn by ten degrees per pixel, would reflect a mean over twice that
angle.

**Rays** go toward samples of the environment, into a glossy lobe, or from several points in the pixel of a mirror.
One ray of n stands for the solid angle 1 / (n pdf). The environment is read from the level of twice that width, so that
neighbouring rays overlap. For a half vector h, GGX has the pdf D = k^2 / pi, k = alpha / (sin^2 + alpha^2 cos^2) of the
angle between h and n. At the peak k = 1 / alpha, and one ray of n has the width alpha / sqrt n. So

    | width = 2 / (k sqrt n) |,    Phong: 2 alpha / sqrt(n cos^e), e its exponent.

With one width for all rays, the few in the long tails of GGX would show emitters as squares of a tile's size.

A mirror's rays stand for parts of its pixel. Their footprints are found from differences of the reflected ray's origin
and direction between neighbouring pixels, for any shape. The frame (``frame_levels``), the environment, and textures of
other objects are filtered over the footprint of a ray.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import warp as wp

from warp_ar.kernels.color import brightness
from warp_ar.kernels.environment.environment_samples import (
    EnvironmentSample,
    ball_of_sample,
    sample_toward,
    sobol_second,
)
from warp_ar.kernels.environment.lobes import level_from_alpha
from warp_ar.kernels.environment.probe_weights import probe_share
from warp_ar.kernels.launch import MOST_REGISTERS, row_launcher
from warp_ar.kernels.materials import Surface, make_surface, material_at, reflect, roughness_at, surface_point
from warp_ar.kernels.objects.reflect import (
    RAY_SPREAD,
    DistantLight,
    DistantLightConfig,
    look_up,
    make_distant_irradiance,
    make_find_in_frame,
    make_radiance_along,
    make_reflected_radiance,
    make_shade_unoccluded,
)
from warp_ar.kernels.picture.frame_levels import Footprint, ReceiverLayers, covered_on, look_up_covered, shown_as
from warp_ar.kernels.rays.shapes import FAR
from warp_ar.kernels.rays.trace import make_trace, offset_origin
from warp_ar.kernels.rays.visibility import VisibleObjects, inside_rect, make_primary, make_sample_direction
from warp_ar.kernels.sampling import frame_from_normal, radical_inverse, sample_ggx_visible, sample_phong_lobe
from warp_ar.kernels.structs import METALLIC_ROUGHNESS, PHONG, FrameParams, Hit, Picture, RayScene

wp.set_module_options({"enable_backward": False})

SHARP_ALPHA = 0.02
"""Lobe width alpha below which a surface is a mirror."""
SHARP = wp.constant(wp.float32(SHARP_ALPHA))
RAY_WIDTH = 2.0
"""Width over which a ray filters the environment, over the width of the part of the lobe that it represents."""
LOBE_ANGLE = 1.0
"""Angle of the side of a lobe ray's square footprint in the frame, over the ray's width. The part of the lobe that a
ray represents has a side of 1.77, but so wide a footprint would cross the edges of surfaces."""
SAME_SURFACE = wp.constant(wp.float32(0.5))
"""Least cosine between the normals of two neighbouring pixels whose difference gives a mirror's curvature."""
MIN_LIGHT = wp.constant(wp.float32(1.0e-6))
"""Brightness |B|, in camera values, below which |M| / |B| is not computed."""
NO_RAY = wp.constant(wp.float32(-1.0))
"""Value of s (share of rays that meet something) in a pixel whose rays all point below its surface."""
SAME_NORMAL = wp.constant(wp.float32(math.cos(math.radians(20.0))))
"""Least cosine between the normals of neighbours that are averaged."""


OWN_RAYS = 4
"""Least number of lobe rays per pixel at which averaging weights neighbours by the difference of normals."""


@dataclasses.dataclass(frozen=True)
class NearFieldConfig:
    """Compile-time configuration of the kernel."""

    distant: DistantLightConfig
    """Kinds of shape and forms of light."""
    count: int
    """Samples of the environment per set; a pixel uses one set."""
    lobe_count: int
    """Rays per pixel into a glossy lobe; 0 if no object has one."""
    mirror_samples: int
    """Points within a pixel from which a mirror sends a ray, a square number; 0 if no object is a mirror."""
    side: int
    """Pixels along a tile (square of pixels with different sets of samples)."""
    ratio: bool
    """True if objects cast shadows on the receiver."""
    added: bool
    """True if virtual lights light the receiver."""
    known: bool = False
    """True if irradiance is that of the environment plus the change by samples that meet something; False if it is the
    sum of all samples."""


@wp.func
def lobe_alpha(model: wp.int32, roughness: wp.float32, shininess: wp.float32) -> wp.float32:
    """Return the width alpha of a surface's lobe; 0 for a mirror."""
    if model == METALLIC_ROUGHNESS:
        return roughness * roughness
    if model == PHONG:
        return 1.0 / wp.sqrt(wp.max(shininess, 1.0))
    return 0.0


@wp.func
def ggx_ray_width(cos_theta: wp.float32, alpha: wp.float32) -> wp.float32:
    """Return the width of a GGX lobe's ray times the square root of the number of rays.

    ``cos_theta`` is the cosine between half vector and normal.
    """
    cos2 = wp.min(cos_theta * cos_theta, 1.0)
    return (1.0 - cos2) / alpha + alpha * cos2


@wp.func
def phong_ray_width(cos_theta: wp.float32, exponent: wp.float32, alpha: wp.float32) -> wp.float32:
    """Return the width of a Phong lobe's ray times the square root of the number of rays, at most 1.

    ``cos_theta`` is the cosine between the ray and the mirror direction.
    """
    return wp.min(alpha * wp.exp(-0.5 * exponent * wp.log(wp.max(cos_theta, 1.0e-3))), 1.0)


@wp.struct
class NearRay:
    """A ray that leaves a pixel of an object, and the environment's light along it."""

    origin: wp.vec3
    direction: wp.vec3
    reach: wp.float32  # length, metres
    spread: wp.float32  # width over length
    point: wp.vec3  # point of the surface that the ray leaves; ``origin`` is offset from it
    radiance: wp.vec3  # radiance of the environment's sample
    weight: wp.float32  # cosine times measure of the sample, times its ball's share
    leaves: wp.bool  # True if the direction is above the surface, False if below
    covers: wp.bool  # True if the ray has a footprint, over which the surface that it meets is filtered


@wp.struct
class SeenPoint:
    """A point of an object that a pixel shows."""

    hit: Hit
    wo: wp.vec3
    normal: wp.vec3  # for shading, on the camera's side
    geometric: wp.vec3  # of the surface itself, on the camera's side
    surface: Surface
    alpha: wp.float32  # width of its lobe; 0 for a mirror
    pixel: wp.vec2  # undistorted (x / z, y / z)
    place: wp.int32  # index of the pixel in its tile
    footprint: Footprint  # of the whole pixel, for a mirror


def ray_width(config: NearFieldConfig) -> float:
    """Return the filter width of a lobe ray over ``NearRay.spread``: all rays of a tile of pixels share the lobe."""
    return RAY_WIDTH / (math.sqrt(max(config.lobe_count, 1)) * config.side)


@functools.cache
def make_footprint_of(config: NearFieldConfig) -> wp.Function:
    """Return the function ``footprint_of(at, ray) -> Footprint``, the ray differentials of a ray.

    For a mirror they span the ray's part of the pixel, for a lobe a square around the ray's direction.
    """
    part = 1.0 / math.sqrt(max(config.mirror_samples, 1))
    share = LOBE_ANGLE * ray_width(config)

    @wp.func(module="unique")
    def footprint_of(at: SeenPoint, ray: NearRay) -> Footprint:
        out = Footprint()
        if wp.static(config.mirror_samples > 0):
            if at.alpha < SHARP:
                out.origin_x = part * at.footprint.origin_x
                out.origin_y = part * at.footprint.origin_y
                out.turn_x = part * at.footprint.turn_x
                out.turn_y = part * at.footprint.turn_y
        if wp.static(config.lobe_count > 0):
            if at.alpha >= SHARP:
                axes = frame_from_normal(ray.direction)
                angle = wp.static(share) * ray.spread
                out.turn_x = angle * wp.vec3(axes[0, 0], axes[1, 0], axes[2, 0])
                out.turn_y = angle * wp.vec3(axes[0, 1], axes[1, 1], axes[2, 1])
        return out

    return footprint_of


@wp.func
def look_up_proxy(
    params: FrameParams, picture: Picture, layers: ReceiverLayers, ray: NearRay, fp: Footprint, proxy: Hit, at: wp.vec2
) -> wp.vec3:
    """Return a proxy's radiance in the frame around the point ``at``, pixels, filtered over the ray's footprint."""
    normal = proxy.geometric_normal
    across = covered_on(fp.origin_x, fp.turn_x, proxy.t, ray.direction, normal)
    along = covered_on(fp.origin_y, fp.turn_y, proxy.t, ray.direction, normal)
    from_camera = proxy.point - params.camera_position
    a = shown_as(params, from_camera, across)
    b = shown_as(params, from_camera, along)
    return look_up_covered(params, picture, layers, at, a, b)


@wp.func
def spread_at(fp: Footprint, t: wp.float32) -> wp.float32:
    """Return the ratio of a ray's width to its length t; the width is the square root of its footprint's area."""
    area = wp.length(wp.cross(fp.origin_x + t * fp.turn_x, fp.origin_y + t * fp.turn_y))
    return wp.sqrt(area) / wp.max(t, 1.0e-6)


@wp.func
def mirrored_level(fp: Footprint, height: wp.int32) -> wp.float32:
    """Return the level of the prefiltered environment whose lobe is as wide as the footprint of a mirror's ray.

    The solid angle of a texel of level 0 is subtracted, as that level is filtered over it already.
    A GGX lobe of width alpha has the peak density of a solid angle of 4 pi alpha^2.
    """
    covered = wp.length(wp.cross(fp.turn_x, fp.turn_y))
    texel = wp.pi / wp.float32(wp.max(height, 1))
    return level_from_alpha(wp.sqrt(wp.max(covered - texel * texel, 0.0) / (4.0 * wp.pi)), height)


@functools.cache
def make_look_near(config: NearFieldConfig) -> wp.Function:
    """Return the function ``look_near(...) -> vec4``: (RGB, 1) of the first near surface on a ray, or zero without one.

    The receiver's radiance includes virtual shadows and virtual light.
    """
    footprint_of = make_footprint_of(config)
    trace = make_trace(config.distant.trace)
    closest_object, closest_proxy = trace.closest_object, trace.closest_proxy
    find_in_frame = make_find_in_frame(config.distant.trace)
    shade_unoccluded = make_shade_unoccluded(config.distant)

    @wp.func(module="unique")
    def look_near(
        params: FrameParams,
        picture: Picture,
        layers: ReceiverLayers,
        scene: RayScene,
        distant: DistantLight,
        at: SeenPoint,
        ray: NearRay,
    ) -> wp.vec4:
        other = closest_object(scene, ray.origin, ray.direction, ray.reach)
        proxy = closest_proxy(scene, ray.origin, ray.direction, other.t)
        if proxy.shape >= 0:
            shown = find_in_frame(params, picture, scene, distant.probes, proxy)
            if shown[0] < 0.0:
                return wp.vec4(0.0)
            if wp.static(config.distant.specular):
                if ray.covers:
                    wide = look_up_proxy(params, picture, layers, ray, footprint_of(at, ray), proxy, shown)
                    return wp.vec4(wide[0], wide[1], wide[2], 1.0)
            radiance = look_up(picture, shown[0], shown[1])
            row = wp.int32(shown[1] + 0.5)
            column = wp.int32(shown[0] + 0.5)
            if wp.static(config.ratio):
                radiance = wp.cw_mul(radiance, layers.shadow_ratio[row, column])
            if wp.static(config.added):
                if inside_rect(row, column, params.light_rect):
                    radiance += layers.added[row, column]
            return wp.vec4(radiance[0], radiance[1], radiance[2], 1.0)
        if other.shape >= 0:
            spread = ray.spread
            if wp.static(config.distant.specular):
                if ray.covers:
                    spread = wp.max(spread, spread_at(footprint_of(at, ray), other.t))
            radiance = shade_unoccluded(scene, distant, other, ray.direction, spread)
            return wp.vec4(radiance[0], radiance[1], radiance[2], 1.0)
        return wp.vec4(0.0)

    return look_near


@wp.struct
class Step:
    """Difference between a neighbouring pixel's reflected ray and a pixel's own."""

    found: wp.bool
    origin: wp.vec3  # difference of the origins, metres
    turn: wp.vec3  # difference of the unit directions


@wp.func
def step_to(
    params: FrameParams, picture: Picture, visible: VisibleObjects, at: SeenPoint, i: wp.int32, j: wp.int32
) -> Step:
    """Return the ``Step`` from a point to pixel (i, j); not found if it shows another object or lies past a crease."""
    out = Step()
    if not inside_rect(i, j, params.object_rect):
        return out
    if visible.objects[i, j] != at.hit.shape:
        return out
    ray = picture.rays[i, j]
    wo = -wp.normalize(params.world_from_camera * wp.vec3(ray[0], ray[1], 1.0))
    beside = visible.hits[i, j]
    normal = wp.where(wp.dot(beside.geometric_normal, wo) < 0.0, -beside.normal, beside.normal)
    if wp.dot(normal, at.normal) < SAME_SURFACE:
        return out
    out.found = True
    out.origin = beside.point - at.hit.point
    out.turn = reflect(wo, normal) - reflect(at.wo, at.normal)
    return out


@wp.func
def shorter_step(
    params: FrameParams,
    picture: Picture,
    visible: VisibleObjects,
    at: SeenPoint,
    pixel: wp.vec2i,
    aside: wp.vec2i,
    axis: wp.vec3,
    angle: wp.float32,
) -> Step:
    """Return the ``Step`` of smaller turn to two opposite neighbours, or a plane mirror's step if neither is found.

    ``aside`` is the offset (rows, columns) to a neighbour. A plane mirror's reflected ray turns by ``angle``, that of a
    pixel, along the unit vector ``axis``.
    """
    out = step_to(params, picture, visible, at, pixel[0] - aside[0], pixel[1] - aside[1])
    second = step_to(params, picture, visible, at, pixel[0] + aside[0], pixel[1] + aside[1])
    if second.found and (not out.found or wp.length_sq(second.turn) < wp.length_sq(out.turn)):
        out = second
    if not out.found:
        out.origin = (wp.length(at.hit.point - params.camera_position) * angle) * axis
        out.turn = angle * axis
    return out


@wp.func
def pixel_footprint(
    params: FrameParams, picture: Picture, visible: VisibleObjects, at: SeenPoint, pixel: wp.vec2i, angle: wp.float32
) -> Footprint:
    """Return a pixel's reflected ray differentials, from differences to neighbours; ``angle`` is a pixel's, radians."""
    axes = frame_from_normal(reflect(at.wo, at.normal))
    across = wp.vec3(axes[0, 0], axes[1, 0], axes[2, 0])
    down = wp.vec3(axes[0, 1], axes[1, 1], axes[2, 1])
    x = shorter_step(params, picture, visible, at, pixel, wp.vec2i(0, 1), across, angle)
    y = shorter_step(params, picture, visible, at, pixel, wp.vec2i(1, 0), down, angle)
    out = Footprint()
    out.origin_x = x.origin
    out.origin_y = y.origin
    out.turn_x = x.turn
    out.turn_y = y.turn
    return out


@functools.cache
def make_see_point(config: NearFieldConfig) -> wp.Function:
    """Return ``see_point(params, picture, scene, dfg, visible, i, j) -> SeenPoint``: an object's point in a pixel."""
    surface_at = make_surface(config.distant.models, config.distant.textures)
    side = config.side

    @wp.func(module="unique")
    def see_point(
        params: wp.array[FrameParams],
        picture: Picture,
        scene: RayScene,
        dfg: wp.array2d[wp.vec2],
        visible: VisibleObjects,
        i: wp.int32,
        j: wp.int32,
    ) -> SeenPoint:
        at = SeenPoint()
        hit = visible.hits[i, j]
        at.hit = hit
        at.pixel = picture.rays[i, j]
        at.place = (i % side) * side + j % side
        at.wo = -wp.normalize(params[0].world_from_camera * wp.vec3(at.pixel[0], at.pixel[1], 1.0))
        at.normal = hit.normal
        at.geometric = hit.geometric_normal
        if wp.dot(at.geometric, at.wo) < 0.0:
            at.normal = -at.normal
            at.geometric = -at.geometric
        cos_o = wp.max(wp.dot(at.normal, at.wo), 1.0e-3)
        at.surface = surface_at(scene, dfg, hit, cos_o, scene.pixel_spread)
        at.alpha = lobe_alpha(at.surface.model, at.surface.roughness, at.surface.shininess)
        if wp.static(config.distant.specular and config.mirror_samples > 0):
            if at.alpha < SHARP:
                at.footprint = pixel_footprint(params[0], picture, visible, at, wp.vec2i(i, j), scene.pixel_spread)
        return at

    return see_point


@wp.func
def make_sample_ray(sample: EnvironmentSample, at: SeenPoint, share: wp.float32) -> NearRay:
    """Return the ray from ``at`` toward an environment sample; its weight is 0 if the sample is behind the surface.

    ``share`` is the interpolation weight, 0 to 1, of the mirror ball whose environment the sample was drawn from; it is
    1 with a single ball.
    """
    out = NearRay()
    toward = sample_toward(sample, at.hit.point)
    cosine = wp.dot(at.normal, toward.direction)
    if cosine > 0.0:
        out.weight = share * cosine * toward.measure
        if wp.dot(at.geometric, toward.direction) > 0.0:
            out.leaves = True
            out.radiance = sample.radiance
            out.origin = offset_origin(at.hit.point, at.geometric, toward.direction, at.hit.error)
            out.direction = toward.direction
            out.reach = toward.distance
            out.spread = RAY_SPREAD
    return out


@wp.func
def make_lobe_ray(u: wp.vec2, at: SeenPoint) -> NearRay:
    """Return a ray into the lobe of a glossy surface, sampled by ``u``, two numbers in [0, 1)."""
    out = NearRay()
    if at.surface.model == PHONG:
        center = reflect(at.wo, at.normal)
        wi = frame_from_normal(center) * sample_phong_lobe(u, at.surface.shininess)
        width = phong_ray_width(wp.dot(wi, center), at.surface.shininess, at.alpha)
    else:
        basis = frame_from_normal(at.normal)
        half = basis * sample_ggx_visible(u, wp.transpose(basis) * at.wo, at.alpha)
        wi = reflect(at.wo, half)
        width = ggx_ray_width(wp.dot(half, at.normal), at.alpha)
    if wp.dot(wi, at.geometric) > 0.0:
        out.leaves = True
        out.origin = offset_origin(at.hit.point, at.geometric, wi, at.hit.error)
        out.direction = wi
        out.reach = FAR
        out.spread = width
        out.point = at.hit.point
        out.covers = True
    return out


@functools.cache
def make_mirror_ray(config: NearFieldConfig) -> wp.Function:
    """Return ``mirror_ray(params, scene, at, k) -> NearRay``: mirror reflection of the camera ray ``k`` of a pixel."""
    closest_visible = make_primary(config.distant.trace)
    sample_direction = make_sample_direction(config.mirror_samples)

    @wp.func(module="unique")
    def mirror_ray(params: wp.array[FrameParams], scene: RayScene, at: SeenPoint, k: wp.int32) -> NearRay:
        out = NearRay()
        direction = wp.normalize(sample_direction(params, at.pixel, k))
        seen = closest_visible(scene, params[0].camera_position, direction)
        if seen.shape == at.hit.shape:
            geometric = seen.geometric_normal
            if wp.dot(geometric, direction) > 0.0:
                geometric = -geometric
            wi = reflect(-direction, seen.normal)
            if wp.dot(wi, geometric) > 0.0:
                out.leaves = True
                out.origin = offset_origin(seen.point, geometric, wi, seen.error)
                out.direction = wi
                out.reach = FAR
                out.spread = scene.pixel_spread
                out.point = seen.point
                out.covers = True
        return out

    return mirror_ray


@functools.cache
def make_pick_ray(config: NearFieldConfig) -> wp.Function:
    """Return ``pick_ray(params, scene, samples, places, at, n, diffuse) -> NearRay``: ray number ``n`` of a pixel.

    The first ``diffuse`` rays go toward samples of the environment, the others into the lobe. ``places`` holds the
    positions of several balls.
    """
    mirror_ray = make_mirror_ray(config) if config.mirror_samples > 0 else None
    side, lobes = config.side, config.lobe_count
    shift = 0.5 / (max(lobes, 1) * side * side)

    @wp.func(module="unique")
    def pick_ray(
        params: wp.array[FrameParams],
        scene: RayScene,
        samples: wp.array[EnvironmentSample],
        places: wp.array[wp.vec4],
        at: SeenPoint,
        n: wp.int32,
        diffuse: wp.int32,
    ) -> NearRay:
        ray = NearRay()
        if wp.static(config.distant.diffuse != "none"):
            if n < diffuse:
                # A sample's measure refers to the samples of all sets. A set is a block of a sequence, in order: its
                # first samples are a smaller set.
                stride = samples.shape[0] / wp.static(side * side)
                share = wp.float32(stride * side * side) / wp.static(float(config.count))
                chosen = at.place * stride + n
                if wp.static(config.distant.several):
                    share *= probe_share(places, ball_of_sample(chosen, places.shape[0]), at.hit.point)
                ray = make_sample_ray(samples[chosen], at, share)
        if wp.static(config.distant.specular):
            if n >= diffuse:
                k = n - diffuse
                if wp.static(config.mirror_samples > 0):
                    if at.alpha < SHARP:
                        ray = mirror_ray(params, scene, at, k)
                if wp.static(lobes > 0):
                    if at.alpha >= SHARP:
                        index = wp.uint32(at.place * wp.static(lobes) + k)
                        u = wp.vec2(radical_inverse(index) + wp.static(shift), sobol_second(index) + wp.static(shift))
                        ray = make_lobe_ray(u, at)
        return ray

    return pick_ray


@functools.cache
def make_look_beyond(config: NearFieldConfig) -> wp.Function:
    """Return ``look_beyond(distant, ray) -> vec3``: the environment along a lobe's ray, filtered to the ray's width."""
    radiance_along = make_radiance_along(config.distant)
    width = ray_width(config)

    @wp.func(module="unique")
    def look_beyond(distant: DistantLight, ray: NearRay) -> wp.vec3:
        level = level_from_alpha(wp.static(width) * ray.spread, distant.level_height)
        return radiance_along(distant, ray.point, ray.direction, level)

    return look_beyond


@wp.struct
class NearLight:
    """Light of the near field at the pixels of objects; arrays that no material needs are empty."""

    irradiance: wp.array2d[wp.vec3]
    reflected: wp.array2d[wp.vec4]  # N, near radiance, and s, the share of rays that meet something near
    transmitted: wp.array2d[wp.vec4]  # M, the environment along rays that meet nothing, and |B|


@functools.cache
def make_count_rays(config: NearFieldConfig) -> wp.Function:
    """Return the function ``count_rays(at) -> vec2i``: numbers of rays to environment samples, and into the lobe."""

    @wp.func(module="unique")
    def count_rays(at: SeenPoint) -> wp.vec2i:
        surface = at.surface
        rays = wp.vec2i(0, 0)
        if wp.static(config.distant.diffuse != "none"):
            if surface.diffuse[0] + surface.diffuse[1] + surface.diffuse[2] > 0.0:
                rays[0] = wp.static(config.count)
        if wp.static(config.distant.specular):
            if surface.reflectance[0] + surface.reflectance[1] + surface.reflectance[2] > 0.0:
                rays[1] = wp.where(at.alpha < SHARP, wp.static(config.mirror_samples), wp.static(config.lobe_count))
        return rays

    return count_rays


@functools.cache
def make_near_field_kernel(config: NearFieldConfig) -> wp.Kernel:
    """Return the kernel of ``estimate_near_field``; equal configs share one kernel.

    One loop traces all kinds of rays, so that the code of tracing is compiled once. A copy for each kind, and for each
    iteration of an unrolled loop, takes NVRTC nine times as long.
    """
    see_point, count_rays = make_see_point(config), make_count_rays(config)
    pick_ray, look_near = make_pick_ray(config), make_look_near(config)
    footprint_of = make_footprint_of(config)
    look_beyond = make_look_beyond(config) if config.lobe_count > 0 else None
    reflected_radiance = make_reflected_radiance(config.distant) if config.mirror_samples > 0 else None
    distant_irradiance = make_distant_irradiance(config.distant)
    lobes = config.lobe_count

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def near_field_kernel(
        row_start: wp.int32,
        # In:
        params: wp.array[FrameParams],
        picture: Picture,
        layers: ReceiverLayers,
        scene: RayScene,
        distant: DistantLight,
        samples: wp.array[EnvironmentSample],
        visible: VisibleObjects,
        # Out:
        near_out: NearLight,
    ):
        i, j = wp.tid()
        i += row_start
        if not inside_rect(i, j, params[0].object_rect):
            return
        if visible.objects[i, j] < 0:
            return
        at = see_point(params, picture, scene, distant.dfg, visible, i, j)
        surface = at.surface
        alpha = at.alpha
        rays = count_rays(at)
        diffuse = rays[0]
        total = wp.vec3(0.0)
        reflected = wp.vec4(0.0)
        transmitted = wp.vec4(0.0)
        leaving = float(0.0)  # rays above the surface; the loss of those below it is part of its reflectance
        for n in range(diffuse + rays[1]):
            ray = pick_ray(params, scene, samples, distant.others.places, at, n, diffuse)
            near = wp.vec4(0.0)
            if ray.leaves:
                near = look_near(params[0], picture, layers, scene, distant, at, ray)
            if wp.static(config.distant.diffuse != "none"):
                if n < diffuse:
                    radiance = ray.radiance
                    if near[3] > 0.0:
                        radiance = wp.vec3(near[0], near[1], near[2])
                    if wp.static(config.known):
                        radiance -= ray.radiance
                    if ray.weight > 0.0:
                        total += ray.weight * radiance
            if wp.static(config.distant.specular):
                if n >= diffuse and ray.leaves:
                    leaving += 1.0
                    if wp.static(config.mirror_samples > 0):
                        if alpha < SHARP and near[3] <= 0.0:
                            beyond = reflected_radiance(
                                distant,
                                surface.model,
                                surface.roughness,
                                surface.shininess,
                                ray.point,
                                ray.direction,
                                mirrored_level(footprint_of(at, ray), distant.level_height),
                            )
                            near = wp.vec4(beyond[0], beyond[1], beyond[2], 1.0)
                    reflected += near
                    if wp.static(lobes > 0):
                        if alpha >= SHARP:
                            beyond = look_beyond(distant, ray)
                            missed = (1.0 - near[3]) * beyond
                            transmitted += wp.vec4(missed[0], missed[1], missed[2], brightness(beyond))
        if wp.static(config.distant.diffuse != "none"):
            if wp.static(config.known):
                total += distant_irradiance(distant, at.hit.point, at.normal)
            near_out.irradiance[i, j] = total
        if wp.static(config.distant.specular):
            near_out.reflected[i, j] = reflected / wp.max(leaving, 1.0)
            near_out.transmitted[i, j] = transmitted / wp.max(leaving, 1.0)
            if rays[1] > 0 and leaving == 0.0 and alpha >= SHARP:
                near_out.reflected[i, j] = wp.vec4(0.0, 0.0, 0.0, NO_RAY)

    return near_field_kernel


@functools.cache
def make_alpha_at(config: NearFieldConfig) -> wp.Function:
    """Return ``alpha_at(scene, hit, origin) -> float32``: lobe width alpha at a hit seen from ``origin``."""

    @wp.func(module="unique")
    def alpha_at(scene: RayScene, hit: Hit, origin: wp.vec3) -> wp.float32:
        material = scene.materials[scene.objects[hit.shape].material]
        roughness = material.roughness
        if wp.static(config.distant.textures):
            material = scene.materials[material_at(scene, hit)]
            direction = wp.normalize(hit.point - origin)
            cos_o = wp.max(wp.abs(wp.dot(hit.normal, direction)), 1.0e-3)
            roughness = roughness_at(scene, material, surface_point(scene, hit, cos_o, scene.pixel_spread))
        return lobe_alpha(material.model, roughness, material.shininess)

    return alpha_at


@wp.func
def fill_lobe(near: wp.vec4, transmitted: wp.vec4) -> wp.vec4:
    """Return (RGB, share): the radiance N + s M that ``shade`` adds, and the share of the environment that it omits.

    Args:
        near: Means over rays: N and s.
        transmitted: M and |B|.
    """
    out = near
    missed = brightness(wp.vec3(transmitted[0], transmitted[1], transmitted[2]))
    # |M| / |B| is at most 1 but for rounding.
    left = wp.where(transmitted[3] > MIN_LIGHT, wp.min(missed / transmitted[3], 1.0), 1.0)
    left *= 1.0 - near[3]
    for channel in range(3):
        out[channel] += near[3] * transmitted[channel]
    out[3] = 1.0 - left
    return out


@functools.cache
def make_filter_kernel(config: NearFieldConfig) -> wp.Kernel:
    """Return the kernel of ``filter_near_field``."""
    side = config.side
    alpha_at = make_alpha_at(config)

    @wp.kernel(module="unique", enable_backward=False)
    def filter_near_field_kernel(
        row_start: wp.int32,
        # In:
        params: wp.array[FrameParams],
        scene: RayScene,
        visible: VisibleObjects,
        estimate: NearLight,
        # Out:
        near_out: NearLight,
    ):
        i, j = wp.tid()
        rect = params[0].object_rect
        objects = visible.objects
        i += row_start
        if not inside_rect(i, j, rect):
            return
        hits = visible.hits
        found = objects[i, j]
        if found < 0:
            return
        normal = hits[i, j].normal
        alpha = float(0.0)
        falling = float(0.0)  # rate at which weights fall with 1 - cosine between normals
        if wp.static(config.distant.specular):
            alpha = alpha_at(scene, hits[i, j], params[0].camera_position)
            if wp.static(config.lobe_count >= OWN_RAYS):
                if alpha >= SHARP and estimate.reflected[i, j][3] != NO_RAY:
                    falling = 1.0 / (alpha * alpha)
        light = wp.vec3(0.0)
        glossy = wp.vec4(0.0)
        weights = float(0.0)
        lobes = float(0.0)  # sum of the weights of pixels with a ray that left the surface
        distant = wp.vec4(0.0)
        reach = wp.static(side // 2)
        for a in range(-reach, reach + 1):
            for b in range(-reach, reach + 1):
                if inside_rect(i + a, j + b, rect):
                    likeness = float(-1.0)
                    if objects[i + a, j + b] == found:
                        likeness = wp.dot(hits[i + a, j + b].normal, normal)
                    if likeness > SAME_NORMAL:
                        weight = wp.where(a == reach or a == -reach, 0.5, 1.0)
                        weight *= wp.where(b == reach or b == -reach, 0.5, 1.0)
                        weights += weight
                        if wp.static(config.distant.diffuse != "none"):
                            light += weight * estimate.irradiance[i + a, j + b]
                        if wp.static(config.distant.specular):
                            if estimate.reflected[i + a, j + b][3] != NO_RAY:
                                weight *= wp.exp(-falling * wp.max(1.0 - likeness, 0.0))
                                lobes += weight
                                glossy += weight * estimate.reflected[i + a, j + b]
                                distant += weight * estimate.transmitted[i + a, j + b]
        if wp.static(config.distant.diffuse != "none"):
            near_out.irradiance[i, j] = wp.max(light / weights, wp.vec3(0.0))
        if wp.static(config.distant.specular):
            if alpha < SHARP:
                near_out.reflected[i, j] = estimate.reflected[i, j]
                return
            share = wp.max(lobes, MIN_LIGHT)
            near_out.reflected[i, j] = fill_lobe(glossy / share, distant / share)

    return filter_near_field_kernel


estimate_near_field = row_launcher(make_near_field_kernel, like=lambda params, picture, *_: picture.rays)
"""Estimate the near field at each pixel of an object, with one set of samples.

Args:
    config: Features of the scene; arguments that it does not use may be None, or empty in a struct.
    params: (1,) FrameParams: camera, object_rect and light_rect.
    picture: (H, W) the camera's frame and rays.
    layers: (H, W) virtual shadows and virtual light on the receiver.
    scene: Objects and proxies.
    distant: The environment.
    samples: Samples of the environment, set after set.
    visible: (H, W) from ``trace_pixels``.
    near_out: (H, W) estimates of single pixels; written only where an object is visible.
"""


filter_near_field = row_launcher(make_filter_kernel, like=lambda params, scene, visible, *_: visible.objects)
"""Average the estimates over neighbours on the same object; arguments as for ``estimate_near_field``.

``irradiance`` and ``reflected`` of ``near_out`` are written. The fourth component of ``reflected`` becomes the share of
the prefiltered environment that ``shade`` omits.
"""
