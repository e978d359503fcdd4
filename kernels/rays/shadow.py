"""Virtual lights: their irradiance at a point, and their shadows.

The scale of a light is the scene format's: a white Lambertian surface that faces a light of radiant intensity I at
distance d has linear camera value I / (pi d^2), so the irradiance of a surface that faces it is I / d^2 (attenuation
(0, 0, 1)). A directional light's intensity is that irradiance itself.
"""

from __future__ import annotations

import functools
import math

import warp as wp

from warp_ar.kernels.rays.shapes import FAR
from warp_ar.kernels.rays.trace import TraceConfig, make_trace, offset_origin
from warp_ar.kernels.sampling import frame_from_normal
from warp_ar.kernels.structs import DIRECTIONAL, POINT, SPOT, Light, RayScene

wp.set_module_options({"enable_backward": False})

# 1 / d^2 has no limit at the light itself, real lights have: no point receives more than at this distance, or at the
# emitting sphere's radius where that is larger. 0.1 mm keeps an intensity of 1e6 at 1e14, far inside float32.
MIN_DISTANCE = wp.constant(wp.float32(1.0e-4))

PROBE_RAYS = 8
"""Rays to rim and centre of a light with a radius; if all agree, the light counts as wholly visible or hidden."""
SOFT_RAYS = 32
"""Rays to a light that is partly hidden."""
GOLDEN_ANGLE = wp.constant(wp.float32(math.pi * (3.0 - math.sqrt(5.0))))


@wp.struct
class LightSample:
    """One light seen from one point, occlusion ignored."""

    wi: wp.vec3  # unit, toward the light; at the light itself opposite to its direction
    distance: wp.float32  # metres; FAR for a directional light
    irradiance_normal: wp.vec3  # irradiance of a surface that faces the light


@wp.func
def spot_falloff(light: Light, wi: wp.vec3) -> wp.float32:
    """Return 1 inside the inner half angle, falling linearly in angle to 0 at the outer one; a step if both are equal.

    The angle comes from atan2, exact at both ends where acos is not. The axis itself is always inside: a cone of 0
    degrees is a line. Where 1 - x^2 / 2 <= cos x already says that a point is outside, no angle is needed.
    """
    axis = -light.direction
    # Both vectors are of unit length to a few roundings, so the margin is ample.
    if wp.dot(axis, wi) < 1.0 - 0.5 * light.outer_angle * light.outer_angle - 1.0e-5:
        return 0.0
    angle = wp.atan2(wp.length(wp.cross(axis, wi)), wp.dot(axis, wi))
    if angle <= light.inner_angle:
        return 1.0
    if angle >= light.outer_angle:
        return 0.0
    return (light.outer_angle - angle) / (light.outer_angle - light.inner_angle)


@functools.cache
def make_sample_light(kinds: tuple[int, ...]) -> wp.Function:
    """Return the function ``sample_light(light, point) -> LightSample`` for the given kinds of light."""
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


ALL_LIGHTS = tuple(sorted(map(int, (POINT, SPOT, DIRECTIONAL))))
"""Kinds of virtual light."""
sample_light = make_sample_light(ALL_LIGHTS)
"""``sample_light(light, point) -> LightSample``: a light of any kind, seen from a world point; finite everywhere."""


@functools.cache
def make_shadow(config: TraceConfig) -> wp.Function:
    """Return the function ``is_lit(scene, point, geometric_normal, error, sample) -> bool``: a light is not hidden.

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


@wp.func
def has_penumbra(light: Light, sample: LightSample) -> wp.bool:
    """Return whether a light casts shadows with penumbrae at the point of a sample: its radius does not enclose it."""
    return light.radius > 0.0 and light.kind != DIRECTIONAL and sample.distance > light.radius


@functools.cache
def make_visible_share(config: TraceConfig) -> wp.Function:
    """Return the function ``visible_share(scene, point, geometric_normal, error, light, sample, turn) -> float32``.

    Its result is the share, 0..1, of a light that is visible from a point. A light with a radius is a disk that faces
    the point. Its centre and rim are tested first. Only in a penumbra is the full sunflower pattern of rays traced,
    each of which stands for the same area of the disk. ``turn`` rotates the pattern, in turns: if it differs between
    the pixels of a small tile, the steps of 1 / ``SOFT_RAYS`` become a fine grain. A light without radius, or one that
    encloses the point, is visible (1) or not (0).
    """
    is_lit = make_shadow(config)
    occluded = make_trace(config).occluded

    @wp.func(module="unique")
    def visible_share(
        scene: RayScene,
        point: wp.vec3,
        geometric_normal: wp.vec3,
        error: wp.float32,
        light: Light,
        sample: LightSample,
        turn: wp.float32,
    ) -> wp.float32:
        if not has_penumbra(light, sample):
            return wp.where(is_lit(scene, point, geometric_normal, error, sample), 1.0, 0.0)
        basis = frame_from_normal(sample.wi)
        seen = wp.int32(0)
        count = wp.int32(PROBE_RAYS)
        k = wp.int32(0)
        while k < count:
            # The last of the first rays goes to the centre, the others to the rim; then the sunflower pattern begins.
            radius = wp.where(k < wp.static(PROBE_RAYS - 1), light.radius, 0.0)
            angle = 2.0 * wp.pi * (wp.float32(k) / wp.static(float(PROBE_RAYS - 1)) + turn)
            if count > wp.static(PROBE_RAYS):
                n = wp.float32(k - wp.static(PROBE_RAYS))
                radius = light.radius * wp.sqrt((n + 0.5) / wp.static(float(SOFT_RAYS)))
                angle = GOLDEN_ANGLE * n + 2.0 * wp.pi * turn
            on_disk = basis * wp.vec3(radius * wp.cos(angle), radius * wp.sin(angle), sample.distance)
            distance = wp.length(on_disk)
            direction = on_disk / distance
            # Parts of the disk below the surface's horizon are hidden.
            if wp.dot(direction, geometric_normal) > 0.0:
                origin = offset_origin(point, geometric_normal, direction, error)
                if not occluded(scene, origin, direction, distance - 2.0 * error):
                    seen += 1
            k += 1
            if k == wp.static(PROBE_RAYS) and count == k and seen > 0 and seen < k:
                count = wp.static(PROBE_RAYS + SOFT_RAYS)
                seen = 0
        if count == wp.static(PROBE_RAYS):
            return wp.where(seen > 0, 1.0, 0.0)
        return wp.float32(seen) / wp.static(float(SOFT_RAYS))

    return visible_share


@wp.func
def tile_turn(row: wp.int32, column: wp.int32) -> wp.float32:
    """Return a pixel's rotation of samples in turns, by a Bayer matrix of 4 x 4: neighbours differ most."""
    mixed = row ^ column
    rank = ((mixed & 1) << 3) | ((row & 1) << 2) | (mixed & 2) | ((row & 2) >> 1)
    return wp.float32(rank) / 16.0
