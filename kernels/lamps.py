"""Lamps of the room that stand near: what surfaces away from the ball receive of them.

The environment holds a lamp as the ball mirrors it to the camera, at a point c of its surface: direction d, distance D
and power p, which is the irradiance of a surface at c that faces it. At a point x with normal n, the vector to the lamp
being r = c + D d - x, it is

    E(x) = p (D / |r|)^2 max(n.r / |r|, 0)     and not, as the environment has it,     p max(n.d, 0).

What is in the way is left out, as irradiance of the environment leaves it out.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.structs import RoomLamp

wp.set_module_options({"enable_backward": False})

MAX_DISTANCE = wp.constant(wp.float32(100.0))
"""Metres from the ball beyond which a lamp is distant: E changes by less than 2 % over a metre."""
MAX_GAIN = wp.constant(wp.float32(16.0))
"""Largest (D / |r|)^2: lamps have a size, and their distances an error."""


@wp.func
def add_nearness(irradiance: wp.vec3, lamps: wp.array[RoomLamp], point: wp.vec3, normal: wp.vec3) -> wp.vec3:
    """Irradiance of the environment at a surface, with near lamps at their places; never negative."""
    result = irradiance
    for k in range(lamps.shape[0]):
        lamp = lamps[k]
        # A lamp that is none has the distance 0.
        if lamp.distance > 0.0 and lamp.distance < MAX_DISTANCE:
            to_lamp = lamp.origin + lamp.distance * lamp.direction - point
            away = wp.max(wp.length(to_lamp), 1.0e-4)
            gain = lamp.distance / away
            here = wp.min(gain * gain, MAX_GAIN) * wp.max(wp.dot(normal, to_lamp) / away, 0.0)
            result += (here - wp.max(wp.dot(normal, lamp.direction), 0.0)) * lamp.power
    return wp.max(result, wp.vec3(0.0, 0.0, 0.0))
