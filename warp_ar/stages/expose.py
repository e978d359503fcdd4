"""The picture at another exposure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import warp as wp

from warp_ar.kernels import exposure
from warp_ar.kernels.codes import by_warps
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Pass, Request, Rows, Stage, Wiring
from warp_ar.stages.composite import composite_config, exposes, layer_names, layers_of
from warp_ar.stages.declip import declips
from warp_ar.stages.variants import composite_variant


class Expose(Stage):
    """Composes the picture and scales its light, over-exposed regions by what they are guessed to have been."""

    name = "expose"
    methods = ("plain", "box", "glow", "ball")
    remembers = ("expose_scale",)
    summary = "another exposure: over-exposed regions keep what they can be guessed to have had"

    @classmethod
    def wire(cls, request: Request) -> Wiring | LeftOut:
        """Reads the layers, and what its method knows of clipped pixels."""
        if not exposes(request):
            return LeftOut(
                "exposure is 1"
                if request.scene.exposure.scale == 1.0
                else "exposure is auto and no virtual light falls"
            )
        reads = ["frame", "exposure", *layer_names(request)]
        if request.scene.exposure.scale == "auto":
            reads.append("clock")
        if uses_table(request):
            reads.append("summed_area")
        if declips(request):
            reads.append("declipped")
        return Wiring(tuple(reads), ("image",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The picture, the scale, the table of codes; for ``auto`` the counts."""
        width, height = self.request.size
        specs = {
            "image": ArraySpec((height, width), wp.vec3ub),
            "expose_scale": ArraySpec((1,), wp.float32),
            "expose_codes": ArraySpec((256,), wp.vec3ub),
        }
        if self.request.scene.exposure.scale == "auto":
            strips = -(-height // exposure.AUTO_STRIDE)
            specs["expose_levels"] = ArraySpec((strips, exposure.LEVELS), wp.int32)
        return specs

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """The scale, the codes, the picture."""
        composed = composite_variant(composite_config(layer_names(self.request)), device)
        config = exposure.ExposureConfig(
            "box" if uses_table(self.request) else "declipped" if declips(self.request) else "plain", composed
        )
        exposure.make_expose_kernel(config, by_warps(device, self.request.size[0]))
        params, frame, decode, encode = (arrays[name] for name in ("params", "frame", "decode", "encode"))
        scale, codes = arrays["expose_scale"], arrays["expose_codes"]
        layers = layers_of(arrays)
        passes: list[Pass] = []
        if self.request.scene.exposure.scale == "auto":
            levels = arrays["expose_levels"]

            def count(rows: Rows | None) -> None:
                exposure.count_levels(composed, params, frame, decode, layers, levels, rows=rows)

            passes.append(Pass(count, rows=levels.shape[0]))
            passes.append(Pass(lambda rows: exposure.adapt_scale(params, levels, scale)))
        else:
            passes.append(Pass(lambda rows: exposure.read_scale(params, scale)))
        passes.append(Pass(lambda rows: exposure.expose_codes(decode, encode, scale, codes)))

        def launch(rows: Rows | None) -> None:
            exposure.expose(
                config,
                params,
                frame,
                decode,
                encode,
                layers,
                arrays["summed_area"] if "summed_area" in self.wiring.reads else None,
                scale,
                codes,
                arrays["image"],
                declipped=arrays.get("declipped"),
                rows=rows,
            )

        passes.append(Pass(launch, rows=self.request.size[1]))
        return passes


def uses_table(request: Request) -> bool:
    """Whether darkening looks at a pixel's surroundings: only the box does, and only where light is taken away."""
    scale = request.scene.exposure.scale
    return exposes(request) and request.quality.method("expose") == "box" and (isinstance(scale, str) or scale < 1.0)
