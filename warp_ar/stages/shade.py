"""Virtual objects lit by the room and by virtual lights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import warp as wp

from warp_ar.kernels.prefilter import integrate_dfg
from warp_ar.kernels.shade import EdgeLists, RoomDiffuse, ShadeConfig, shade
from warp_ar.kernels.structs import METALLIC_ROUGHNESS
from warp_ar.ray_scene import (
    has_sized_lights,
    has_textures,
    light_kind,
    material_model,
    reflects_diffusely,
    reflects_glossily,
    trace_config,
)
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Pass, Request, Rows, Stage, Wiring
from warp_ar.stages.visibility import GrowingRows

# Roughness by cosine; bilinear between them, the table stays within 1e-3 of the integral.
DFG_SIZE = 32

LISTED_SHARE = 16
"""Edges that can be listed: one pixel in so many."""


def shade_config(request: Request) -> ShadeConfig:
    """What the shading of a request's objects calls for."""
    scene = request.scene
    materials = [thing.material for thing in scene.objects]
    diffuse: RoomDiffuse = "none"
    if scene.probes and any(map(reflects_diffusely, materials)):
        diffuse = "sh" if request.quality.rung("diffuse") == "sh2" else "map"
    return ShadeConfig(
        trace=trace_config(scene),
        models=tuple(sorted(set(map(material_model, materials)))),
        lights=tuple(sorted({light_kind(light) for light in scene.lights})),
        textures=has_textures(scene),
        room_diffuse=diffuse,
        room_specular=bool(scene.probes) and any(map(reflects_glossily, materials)),
        edge_samples=request.quality.edge_samples,
        soft=casts_soft(request),
        near=bool(scene.probes) and sees_near(request),
    )


def casts_soft(request: Request) -> bool:
    """Whether sized virtual lights cast soft shadows: ``light_shadow`` names a way of two stages, hard or soft."""
    return request.quality.rung("light_shadow") == "soft" and has_sized_lights(request.scene)


def sees_near(request: Request) -> bool:
    """Whether the quality asks for what surrounds the objects at close range."""
    return request.quality.rung("shade") == "one_bounce"


def near_names(config: ShadeConfig) -> tuple[tuple[str, bool], ...]:
    """Resources of what surrounds the objects, and whether their materials show them."""
    return ("object_irradiance", config.room_diffuse != "none"), ("object_mirrored", config.room_specular)


def room_light_names(config: ShadeConfig) -> tuple[str, ...]:
    """Resources that hold the forms of the room's light that materials reflect."""
    diffuse = () if config.room_diffuse == "none" else (f"irradiance_{config.room_diffuse}",)
    return (*diffuse, "specular_levels") if config.room_specular else diffuse


class Shade(Stage):
    """Radiance and coverage of virtual objects, with smooth edges."""

    name = "shade"
    rungs = ("environment", "one_bounce")
    summary = "shade virtual objects by the room's light and virtual lights, shadowed and anti-aliased"

    @classmethod
    def wire(cls, request: Request) -> Wiring | LeftOut:
        """Reads only the forms of light that its materials reflect."""
        if not request.scene.objects:
            return LeftOut("the scene has no virtual object")
        config = shade_config(request)
        reads = ["pose", "objects", "hit_object", "hits"]
        if config.lights:
            reads.append("lights")
        reads += room_light_names(config)
        if config.near and (config.room_diffuse != "none" or config.room_specular):
            reads += [name for name, used in near_names(config) if used]
        return Wiring(tuple(reads), ("virtual",))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The shaded objects, lists of edges and, for metallic-roughness, the table of its reflectance."""
        width, height = self.request.size
        edges = width * height // LISTED_SHARE
        specs = {
            "virtual": ArraySpec((height, width), wp.vec4),
            "shade_edge_count": ArraySpec((1,), wp.int32),
            "shade_edges": ArraySpec((edges,), wp.vec2i),
            "shade_edge_samples": ArraySpec((edges * self.request.quality.edge_samples,), wp.vec4),
        }
        if METALLIC_ROUGHNESS in shade_config(self.request).models:
            specs["shade_dfg"] = ArraySpec((DFG_SIZE, DFG_SIZE), wp.vec2)
        return specs

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """One pass over the rows where objects are or were; the table is computed here, once."""
        config = shade_config(self.request)
        lists = None
        if not device.is_cpu:
            lists = EdgeLists(*(arrays[f"shade_{name}"] for name in ("edge_count", "edges", "edge_samples")))
        dfg = arrays.get("shade_dfg")
        if dfg is not None:
            integrate_dfg(dfg)
        inputs = (
            arrays["params"],
            arrays["rays"],
            arrays["ray_scene"],
            arrays["light_array"] if config.lights else None,
            arrays["irradiance_sh"] if config.room_diffuse == "sh" else None,
            arrays["irradiance_map"] if config.room_diffuse == "map" else None,
            arrays["specular_levels"] if config.room_specular else None,
            self.request.quality.environment_height,
            dfg,
            arrays["hit_object"],
            arrays["hits"],
        )

        def launch(rows: Rows | None) -> None:
            shade(
                config,
                *inputs,
                arrays["virtual"],
                near_irradiance=arrays.get("object_irradiance"),
                near_mirrored=arrays.get("object_mirrored"),
                edge_lists=lists,
                rows=rows,
            )

        return [Pass(launch, rows=self.request.size[1], extent=GrowingRows(arrays["object_rows"]))]
