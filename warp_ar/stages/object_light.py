"""What surrounds virtual objects at close range."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels import object_light
from warp_ar.scene import Material, MetallicRoughnessMaterial, PhongMaterial
from warp_ar.scene.ray_scene import reflects_glossily
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Pass, Request, Rows, Stage, Wiring
from warp_ar.stages.composite import layer_names
from warp_ar.stages.reflect import distant_light_arrays, distant_light_config, distant_light_reads, make_distant_light
from warp_ar.stages.shade import near_names, sees_near
from warp_ar.stages.variants import distant_variant

SIDE = 4
"""Pixels along a tile."""
COUNT = 32
"""Samples of the environment per pixel."""
LOBE_COUNT = 4
"""Rays per pixel into a glossy lobe."""
MIRROR_SAMPLES = 4
"""Rays per pixel of a mirror."""


def lobe_width(material: Material) -> float:
    """Width alpha of what a material mirrors, as ``kernels.object_light`` has it."""
    match material:
        case MetallicRoughnessMaterial():
            return material.roughness**2
        case PhongMaterial():
            return 1.0 / math.sqrt(max(material.shininess, 1.0))
    return 0.0


class ObjectLight(Stage):
    """Light that reaches objects past each other, and what they mirror of the desk and of each other."""

    name: ClassVar[str] = "object_light"
    methods: ClassVar[tuple[str, ...]] = ("default",)
    summary: ClassVar[str] = "what of the desk and of other objects virtual objects show"

    @classmethod
    def wire(cls, request: Request) -> Wiring | LeftOut:
        """Needs objects, an environment that lights them, and a quality that asks for it."""
        if not request.scene.objects:
            return LeftOut("the scene has no virtual object")
        if not request.scene.probes:
            return LeftOut("the scene has no probe, so the environment is unknown")
        if not sees_near(request):
            return LeftOut(f"the quality {request.quality.name!r} reflects the environment only")
        config = distant_light_config(request)
        reads = ["frame", "pose", "objects", "hit_object", "hits", *distant_light_reads(config)]
        if config.diffuse != "none":
            reads.append("environment_samples")
        reads += [name for name in layer_names(request) if name not in ("virtual", "mirrored")]
        return Wiring(tuple(reads), near_names(config))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """Irradiance and what is mirrored, before and after averaging."""
        width, height = self.request.size
        config = distant_light_config(self.request)
        specs = {}
        if config.diffuse != "none":
            specs["object_irradiance"] = specs["object_light_irradiance"] = ArraySpec((height, width), wp.vec3)
        if config.specular:
            specs["object_light_passed"] = ArraySpec((height, width), wp.vec4)
            specs["object_mirrored"] = specs["object_light_mirrored"] = ArraySpec((height, width), wp.vec4)
        return {**specs, **distant_light_arrays(config, self.name)}

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """Estimates, then their mean."""
        layers = layer_names(self.request)
        forms = distant_light_config(self.request)
        widths = [lobe_width(item.material) for item in self.request.scene.objects if reflects_glossily(item.material)]
        sharp = [width < object_light.SHARP_ALPHA for width in widths]
        # The forms themselves stay the scene's: they are what the kernel writes.
        variant = distant_variant(forms, self.request, device)
        config = object_light.ObjectLightConfig(
            dataclasses.replace(variant, diffuse=forms.diffuse, specular=forms.specular),
            COUNT,
            0 if all(sharp) else LOBE_COUNT,
            MIRROR_SAMPLES if any(sharp) else 0,
            SIDE,
            "shadow_ratio" in layers,
            "physical_added" in layers,
        )
        object_light.make_object_light_kernel(config)
        object_light.make_filter_kernel(config)
        distant = make_distant_light(forms, self.request, arrays, self.name)
        inputs = [arrays[name] for name in ("params", "rays", "frame", "decode")]
        inputs += [arrays.get("shadow_ratio"), arrays.get("physical_added"), arrays["ray_scene"], distant]
        inputs += [
            arrays["environment_samples"] if forms.diffuse != "none" else None,
            arrays["hit_object"],
            arrays["hits"],
        ]
        raw = [arrays.get(f"object_light_{name}") for name in ("irradiance", "mirrored", "passed")]
        out = arrays.get("object_irradiance"), arrays.get("object_mirrored")

        def estimate(rows: Rows | None) -> None:
            object_light.light_objects(config, *inputs, *raw, rows=rows)

        def average(rows: Rows | None) -> None:
            object_light.filter_object_light(
                config,
                arrays["params"],
                arrays["ray_scene"],
                arrays["hit_object"],
                arrays["hits"],
                *raw,
                *out,
                rows=rows,
            )

        height = self.request.size[1]
        extent = arrays["object_rows"]
        return [Pass(estimate, rows=height, extent=extent), Pass(average, rows=height, extent=extent)]
