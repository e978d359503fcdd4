"""The environment as samples, for shadows and reflections."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels import environment_samples, pyramid
from warp_ar.kernels.environment_samples import EnvironmentSample
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Pass, Request, Rows, Stage, Wiring
from warp_ar.stages.composite import shadows_environment, shares_environment
from warp_ar.stages.recover import knows_emitters
from warp_ar.stages.reflect import distant_light_config
from warp_ar.stages.shade import sees_near

SAMPLES = 1024
"""Of all sets together: what an 8-bit picture of their mean can tell apart, four times over."""
REFERENCE_SIZE = (32, 64)
"""Texels of the map that the reference sums over."""


def lists_texels(request: Request) -> bool:
    """Whether the reference asks for every texel of the environment, beside the samples that follow its light."""
    return request.quality.method("environment_shadow") == "brute_force"


def sample_names(request: Request) -> tuple[str, str, str]:
    """Arrays that shadows read: directions, flux, samples."""
    listed = "environment_samples_texel_directions", "environment_samples_texel_flux", "environment_samples_texels"
    return (
        listed
        if lists_texels(request)
        else ("environment_samples_directions", "environment_samples_flux", "environment_samples")
    )


class EnvironmentSamples(Stage):
    """Draws directions by the light that comes from them, anew whenever the environment changes."""

    name: ClassVar[str] = "environment_samples"
    methods: ClassVar[tuple[str, ...]] = ("default",)
    summary: ClassVar[str] = "the environment as directions, drawn by what they send to the desk"

    @classmethod
    def wire(cls, request: Request) -> Wiring | LeftOut:
        """Read the environment, write samples."""
        gathers = sees_near(request) and distant_light_config(request).diffuse != "none"
        if not shadows_environment(request) and not shares_environment(request) and not gathers:
            return LeftOut("nothing traces rays to the environment")
        lamps = ("lamps",) if knows_emitters(request) else ()
        return Wiring(("environment", *lamps), ("environment_samples",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The samples, and the sums that are inverted to draw them; for the reference a small map's texels as well."""
        height = self.request.quality.environment_height
        specs = {
            "environment_samples": ArraySpec((SAMPLES,), EnvironmentSample, EnvironmentSample()),
            "environment_samples_directions": ArraySpec((SAMPLES,), wp.vec3),
            "environment_samples_flux": ArraySpec((SAMPLES,), wp.vec3),
            "environment_samples_cumulative": ArraySpec((height, 2 * height), wp.float32),
            "environment_samples_rows": ArraySpec((height,), wp.vec2),
        }
        if not lists_texels(self.request):
            return specs
        texels = REFERENCE_SIZE[0] * REFERENCE_SIZE[1]  # a smaller environment leaves the rest without measure
        return {
            **specs,
            "environment_samples_map": ArraySpec(
                (min(REFERENCE_SIZE[0], height), min(REFERENCE_SIZE[1], 2 * height)), wp.vec3
            ),
            "environment_samples_texels": ArraySpec((texels,), EnvironmentSample, EnvironmentSample()),
            "environment_samples_texel_directions": ArraySpec((texels,), wp.vec3),
            "environment_samples_texel_flux": ArraySpec((texels,), wp.vec3),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Sum, then invert; and list the texels of a small map."""
        environment, samples = arrays["environment"], arrays["environment_samples"]
        cumulative, sums = arrays["environment_samples_cumulative"], arrays["environment_samples_rows"]
        out = arrays["environment_samples_directions"], arrays["environment_samples_flux"], samples
        origin = wp.vec3(*self.request.scene.probes[0].center)
        passes = [
            Pass(lambda rows: environment_samples.sum_environment(environment, cumulative, sums)),
            Pass(lambda rows: environment_samples.draw_samples(environment, cumulative, sums, origin, *out)),
        ]
        found = [samples]
        if lists_texels(self.request):
            small, texels = arrays["environment_samples_map"], [arrays[name] for name in sample_names(self.request)]
            passes += [
                Pass(lambda rows: pyramid.reduce_latlong(environment, small)),
                Pass(lambda rows: environment_samples.list_texels(small, origin, *texels)),
            ]
            found.append(texels[-1])
        if knows_emitters(self.request):

            def place(rows: Rows | None) -> None:
                for one in found:
                    environment_samples.place_lamps(arrays["lamps"], one)

            passes.append(Pass(place))
        return passes
