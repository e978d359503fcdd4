"""Stage ``visibility``: the virtual object that each pixel shows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.rays.visibility import trace_pixels
from warp_ar.kernels.structs import Hit
from warp_ar.scene.kinds import trace_config
from warp_ar.stages import base
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Reach, Stage, Wiring, over_rows
from warp_ar.stages.features import Features
from warp_ar.stages.shared.lighting import trace_variant
from warp_ar.stages.shared.picture import GrowingRows, find_visible


class Visibility(Stage):
    """Traces primary rays where virtual objects can be in the picture."""

    name: ClassVar[str] = "visibility"
    summary: ClassVar[str] = "traces the virtual object that each pixel sees, behind proxies"
    numerics: ClassVar[Numerics] = Numerics(
        "float32; error bound carried with every hit", 3e-5, "twenty roundings at a grazing angle of 3 degrees"
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written for a scene with virtual objects."""
        if not features.request.scene.objects:
            return LeftOut(base.NO_OBJECT)
        return Wiring(reads=("pose", "objects"), writes=("hit_object", "hits"))

    def idle(self, reach: Reach) -> str | None:
        """Return the reason for no effect in a frame if no object is in the picture, else None."""
        return None if reach.objects else base.OUT_OF_PICTURE

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of the visible object and the hit of each pixel."""
        return {"hit_object": ArraySpec(self.shape, wp.int32, -1), "hits": ArraySpec(self.shape, Hit, Hit())}

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return one pass over the rows in which objects are in this frame or were in the previous one."""
        config = trace_variant(trace_config(self.request.scene), device)
        inputs = [arrays[name] for name in ("params", "rays", "ray_scene")]
        extent = GrowingRows(arrays["object_rows"])
        return [over_rows(self.height, trace_pixels, config, *inputs, find_visible(arrays), extent=extent)]
