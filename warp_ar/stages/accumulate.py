"""The light of successive frames becomes the light of the environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels import accumulate
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Rows, Stage, Wiring, unobserved
from warp_ar.stages.features import Features
from warp_ar.stages.shared.probe_maps import UNWRAPPED, find_view


class Accumulate(Stage):
    """Running mean over time, keyed to confidence; follows real changes faster than noise."""

    name: ClassVar[str] = "accumulate"
    summary: ClassVar[str] = "steadies the light over time and remembers what is out of sight"
    unread: ClassVar[str] = "nothing asks for the environment"
    settings: ClassVar[tuple[str, ...]] = ("environment_height",)
    follows: ClassVar[bool] = True
    numerics: ClassVar[Numerics] = Numerics(
        precision="float32; m + a (x - m), exact where x = m",
        bound=1e-5,
        cause="an exponential and a dozen roundings",
        measured=9.9e-08,
        rows=(6, 7, 17, 18),
    )
    remembers: ClassVar[tuple[str, ...]] = ("accumulate_change",)

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Needs a mirror ball."""
        if not features.observed:
            return LeftOut(unobserved(features))
        seen = "merged" if features.merged else "probe"
        return Wiring(
            (*(f"{seen}_{part}" for part in UNWRAPPED), "clock"),
            ("environment_radiance", "environment_confidence", "environment_clipped"),
        )

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The accumulated maps, and the change of each cell."""
        height = self.request.quality.environment_height
        shape = (height, 2 * height)
        return {
            "environment_radiance": ArraySpec(shape, wp.vec3),
            "environment_confidence": ArraySpec(shape, wp.float32),
            "environment_clipped": ArraySpec(shape, wp.vec3),
            "accumulate_change": ArraySpec(accumulate.change_shape(*shape), wp.vec2),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Change first, then the mean; neither of a frame in which something covers a ball."""
        height = self.request.quality.environment_height
        view = find_view(arrays, self.wiring.reads[0].removesuffix("_radiance"))
        environment, change, params = find_view(arrays, "environment"), arrays["accumulate_change"], arrays["params"]

        def measure(rows: Rows | None) -> None:
            accumulate.measure_change(view, environment, change, rows=rows)

        def follow(rows: Rows | None) -> None:
            accumulate.accumulate_environment(view, change, params, environment, rows=rows)

        def tells() -> bool:
            return not arrays["ball_covered"]()

        return [Pass(measure, enabled=tells), Pass(follow, rows=height, enabled=tells)]
