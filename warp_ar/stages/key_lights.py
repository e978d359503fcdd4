"""Where the environment comes from, in a few directions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.environment import key_lights
from warp_ar.kernels.structs import KeyLight
from warp_ar.stages.base import NO_BALL, Arrays, ArraySpec, LeftOut, Numerics, Pass, Rows, Stage, Wiring
from warp_ar.stages.features import Features
from warp_ar.stages.shared.settled import settled_environment


class KeyLights(Stage):
    """Dominant directions, brightest first, and how far each dominates."""

    name: ClassVar[str] = "key_lights"
    summary: ClassVar[str] = "finds the environment's brightest directions and how far they dominate"
    unread: ClassVar[str] = "relighting does not ask where the environment's light comes from"
    settings: ClassVar[tuple[str, ...]] = ("environment_height",)
    numerics: ClassVar[Numerics] = Numerics(
        precision="float32; directions stepped by rotation",
        bound=4e-3,
        cause="the edge of a lobe falls between whole texels; 6e-8 a step",
        measured=0.0031,
        rows=(4, 6, 10, 17),
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Needs a mirror ball."""
        if not features.environment:
            return LeftOut(NO_BALL)
        return Wiring(("environment",), ("key_lights",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The lights and the sums on the way to them."""
        return {
            "key_lights": ArraySpec((key_lights.KEY_LIGHT_COUNT,), KeyLight),
            "key_lights_sums": ArraySpec((self.request.quality.environment_height,), wp.vec4),
            "key_lights_sectors": ArraySpec((key_lights.SECTOR_SUMS,), wp.vec4),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """One short series of launches."""
        environment = settled_environment(arrays, device)

        def find(rows: Rows | None) -> None:
            key_lights.find_key_lights(
                environment, arrays["key_lights_sums"], arrays["key_lights_sectors"], arrays["key_lights"]
            )

        return [Pass(find)]
