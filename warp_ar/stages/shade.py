"""Virtual objects lit by the environment and by virtual lights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels.launch import takes_few_blocks
from warp_ar.kernels.objects.near_field import NearLight
from warp_ar.kernels.objects.shade import (
    make_object_light,
    shade,
)
from warp_ar.stages.base import (
    NO_OBJECT,
    OUT_OF_PICTURE,
    Arrays,
    ArraySpec,
    LeftOut,
    Numerics,
    Pass,
    Reach,
    Rows,
    Stage,
    Wiring,
    clearing,
)
from warp_ar.stages.features import Features
from warp_ar.stages.shared.edge_lists import edge_arrays, make_edge_lists
from warp_ar.stages.shared.lighting import (
    distant_light_arrays,
    distant_light_reads,
    make_distant_light,
    shade_config,
    shade_variant,
)
from warp_ar.stages.shared.picture import GrowingRows, find_visible


class Shade(Stage):
    """Radiance and coverage of virtual objects, with smooth edges."""

    name: ClassVar[str] = "shade"
    methods: ClassVar[Mapping[str, str]] = {
        "environment": "the environment (the paper)",
        "few_rays": "the environment, the receiver, themselves and each other, by few rays",
        "one_bounce": "the environment, the receiver and each other",
    }
    summary: ClassVar[str] = "shades virtual objects by the environment and virtual lights, shadowed and anti-aliased"
    subject: ClassVar[str] = "what virtual objects reflect"
    settings: ClassVar[tuple[str, ...]] = (
        "edge_samples",
        "light_shadow",
        "area_light",
    )
    unseen_method: ClassVar[str | None] = "environment"
    numerics: ClassVar[Numerics] = Numerics(
        precision="float32; log1p for exponents, cross products for peaks",
        bound=1e-4,
        cause="1e-7 of an angle, to the power of 1e5",
        measured=4.1e-07,
        rows=(5, 6, 8, 9, 13, 14, 17, 18),
    )

    @classmethod
    def wire(cls, features: Features) -> Wiring | LeftOut:
        """Reads only the forms of light that its materials reflect."""
        if not features.request.scene.objects:
            return LeftOut(NO_OBJECT)
        config = shade_config(features)
        reads = ["pose", "objects", "hit_object", "hits"]
        if config.lights:
            reads.append("lights")
        reads += distant_light_reads(features)
        if config.near_field:
            reads += features.near_names
        return Wiring(tuple(reads), ("virtual",))

    def idle(self, reach: Reach) -> str | None:
        """Without an object in the picture nothing is covered."""
        return None if reach.objects else OUT_OF_PICTURE

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The shaded objects, lists of edges and, for metallic-roughness, the table of its reflectance."""
        width, height = self.request.size
        return {
            "virtual": ArraySpec((height, width), wp.vec4),
            **edge_arrays(self.request, self.name),
            **distant_light_arrays(self.features, self.name),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """One pass over the rows where objects are or were."""
        config = shade_config(self.features)
        variant = shade_variant(config, self.features, device)
        lists = make_edge_lists(arrays, device, self.name)
        near = NearLight()
        for name in self.features.near_names if config.near_field else ():
            setattr(near, name.removeprefix("near_"), arrays[name])
        distant = make_distant_light(self.features, arrays, self.name)
        light = make_object_light(distant, arrays["light_array"] if config.lights else None, near)
        inputs = arrays["params"], arrays["rays"], arrays["ray_scene"], light, find_visible(arrays)

        cleared = lists is not None and takes_few_blocks(arrays["virtual"].shape, device)

        def launch(rows: Rows | None) -> None:
            shade(variant, *inputs, arrays["virtual"], edge_lists=lists, cleared=cleared, rows=rows)

        first = [clearing(arrays["virtual"])] if cleared else []
        return [*first, Pass(launch, rows=self.request.size[1], extent=GrowingRows(arrays["object_rows"]))]
