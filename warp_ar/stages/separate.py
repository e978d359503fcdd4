"""Stage ``separate``: separate layers of the picture, for composition in another program."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.picture.separate import SeparateLayers, separate_layers
from warp_ar.kernels.structs import filled, make_picture
from warp_ar.stages.base import NOT_ASKED, Arrays, ArraySpec, LeftOut, Numerics, Pass, Stage, Wiring, over_rows
from warp_ar.stages.features import Features
from warp_ar.stages.request import LAYERS, PICTURE_LAYERS
from warp_ar.stages.shared.picture import box_reads, clipped_evidence, layers_of

SOURCES: Mapping[str, str] = {
    "objects": "virtual",
    "shadow_ratio": "shadow_ratio",
    "added_light": "added_light",
    "mirror_ball": "mirror_ball",
}
"""Resource from which each layer is taken. ``objects`` refers to the records of virtual objects; if receivers reflect
too, ``reflected`` includes ``mirror_ball``."""


class Separate(Stage):
    """Writes the requested layers, with the layer's neutral value in pixels without virtual content."""

    name: ClassVar[str] = "separate"
    summary: ClassVar[str] = "requested layers of the picture, and the frame as linear radiance"
    numerics: ClassVar[Numerics] = Numerics(
        "float32, as the picture is made of", 2e-6, "one product of a clipped pixel's guess; layers are copied"
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written, with only the resources of the requested layers."""
        asked = [name for name in PICTURE_LAYERS if features.request.asks_for(LAYERS[name].resource)]
        if not asked:
            return LeftOut(NOT_ASKED)
        reads = ["pose"] if any(name in SOURCES for name in asked) else []
        reads += [SOURCES[name] for name in asked if SOURCES.get(name) in features.layers]
        reads += ["reflected"] * ("mirror_ball" in asked and "reflected" in features.layers)
        if "plate" in asked:
            reads.append("frame")
            # The estimate for clipped pixels depends on the exposure's scale.
            reads += ["image"] if features.exposed else []
            reads += box_reads(features)
            reads += ["declipped"] if features.declipped else []
        return Wiring(tuple(reads), tuple(LAYERS[name].resource for name in asked))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of the requested layers."""
        return {
            name: ArraySpec(self.shape, wp.vec4 if name == LAYERS["objects"].resource else wp.vec3)
            for name in self.wiring.writes
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return one pass over all pixels."""
        features, reads = self.features, self.wiring.reads
        asked = {name: LAYERS[name].resource for name in PICTURE_LAYERS if LAYERS[name].resource in self.wiring.writes}
        out = filled(SeparateLayers(), **{name: arrays[resource] for name, resource in asked.items()})
        layers = layers_of({name: arrays[name] for name in (*SOURCES.values(), "reflected") if name in reads})
        plate = "plate" in self.wiring.writes
        inputs = (
            arrays["params"],
            make_picture(arrays["frame"], arrays["decode"], None),
            layers,
            clipped_evidence(self.request, self.wiring, arrays),
            arrays["expose_scale"] if plate and features.exposed else None,
        )
        return [over_rows(self.height, separate_layers, features.exposure_method, *inputs, out)]
