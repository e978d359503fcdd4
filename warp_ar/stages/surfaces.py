"""Stage ``surfaces``: the modelled surface that each pixel shows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.rays.visibility import VisibleObjects
from warp_ar.kernels.receiver.surfaces import Surfaces as SurfaceMaps
from warp_ar.kernels.receiver.surfaces import trace_surfaces
from warp_ar.kernels.structs import filled
from warp_ar.scene.kinds import trace_config
from warp_ar.stages.base import NOT_ASKED, Arrays, ArraySpec, LeftOut, Numerics, Pass, Stage, Wiring, over_rows
from warp_ar.stages.features import Features
from warp_ar.stages.shared.lighting import trace_variant
from warp_ar.stages.shared.picture import find_visible


class Surfaces(Stage):
    """Finds id, depth, normal and position of the surface at every pixel's centre."""

    name: ClassVar[str] = "surfaces"
    summary: ClassVar[str] = "depth, normal and position of each pixel's object, proxy or ball"
    unread: ClassVar[str] = NOT_ASKED
    numerics: ClassVar[Numerics] = Numerics(
        "float32; points put back onto their surfaces", 3e-5, "twenty roundings at a grazing angle of 3 degrees"
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written; the graph leaves the stage out if none of its outputs is requested."""
        hits = ("hit_object", "hits") if features.request.scene.objects else ()
        return Wiring(("pose", "objects", *hits), ("surface_ids", "depth", "normals", "position"))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of index, depth, normal and position of one surface per pixel."""
        return {
            "surface_ids": ArraySpec(self.shape, wp.int32, -1),
            "depth": ArraySpec(self.shape, wp.float32),
            "normals": ArraySpec(self.shape, wp.vec3),
            "position": ArraySpec(self.shape, wp.vec3),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return one pass over all pixels."""
        config = trace_variant(trace_config(self.request.scene), device)
        inputs = tuple(arrays[name] for name in ("params", "rays", "ray_scene", "probes"))
        visible = find_visible(arrays) if "hits" in self.wiring.reads else VisibleObjects()
        names = {"index": "surface_ids", "depth": "depth", "normal": "normals", "position": "position"}
        out = filled(SurfaceMaps(), **{field: arrays[name] for field, name in names.items()})
        return [over_rows(self.height, trace_surfaces, config, *inputs, visible, out)]
