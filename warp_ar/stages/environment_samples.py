"""Stage ``environment_samples``: samples of the environment for shadows and reflections."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.environment import environment_samples, pyramid
from warp_ar.kernels.environment.environment_samples import EnvironmentSample
from warp_ar.stages.base import NO_BALL, Arrays, ArraySpec, LeftOut, Numerics, Pass, Rows, Stage, Wiring
from warp_ar.stages.features import Features
from warp_ar.stages.shared import environment_sets


class EnvironmentSamples(Stage):
    """Draws directions with probabilities by their radiance, whenever the environment changes."""

    name: ClassVar[str] = "environment_samples"
    summary: ClassVar[str] = "directions sampled by the environment's light on the receiver"
    unread: ClassVar[str] = "nothing traces rays to the environment"
    settings: ClassVar[tuple[str, ...]] = ("environment_height",)
    numerics: ClassVar[Numerics] = Numerics(
        "float32, compensated cumulative sums", 5e-6, "compensated along rows; one rounding a row over them"
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources that the stage reads, such as the environment, and the samples that it writes."""
        if not features.environment:
            return LeftOut(NO_BALL)
        emitters = ("emitters",) if features.emitters else ()
        others = ("others_environment",) if features.others else ()
        placed = ("others_emitters",) if features.others and features.emitters else ()
        return Wiring(("environment", *emitters, *others, *placed), ("environment_samples",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of the samples, of the sums by which they are drawn, and for the reference of texels."""
        height, width = self.map_shape
        count = environment_sets.sample_count(self.features)
        specs = {
            "environment_samples": ArraySpec((count,), EnvironmentSample, EnvironmentSample()),
            "environment_samples_directions": ArraySpec((count,), wp.vec3),
            "environment_samples_flux": ArraySpec((count,), wp.vec3),
            "environment_samples_cumulative": ArraySpec(self.map_shape, wp.float32),
            "environment_samples_rows": ArraySpec((height,), wp.vec2),
        }
        if not environment_sets.lists_texels(self.features):
            return specs
        # For a smaller environment the remaining samples have weight 0.
        rows, columns = environment_sets.REFERENCE_SIZE
        texels = rows * columns * environment_sets.sample_slots(self.features)
        return {
            **specs,
            "environment_samples_map": ArraySpec((min(rows, height), min(columns, width)), wp.vec3),
            "environment_samples_texels": ArraySpec((texels,), EnvironmentSample, EnvironmentSample()),
            "environment_samples_texel_directions": ArraySpec((texels,), wp.vec3),
            "environment_samples_texel_flux": ArraySpec((texels,), wp.vec3),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return, for each ball, passes that draw samples; for the reference also one that lists a map's texels."""
        emitters = arrays["emitters"] if self.features.emitters else None
        passes = self._draw(arrays, 0, arrays["environment"], emitters)
        for ball in range(self.features.others):
            emitters = arrays["others_emitters"][ball] if self.features.emitters else None
            passes += self._draw(arrays, ball + 1, arrays["others_environment"][ball], emitters)
        return passes

    def _draw(self, arrays: Arrays, ball: int, environment: Any, emitters: Any) -> list[Pass]:
        """Return the passes from one map of the environment to its samples; the balls' passes reuse the same sums."""
        samples = arrays["environment_samples"]
        cumulative, sums = arrays["environment_samples_cumulative"], arrays["environment_samples_rows"]
        out = arrays["environment_samples_directions"], arrays["environment_samples_flux"], samples
        probes, turn = self.request.scene.probes, (ball, self.features.others + 1)
        origin = wp.vec3(*probes[ball].center) if probes else wp.vec3()
        known = environment, cumulative, sums, origin, turn
        passes = [
            Pass(lambda rows: environment_samples.sum_environment(environment, cumulative, sums)),
            Pass(lambda rows: environment_samples.draw_samples(*known, *out)),
        ]
        found = [samples]
        if environment_sets.lists_texels(self.features):
            small = arrays["environment_samples_map"]
            texels = [arrays[name] for name in environment_sets.sample_names(self.features)]
            passes += [
                Pass(lambda rows: pyramid.reduce_latlong(environment, small)),
                Pass(lambda rows: environment_samples.list_texels(small, origin, turn, *texels)),
            ]
            found.append(texels[-1])
        if emitters is not None:

            def place(rows: Rows | None) -> None:
                for one in found:
                    environment_samples.place_emitters(emitters, turn, one)

            passes.append(Pass(place))
        return passes
