"""Reflections of virtual objects, of virtual light and of shadows in mirror balls.

The camera's image of a ball shows the real environment alone. A pixel's ray is reflected at the ball, which has the
reflectance rho, and followed to the first surface that it meets:

- a virtual object: the pixel becomes rho times the object's radiance;
- a proxy: the frame's radiance is multiplied by the environment shadow of virtual objects, looked up where the frame
  shows the same point, and rho times the virtual light that the proxy reflects is added. The proxy's reflectance is
  found from the ball's own pixel, which shows rho times the proxy's radiance;
- another ball, or nothing: no change. Light is reflected at one ball only.

The result is a change of radiance, to be added to the frame's; it may be negative.
"""

from __future__ import annotations

import dataclasses
import functools

import warp as wp

from warp_ar.kernels.launch import MOST_REGISTERS, row_launcher
from warp_ar.kernels.materials import reflect
from warp_ar.kernels.objects.reflect import DistantLight, look_up_layer, make_find_in_frame
from warp_ar.kernels.objects.shade import NearPoint, ShadeConfig, make_shade_hit
from warp_ar.kernels.pixels import shown_radiance
from warp_ar.kernels.rays.shadow import tile_turn
from warp_ar.kernels.rays.shapes import FAR, ROUNDING, intersect_sphere
from warp_ar.kernels.rays.trace import TraceConfig, make_trace, offset_origin
from warp_ar.kernels.rays.visibility import inside_rect, look_within_pixel
from warp_ar.kernels.receiver.receiver import Receiver, RelightConfig
from warp_ar.kernels.receiver.relight import make_direct_lighting
from warp_ar.kernels.structs import FrameParams, Light, Probe, RayScene

wp.set_module_options({"enable_backward": False})

MIN_REFLECTANCE = wp.constant(wp.float32(0.05))
"""Lower bound of a mirror ball's reflectance: a pixel's radiance is divided by it."""


@dataclasses.dataclass(frozen=True)
class MirrorBallConfig:
    """Compile-time configuration of the kernel."""

    trace: TraceConfig
    """Kinds of shape in the scene."""
    shade: ShadeConfig | None = None
    """Shading of virtual objects; None: there are none."""
    relight: RelightConfig | None = None
    """Response of the receiver to virtual light; None: there is no virtual light, or no proxy for it."""
    ratio: bool = False
    """True if virtual objects cast environment shadows on the receiver."""


@wp.func
def nearest_ball(probes: wp.array[Probe], origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.int32:
    """Return the index of the first ball that a ray meets before ``t_max``, or -1."""
    nearest = wp.int32(-1)
    reach = t_max
    for index in range(probes.shape[0]):
        t = intersect_sphere(probes[index].radius, origin - probes[index].center, direction, reach)
        if t < reach:
            reach = t
            nearest = index
    return nearest


@wp.struct
class BallRay:
    """A ray from the camera that a mirror ball reflects."""

    ball: wp.int32  # index of the ball; -1 for none
    origin: wp.vec3  # of the reflected ray
    wi: wp.vec3
    width: wp.float32  # width of the pixel on the ball, metres


@functools.cache
def make_reflect_at_ball(config: MirrorBallConfig) -> wp.Function:
    """Return ``reflect_at_ball(scene, probes, origin, direction) -> BallRay``: camera ray, reflected at a ball."""
    occluded_by_proxies = make_trace(config.trace).occluded_by_proxies

    @wp.func(module="unique")
    def reflect_at_ball(scene: RayScene, probes: wp.array[Probe], origin: wp.vec3, direction: wp.vec3) -> BallRay:
        out = BallRay()
        out.ball = -1
        ball = nearest_ball(probes, origin, direction, FAR)
        if ball < 0:
            return out
        probe = probes[ball]
        t = intersect_sphere(probe.radius, origin - probe.center, direction, FAR)
        # Projected back onto the ball: removes the error of t, which grows with the camera's distance.
        normal = wp.normalize(origin - probe.center + t * direction)
        if wp.dot(normal, direction) >= 0.0:
            return out  # the camera is inside the ball, or the ray grazes it
        if occluded_by_proxies(scene, origin, direction, t):
            return out
        point = probe.center + probe.radius * normal
        error = ROUNDING * (8.0 * wp.max(wp.abs(point)) + 32.0 * probe.radius)
        out.wi = reflect(-wp.normalize(direction), normal)
        out.origin = offset_origin(point, normal, out.wi, error)
        out.width = scene.pixel_spread * t / wp.max(-wp.dot(normal, wp.normalize(direction)), 0.1)
        out.ball = ball
        return out

    return reflect_at_ball


@functools.cache
def make_mirrored_change(config: MirrorBallConfig) -> wp.Function:
    """Return ``mirrored_change(...) -> vec3``: change of a pixel's radiance, by one camera ray along ``direction``."""
    trace = make_trace(config.trace)
    closest_object, closest_proxy = trace.closest_object, trace.closest_proxy
    reflect_at_ball = make_reflect_at_ball(config)
    shade_hit = make_shade_hit(config.shade) if config.shade is not None else None
    direct_lighting = make_direct_lighting(config.relight) if config.relight is not None else None
    find_in_frame = make_find_in_frame(config.trace)

    @wp.func(module="unique")
    def mirrored_change(
        params: wp.array[FrameParams],
        scene: RayScene,
        lights: wp.array[Light],
        distant: DistantLight,
        receiver: Receiver,
        shadow_ratio: wp.array2d[wp.vec3],
        pixel: wp.vec2i,
        direction: wp.vec3,
        shown: wp.vec3,
    ) -> wp.vec3:
        i, j = pixel[0], pixel[1]
        change = wp.vec3(0.0, 0.0, 0.0)
        seen = reflect_at_ball(scene, receiver.probes, params[0].camera_position, direction)
        if seen.ball < 0:
            return change
        start = seen.origin
        wi = seen.wi
        probe = receiver.probes[seen.ball]
        surface = closest_proxy(scene, start, wi, FAR)
        reach = surface.t
        if wp.static(config.shade is not None):
            item = closest_object(scene, start, wi, reach)
            reach = item.t
        if nearest_ball(receiver.probes, start, wi, reach) >= 0:
            return change
        rho = wp.max(probe.reflectance, wp.vec3(MIN_REFLECTANCE, MIN_REFLECTANCE, MIN_REFLECTANCE))
        if wp.static(config.shade is not None):
            if item.shape >= 0:
                # Reflection turns two rays of a pixel apart by twice the angle between the ball's normals there.
                spread = seen.width / wp.max(item.t, 1.0e-6) + 2.0 * seen.width / probe.radius
                radiance = shade_hit(scene, lights, distant, item, wi, NearPoint(), tile_turn(i, j), spread)
                return wp.cw_mul(rho, radiance) - shown
        if surface.shape < 0 or wp.dot(surface.geometric_normal, wi) >= 0.0:
            return change
        if wp.static(config.ratio):
            if shadow_ratio.shape[0] > 0:
                at = find_in_frame(params[0], receiver.picture, scene, receiver.probes, surface)
                if at[0] >= 0.0:
                    ratio = look_up_layer(shadow_ratio, at[0], at[1])
                    change = wp.cw_mul(shown, ratio - wp.vec3(1.0, 1.0, 1.0))
        if wp.static(config.relight is not None):
            lit = direct_lighting(scene, lights, receiver, surface, i, j, rho, tile_turn(i, j))
            change += wp.cw_mul(rho, lit.added)
        return change

    return mirrored_change


@functools.cache
def make_mirror_ball_kernel(config: MirrorBallConfig) -> wp.Kernel:
    """Return the kernel specialised to ``config``; equal configs share one kernel."""
    mirrored_change = make_mirrored_change(config)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def mirror_ball_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        scene: RayScene,
        lights: wp.array[Light],
        distant: DistantLight,
        receiver: Receiver,
        shadow_ratio: wp.array2d[wp.vec3],
        side: wp.int32,
        # Out:
        mirrored_out: wp.array2d[wp.vec3],
    ):
        i, j = wp.tid()
        i += row_start
        pixel = wp.vec2i(i, j)
        if not inside_rect(i, j, params[0].ball_rect):
            mirrored_out[i, j] = wp.vec3(0.0, 0.0, 0.0)
            return
        ray = receiver.picture.rays[i, j]
        shown = shown_radiance(receiver.picture, i, j)
        change = wp.vec3(0.0, 0.0, 0.0)
        for sample in range(side * side):
            direction = look_within_pixel(params, ray, sample, side)
            change += mirrored_change(params, scene, lights, distant, receiver, shadow_ratio, pixel, direction, shown)
        mirrored_out[i, j] = change / wp.float32(side * side)

    return mirror_ball_kernel


mirror_ball = row_launcher(make_mirror_ball_kernel)
"""Write the change of radiance of pixels that show mirror balls; zero outside ``params[0].ball_rect``.

Args:
    config: Features of the scene; arguments that it does not use may be None.
    params: (1,) FrameParams: camera and ball_rect.
    scene: Objects and proxies.
    lights: (n,) Light.
    distant: The environment that lights objects; empty if ``config.shade`` is None.
    receiver: From ``make_receiver``; picture and probes are always needed.
    shadow_ratio: (H, W) vec3 of ``environment_shadow``; needed if ``config.ratio``.
    side: Square root of the number of rays per pixel; all values share one kernel.
    mirrored_out: (H, W) vec3, change of linear radiance in camera values.
"""
