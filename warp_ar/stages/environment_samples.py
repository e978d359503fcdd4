"""The environment as samples, for shadows and reflections."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels import environment_samples, pyramid
from warp_ar.kernels.environment_samples import EnvironmentSample
from warp_ar.stages.base import NO_BALL, Arrays, ArraySpec, LeftOut, Numerics, Pass, Rows, Stage, Wiring
from warp_ar.stages.features import Features
from warp_ar.stages.shared.environment_sets import REFERENCE_SIZE, SAMPLES, lists_texels, sample_names
from warp_ar.stages.shared.settled import settled_environment


class EnvironmentSamples(Stage):
    """Draws directions by the light that comes from them, anew whenever the environment changes."""

    name: ClassVar[str] = "environment_samples"
    summary: ClassVar[str] = "the environment as directions, drawn by what they send to the receiver"
    unread: ClassVar[str] = "nothing traces rays to the environment"
    settings: ClassVar[tuple[str, ...]] = ("environment_height",)
    numerics: ClassVar[Numerics] = Numerics(
        precision="float32, compensated cumulative sums",
        bound=5e-6,
        cause="compensated along rows; one rounding a row over them",
        measured=3.6e-07,
        rows=(4, 6, 17, 18),
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Read the environment, write samples."""
        if not features.environment:
            return LeftOut(NO_BALL)
        emitters = ("emitters",) if features.emitters else ()
        return Wiring(("environment", *emitters), ("environment_samples",))

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
        if not lists_texels(self.features):
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
        environment, samples = settled_environment(arrays, device), arrays["environment_samples"]
        cumulative, sums = arrays["environment_samples_cumulative"], arrays["environment_samples_rows"]
        out = arrays["environment_samples_directions"], arrays["environment_samples_flux"], samples
        probes = self.request.scene.probes
        origin = wp.vec3(*probes[0].center) if probes else wp.vec3()
        passes = [
            Pass(lambda rows: environment_samples.sum_environment(environment, cumulative, sums)),
            Pass(lambda rows: environment_samples.draw_samples(environment, cumulative, sums, origin, *out)),
        ]
        found = [samples]
        if lists_texels(self.features):
            small, texels = arrays["environment_samples_map"], [arrays[name] for name in sample_names(self.features)]
            passes += [
                Pass(lambda rows: pyramid.reduce_latlong(environment, small)),
                Pass(lambda rows: environment_samples.list_texels(small, origin, *texels)),
            ]
            found.append(texels[-1])
        if self.features.emitters:

            def place(rows: Rows | None) -> None:
                for one in found:
                    environment_samples.place_emitters(arrays["emitters"], one)

            passes.append(Pass(place))
        return passes
