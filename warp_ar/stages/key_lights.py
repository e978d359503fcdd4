"""Where the environment comes from, in a few directions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels import key_lights
from warp_ar.kernels.structs import KeyLight
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Pass, Request, Rows, Stage, Wiring
from warp_ar.stages.unwrap import NO_PROBE


class KeyLights(Stage):
    """Dominant directions, brightest first, and how far each dominates."""

    name: ClassVar[str] = "key_lights"
    methods: ClassVar[tuple[str, ...]] = ("default",)
    summary: ClassVar[str] = "finds the environment's brightest directions and how far they dominate"

    @classmethod
    def wire(cls, request: Request) -> Wiring | LeftOut:
        """Needs a mirror ball."""
        if not request.scene.probes:
            return LeftOut(NO_PROBE)
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

        def find(rows: Rows | None) -> None:
            key_lights.find_key_lights(
                arrays["environment"], arrays["key_lights_sums"], arrays["key_lights_sectors"], arrays["key_lights"]
            )

        return [Pass(find)]
