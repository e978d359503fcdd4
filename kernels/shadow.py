"""Virtual lights: what arrives from one at a point, and whether something stands between.

The scale of a light is the scene format's: a white Lambertian surface that faces a light of radiant intensity I at
distance d has linear camera value I / (pi d^2), so the irradiance of a surface that faces it is I / d^2 (attenuation
(0, 0, 1)). A directional light's intensity is that irradiance itself.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.structs import DIRECTIONAL, POINT, SPOT, Light, RayScene
from warp_ar.kernels.visibility import FAR, TraceConfig, make_trace, offset_origin

wp.set_module_options({"enable_backward": False})

# 1 / d^2 has no limit at the light itself, real lights have: no point receives more than at this distance, or at the
# emitting sphere's radius where that is larger. 0.1 mm keeps an intensity of 1e6 at 1e14, far inside float32.
MIN_DISTANCE = wp.constant(wp.float32(1.0e-4))


@wp.struct
class LightSample:
    """One light seen from one point, as if nothing stood between."""

    wi: wp.vec3  # unit, toward the light; at the light itself the way back along its direction
    distance: wp.float32  # metres; FAR for a directional light
    irradiance_normal: wp.vec3  # irradiance of a surface that faces the light


@wp.func
def spot_falloff(light: Light, wi: wp.vec3) -> wp.float32:
    """1 inside the inner half angle, falling linearly in angle to 0 at the outer one; a step where both are equal.

    The angle comes from atan2, exact at both ends where acos is not. The axis itself is always inside: a cone of 0
    degrees is a line.
    """
    axis = -light.direction
    angle = wp.atan2(wp.length(wp.cross(axis, wi)), wp.dot(axis, wi))
    if angle <= light.inner_angle:
        return 1.0
    if angle >= light.outer_angle:
        return 0.0
    return (light.outer_angle - angle) / (light.outer_angle - light.inner_angle)


@functools.cache
def make_sample_light(kinds: tuple[int, ...]) -> wp.Function:
    """``sample_light(light, point) -> LightSample`` for the given kinds of light."""
    label = "_".join(map(str, kinds))
    positional = POINT in kinds or SPOT in kinds

    @wp.func(name=f"sample_light_{label}", module="unique")
    def sample_light_of_kinds(light: Light, point: wp.vec3) -> LightSample:
        sample = LightSample()
        if wp.static(DIRECTIONAL in kinds):
            if light.kind == DIRECTIONAL:
                sample.wi = -light.direction
                sample.distance = FAR
                sample.irradiance_normal = light.intensity
        if wp.static(positional):
            if light.kind != DIRECTIONAL:
                to_light = light.position - point
                distance = wp.length(to_light)
                wi = -light.direction
                if distance > 0.0:
                    wi = to_light / distance
                elif wp.dot(wi, wi) == 0.0:
                    wi = wp.vec3(0.0, 0.0, 1.0)  # a point light has no direction of its own
                d = wp.max(distance, wp.max(light.radius, MIN_DISTANCE))
                fall = light.attenuation[0] + (light.attenuation[1] + light.attenuation[2] * d) * d
                falloff = 1.0 / wp.max(fall, 1.0e-12)
                if wp.static(SPOT in kinds):
                    if light.kind == SPOT:
                        falloff *= spot_falloff(light, wi)
                sample.wi = wi
                sample.distance = distance
                sample.irradiance_normal = falloff * light.intensity
        return sample

    return sample_light_of_kinds


sample_light = make_sample_light((POINT, SPOT, DIRECTIONAL))
"""``sample_light(light, point) -> LightSample``: what a light of any kind sends to a world point; finite everywhere."""


@functools.cache
def make_shadow(config: TraceConfig) -> wp.Function:
    """``is_lit(scene, point, geometric_normal, error, sample) -> bool`` for the kinds of shape in ``config``.

    ``point``, ``geometric_normal`` and ``error`` are those of a ``Hit``. A light at distance 0 or below the offset is
    never hidden.
    """
    occluded = make_trace(config).occluded

    @wp.func(module="unique")
    def is_lit(
        scene: RayScene, point: wp.vec3, geometric_normal: wp.vec3, error: wp.float32, sample: LightSample
    ) -> wp.bool:
        origin = offset_origin(point, geometric_normal, sample.wi, error)
        # Short of the light by the offset, so that a light on a surface is not hidden by that surface.
        return not occluded(scene, origin, sample.wi, sample.distance - 2.0 * error)

    return is_lit
