"""Virtual light that a mirror ball throws onto a surface.

A ball of radius R mirrors a light to a point x at one place p of it, where the normal halves the angle between both.
Seen from the ball's middle, x lies at X radii and the light at L, the angle g between them; p lies between both, at the
angle a from the light, where light leaves as it came in:

    sin a (X cos b - 1) = (cos a - 1 / L) X sin b,    b = g - a.                                                  (1)

The left less the right side grows with a from below 0 to above it, so halving finds it. Behind the mirror the light has
its image at other distances across the plane of incidence and in it (Coddington): with d to the light, e from p to x and
the angle t of incidence

    1 / s = 1 / d + 2 cos t / R,    1 / s' = 1 / d + 2 / (R cos t),

and of the irradiance E that a surface at p which faces the light would have there arrives at x, facing p,

    reflectance E / ((1 + e / s) (1 + e / s')).                                                                   (2)

``REACH`` radii away that is .2 % of E; it fades to nothing there. Lights count as points.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.structs import DIRECTIONAL, Light, Probe

wp.set_module_options({"enable_backward": False})

REACH = 12.0
"""Radii from a ball's middle within which its light is known."""
_REACH = wp.constant(wp.float32(REACH))
_FADES = wp.constant(wp.float32(0.75))
"""Share of ``REACH`` from which it fades."""
HALVINGS = wp.constant(18)
"""Of the angle in which p is looked for: to a hundred-thousandth of it."""
MIN_COSINE = wp.constant(wp.float32(1.0e-3))
"""Of the angle of incidence: beyond it the ball is seen from the side, or from behind."""


@wp.struct
class Mirroring:
    """How a ball mirrors a light to a point."""

    found: wp.bool
    place: wp.vec3  # on the ball
    normal: wp.vec3
    wi: wp.vec3  # unit, from the point to that place
    distance: wp.float32  # metres to it
    spread: wp.float32  # irradiance at the point, facing the place, over that at the place, facing the light


@wp.func
def within_reach(probes: wp.array[Probe], point: wp.vec3) -> wp.bool:
    """Whether any ball may mirror light to a point."""
    for index in range(probes.shape[0]):
        away = point - probes[index].center
        reach = _REACH * probes[index].radius
        if wp.dot(away, away) < reach * reach:
            return True
    return False


@wp.func
def find_mirroring(light: Light, probe: Probe, point: wp.vec3) -> Mirroring:
    """Equations (1) and (2), but for reflectance and what stands in the way."""
    out = Mirroring()
    away = point - probe.center
    x = wp.length(away) / probe.radius
    if x <= 1.0 or x >= _REACH:
        return out
    to_point = away / (x * probe.radius)
    to_light = -light.direction
    nearness = float(0.0)  # 1 / L
    if light.kind != DIRECTIONAL:
        to_light = light.position - probe.center
        distance = wp.length(to_light)
        if distance <= probe.radius:
            return out
        to_light /= distance
        nearness = probe.radius / distance
    between = wp.atan2(wp.length(wp.cross(to_light, to_point)), wp.dot(to_light, to_point))
    low = float(0.0)
    high = float(between)
    for _k in range(HALVINGS):
        a = 0.5 * (low + high)
        b = between - a
        if wp.sin(a) * (x * wp.cos(b) - 1.0) > (wp.cos(a) - nearness) * x * wp.sin(b):
            high = a
        else:
            low = a
    a = 0.5 * (low + high)
    normal = wp.normalize(wp.sin(between - a) * to_light + wp.sin(a) * to_point)
    if between < 1.0e-4:
        normal = to_light
    out.normal = normal
    out.place = probe.center + probe.radius * normal
    leaving = point - out.place
    out.distance = wp.length(leaving)
    if out.distance <= 0.0:
        return out
    out.wi = -leaving / out.distance
    cosine = -wp.dot(out.wi, normal)
    if cosine <= MIN_COSINE:
        return out
    from_light = float(0.0)  # 1 / d
    if light.kind != DIRECTIONAL:
        from_light = 1.0 / wp.max(wp.length(light.position - out.place), 1.0e-6)
    across = 1.0 + out.distance * (from_light + 2.0 * cosine / probe.radius)
    along = 1.0 + out.distance * (from_light + 2.0 / (probe.radius * cosine))
    fade = wp.clamp((1.0 - x / _REACH) / (1.0 - _FADES), 0.0, 1.0)
    out.spread = fade / (across * along)
    out.found = True
    return out
