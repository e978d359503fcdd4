"""Reflections of virtual objects and highlights of virtual lights in glossy receivers, such as a polished table.

The camera's frame shows the reflection of the real surroundings. Virtual objects would be reflected too, and would hide
the reflection of the surfaces behind them. With f the receiver's specular BRDF (GGX of the proxy's roughness, Smith's
masking, Schlick's Fresnel over the reflectance F0), the change of radiance is

    change(x, wo) = integral over wi of  f(wo, wi) cos_i (L_with - L_without)(x, wi)
                    + sum over virtual lights of  f(wo, wi) cos_i E visible.

Half vectors are drawn from the distribution of visible normals [DB23], so a ray has the weight F G2 / G1, at most 1.
Rays of a mirror start at different places in the pixel. The first surface that a ray meets decides:

- a virtual object: L_with is its radiance. L_without is the radiance of the proxy behind the object, as the frame
  shows it, or else the environment, filtered to the width that one ray stands for. (Unfiltered, a narrow lamp would be
  found by few of the rays, and flicker between pixels.)
- a proxy: L changes by the shadows and the virtual light of the frame's layers at that point;
- a mirror ball, or nothing: no change.

``shadow_ratio`` scales the whole radiance of the frame, although shadows of objects on the receiver reduce its diffuse
part alone. So the specular part, S = integral of f cos_i L_without, is restored:

    change += (1 - shadow_ratio) min(S, frame).

No rays are traced where nothing can change: the ratio is 1, no object's bounding sphere lies within ``LOBE_REACH`` of
the mirror direction, and no other proxy lies in that direction. Where no object is near, one ray is traced. The change
may be negative.

References:
    [DB23] Dupuy, Benyoub 2023, Sampling Visible GGX Normals with Spherical Caps.
"""

from __future__ import annotations

import dataclasses
import functools

import warp as wp

from warp_ar.kernels.emitters import correct_parallax
from warp_ar.kernels.environment.lobes import level_from_alpha, sample_levels
from warp_ar.kernels.launch import MOST_REGISTERS, row_launcher
from warp_ar.kernels.materials import MIN_ALPHA, ggx_lobe, reflect, schlick
from warp_ar.kernels.objects.reflect import DistantLight, look_up, look_up_layer, make_find_in_frame
from warp_ar.kernels.objects.shade import NearPoint, ShadeConfig, make_shade_hit
from warp_ar.kernels.pixels import shown_radiance
from warp_ar.kernels.rays.shadow import make_sample_light, make_visible_share, tile_turn
from warp_ar.kernels.rays.shapes import FAR
from warp_ar.kernels.rays.trace import TraceConfig, make_trace, meets_probe, offset_origin
from warp_ar.kernels.rays.visibility import inside_rect, make_sample_direction
from warp_ar.kernels.sampling import (
    frame_from_normal,
    ggx_masking,
    ggx_masking_shadowing,
    hammersley,
    pcg3d_hash,
    sample_ggx_visible,
    uniform_from_bits,
)
from warp_ar.kernels.structs import FrameParams, Hit, Light, Picture, Probe, RayScene

wp.set_module_options({"enable_backward": False})

LOBE_REACH = wp.constant(wp.float32(14.0))
"""Largest tangent of a half vector's angle, over alpha, that is considered: 0.5 % of GGX's energy lies beyond."""
MIRROR_ALPHA = wp.constant(wp.float32(1.0e-3))
"""Lobe width alpha below which a receiver is a mirror: it reflects each camera ray in one direction."""
EDGE_SAMPLES = 4
"""Rays per pixel of a mirror, to anti-alias edges of its image."""
MOST_RADIANCE = wp.constant(wp.float32(8.0))
"""Largest radiance of one ray of a rough receiver; it suppresses speckles of mirrored highlights."""
LEAST = wp.constant(wp.float32(2.0e-4))
"""Radiance below which a highlight is not computed: the least step between 8-bit values is 3e-4."""
LEAST_SHADOW = wp.constant(wp.float32(0.01))
"""Least change of the frame by a shadow, as a share, at which the specular part of its radiance is restored."""
SMOOTHED = wp.constant(2)
"""Half width, pixels, of the window over which the change of a rough receiver is averaged."""


@wp.struct
class Gloss:
    """Specular material of a proxy's surface."""

    reflectance: wp.vec3  # F0, specular reflectance at normal incidence; 0: the proxy is matt
    roughness: wp.float32  # perceptual; alpha is its square


@wp.struct
class GlossLayers:
    """Layers of the frame that a glossy receiver reflects, (H, W) each; a layer that the scene lacks is empty."""

    shadow_ratio: wp.array2d[wp.vec3]
    added: wp.array2d[wp.vec3]


@dataclasses.dataclass(frozen=True)
class GlossConfig:
    """Compile-time configuration of the kernel."""

    trace: TraceConfig
    """Kinds of shape in the scene."""
    samples: int
    """Rays per pixel into the lobe of a rough receiver."""
    lights: tuple[int, ...] = ()
    """Sorted kinds of virtual light."""
    shade: ShadeConfig | None = None
    """Shading of virtual objects; None: there are none."""
    emitters: bool = False
    """True if positions of the environment's emitters are known."""
    faces: bool = False
    """True if one proxy may reflect another one whose radiance changes."""


@wp.func
def may_mirror(scene: RayScene, point: wp.vec3, direction: wp.vec3, reach: wp.float32) -> wp.bool:
    """Return whether an object's bounding sphere may lie within the angle ``reach``, radians, of a ray."""
    for index in range(scene.objects.shape[0]):
        shape = scene.objects[index]
        # A torus gives its two radii: their sum is no more than this.
        radius = 1.5 * shape.scale * wp.length(shape.extent)
        to = shape.position - point
        distance = wp.length(to)
        if distance <= radius:
            return True
        angle = wp.atan2(wp.length(wp.cross(direction, to)), wp.dot(direction, to))
        if angle - wp.asin(radius / distance) <= reach:
            return True
    return False


@wp.struct
class Sight:
    """The scene, its environment, the camera's frame, and the frame's layers."""

    scene: RayScene
    distant: DistantLight
    picture: Picture
    probes: wp.array[Probe]
    layers: GlossLayers


@wp.struct
class Reflected:
    """Radiance along one reflected ray, times the ray's weight."""

    change: wp.vec3  # L_with - L_without
    before: wp.vec3  # L_without, where it was needed


@functools.cache
def make_follow(config: GlossConfig) -> wp.Function:
    """Return the function ``follow(params, sight, lights, hit, wi, weight, width, asked, turn) -> Reflected``.

    The ray leaves ``hit`` along ``wi`` and represents a lobe of width alpha ``width``. ``Reflected.before`` is always
    found if ``asked``, else only if an object is met.
    """
    trace = make_trace(config.trace)
    closest_object, closest_proxy = trace.closest_object, trace.closest_proxy
    shade_hit = make_shade_hit(config.shade) if config.shade is not None else None
    find_in_frame = make_find_in_frame(config.trace)

    @wp.func(module="unique")
    def follow(
        params: FrameParams,
        sight: Sight,
        lights: wp.array[Light],
        hit: Hit,
        wi: wp.vec3,
        weight: wp.vec3,
        width: wp.float32,
        asked: wp.bool,
        turn: wp.float32,
    ) -> Reflected:
        result = Reflected()
        scene = sight.scene
        distant = sight.distant
        layers = sight.layers
        start = offset_origin(hit.point, hit.geometric_normal, wi, hit.error)
        behind = closest_proxy(scene, start, wi, FAR)
        is_object = bool(False)
        if wp.static(config.shade is not None):
            item = closest_object(scene, start, wi, behind.t)
            is_object = item.shape >= 0
            if is_object and meets_probe(sight.probes, start, wi, item.t):
                is_object = False
        at = wp.vec2(-1.0, -1.0)
        if behind.shape >= 0 and (is_object or asked or wp.static(config.faces)):
            at = find_in_frame(params, sight.picture, scene, sight.probes, behind)
        if not is_object and not asked and at[0] < 0.0:
            return result
        if at[0] >= 0.0:
            result.before = look_up(sight.picture, at[0], at[1])
        else:
            toward = wi
            if wp.static(config.emitters):
                toward = correct_parallax(distant.emitters, start, wi)
            level = level_from_alpha(width, distant.level_height)
            result.before = sample_levels(distant.levels, toward, level, distant.level_height)
        if wp.static(config.shade is not None):
            if is_object:
                spread = scene.pixel_spread * (hit.t + item.t) / wp.max(item.t, 1.0e-6) + width
                radiance = shade_hit(scene, lights, distant, item, wi, NearPoint(), turn, spread)
                if width > 0.0:
                    most = wp.vec3(MOST_RADIANCE, MOST_RADIANCE, MOST_RADIANCE)
                    radiance = wp.min(radiance, most)
                    result.before = wp.min(result.before, most)
                result.change = radiance - result.before
        if at[0] >= 0.0 and not is_object and not meets_probe(sight.probes, start, wi, behind.t):
            if layers.shadow_ratio.shape[0] > 0:
                there = look_up_layer(layers.shadow_ratio, at[0], at[1]) - wp.vec3(1.0, 1.0, 1.0)
                result.change += wp.cw_mul(result.before, there)
            if layers.added.shape[0] > 0:
                result.change += look_up_layer(layers.added, at[0], at[1])
        result.change = wp.cw_mul(weight, result.change)
        result.before = wp.cw_mul(weight, result.before)
        return result

    return follow


# A sphere of angular radius e is reflected by half vectors whose slopes (tangents from the normal) lie in an ellipse
# around the slope of its centre, of radii e / 2 and e / (2 cos_d), cos_d between half vector and ray. The ellipse is
# replaced by the circle of the same area, s^2 = e^2 / (4 cos_d). GGX's density of slopes,
# alpha^2 / (pi (alpha^2 + m^2)^2), is that of points spread evenly over a sphere and projected stereographically onto
# the plane, m = alpha tan(theta / 2). The projection maps circles to circles, so the circle of radius s at slope m has
# the share of a spherical cap between 2 atan((m - s) / alpha) and 2 atan((m + s) / alpha). Its mean density is that
# share over the circle's area,
#
#     2 alpha^2 / (pi H (H + X)),   X = P - s^2,   H = sqrt(X^2 + 4 s^2 alpha^2),   P = alpha^2 + m^2,
#
# and over the density at m it is 2 P^2 / (H (H + X)). Where X < 0 the sum H + X cancels; there 1 / (H + X) is
# computed as (H - X) / (4 s^2 alpha^2).
@wp.func
def sphere_over_point(
    normal: wp.vec3, half: wp.vec3, cos_d: wp.float32, roughness: wp.float32, reach: wp.float32
) -> wp.float32:
    """Return the ratio of a spherical light's highlight to that of a point light of equal irradiance at its centre.

    ``half`` is the half vector, ``cos_d`` its cosine with the ray, ``reach`` the sphere's radius over its distance.
    """
    alpha = wp.max(roughness * roughness, MIN_ALPHA)
    cross = wp.cross(normal, half)
    cos_h = wp.max(wp.dot(normal, half), 1.0e-3)
    point = alpha * alpha + wp.dot(cross, cross) / (cos_h * cos_h)
    square = 0.25 * reach * reach / wp.max(cos_d, 1.0e-3)
    x = point - square
    cap = 4.0 * square * alpha * alpha
    h = wp.sqrt(x * x + cap)
    if x < 0.0:
        return 2.0 * point * (point / h) * ((h - x) / cap)
    return 2.0 * (point / h) * (point / (h + x))


@functools.cache
def make_highlights(config: GlossConfig) -> wp.Function:
    """Return the function ``highlights(sight, lights, surface, hit, wo, turn) -> vec3``: virtual lights' highlights."""
    sample_light = make_sample_light(config.lights)
    visible_share = make_visible_share(config.trace)

    @wp.func(module="unique")
    def highlights(
        sight: Sight, lights: wp.array[Light], surface: Gloss, hit: Hit, wo: wp.vec3, turn: wp.float32
    ) -> wp.vec3:
        result = wp.vec3(0.0, 0.0, 0.0)
        cos_o = wp.dot(hit.normal, wo)
        for index in range(lights.shape[0]):
            light = sample_light(lights[index], hit.point)
            cos_i = wp.dot(hit.normal, light.wi)
            if cos_i > 0.0 and wp.dot(hit.geometric_normal, light.wi) > 0.0:
                half = wp.normalize(wo + light.wi)
                f = surface.reflectance + schlick(wp.dot(wo, half)) * (wp.vec3(1.0) - surface.reflectance)
                lobe = cos_i * ggx_lobe(hit.normal, half, cos_i, cos_o, surface.roughness)
                if lights[index].radius > 0.0:
                    reach = lights[index].radius / wp.max(light.distance, 1.0e-6)
                    lobe *= sphere_over_point(hit.normal, half, wp.dot(wo, half), surface.roughness, reach)
                sent = lobe * wp.cw_mul(f, light.irradiance_normal)
                if wp.max(sent) > LEAST and not meets_probe(sight.probes, hit.point, light.wi, light.distance):
                    result += sent * visible_share(
                        sight.scene, hit.point, hit.geometric_normal, hit.error, lights[index], light, turn
                    )
        return result

    return highlights


@wp.struct
class GlossPoint:
    """A point of a glossy receiver."""

    hit: Hit  # its shape is -1 if the pixel shows no glossy receiver
    wo: wp.vec3
    surface: Gloss
    alpha: wp.float32


@functools.cache
def make_see_receiver(config: GlossConfig) -> wp.Function:
    """Return ``see_receiver(params, sight, gloss, i, j) -> GlossPoint``: surface in pixel (i, j), if it is glossy."""
    closest_proxy = make_trace(config.trace).closest_proxy

    @wp.func(module="unique")
    def see_receiver(
        params: wp.array[FrameParams], sight: Sight, gloss: wp.array[Gloss], i: wp.int32, j: wp.int32
    ) -> GlossPoint:
        at = GlossPoint()
        at.hit.shape = -1
        origin = params[0].camera_position
        ray = sight.picture.rays[i, j]
        seen = params[0].world_from_camera * wp.vec3(ray[0], ray[1], 1.0)
        hit = closest_proxy(sight.scene, origin, seen, FAR)
        if hit.shape < 0:
            return at
        at.surface = gloss[hit.shape]
        at.alpha = at.surface.roughness * at.surface.roughness
        at.wo = -wp.normalize(seen)
        if wp.max(at.surface.reflectance) <= 0.0 or wp.dot(hit.geometric_normal, at.wo) <= 0.0:
            return at  # not glossy, or seen from behind
        if wp.dot(hit.normal, at.wo) <= 0.0 or meets_probe(sight.probes, origin, seen, hit.t):
            return at
        at.hit = hit
        return at

    return see_receiver


@wp.struct
class GlossRay:
    """One of the rays that sample the reflection of a receiver's point."""

    hit: Hit  # point that the ray leaves
    wi: wp.vec3
    masking: wp.float32  # G2 / G1, share of light that other facets do not block; 0: no valid ray
    cos_d: wp.float32  # cosine between the facet's normal and the ray
    width: wp.float32  # lobe width alpha that the ray stands for


@wp.func
def draw_facet(ray: GlossRay, u: wp.vec2, wo: wp.vec3, alpha: wp.float32) -> GlossRay:
    """Return the ray reflected at a visible microfacet, which is drawn by ``u``, a point of the unit square."""
    out = ray
    basis = frame_from_normal(ray.hit.normal)
    local = wp.transpose(basis) * wo
    facet = sample_ggx_visible(u, local, alpha)
    away = reflect(local, facet)
    if away[2] > 0.0:
        out.masking = ggx_masking_shadowing(away, local, alpha) / ggx_masking(local, alpha)
        out.cos_d = wp.max(wp.dot(local, facet), 0.0)
        out.wi = wp.normalize(basis * away)
    return out


@functools.cache
def make_draw_ray(config: GlossConfig) -> wp.Function:
    """Return ``draw_ray(params, sight, at, pixel, is_near, shift, sample, count) -> GlossRay``: one of ``count`` rays.

    If no object is near, the ray goes in the mirror direction. Otherwise a rough receiver draws a facet, by a point of
    a Hammersley set moved by ``shift``, and a mirror traces a sample of its own within the pixel.
    """
    closest_proxy = make_trace(config.trace).closest_proxy
    sample_direction = make_sample_direction(EDGE_SAMPLES)

    @wp.func(module="unique")
    def draw_ray(
        params: wp.array[FrameParams],
        sight: Sight,
        at: GlossPoint,
        pixel: wp.vec2i,
        is_near: wp.bool,
        shift: wp.vec2,
        sample: wp.int32,
        count: wp.int32,
    ) -> GlossRay:
        out = GlossRay()
        out.hit = at.hit
        if not is_near:
            out.wi = reflect(at.wo, at.hit.normal)
            out.masking = 1.0
            out.cos_d = wp.dot(at.hit.normal, at.wo)
            out.width = at.alpha
        elif at.alpha > MIRROR_ALPHA:
            u = hammersley(sample, count) + shift
            out = draw_facet(out, wp.vec2(u[0] - wp.floor(u[0]), u[1] - wp.floor(u[1])), at.wo, at.alpha)
            out.width = at.alpha / wp.sqrt(wp.float32(count))
        else:
            origin = params[0].camera_position
            direction = wp.normalize(sample_direction(params, sight.picture.rays[pixel[0], pixel[1]], sample))
            out.hit = closest_proxy(sight.scene, origin, direction, FAR)
            if out.hit.shape != at.hit.shape or meets_probe(sight.probes, origin, direction, out.hit.t):
                return out
            out.wi = reflect(-direction, out.hit.normal)
            out.masking = 1.0
            out.cos_d = -wp.dot(out.hit.normal, direction)
        if wp.dot(out.wi, out.hit.geometric_normal) <= 0.0:
            out.masking = 0.0
        return out

    return draw_ray


@functools.cache
def make_gloss_kernel(config: GlossConfig) -> wp.Kernel:
    """Return the kernel specialised to ``config``; equal configs share one kernel."""
    closest_proxy = make_trace(config.trace).closest_proxy
    see_receiver, draw_ray, follow = make_see_receiver(config), make_draw_ray(config), make_follow(config)
    highlights = make_highlights(config) if config.lights else None

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def gloss_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        sight: Sight,
        lights: wp.array[Light],
        gloss: wp.array[Gloss],
        # Out:
        change_out: wp.array2d[wp.vec3],
        surface_out: wp.array2d[wp.int32],
    ):
        i, j = wp.tid()
        i += row_start
        change_out[i, j] = wp.vec3(0.0, 0.0, 0.0)
        surface_out[i, j] = -1
        if not inside_rect(i, j, params[0].ball_rect):
            return
        at = see_receiver(params, sight, gloss, i, j)
        hit = at.hit
        if hit.shape < 0:
            return
        turn = tile_turn(i, j)
        change = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(len(config.lights) > 0):
            change = highlights(sight, lights, at.surface, hit, at.wo, turn)
        ratio = wp.vec3(1.0, 1.0, 1.0)
        if sight.layers.shadow_ratio.shape[0] > 0 and inside_rect(i, j, params[0].shadow_rect):
            ratio = sight.layers.shadow_ratio[i, j]
        is_shadowed = wp.max(wp.abs(ratio - wp.vec3(1.0, 1.0, 1.0))) > LEAST_SHADOW
        mirror = reflect(at.wo, hit.normal)
        is_near = may_mirror(sight.scene, hit.point, mirror, 2.0 * wp.atan(LOBE_REACH * at.alpha))
        wanted = is_shadowed or is_near
        if wp.static(config.faces):
            if not wanted:
                start = offset_origin(hit.point, hit.geometric_normal, mirror, hit.error)
                wanted = closest_proxy(sight.scene, start, mirror, FAR).shape >= 0
        if wanted:
            added = wp.vec3(0.0, 0.0, 0.0)
            before = wp.vec3(0.0, 0.0, 0.0)
            count = wp.where(at.alpha > MIRROR_ALPHA, wp.static(config.samples), wp.static(EDGE_SAMPLES))
            if not is_near:
                count = 1  # in the mirror direction: the environment is prefiltered over the whole lobe
            hashes = pcg3d_hash(wp.uint32(i), wp.uint32(j), wp.uint32(0))
            shift = wp.vec2(uniform_from_bits(hashes[0]), uniform_from_bits(hashes[1]))
            for sample in range(count):
                ray = draw_ray(params, sight, at, wp.vec2i(i, j), is_near, shift, sample, count)
                if ray.masking > 0.0:
                    f = at.surface.reflectance + schlick(ray.cos_d) * (wp.vec3(1.0) - at.surface.reflectance)
                    one = follow(
                        params[0], sight, lights, ray.hit, ray.wi, ray.masking * f, ray.width, is_shadowed, turn
                    )
                    added += one.change
                    before += one.before
            share = 1.0 / wp.float32(count)
            shown = shown_radiance(sight.picture, i, j)
            given_back = wp.cw_mul(wp.vec3(1.0, 1.0, 1.0) - ratio, wp.min(share * before, shown))
            change += share * added + wp.where(is_shadowed, 1.0, 0.0) * given_back
        change_out[i, j] = change
        if at.alpha > MIRROR_ALPHA:
            surface_out[i, j] = hit.shape

    return gloss_kernel


@wp.kernel(enable_backward=False)
def smooth_gloss_kernel(
    # In:
    row_start: wp.int32,
    change: wp.array2d[wp.vec3],
    surface: wp.array2d[wp.int32],
    mirror_ball: wp.array2d[wp.vec3],
    # Out:
    reflected_out: wp.array2d[wp.vec3],
):
    """Average one pixel's change over neighbours on the same rough surface, which traced other rays.

    Mirrors are not averaged.
    """
    i, j = wp.tid()
    i += row_start
    result = change[i, j]
    key = surface[i, j]
    if key >= 0:
        total = wp.vec3(0.0, 0.0, 0.0)
        weights = float(0.0)
        for k in range(wp.max(i - SMOOTHED, 0), wp.min(i + SMOOTHED + 1, change.shape[0])):
            for m in range(wp.max(j - SMOOTHED, 0), wp.min(j + SMOOTHED + 1, change.shape[1])):
                if surface[k, m] == key:
                    total += change[k, m]
                    weights += 1.0
        result = total / weights
    if mirror_ball.shape[0] > 0:
        result += mirror_ball[i, j]
    reflected_out[i, j] = result


gloss = row_launcher(make_gloss_kernel, outputs=2)
"""Write the change of radiance of glossy receivers by virtual objects and lights, pixel by pixel.

Args:
    config: Features of the scene; arguments that it does not use may be None.
    params: (1,) FrameParams: camera, shadow_rect and ball_rect, beyond which nothing changes.
    sight: The scene, its light and its picture.
    lights: (n,) Light.
    surfaces: (n,) Gloss, one for each proxy.
    change_out: (H, W) vec3, change of linear radiance in camera values.
    surface_out: (H, W) int32, index of the rough proxy that a pixel shows, or -1.
"""


smooth_gloss = row_launcher(smooth_gloss_kernel)
"""Write the change of radiance of receivers and mirror balls, averaged over neighbours on rough receivers.

Args:
    change: (H, W) vec3 from ``gloss``.
    surface: (H, W) int32 from ``gloss``.
    mirror_ball: (H, W) vec3 from ``mirror_ball``, which is added; None if there is none.
    reflected_out: (H, W) vec3.
"""
