"""Near emitters of the environment: their irradiance away from the ball, and the parallax of their reflections.

The environment holds an emitter as the ball mirrors it to the camera, at a point c of its surface: direction d,
distance D and power p, which is the irradiance of a surface at c that faces it. At a point x with normal n, the vector
to the emitter being r = c + D d - x, it is

    E(x) = p (D / |r|)^2 max(n.r / |r|, 0)     and not, as the environment has it,     p max(n.d, 0).

Occlusion is ignored, as in the environment's irradiance.

A mirror shows the emitter along r as well. So look-ups of the environment in a direction w are rotated by the angle
that turns u = r / |r| to d, times

    (1 - s^4)^2,    s = |w - u| / max(REACH, 2.5 |d - u|) < 1.

Then the emitter and the glow around it appear once, in the right direction and undistorted, and directions farther away
do not change. The map of directions is one-to-one, because (1 - s^4)^2 falls by at most 2.2 per unit of s. Parts of one
window are emitters side by side, whose rotations are nearly equal; directions between them must not be rotated by all
of them in sequence. With an emitter's factor f and its rotation vector v, the combined rotation

    sum g v / (1 + sum g),    g = f / (1 - f),

is f v for one emitter, lies between their rotations for several, and equals an emitter's own v in its direction.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.structs import Emitter

wp.set_module_options({"enable_backward": False})

MAX_DISTANCE = wp.constant(wp.float32(100.0))
"""Metres from the ball beyond which an emitter is distant: E changes by less than 2 % over a metre."""
MAX_GAIN = wp.constant(wp.float32(16.0))
"""Largest (D / |r|)^2: emitters have a size, and their distances an error."""
REACH = wp.constant(wp.float32(0.2))
"""Least angular radius, radians, around a near emitter within which directions are rotated."""
NEARLY_ALL = wp.constant(wp.float32(1.0e-6))
"""Least value of 1 - f, to bound g."""
LEAST_TURN = wp.constant(wp.float32(1.0e-4))
"""Least rotation that is applied, radians: the axis has an error of some 1e-7 over the angle."""


@wp.func
def add_emitters(irradiance: wp.vec3, emitters: wp.array[Emitter], point: wp.vec3, normal: wp.vec3) -> wp.vec3:
    """Return the environment's irradiance at a surface, with near emitters at their positions; never negative."""
    result = irradiance
    for k in range(emitters.shape[0]):
        emitter = emitters[k]
        # Unused records have the distance 0.
        if emitter.distance > 0.0 and emitter.distance < MAX_DISTANCE:
            to_emitter = emitter.origin + emitter.distance * emitter.direction - point
            away = wp.max(wp.length(to_emitter), 1.0e-4)
            gain = emitter.distance / away
            here = wp.min(gain * gain, MAX_GAIN) * wp.max(wp.dot(normal, to_emitter) / away, 0.0)
            result += (here - wp.max(wp.dot(normal, emitter.direction), 0.0)) * emitter.power
    return wp.max(result, wp.vec3(0.0, 0.0, 0.0))


@wp.func
def emitter_weight(away: wp.float32, off: wp.float32) -> wp.float32:
    """Return g = f / (1 - f), the weight with which an emitter rotates a direction: f = (1 - s^4)^2, or 0 if s >= 1.

    Args:
        away: |w - u|, distance between the direction and the emitter's direction from the point.
        off: |d - u|, distance between the emitter's directions in the environment and from the point.
    """
    s = away / wp.max(REACH, 2.5 * off)
    if s >= 1.0:
        return 0.0
    s4 = s * s * s * s
    return (1.0 - s4) * (1.0 - s4) / wp.max(s4 * (2.0 - s4), NEARLY_ALL)


@wp.func
def correct_parallax(emitters: wp.array[Emitter], point: wp.vec3, direction: wp.vec3) -> wp.vec3:
    """Return the unit direction in which to read the environment for a ray from ``point`` along ``direction``."""
    spin = wp.vec3(0.0)
    weights = float(1.0)
    for k in range(emitters.shape[0]):
        emitter = emitters[k]
        if emitter.distance > 0.0 and emitter.distance < MAX_DISTANCE:
            to_emitter = wp.normalize(emitter.origin + emitter.distance * emitter.direction - point)
            off = wp.length(emitter.direction - to_emitter)
            weight = emitter_weight(wp.length(direction - to_emitter), off)
            if weight > 0.0:
                weights += weight
                if off > LEAST_TURN:
                    axis = wp.normalize(wp.cross(to_emitter, emitter.direction))
                    spin += weight * 2.0 * wp.asin(wp.min(0.5 * off, 1.0)) * axis
    angle = wp.length(spin) / weights
    if angle <= LEAST_TURN:
        return direction
    axis = wp.normalize(spin)
    along = wp.dot(axis, direction) * axis
    turned = along + wp.cos(angle) * (direction - along) + wp.sin(angle) * wp.cross(axis, direction)
    return wp.normalize(turned)


@wp.func
def seen_from(emitter: Emitter, place: wp.vec3) -> Emitter:
    """Return an emitter with origin, direction, distance and power seen from ``place``; a distant one is unchanged."""
    out = emitter
    if emitter.distance > 0.0 and emitter.distance < MAX_DISTANCE:
        to_emitter = emitter.origin + emitter.distance * emitter.direction - place
        away = wp.max(wp.length(to_emitter), 1.0e-4)
        gain = emitter.distance / away
        out.origin = place
        out.direction = to_emitter / away
        out.distance = away
        out.power = wp.min(gain * gain, MAX_GAIN) * emitter.power
    return out


@wp.func
def solid_angle_gain(emitters: wp.array[Emitter], point: wp.vec3, direction: wp.vec3) -> wp.float32:
    """Return the solid angle that light along a direction covers seen from ``point``, over that in the environment.

    It is (D / |r|)^2 in an emitter's direction and 1 far from all, interpolated by the weights of ``correct_parallax``.
    """
    gain = float(1.0)
    weights = float(1.0)
    for k in range(emitters.shape[0]):
        emitter = emitters[k]
        if emitter.distance > 0.0 and emitter.distance < MAX_DISTANCE:
            offset = emitter.origin + emitter.distance * emitter.direction - point
            away = wp.max(wp.length(offset), 1.0e-4)
            to_emitter = offset / away
            off = wp.length(emitter.direction - to_emitter)
            weight = emitter_weight(wp.length(direction - to_emitter), off)
            if weight > 0.0:
                weights += weight
                near = emitter.distance / away
                gain += weight * wp.min(near * near, MAX_GAIN)
    return gain / weights
