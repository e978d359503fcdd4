"""Stage ``expose``: the picture at another exposure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.picture import expose
from warp_ar.kernels.structs import make_picture
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Stage, Wiring, over_rows
from warp_ar.stages.features import Features
from warp_ar.stages.shared.picture import box_reads, clipped_evidence, frame_reads, layers_of


class Expose(Stage):
    """Composes the picture and scales its radiance, with estimates for over-exposed regions."""

    name: ClassVar[str] = "expose"
    methods: ClassVar[Mapping[str, str]] = {
        "plain": "scaled",
        "paper": "scaled less where surroundings clip too",
        "ball": "from their glow and the ball's view of the emitter",
    }
    remembers: ClassVar[tuple[str, ...]] = ("expose_scale",)
    summary: ClassVar[str] = "simulates another exposure, with estimated radiance where the frame clips"
    subject: ClassVar[str] = "clipped pixels at a shorter exposure"
    numerics: ClassVar[Numerics] = Numerics(
        "float32 to 8-bit codes by exact thresholds", 0.501, "rounding to codes; exposure 1 to the bit", codes=True
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written, among them those from which the method estimates clipped pixels."""
        scale = features.request.scene.exposure.scale
        if not features.exposed:
            return LeftOut("exposure is 1" if scale == 1.0 else "exposure is auto and no virtual light falls")
        reads = [*frame_reads(features), "exposure", *features.layers]
        if scale == "auto":
            reads.append("clock")
        reads += box_reads(features)
        if features.declipped:
            reads.append("declipped")
        return Wiring(tuple(reads), ("image",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of the picture, the scale and the table of codes; for ``auto`` also the histogram."""
        specs = {
            "image": ArraySpec(self.shape, wp.vec3ub),
            "expose_scale": ArraySpec((1,), wp.float32),
            "expose_codes": ArraySpec((256,), wp.vec3ub),
        }
        if self.request.scene.exposure.scale == "auto":
            strips = -(-self.height // expose.AUTO_STRIDE)
            specs["expose_levels"] = ArraySpec((strips, expose.LEVELS), wp.int32)
        return specs

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return passes that find the exposure scale, make the table of scaled codes, and write the picture."""
        params, decode, encode = (arrays[name] for name in ("params", "decode", "encode"))
        picture = make_picture(arrays["frame"], decode, None, arrays["linear_frame"])
        scale, codes = arrays["expose_scale"], arrays["expose_codes"]
        layers = layers_of(arrays)
        if self.request.scene.exposure.scale == "auto":
            levels = arrays["expose_levels"]
            passes = [
                over_rows(levels.shape[0], expose.count_levels, params, picture, layers, levels),
                Pass(lambda rows: expose.adapt_scale(params, levels, scale)),
            ]
        else:
            passes = [Pass(lambda rows: expose.read_scale(params, scale))]
        passes.append(Pass(lambda rows: expose.expose_codes(decode, encode, scale, codes)))
        clipped = clipped_evidence(self.request, self.wiring, arrays)
        given = picture, layers, clipped, expose.make_exposure(encode, scale, codes), arrays["image"]
        return [*passes, over_rows(self.height, expose.expose, self.features.exposure_method, params, *given)]
