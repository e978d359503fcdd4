"""Emitters of the environment that stand near: what surfaces away from the ball receive of them.

The environment holds an emitter as the ball mirrors it to the camera, at a point c of its surface: direction d,
distance D and power p, which is the irradiance of a surface at c that faces it. At a point x with normal n, the vector
to the emitter being r = c + D d - x, it is

    E(x) = p (D / |r|)^2 max(n.r / |r|, 0)     and not, as the environment has it,     p max(n.d, 0).

What is in the way is left out, as irradiance of the environment leaves it out.

What mirrors shows the emitter along r as well. The environment is looked up there as if it were bent: for the direction
w by the angle that turns u = r / |r| to d, times

    (1 - s^4)^2,    s = |w - u| / max(REACH, 2.5 |d - u|) < 1,

so that the emitter, and the glow around it, is seen once, at its place and undistorted, and what is farther from it
stays. The factor keeps it one-to-one: (1 - s^4)^2 falls by no more than 2.2 per unit of s. Parts of one window are
emitters side by side, which all turn much the same way; what lies between must not be turned by all of them in turn.
With an emitter's factor f and its turn v, a rotation vector,

    v = sum g v / (1 + sum g),    g = f / (1 - f),

is f v for one emitter, between theirs for several, and each emitter's own where it stands.
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
"""Radians around a near emitter that turn with it, at least."""
NEARLY_ALL = wp.constant(wp.float32(1.0e-6))
"""Least 1 - f: closer to an emitter its turn is as good as alone."""
LEAST_TURN = wp.constant(wp.float32(1.0e-4))
"""Radians that are not worth turning: the axis is known to some 1e-7 over that."""


@wp.func
def add_emitters(irradiance: wp.vec3, emitters: wp.array[Emitter], point: wp.vec3, normal: wp.vec3) -> wp.vec3:
    """Irradiance of the environment at a surface, with near emitters at their places; never negative."""
    result = irradiance
    for k in range(emitters.shape[0]):
        emitter = emitters[k]
        # A emitter that is none has the distance 0.
        if emitter.distance > 0.0 and emitter.distance < MAX_DISTANCE:
            to_emitter = emitter.origin + emitter.distance * emitter.direction - point
            away = wp.max(wp.length(to_emitter), 1.0e-4)
            gain = emitter.distance / away
            here = wp.min(gain * gain, MAX_GAIN) * wp.max(wp.dot(normal, to_emitter) / away, 0.0)
            result += (here - wp.max(wp.dot(normal, emitter.direction), 0.0)) * emitter.power
    return wp.max(result, wp.vec3(0.0, 0.0, 0.0))


@wp.func
def emitter_weight(away: wp.float32, off: wp.float32) -> wp.float32:
    """Weight of an emitter for a direction ``away`` from it, as derived above; both are lengths between unit vectors.

    Args:
        away: From where the emitter is seen from the point.
        off: From there to where the environment shows it.
    """
    s = away / wp.max(REACH, 2.5 * off)
    if s >= 1.0:
        return 0.0
    s4 = s * s * s * s
    return (1.0 - s4) * (1.0 - s4) / wp.max(s4 * (2.0 - s4), NEARLY_ALL)


@wp.func
def correct_parallax(emitters: wp.array[Emitter], point: wp.vec3, direction: wp.vec3) -> wp.vec3:
    """Unit direction in which the environment shows what is seen from a point along a unit direction."""
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
    """An emitter as a map of the light at another place holds it; a distant one as it is."""
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
    """Ratio of the solid angle of what a point sees along a unit direction to that in the environment.

    (D / |r|)^2 where an emitter stands, 1 far from all, between them by the weights of ``correct_parallax``.
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
