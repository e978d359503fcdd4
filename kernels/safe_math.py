"""Bounds on numbers: finite radiance and confidence, and smooth ramps."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

MAX_RADIANCE = wp.constant(wp.float32(1.0e8))
"""Upper bound of a texel's radiance, in camera values, so that sums over any map stay finite in float32."""


@wp.func
def is_finite(value: wp.vec3) -> wp.bool:
    """Return whether all three components are finite."""
    return wp.isfinite(value[0]) and wp.isfinite(value[1]) and wp.isfinite(value[2])


@wp.func
def smooth_ramp(low: wp.float32, high: wp.float32, x: wp.float32) -> wp.float32:
    """Return 0 below low, 1 above high, a smooth ramp between; 0 for NaN."""
    t = wp.clamp((x - low) / (high - low), 0.0, 1.0)
    return wp.where(x > low, t * t * (3.0 - 2.0 * t), 0.0)


@wp.func
def usable_confidence(value: wp.vec3, confidence: wp.float32) -> wp.float32:
    """Return the confidence of a texel; 0 if it or the texel's value is not finite."""
    if confidence > 0.0 and is_finite(value):
        return wp.min(confidence, 1.0)
    return 0.0


@wp.func
def light_confidence(radiance: wp.vec3, confidence: wp.float32) -> wp.float32:
    """Return the confidence of a texel's radiance in one frame; 0 if the radiance is negative or not finite."""
    if wp.min(radiance) < 0.0:
        return 0.0
    return usable_confidence(radiance, confidence)


@wp.func
def safe_channel(value: wp.float32) -> wp.float32:
    """Clamp a value to 0..``MAX_RADIANCE``; NaN becomes 0."""
    if value > 0.0:  # false for NaN
        return wp.min(value, MAX_RADIANCE)
    return 0.0


@wp.func
def safe_radiance(radiance: wp.vec3) -> wp.vec3:
    """Clamp the channels of radiance to 0..``MAX_RADIANCE``; NaN becomes 0."""
    return wp.vec3(safe_channel(radiance[0]), safe_channel(radiance[1]), safe_channel(radiance[2]))
