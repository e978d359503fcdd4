"""Bounds on numbers: radiance and confidence that can be trusted, and ramps without corners."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

MAX_RADIANCE = wp.constant(wp.float32(1.0e8))
"""Radiance that an infinite or larger texel counts as, in camera values: sums over any map stay finite in float32."""


@wp.func
def is_finite(value: wp.vec3) -> wp.bool:
    """Return whether all three are numbers."""
    return wp.isfinite(value[0]) and wp.isfinite(value[1]) and wp.isfinite(value[2])


@wp.func
def smooth_ramp(low: wp.float32, high: wp.float32, x: wp.float32) -> wp.float32:
    """0 below low, 1 above high, smooth between; 0 for NaN."""
    t = wp.clamp((x - low) / (high - low), 0.0, 1.0)
    return wp.where(x > low, t * t * (3.0 - 2.0 * t), 0.0)


@wp.func
def usable_confidence(value: wp.vec3, confidence: wp.float32) -> wp.float32:
    """Confidence of a texel; 0 where it or its value is not a number."""
    if confidence > 0.0 and is_finite(value):
        return wp.min(confidence, 1.0)
    return 0.0


@wp.func
def light_confidence(radiance: wp.vec3, confidence: wp.float32) -> wp.float32:
    """Confidence of what a frame says of a texel; 0 where that is no light: negative, or not a number."""
    if wp.min(radiance) < 0.0:
        return 0.0
    return usable_confidence(radiance, confidence)


@wp.func
def safe_channel(value: wp.float32) -> wp.float32:
    """NaN and negative values to 0, infinity and anything beyond ``MAX_RADIANCE`` to that."""
    if value > 0.0:  # false for NaN
        return wp.min(value, MAX_RADIANCE)
    return 0.0


@wp.func
def safe_radiance(radiance: wp.vec3) -> wp.vec3:
    """Radiance that a filter can take: NaN and negative to 0, infinity to ``MAX_RADIANCE``."""
    return wp.vec3(safe_channel(radiance[0]), safe_channel(radiance[1]), safe_channel(radiance[2]))
