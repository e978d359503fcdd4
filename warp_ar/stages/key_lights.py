"""Stage ``key_lights``: the dominant direction of the environment's light."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.environment import key_lights
from warp_ar.kernels.structs import KeyLight
from warp_ar.stages.base import NO_BALL, Arrays, ArraySpec, LeftOut, Numerics, Pass, Stage, Wiring
from warp_ar.stages.features import Features


class KeyLights(Stage):
    """Computes the dominant direction and its directionality."""

    name: ClassVar[str] = "key_lights"
    summary: ClassVar[str] = "finds the environment's dominant direction and its directionality"
    unread: ClassVar[str] = "relighting does not ask where the environment's light comes from"
    settings: ClassVar[tuple[str, ...]] = ("environment_height",)
    numerics: ClassVar[Numerics] = Numerics("float32 sums", 2e-5, "sums over the texels of a map, row by row")

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written for a scene with a mirror ball."""
        if not features.environment:
            return LeftOut(NO_BALL)
        return Wiring(("environment",), ("key_lights",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of the dominant direction and of its partial sums."""
        return {
            "key_lights": ArraySpec((1,), KeyLight),
            "key_lights_sums": ArraySpec((self.map_height,), wp.vec4),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return two passes: sums over rows, one per thread, and the sum of all rows, in one thread."""
        known = arrays["environment"], arrays["key_lights_sums"], arrays["key_lights"]
        return [Pass(lambda rows: key_lights.find_key_light(*known))]
