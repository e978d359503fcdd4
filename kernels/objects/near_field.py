"""Surroundings of a virtual object at close range: the receiver that it stands on, other objects, itself.

Per pixel of an object, two objects replace what the distant environment alone would give ``shade``:

*Irradiance*, the sum over one set of the environment's samples, each traced: a proxy in the way shows the camera's
picture of it (see ``reflect``), darkened by the objects' own shadows and brightened by virtual light; an object in the
way shows what the distant environment makes of it. So an object's underside sees the shadow that it stands in, not an
empty receiver. Few samples are a bad sum: there it is the environment's irradiance, which is known, and of the samples
only what those change that meet something. Where nothing is near that has no noise.

*Mirrored*, radiance of what is near and a share; ``shade`` adds (1 - share) of the prefiltered environment. A mirror
sends rays from places all over the pixel, for what a curved one shows in neighbouring pixels may lie far apart; each
reads what it meets as wide as its part of the pixel is there, the environment as well, and the share is 1. A glossy
lobe sends a few, another few from each pixel of a tile. What is near hides part of the lobe, and what it hides may be
much darker than the rest: at the rim of a window that a receiver cuts off, half of the rays meet the receiver and
hardly any of the light is gone. So every ray reads the environment as well. With the means over the rays

    s  share of the rays that meet something near,      N  their radiance, 0 for the others,
    B  the environment along all rays,                  M  the environment along those that meet nothing,

the lobe holds N + M. M is noisy where much of the lobe is open, and there L, the environment prefiltered with the
whole lobe, is known: M = (|M| / |B|) L, as L is B without noise. Where hardly any of it is open the noise of M is a
small part of the sum, and L may be all that is hidden. Hence

    | N + s M + (1 - s) (|M| / |B|) L |,    |.| the brightness: share = 1 - (1 - s) |M| / |B|.

Both are averaged over one tile's worth of neighbours on the same object whose normals agree, as ``environment_shadow``
does; mirrors are not. Where a pixel has rays enough of its own, neighbours count less for what a lobe holds the more
their normals differ: exp(-theta^2 / (2 alpha^2)), alpha the lobe's width, as 1 - cos theta = theta^2 / 2. Normals of a
thin tube turn by ten degrees from pixel to pixel, and a mean over them would hold what twice that angle shows.

**Rays** go toward samples of the environment, into a glossy lobe, or from places all over the pixel of a mirror.
A ray among n stands for the solid angle 1 / (n pdf). The environment's level of the same width is read, twice as wide
so that neighbours overlap: for a half vector h, GGX has pdf D = k^2 / pi, k = alpha / (sin^2 + alpha^2 cos^2) of the
angle between h and n, which is 1 / alpha at the peak, where a lobe's n-th has the width alpha / sqrt n. So

    | width = 2 / (k sqrt n) |,    Phong: 2 alpha / sqrt(n cos^e), e its exponent.

With one width for all, the few rays in the long tails of GGX would show emitters as squares of a tile's size.

A mirror's rays stand for the parts of its pixel, and spread as its neighbours say: how origin and direction of the
mirrored ray differ from pixel to pixel, whatever the shape. The picture of the receiver is read as wide as a ray of a
mirror or a lobe is there (``frame_levels``), and so are the environment and the textures of other objects.
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
"""Width of a lobe below which it is a mirror."""
SHARP = wp.constant(wp.float32(SHARP_ALPHA))
RAY_WIDTH = 2.0
"""Width of one ray of many, over the width that its share of the lobe has."""
LOBE_ANGLE = 1.0
"""Side of such a ray's footprint in the frame, as an angle, over its width. The whole share of a ray has a side of
1.77, but so wide a footprint would cross the edges of its surface."""
SAME_SURFACE = wp.constant(wp.float32(0.5))
"""Least cosine between the normals of neighbours that estimate a mirror's curvature."""
MIN_LIGHT = wp.constant(wp.float32(1.0e-6))
"""Brightness, in camera values, below which a lobe's share is 0 over 0."""
NO_RAY = wp.constant(wp.float32(-1.0))
"""Share of a pixel whose rays all ran into its surface: it knows nothing of its lobe."""
SAME_NORMAL = wp.constant(wp.float32(math.cos(math.radians(20.0))))
"""Cosine of the angle up to which neighbours' normals are those of one surface."""


OWN_RAYS = 4
"""Rays into a lobe from which on neighbours count by how much their normals differ."""


@dataclasses.dataclass(frozen=True)
class NearFieldConfig:
    """Compile-time configuration of the kernel."""

    distant: DistantLightConfig
    """Kinds of shape and forms of light."""
    count: int
    """Samples of the environment per pixel, of each set."""
    lobe_count: int
    """Rays per pixel into a glossy lobe; 0 if no object has one."""
    mirror_samples: int
    """Places within a pixel from which a mirror sends a ray, a square number; 0 if no object is one."""
    side: int
    """Pixels along a tile."""
    ratio: bool
    """True if objects shade the receiver."""
    added: bool
    """True if virtual lights light the receiver."""
    known: bool = False
    """True if irradiance is the environment's known one plus the change by samples that hit something; else the sum
    of all samples."""


@wp.func
def lobe_alpha(model: wp.int32, roughness: wp.float32, shininess: wp.float32) -> wp.float32:
    """Width of a surface's lobe; 0 for a mirror."""
    if model == METALLIC_ROUGHNESS:
        return roughness * roughness
    if model == PHONG:
        return 1.0 / wp.sqrt(wp.max(shininess, 1.0))
    return 0.0


@wp.func
def ggx_ray_width(cos_theta: wp.float32, alpha: wp.float32) -> wp.float32:
    """Width of a ray, times the root of their number, whose half vector is this far from the normal."""
    cos2 = wp.min(cos_theta * cos_theta, 1.0)
    return (1.0 - cos2) / alpha + alpha * cos2


@wp.func
def phong_ray_width(cos_theta: wp.float32, exponent: wp.float32, alpha: wp.float32) -> wp.float32:
    """The same for a ray this far from the mirror direction; no wider than the hemisphere."""
    return wp.min(alpha * wp.exp(-0.5 * exponent * wp.log(wp.max(cos_theta, 1.0e-3))), 1.0)


@wp.struct
class NearRay:
    """A ray that leaves a pixel of an object, and what stands behind the near field on its way."""

    origin: wp.vec3
    direction: wp.vec3
    reach: wp.float32  # metres
    spread: wp.float32  # width over length
    point: wp.vec3  # that it leaves, without offset
    radiance: wp.vec3  # a sample's of the environment
    weight: wp.float32  # that sample's cosine and measure, times its share
    leaves: wp.bool  # into the open; else into the surface
    covers: wp.bool  # a part of what a pixel mirrors: what it meets is read as wide as that


@wp.struct
class SeenPoint:
    """A point of an object that a pixel shows."""

    hit: Hit
    wo: wp.vec3
    normal: wp.vec3  # for shading; this one and the next on the camera's side
    geometric: wp.vec3  # of the surface that rays meet
    surface: Surface
    alpha: wp.float32  # width of its lobe; 0 for a mirror
    pixel: wp.vec2  # undistorted (x / z, y / z)
    place: wp.int32  # of the pixel in its tile
    footprint: Footprint  # of a mirror's whole pixel


def ray_width(config: NearFieldConfig) -> float:
    """Width of a ray of a tile's lobes, over ``NearRay.spread``."""
    return RAY_WIDTH / (math.sqrt(max(config.lobe_count, 1)) * config.side)


@functools.cache
def make_footprint_of(config: NearFieldConfig) -> wp.Function:
    """``footprint_of(at, ray) -> Footprint``: of a ray that covers a part of what a pixel mirrors.

    A mirror's is its part of the pixel, a lobe's a square around its direction.
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
    """The picture of a proxy, shown at ``at``, as wide as the ray is that meets it."""
    normal = proxy.geometric_normal
    across = covered_on(fp.origin_x, fp.turn_x, proxy.t, ray.direction, normal)
    along = covered_on(fp.origin_y, fp.turn_y, proxy.t, ray.direction, normal)
    from_camera = proxy.point - params.camera_position
    a = shown_as(params, from_camera, across)
    b = shown_as(params, from_camera, along)
    return look_up_covered(params, picture, layers, at, a, b)


@wp.func
def spread_at(fp: Footprint, t: wp.float32) -> wp.float32:
    """Width over length that a ray has when it has come so far: the side of a square of the area that it covers."""
    area = wp.length(wp.cross(fp.origin_x + t * fp.turn_x, fp.origin_y + t * fp.turn_y))
    return wp.sqrt(area) / wp.max(t, 1.0e-6)


@wp.func
def mirrored_level(fp: Footprint, height: wp.int32) -> wp.float32:
    """Level of the environment for what a mirror's ray covers beyond a texel, which level 0 shows by itself.

    A GGX lobe of width alpha has the peak density of a solid angle of 4 pi alpha^2.
    """
    covered = wp.length(wp.cross(fp.turn_x, fp.turn_y))
    texel = wp.pi / wp.float32(wp.max(height, 1))
    return level_from_alpha(wp.sqrt(wp.max(covered - texel * texel, 0.0) / (4.0 * wp.pi)), height)


@functools.cache
def make_look_near(config: NearFieldConfig) -> wp.Function:
    """``look_near(...) -> vec4``: radiance of what is near along a ray, and 1; zero where only the environment is.

    The receiver's radiance is that of the picture so far: its shadows and its virtual light included.
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
    """Difference of a mirrored ray from that of a pixel's neighbour."""

    found: wp.bool
    origin: wp.vec3
    turn: wp.vec3


@wp.func
def step_to(
    params: FrameParams, picture: Picture, visible: VisibleObjects, at: SeenPoint, i: wp.int32, j: wp.int32
) -> Step:
    """To pixel (i, j), where it shows the same object with no crease between."""
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
    """Of two neighbours the one that lies more on the same surface; without any, a pixel of a plane mirror."""
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
    """Return the change of the mirrored ray over a pixel, which is ``angle`` wide, by its neighbours."""
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
    """``see_point(params, picture, scene, dfg, visible, i, j) -> SeenPoint``: what pixel (i, j) shows of an object."""
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
    """Toward a sample of the environment; its weight is 0 where the surface does not see it."""
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
    """Into the lobe of a glossy surface, by two numbers of [0, 1)."""
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
    """``mirror_ray(params, scene, at, k) -> NearRay``: from what a pixel's sample ``k`` shows of a mirror."""
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
    """``pick_ray(params, scene, samples, places, at, n, diffuse) -> NearRay``: ray number ``n`` of a pixel.

    The first ``diffuse`` go toward samples of the environment, of several balls at ``places``, the others into the
    lobe.
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
                # A sample's measure is its share of all sets. A set is in the order of its sequence: any first part of
                # it is a smaller set.
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
    """``look_beyond(distant, ray) -> vec3``: the environment along a lobe's ray, as wide as the ray."""
    radiance_along = make_radiance_along(config.distant)
    width = ray_width(config)

    @wp.func(module="unique")
    def look_beyond(distant: DistantLight, ray: NearRay) -> wp.vec3:
        level = level_from_alpha(wp.static(width) * ray.spread, distant.level_height)
        return radiance_along(distant, ray.point, ray.direction, level)

    return look_beyond


@wp.struct
class NearLight:
    """Light that reaches the pixels of objects from near by; empty where no material asks for it."""

    irradiance: wp.array2d[wp.vec3]
    reflected: wp.array2d[wp.vec4]  # premultiplied near radiance, and its share of the rays
    transmitted: wp.array2d[wp.vec4]  # the environment along rays that pass the near field, and its brightness on all


@functools.cache
def make_count_rays(config: NearFieldConfig) -> wp.Function:
    """``count_rays(at) -> vec2i``: rays of a pixel toward samples of the environment, and into its lobe."""

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
    """Kernel specialised to ``config``; equal configs share one kernel.

    Rays of all kinds go through one loop, so that the walk through the scene is there once: a copy for each kind, and
    for each turn of an unrolled loop, takes NVRTC nine times as long.
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
        leaving = float(0.0)  # rays; those into the surface are part of its reflectance
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
    """``alpha_at(scene, hit, origin) -> float32``: width of the lobe of what a pixel shows from ``origin``."""

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
    """Return the light that ``shade`` adds, and the share of the prefiltered environment that it leaves out.

    Args:
        near: Means over rays: N and s.
        transmitted: M, and the brightness of B.
    """
    out = near
    missed = brightness(wp.vec3(transmitted[0], transmitted[1], transmitted[2]))
    # What passes is no more than all; rounding may say otherwise.
    left = wp.where(transmitted[3] > MIN_LIGHT, wp.min(missed / transmitted[3], 1.0), 1.0)
    left *= 1.0 - near[3]
    for channel in range(3):
        out[channel] += near[3] * transmitted[channel]
    out[3] = 1.0 - left
    return out


@functools.cache
def make_filter_kernel(config: NearFieldConfig) -> wp.Kernel:
    """Kernel of ``filter_near_field``."""
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
        falling = float(0.0)  # of weights with 1 less the cosine between normals
        if wp.static(config.distant.specular):
            alpha = alpha_at(scene, hits[i, j], params[0].camera_position)
            if wp.static(config.lobe_count >= OWN_RAYS):
                if alpha >= SHARP and estimate.reflected[i, j][3] != NO_RAY:
                    falling = 1.0 / (alpha * alpha)
        light = wp.vec3(0.0)
        glossy = wp.vec4(0.0)
        weights = float(0.0)
        lobes = float(0.0)  # weights of pixels of which a ray left the surface
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
"""Estimate what surrounds the objects, each pixel with one set of samples.

Args:
    config: What the scene calls for; what it leaves out may be None, or empty in a struct.
    params: (1,) FrameParams: camera, object_rect and light_rect.
    picture: (H, W) the camera's.
    layers: (H, W) what virtual objects and lights change in it.
    scene: Objects and proxies.
    distant: The environment.
    samples: Samples of the environment, set after set.
    visible: (H, W) as ``trace_pixels`` writes.
    near_out: (H, W) estimates of single pixels; written only where an object is visible.
"""


filter_near_field = row_launcher(make_filter_kernel, like=lambda params, scene, visible, *_: visible.objects)
"""Average the estimates over tiles, along objects only; arguments as those of ``estimate_near_field``.

Of ``near_out``, irradiance and reflected are written; the last of reflected becomes the share of the prefiltered
environment that ``shade`` leaves out.
"""
