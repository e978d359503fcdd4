"""What surrounds a virtual object at close range: the receiver that it stands on, other objects, itself.

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
"""

from __future__ import annotations

import functools
import math

import warp as wp

from warp_ar.kernels.color import brightness
from warp_ar.kernels.cooperative import sum_beside
from warp_ar.kernels.environment.environment_samples import EnvironmentSample
from warp_ar.kernels.launch import MOST_REGISTERS, Rows, launch_rows
from warp_ar.kernels.materials import material_at, roughness_at, surface_point
from warp_ar.kernels.objects.near_field_rays import (
    SHARP,
    NearFieldConfig,
    ReceiverLayers,
    SeenPoint,
    lobe_alpha,
    make_footprint_of,
    make_look_beyond,
    make_look_near,
    make_pick_ray,
    make_see_point,
    mirrored_level,
)
from warp_ar.kernels.objects.reflect import DistantLight, make_distant_irradiance, make_reflected_radiance
from warp_ar.kernels.pixel_order import own_pixel
from warp_ar.kernels.rays.visibility import VisibleObjects, inside_rect
from warp_ar.kernels.structs import FrameParams, Hit, Picture, RayScene

wp.set_module_options({"enable_backward": False})

MIN_LIGHT = wp.constant(wp.float32(1.0e-6))
"""Brightness, in camera values, below which a lobe's share is 0 over 0."""
LANES = 4
"""Lanes of a CUDA device that share a pixel's rays, where no kind has fewer."""
NO_RAY = wp.constant(wp.float32(-1.0))
"""Share of a pixel whose rays all ran into its surface: it knows nothing of its lobe."""
SAME_NORMAL = wp.constant(wp.float32(math.cos(math.radians(20.0))))
"""Cosine of the angle up to which neighbours' normals are those of one surface."""


OWN_RAYS = 4
"""Rays into a lobe from which on neighbours count by how much their normals differ."""


@wp.struct
class NearLight:
    """What reaches the pixels of objects from near by; empty where no material asks for it."""

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
        share: wp.int32,
        # Out:
        near_out: NearLight,
    ):
        """A pixel; or, of every ``share`` of its rays, the one that is the lane's."""
        i, j, part = wp.tid()
        objects = visible.objects
        pixel = own_pixel(i, j, row_start, params[0].object_rect, objects.shape[0], objects.shape[1])
        i = pixel[0]
        j = pixel[1]
        if i < 0:
            return
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
        for n in range(part, diffuse + rays[1], share):
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
        if share > 1:
            if wp.static(config.distant.diffuse != "none"):
                total = sum_beside(total, share)
            if wp.static(config.distant.specular):
                met = sum_beside(wp.vec3(reflected[0], reflected[1], reflected[2]), share)
                missed_by = sum_beside(wp.vec3(transmitted[0], transmitted[1], transmitted[2]), share)
                counts = sum_beside(wp.vec3(reflected[3], transmitted[3], leaving), share)
                reflected = wp.vec4(met[0], met[1], met[2], counts[0])
                transmitted = wp.vec4(missed_by[0], missed_by[1], missed_by[2], counts[1])
                leaving = counts[2]
            if part > 0:
                return
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
    """What ``shade`` adds, and the share of the prefiltered environment that it leaves out, as derived above.

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
        pixel = own_pixel(i, j, row_start, rect, objects.shape[0], objects.shape[1])
        i = pixel[0]
        j = pixel[1]
        if i < 0:
            return
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
    least = min(count for count in (config.count, config.lobe_count, config.mirror_samples) if count > 0)
    share = LANES if least >= LANES and not picture.rays.device.is_cpu else 1
    launch_rows(
        make_near_field_kernel(config),
        (*picture.rays.shape, share),
        [params, picture, layers, scene, distant, samples, visible, share],
        [near_out],
        rows=rows,
        device=picture.rays.device,
        rectangle_first=True,
        alone=True,
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
        rectangle_first=True,
        alone=True,
    )
