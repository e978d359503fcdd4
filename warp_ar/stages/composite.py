"""The picture at the camera's own exposure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.launch import copy
from warp_ar.kernels.picture import composite
from warp_ar.kernels.picture.codes import by_warps
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Rows, Stage, Wiring
from warp_ar.stages.features import Features
from warp_ar.stages.shared.layers import composite_config, layers_of
from warp_ar.stages.shared.rows import union_of


class Composite(Stage):
    """Lays virtual light and virtual objects over the frame."""

    name: ClassVar[str] = "composite"
    summary: ClassVar[str] = "frame, virtual light on the receiver and virtual objects, in linear light"
    numerics: ClassVar[Numerics] = Numerics(
        precision="float32 to 8-bit codes by exact thresholds",
        bound=0.501,
        cause="rounding to codes; untouched pixels to the bit",
        measured=0.5,
        rows=(6, 12, 17),
        codes=True,
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Left out where nothing is laid over the frame, and where the exposure stage does it in its own pass."""
        layers = features.layers
        if features.exposed:
            return LeftOut("the exposure stage composes what it exposes")
        if not layers:
            return LeftOut("nothing virtual is laid over the frame")
        return Wiring(("frame", *layers), ("image",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The picture."""
        width, height = self.request.size
        return {"image": ArraySpec((height, width), wp.vec3ub)}

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """On CPU a plain copy, then a pass over the rows that a layer can reach; on CUDA one pass over all."""
        config = composite_config(self.features.layers)
        width, height = self.request.size
        if not device.is_cpu:
            composite.make_composite_kernel(config, by_warps(device, width))
        image, frame, layers = arrays["image"], arrays["frame"], layers_of(arrays)

        def launch(rows: Rows | None) -> None:
            composite.composite(
                config,
                arrays["params"],
                frame,
                arrays["decode"],
                arrays["encode"],
                layers,
                image,
                rows=rows,
            )

        if not device.is_cpu:
            return [Pass(launch, rows=height)]
        extents = [arrays["object_rows"]] * config.virtual + [arrays["light_rows"]] * config.added
        extents += [arrays["shadow_rows"]] * config.ratio + [arrays["ball_rows"]] * config.mirror_ball
        return [Pass(lambda rows: copy(image, frame), rows=height), Pass(launch, rows=height, extent=union_of(extents))]
