"""Stage ``fill``: fills directions that no ball shows, from the camera's picture and from confident neighbours."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.environment import fill, fill_frame
from warp_ar.scene.kinds import trace_config
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Stage, Wiring, over_rows, unobserved
from warp_ar.stages.features import Features
from warp_ar.stages.shared.lighting import trace_variant
from warp_ar.stages.shared.picture import find_picture, frame_reads
from warp_ar.stages.shared.probe_maps import KEPT, other_names


class Fill(Stage):
    """Completes the environment map, which all later stages or ``recover`` read."""

    name: ClassVar[str] = "fill"
    summary: ClassVar[str] = (
        "completes the blind cone and hidden parts from the frame itself and from confident neighbours"
    )
    unread: ClassVar[str] = "nothing asks for the environment"
    settings: ClassVar[tuple[str, ...]] = ("environment_height",)
    numerics: ClassVar[Numerics] = Numerics(
        "float32; running means, normalised", 1e-5, "one rounding a level and texel"
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written for a scene with a mirror ball."""
        if not features.observed:
            return LeftOut(unobserved(features))
        written = "filled_radiance" if features.recovered else "environment"
        kept = other_names(features, KEPT)[:2]
        others = ("others_filled" if features.recovered else "others_environment",) if features.others else ()
        reads = "environment_radiance", "environment_confidence", *kept, *frame_reads(features), "pose"
        return Wiring(reads, (written, *others))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of the completed environment map and of the fill pyramid."""
        shape = self.map_shape
        return {
            **{name: ArraySpec((self.features.others, *shape), wp.vec3) for name in self.wiring.writes[1:]},
            self.wiring.writes[0]: ArraySpec(shape, wp.vec3),
            "fill_levels": ArraySpec((fill.fill_level_offsets(*shape)[-1],), wp.vec4),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return passes down and up the pyramid."""
        self._arrays = arrays
        self._is_filled = self._holds = False
        # One exposure gives no larger values. With merged exposures the limit keeps lamps from being spread into unseen
        # directions.
        most = math.inf
        if self.features.merged:
            most = 1.0 / max(min(min(probe.reflectance) for probe in self.request.scene.probes), 1e-3)

        maps = [(arrays["environment_radiance"], arrays["environment_confidence"], arrays[self.wiring.writes[0]])]
        for ball in range(self.features.others):
            names = *other_names(self.features, KEPT)[:2], self.wiring.writes[1]
            maps.append(tuple(arrays[name][ball] for name in names))
        proxies = trace_variant(trace_config(self.request.scene), device).proxies
        passes = [one for ball, known in enumerate(maps) for one in self._complete(arrays, ball, known, most, proxies)]
        return [dataclasses.replace(one, enabled=lambda: not self._holds) for one in passes]

    @staticmethod
    def _complete(
        arrays: Arrays, ball: int, known: tuple[Any, ...], most: float, proxies: tuple[int, ...]
    ) -> list[Pass]:
        """Return the passes that complete the map of one ball; the passes of all balls reuse one pyramid."""
        radiance, confidence, filled = known
        shape = height, _ = radiance.shape
        levels = arrays["fill_levels"]
        scene = find_picture(arrays), arrays["params"], arrays["probes"], arrays["ray_scene"]
        return [
            over_rows(height, fill.seed_fill, radiance, confidence, levels),
            over_rows(height, fill_frame.fill_frame, proxies, *scene, shape, ball, levels),
            Pass(lambda rows: fill.push_pull(levels, *shape, most=most)),
            over_rows(height, fill.finish_fill, levels, filled),
        ]

    def begin(self) -> None:
        """Keep the last map if something covers a ball, because it also covers the frame's view behind the ball."""
        self._holds = self._is_filled and self._arrays["ball_covered"]()
        self._is_filled = True
