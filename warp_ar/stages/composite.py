"""Stage ``composite``: the picture at the camera's own exposure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.picture import composite
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Stage, Wiring, over_rows
from warp_ar.stages.features import Features
from warp_ar.stages.shared.picture import layers_of


class Composite(Stage):
    """Composes virtual light, shadows and virtual objects over the camera's frame."""

    name: ClassVar[str] = "composite"
    summary: ClassVar[str] = "frame, virtual light on the receiver and virtual objects, in linear light"
    numerics: ClassVar[Numerics] = Numerics(
        "float32 to 8-bit codes by exact thresholds",
        0.501,
        "rounding to codes; untouched pixels to the bit",
        codes=True,
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written; none if no layer covers the frame, or if ``expose`` composes it."""
        layers = features.layers
        if features.exposed:
            return LeftOut("the exposure stage composes what it exposes")
        if not layers:
            return LeftOut("nothing virtual is laid over the frame")
        return Wiring(("frame", *layers), ("image",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the array of the picture."""
        return {"image": ArraySpec(self.shape, wp.vec3ub)}

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return one pass over all pixels."""
        given = (arrays[name] for name in ("params", "frame", "decode", "encode"))
        return [over_rows(self.height, composite.composite, *given, layers_of(arrays), arrays["image"])]
