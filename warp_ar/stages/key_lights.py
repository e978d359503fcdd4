"""Direction from which most of the environment's light comes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.environment import key_lights
from warp_ar.kernels.structs import KeyLight
from warp_ar.stages.base import NO_BALL, Arrays, ArraySpec, LeftOut, Numerics, Pass, Stage, Wiring
from warp_ar.stages.features import Features
from warp_ar.stages.shared.settled import settled_environment


class KeyLights(Stage):
    """Dominant direction, and how far it dominates."""

    name: ClassVar[str] = "key_lights"
    summary: ClassVar[str] = "finds the environment's dominant direction and its directionality"
    unread: ClassVar[str] = "relighting does not ask where the environment's light comes from"
    settings: ClassVar[tuple[str, ...]] = ("environment_height",)
    numerics: ClassVar[Numerics] = Numerics(
        precision="float32 sums",
        bound=2e-5,
        cause="sums over the texels of a map, row by row",
        measured=2e-06,
        rows=(4, 6, 10, 17),
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Needs a mirror ball."""
        if not features.environment:
            return LeftOut(NO_BALL)
        return Wiring(("environment",), ("key_lights",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The light and the sums on the way to it."""
        return {
            "key_lights": ArraySpec((1,), KeyLight),
            "key_lights_sums": ArraySpec((self.request.quality.environment_height,), wp.vec4),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Two launches, of one row a thread and of one thread."""
        known = settled_environment(arrays, device), arrays["key_lights_sums"], arrays["key_lights"]
        return [Pass(lambda rows: key_lights.find_key_light(*known))]
