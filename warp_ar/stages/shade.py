"""Stage ``shade``: virtual objects lit by the environment and by virtual lights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.objects.near_field import NearLight
from warp_ar.kernels.objects.shade import make_object_light, shade
from warp_ar.kernels.structs import filled
from warp_ar.stages import base
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Numerics, Pass, Reach, Stage, Wiring, over_rows
from warp_ar.stages.features import Features
from warp_ar.stages.shared.edge_lists import edge_arrays, make_edge_lists
from warp_ar.stages.shared.lighting import distant_light_reads, make_distant_light, shade_config, shade_variant
from warp_ar.stages.shared.picture import GrowingRows, find_visible


class Shade(Stage):
    """Computes radiance and coverage of virtual objects, with antialiased edges."""

    name: ClassVar[str] = "shade"
    methods: ClassVar[Mapping[str, str]] = {
        "environment": "the environment",
        "few_rays": "environment, receiver and objects, by few rays",
        "one_bounce": "environment, receiver and other objects",
    }
    summary: ClassVar[str] = "shades virtual objects by the environment and virtual lights, shadowed and anti-aliased"
    subject: ClassVar[str] = "surroundings that virtual objects reflect"
    settings: ClassVar[tuple[str, ...]] = ("edge_samples", "light_shadow", "area_light")
    unseen_method: ClassVar[str | None] = "environment"
    numerics: ClassVar[Numerics] = Numerics(
        "float32; log1p for exponents, cross products for peaks", 1e-4, "1e-7 of an angle, to the power of 1e5"
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Return the resources read and written, with only the forms of light that the scene's materials reflect."""
        if not features.request.scene.objects:
            return LeftOut(base.NO_OBJECT)
        config = shade_config(features)
        reads = ["pose", "objects", "hit_object", "hits"]
        if config.lights:
            reads.append("lights")
        reads += distant_light_reads(features)
        if config.near_field:
            reads += features.near_names
        return Wiring(tuple(reads), ("virtual",))

    def idle(self, reach: Reach) -> str | None:
        """Return the reason for no effect in a frame if no object is in the picture, else None."""
        return None if reach.objects else base.OUT_OF_PICTURE

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Declare the arrays of the shaded objects and the edge lists."""
        return {
            "virtual": ArraySpec(self.shape, wp.vec4),
            **edge_arrays(self.request, self.name),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Return one pass over the rows in which objects are in this frame or were in the previous one."""
        config = shade_config(self.features)
        variant = shade_variant(config, self.features, device)
        lists = make_edge_lists(arrays, device, self.name)
        names = self.features.near_names if config.near_field else ()
        near = filled(NearLight(), **{name.removeprefix("near_"): arrays[name] for name in names})
        distant = make_distant_light(self.features, arrays)
        light = make_object_light(distant, arrays["light_array"] if config.lights else None, near)
        out, extent = arrays["virtual"], GrowingRows(arrays["object_rows"])
        inputs = arrays["params"], arrays["rays"], arrays["ray_scene"], light, find_visible(arrays)
        return [over_rows(self.height, shade, variant, *inputs, out, edge_lists=lists, extent=extent)]
