"""Stage ``accumulate``: the environment as a running mean of the light in successive frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.environment import accumulate
from warp_ar.kernels.environment.probe_weights import update_places
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Stage, Wiring, over_rows, unobserved
from warp_ar.stages.features import Features
from warp_ar.stages.shared.probe_maps import KEPT, OTHERS, UNWRAPPED, find_view, other_maps, other_names, other_views


class Accumulate(Stage):
    """Averages light over time, weighted by confidence; follows real changes faster than noise."""

    name: ClassVar[str] = "accumulate"
    summary: ClassVar[str] = "steadies the light over time and remembers what is out of sight"
    unread: ClassVar[str] = "nothing asks for the environment"
    settings: ClassVar[tuple[str, ...]] = ("environment_height",)
    follows: ClassVar[bool] = True
    numerics: ClassVar[Numerics] = Numerics(
        "float32; m + a (x - m), exact where x = m", 1e-5, "an exponential and a dozen roundings"
    )
    remembers: ClassVar[tuple[str, ...]] = (
        "accumulate_change",
        "accumulate_others",
        "probe_places",
        *(f"{KEPT}_{part}" for part in UNWRAPPED),
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written for a scene with a mirror ball."""
        if not features.observed:
            return LeftOut(unobserved(features))
        seen = "merged" if features.merged else "probe"
        others = (*other_names(features, OTHERS), "probes_seen", "pose") if features.others else ()
        kept = (*other_names(features, KEPT), "probe_places") if features.others else ()
        return Wiring(
            (*(f"{seen}_{part}" for part in UNWRAPPED), *others, "clock"),
            ("environment_radiance", "environment_confidence", "environment_clipped", *kept),
        )

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of the accumulated maps, and the change of each sector (block of texels)."""
        shape, others = self.map_shape, self.features.others
        sectors = accumulate.change_shape(*shape)
        specs = {
            "environment_radiance": ArraySpec(shape, wp.vec3),
            "environment_confidence": ArraySpec(shape, wp.float32),
            "environment_clipped": ArraySpec(shape, wp.vec3),
            "accumulate_change": ArraySpec(sectors, wp.vec2),
        }
        if others:
            specs["probe_places"] = ArraySpec((others + 1,), wp.vec4)
            specs["accumulate_others"] = ArraySpec((others, *sectors), wp.vec2)
        return {**specs, **other_maps(self.features, KEPT, shape)}

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return passes that measure the change of light, then update the mean; none runs while a ball is covered."""
        view = find_view(arrays, self.wiring.reads[0].removesuffix("_radiance"))
        environment, change, params = find_view(arrays, "environment"), arrays["accumulate_change"], arrays["params"]

        def follow(view: Any, environment: Any, change: Any) -> list[Pass]:
            return [
                Pass(lambda rows: accumulate.measure_change(view, environment, change)),
                over_rows(self.map_height, accumulate.accumulate_environment, view, change, params, environment),
            ]

        passes = follow(view, environment, change)
        if self.features.others:  # weights of the balls, and the same passes for each further ball
            seen = arrays["probes_seen"], arrays["probes"], params, arrays["probe_places"]
            passes.append(Pass(lambda rows: update_places(*seen)))
        others = (other_views(self.features, arrays, name) for name in (OTHERS, KEPT))
        for ball, (view, environment) in enumerate(zip(*others, strict=True)):
            passes += follow(view, environment, arrays["accumulate_others"][ball])
        return [dataclasses.replace(one, enabled=lambda: not arrays["ball_covered"]()) for one in passes]
