"""What surrounds a virtual object at close range: the receiver that it stands on, other objects, itself.

Per pixel of an object, two objects replace what the distant environment alone would give ``shade``:

*Irradiance*, the sum over one set of the environment's samples, each traced: a proxy in the way shows the camera's
picture of it (see ``reflect``), darkened by the objects' own shadows and brightened by virtual light; an object in the
way shows what the distant environment makes of it. So an object's underside sees the shadow that it stands in, not an
empty receiver. Few samples are a bad sum: there it is the environment's irradiance, which is known, and of the samples
only what those change that meet something. Where nothing is near that has no noise.

*Mirrored*, radiance of what is near and a share; ``shade`` adds (1 - share) of the prefiltered environment. A mirror
sends rays from places all over the pixel, for what a curved one shows in neighbouring pixels may lie far apart; they
read the environment as well, and the share is 1. A glossy lobe sends a few, another few from each pixel of a tile. What
is near hides part of the lobe, and what it hides may be much darker than the rest: at the rim of a window that a
receiver cuts off, half of the rays meet the receiver and hardly any of the light is gone. So every ray reads the
environment as well. With the means over the rays

    s  share of the rays that meet something near,      N  their radiance, 0 for the others,
    B  the environment along all rays,                  M  the environment along those that meet nothing,

the lobe holds N + M. M is noisy where much of the lobe is open, and there L, the environment prefiltered with the
whole lobe, is known: M = (|M| / |B|) L, as L is B without noise. Where hardly any of it is open the noise of M is a
small part of the sum, and L may be all that is hidden. Hence

    | N + s M + (1 - s) (|M| / |B|) L |,    |.| the brightness: share = 1 - (1 - s) |M| / |B|.

A ray among n stands for the solid angle 1 / (n pdf). The environment's level of the same width is read, twice as wide
so that neighbours overlap: for a half vector h, GGX has pdf D = k^2 / pi, k = alpha / (sin^2 + alpha^2 cos^2) of the
angle between h and n, which is 1 / alpha at the peak, where a lobe's n-th has the width alpha / sqrt n. So

    | width = 2 / (k sqrt n) |,    Phong: 2 alpha / sqrt(n cos^e), e its exponent.

With one width for all, the few rays in the long tails of GGX would show emitters as squares of a tile's size.

Both are averaged over one tile's worth of neighbours on the same object whose normals agree, as ``environment_shadow``
does; mirrors are not.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import warp as wp

from warp_ar.kernels.color import brightness
from warp_ar.kernels.environment_samples import EnvironmentSample, ball_of_sample, sample_toward, sobol_second
from warp_ar.kernels.launch import MOST_REGISTERS, Rows, launch_rows, slow_to_compile
from warp_ar.kernels.lobes import level_from_alpha
from warp_ar.kernels.materials import Surface, make_surface, material_at, reflect, roughness_at, surface_point
from warp_ar.kernels.probe_weights import probe_share
from warp_ar.kernels.reflect import (
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
from warp_ar.kernels.sampling import (
    frame_from_normal,
    radical_inverse,
    sample_ggx_visible,
    sample_phong_lobe,
)
from warp_ar.kernels.shapes import FAR
from warp_ar.kernels.structs import METALLIC_ROUGHNESS, PHONG, FrameParams, Hit, Picture, RayScene
from warp_ar.kernels.trace import make_trace, offset_origin
from warp_ar.kernels.visibility import VisibleObjects, inside_rect, make_primary, make_sample_direction

wp.set_module_options({"enable_backward": False})

SHARP_ALPHA = 0.02
"""Width of a lobe below which it is a mirror."""
SHARP = wp.constant(wp.float32(SHARP_ALPHA))
MIN_LIGHT = wp.constant(wp.float32(1.0e-6))
"""Brightness, in camera values, below which a lobe's share is 0 over 0."""
NO_RAY = wp.constant(wp.float32(-1.0))
"""Share of a pixel whose rays all ran into its surface: it knows nothing of its lobe."""
RAY_WIDTH = 2.0
"""Width of one ray of many, over the width that its share of the lobe has."""
SAME_NORMAL = wp.constant(wp.float32(math.cos(math.radians(20.0))))
"""Cosine of the angle up to which neighbours' normals are those of one surface."""


@dataclasses.dataclass(frozen=True)
class NearFieldConfig:
    """What is compiled into the kernel."""

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
    """Whether objects shade the receiver."""
    added: bool
    """Whether virtual lights light the receiver."""
    known: bool = False
    """Whether irradiance is that of the environment, as it is known, and what the samples that meet something change;
    else the sum of all samples."""


@wp.struct
class ReceiverLayers:
    """What virtual objects and lights change in the picture of the receiver; empty where nothing does."""

    shadow_ratio: wp.array2d[wp.vec3]  # factor on the frame
    added: wp.array2d[wp.vec3]  # radiance of virtual light


@wp.struct
class NearLight:
    """What reaches the pixels of objects from near by; empty where no material asks for it."""

    irradiance: wp.array2d[wp.vec3]
    reflected: wp.array2d[wp.vec4]  # premultiplied near radiance, and its share of the rays
    transmitted: wp.array2d[wp.vec4]  # the environment along rays that pass the near field, and its brightness on all


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


@functools.cache
def make_look_near(config: NearFieldConfig) -> wp.Function:
    """``look_near(...) -> vec4``: radiance of what is near along a ray, and 1; zero where only the environment is.

    The receiver's radiance is that of the picture so far: its shadows and its virtual light included.
    """
    trace = make_trace(config.distant.trace)
    closest_object, closest_proxy = trace.closest_object, trace.closest_proxy
    find_in_frame = make_find_in_frame(config.distant.trace, config.distant.probes)
    shade_unoccluded = make_shade_unoccluded(config.distant)

    @wp.func(module="unique")
    def look_near(
        params: FrameParams,
        picture: Picture,
        layers: ReceiverLayers,
        scene: RayScene,
        distant: DistantLight,
        origin: wp.vec3,
        direction: wp.vec3,
        t_max: wp.float32,
        spread: wp.float32,
    ) -> wp.vec4:
        other = closest_object(scene, origin, direction, t_max)
        proxy = closest_proxy(scene, origin, direction, other.t)
        if proxy.shape >= 0:
            at = find_in_frame(params, picture, scene, distant.probes, proxy)
            if at[0] < 0.0:
                return wp.vec4(0.0)
            radiance = look_up(picture, at[0], at[1])
            row = wp.int32(at[1] + 0.5)
            column = wp.int32(at[0] + 0.5)
            if wp.static(config.ratio):
                radiance = wp.cw_mul(radiance, layers.shadow_ratio[row, column])
            if wp.static(config.added):
                if inside_rect(row, column, params.light_rect):
                    radiance += layers.added[row, column]
            return wp.vec4(radiance[0], radiance[1], radiance[2], 1.0)
        if other.shape >= 0:
            radiance = shade_unoccluded(scene, distant, other, direction, spread)
            return wp.vec4(radiance[0], radiance[1], radiance[2], 1.0)
        return wp.vec4(0.0)

    return look_near


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


@functools.cache
def make_see_point(config: NearFieldConfig) -> wp.Function:
    """``see_point(params, picture, scene, dfg, hit, i, j) -> SeenPoint``: what pixel (i, j) shows of an object."""
    surface_at = make_surface(config.distant.models, config.distant.textures)
    side = config.side

    @wp.func(module="unique")
    def see_point(
        params: wp.array[FrameParams],
        picture: Picture,
        scene: RayScene,
        dfg: wp.array2d[wp.vec2],
        hit: Hit,
        i: wp.int32,
        j: wp.int32,
    ) -> SeenPoint:
        at = SeenPoint()
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
    return out


@functools.cache
def make_mirror_ray(config: NearFieldConfig) -> wp.Function:
    """``mirror_ray(params, scene, shape, ray, k) -> NearRay``: from what a pixel's sample ``k`` shows of a mirror."""
    closest_visible = make_primary(config.distant.trace)
    sample_direction = make_sample_direction(config.mirror_samples)

    @wp.func(module="unique")
    def mirror_ray(
        params: wp.array[FrameParams], scene: RayScene, shape: wp.int32, ray: wp.vec2, k: wp.int32
    ) -> NearRay:
        out = NearRay()
        direction = wp.normalize(sample_direction(params, ray, k))
        seen = closest_visible(scene, params[0].camera_position, direction)
        if seen.shape == shape:
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
                        ray = mirror_ray(params, scene, at.hit.shape, at.pixel, k)
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
    ray_width = RAY_WIDTH / (math.sqrt(max(config.lobe_count, 1)) * config.side)

    @wp.func(module="unique")
    def look_beyond(distant: DistantLight, ray: NearRay) -> wp.vec3:
        level = level_from_alpha(wp.static(ray_width) * ray.spread, distant.level_height)
        return radiance_along(distant, ray.point, ray.direction, level)

    return look_beyond


@functools.cache
def make_near_field_kernel(config: NearFieldConfig) -> wp.Kernel:
    """Kernel specialised to ``config``; equal configs share one kernel.

    Rays of all kinds go through one loop, so that the walk through the scene is there once: a copy for each kind, and
    for each turn of an unrolled loop, takes NVRTC nine times as long.
    """
    see_point, pick_ray, look_near = make_see_point(config), make_pick_ray(config), make_look_near(config)
    look_beyond = make_look_beyond(config) if config.lobe_count > 0 else None
    reflected_radiance = make_reflected_radiance(config.distant) if config.mirror_samples > 0 else None
    distant_irradiance = make_distant_irradiance(config.distant)
    lobes = config.lobe_count

    @slow_to_compile
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
        at = see_point(params, picture, scene, distant.dfg, visible.hits[i, j], i, j)
        surface = at.surface
        alpha = at.alpha
        diffuse = wp.int32(0)
        glossy = wp.int32(0)
        if wp.static(config.distant.diffuse != "none"):
            if surface.diffuse[0] + surface.diffuse[1] + surface.diffuse[2] > 0.0:
                diffuse = wp.static(config.count)
        if wp.static(config.distant.specular):
            if surface.reflectance[0] + surface.reflectance[1] + surface.reflectance[2] > 0.0:
                glossy = wp.where(alpha < SHARP, wp.static(config.mirror_samples), wp.static(lobes))
        total = wp.vec3(0.0)
        reflected = wp.vec4(0.0)
        transmitted = wp.vec4(0.0)
        leaving = float(0.0)  # rays; those into the surface are part of its reflectance
        for n in range(diffuse + glossy):
            ray = pick_ray(params, scene, samples, distant.others.places, at, n, diffuse)
            near = wp.vec4(0.0)
            if ray.leaves:
                near = look_near(
                    params[0], picture, layers, scene, distant, ray.origin, ray.direction, ray.reach, ray.spread
                )
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
                                0.0,
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
            if glossy > 0 and leaving == 0.0 and alpha >= SHARP:
                near_out.reflected[i, j] = wp.vec4(0.0, 0.0, 0.0, NO_RAY)

    return near_field_kernel


@functools.cache
def make_filter_kernel(config: NearFieldConfig) -> wp.Kernel:
    """Kernel of ``filter_near_field``."""
    side = config.side

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
        i += row_start
        rect = params[0].object_rect
        if not inside_rect(i, j, rect):
            return
        objects = visible.objects
        hits = visible.hits
        found = objects[i, j]
        if found < 0:
            return
        normal = hits[i, j].normal
        material = scene.materials[scene.objects[found].material]
        roughness = material.roughness
        if wp.static(config.distant.textures):
            material = scene.materials[material_at(scene, hits[i, j])]
            direction = wp.normalize(hits[i, j].point - params[0].camera_position)
            cos_o = wp.max(wp.abs(wp.dot(normal, direction)), 1.0e-3)
            point = surface_point(scene, hits[i, j], cos_o, scene.pixel_spread)
            roughness = roughness_at(scene, material, point)
        sharp = lobe_alpha(material.model, roughness, material.shininess) < SHARP
        light = wp.vec3(0.0)
        glossy = wp.vec4(0.0)
        weights = float(0.0)
        lobes = float(0.0)  # weights of pixels of which a ray left the surface
        distant = wp.vec4(0.0)
        reach = wp.static(side // 2)
        for a in range(-reach, reach + 1):
            for b in range(-reach, reach + 1):
                if inside_rect(i + a, j + b, rect):
                    if objects[i + a, j + b] == found and wp.dot(hits[i + a, j + b].normal, normal) > SAME_NORMAL:
                        weight = wp.where(a == reach or a == -reach, 0.5, 1.0)
                        weight *= wp.where(b == reach or b == -reach, 0.5, 1.0)
                        weights += weight
                        if wp.static(config.distant.diffuse != "none"):
                            light += weight * estimate.irradiance[i + a, j + b]
                        if wp.static(config.distant.specular):
                            if estimate.reflected[i + a, j + b][3] != NO_RAY:
                                lobes += weight
                                glossy += weight * estimate.reflected[i + a, j + b]
                                distant += weight * estimate.transmitted[i + a, j + b]
        if wp.static(config.distant.diffuse != "none"):
            near_out.irradiance[i, j] = wp.max(light / weights, wp.vec3(0.0))
        if wp.static(config.distant.specular):
            if sharp:
                near_out.reflected[i, j] = estimate.reflected[i, j]
                return
            near = glossy / wp.max(lobes, MIN_LIGHT)
            distant = distant / wp.max(lobes, MIN_LIGHT)
            missed = brightness(wp.vec3(distant[0], distant[1], distant[2]))
            # What passes is no more than all; rounding may say otherwise.
            left = wp.where(distant[3] > MIN_LIGHT, wp.min(missed / distant[3], 1.0), 1.0)
            left *= 1.0 - near[3]
            for channel in range(3):
                near[channel] += near[3] * distant[channel]
            near[3] = 1.0 - left
            near_out.reflected[i, j] = near

    return filter_near_field_kernel


def estimate_near_field(
    config: NearFieldConfig,
    params: wp.array[FrameParams],
    picture: Picture,
    layers: ReceiverLayers,
    scene: RayScene,
    distant: DistantLight,
    samples: wp.array[EnvironmentSample] | None,
    visible: VisibleObjects,
    near_out: NearLight,
    *,
    rows: Rows | None = None,
) -> None:
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
        rows: Band of rows; None means all.
    """
    launch_rows(
        make_near_field_kernel(config),
        picture.rays.shape,
        [params, picture, layers, scene, distant, samples, visible],
        [near_out],
        rows=rows,
        device=picture.rays.device,
    )


def filter_near_field(
    config: NearFieldConfig,
    params: wp.array[FrameParams],
    scene: RayScene,
    visible: VisibleObjects,
    estimate: NearLight,
    near_out: NearLight,
    *,
    rows: Rows | None = None,
) -> None:
    """Average the estimates over tiles, along objects only; arguments as those of ``estimate_near_field``.

    Of ``near_out``, irradiance and reflected are written; the last of reflected becomes the share of the prefiltered
    environment that ``shade`` leaves out.
    """
    launch_rows(
        make_filter_kernel(config),
        visible.objects.shape,
        [params, scene, visible, estimate],
        [near_out],
        rows=rows,
        device=visible.objects.device,
    )
