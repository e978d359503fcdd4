"""Virtual objects lit by the environment and by virtual lights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import warp as wp

from warp_ar.kernels.reflect import DistantLightConfig
from warp_ar.kernels.shade import ShadeConfig, shade
from warp_ar.scene.ray_scene import has_sized_lights, light_kind
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Pass, Request, Rows, Stage, Wiring
from warp_ar.stages.edge_lists import edge_arrays, make_edge_lists
from warp_ar.stages.reflect import distant_light_arrays, distant_light_config, distant_light_reads, make_distant_light
from warp_ar.stages.variants import shade_variant
from warp_ar.stages.visibility import GrowingRows


def shade_config(request: Request) -> ShadeConfig:
    """What the shading of a request's objects calls for."""
    scene = request.scene
    return ShadeConfig(
        distant=distant_light_config(request),
        lights=tuple(sorted({light_kind(light) for light in scene.lights})),
        edge_samples=request.quality.edge_samples,
        soft=casts_soft(request),
        near=bool(scene.probes) and sees_near(request),
    )


def casts_soft(request: Request) -> bool:
    """Whether sized virtual lights cast soft shadows: ``light_shadow`` names a way of two stages, hard or soft."""
    return request.quality.method("light_shadow") == "soft" and has_sized_lights(request.scene)


def sees_near(request: Request) -> bool:
    """Whether the quality asks for what surrounds the objects at close range."""
    return request.quality.method("shade") == "one_bounce"


def near_names(config: DistantLightConfig) -> tuple[str, ...]:
    """Resources of what surrounds the objects, those that their materials show."""
    diffuse = () if config.diffuse == "none" else ("object_irradiance",)
    return (*diffuse, "object_mirrored") if config.specular else diffuse


class Shade(Stage):
    """Radiance and coverage of virtual objects, with smooth edges."""

    name = "shade"
    methods = ("environment", "one_bounce")
    summary = "shade virtual objects by the environment and virtual lights, shadowed and anti-aliased"

    @classmethod
    def wire(cls, request: Request) -> Wiring | LeftOut:
        """Reads only the forms of light that its materials reflect."""
        if not request.scene.objects:
            return LeftOut("the scene has no virtual object")
        config = shade_config(request)
        reads = ["pose", "objects", "hit_object", "hits"]
        if config.lights:
            reads.append("lights")
        reads += distant_light_reads(config.distant)
        if config.near:
            reads += near_names(config.distant)
        return Wiring(tuple(reads), ("virtual",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The shaded objects, lists of edges and, for metallic-roughness, the table of its reflectance."""
        width, height = self.request.size
        return {
            "virtual": ArraySpec((height, width), wp.vec4),
            **edge_arrays(self.request, self.name),
            **distant_light_arrays(distant_light_config(self.request), self.name),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """One pass over the rows where objects are or were."""
        config = shade_config(self.request)
        variant = shade_variant(config, self.request, device)
        lists = make_edge_lists(arrays, device, self.name)
        inputs = (
            arrays["params"],
            arrays["rays"],
            arrays["ray_scene"],
            arrays["light_array"] if config.lights else None,
            make_distant_light(config.distant, self.request, arrays, self.name),
            arrays["hit_object"],
            arrays["hits"],
        )

        def launch(rows: Rows | None) -> None:
            shade(
                variant,
                *inputs,
                arrays["virtual"],
                near_irradiance=arrays.get("object_irradiance"),
                near_mirrored=arrays.get("object_mirrored"),
                edge_lists=lists,
                rows=rows,
            )

        return [Pass(launch, rows=self.request.size[1], extent=GrowingRows(arrays["object_rows"]))]
