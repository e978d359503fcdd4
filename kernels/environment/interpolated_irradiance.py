"""Irradiance of the environment at a point: of one mirror ball's map, or interpolated between several balls.

Objects and the receiver use the same functions. Emitters of known position light the point from their position, in
every ball's map. ``probe_weights`` gives the weights of the balls.
"""

from __future__ import annotations

import functools
from typing import Literal

import warp as wp

from warp_ar.kernels.emitters import add_emitters
from warp_ar.kernels.environment.irradiance import sh_irradiance
from warp_ar.kernels.environment.probe_weights import probe_weight
from warp_ar.kernels.latlong import sample_latlong
from warp_ar.kernels.structs import Emitter

wp.set_module_options({"enable_backward": False})


@wp.struct
class OtherBalls:
    """The environment at the mirror balls after the first, one array entry per ball; empty if there is one ball."""

    places: wp.array[wp.vec4]  # centres and trusts of all balls, the first included
    irradiance_sh: wp.array2d[wp.vec3]
    irradiance_map: wp.array3d[wp.vec3]
    levels: wp.array2d[wp.vec3]  # prefiltered
    environment: wp.array3d[wp.vec3]
    emitters: wp.array2d[Emitter]


@functools.cache
def make_irradiance_at(form: Literal["sh", "map"], emitters: bool, several: bool) -> wp.Function:
    """Return the function ``irradiance_at(sh, latlong, emitters, others, point, normal) -> vec3``.

    Args:
        form: ``sh`` if irradiance is given by nine coefficients, ``map`` if by a latlong map; the other is not read.
        emitters: Whether positions of emitters are known.
        several: Whether the light of several balls is interpolated.
    """

    @wp.func(module="unique")
    def irradiance_at(
        sh: wp.array[wp.vec3],
        latlong: wp.array2d[wp.vec3],
        emitters_at: wp.array[Emitter],
        others: OtherBalls,
        point: wp.vec3,
        normal: wp.vec3,
    ) -> wp.vec3:
        irradiance = wp.vec3(0.0)
        if wp.static(form == "sh"):
            irradiance = sh_irradiance(sh, normal)
        if wp.static(form == "map"):
            irradiance = sample_latlong(latlong, normal)
        if wp.static(emitters):
            irradiance = add_emitters(irradiance, emitters_at, point, normal)
        if wp.static(several):
            total = probe_weight(others.places, 0, point)
            for ball in range(1, others.places.shape[0]):
                weight = probe_weight(others.places, ball, point)
                if weight > 0.0:
                    total += weight
                    other = wp.vec3(0.0)
                    if wp.static(form == "sh"):
                        other = sh_irradiance(others.irradiance_sh[ball - 1], normal)
                    if wp.static(form == "map"):
                        other = sample_latlong(others.irradiance_map[ball - 1], normal)
                    if wp.static(emitters):
                        other = add_emitters(other, others.emitters[ball - 1], point, normal)
                    irradiance += (weight / total) * (other - irradiance)
        return irradiance

    return irradiance_at
