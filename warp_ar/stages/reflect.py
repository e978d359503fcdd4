"""The room's light as stages hand it to their kernels: which of its forms a request's objects reflect, and where."""

from __future__ import annotations

from collections.abc import Mapping

import warp as wp

from warp_ar.kernels.prefilter import integrate_dfg
from warp_ar.kernels.reflect import Room, RoomConfig, RoomDiffuse
from warp_ar.kernels.structs import METALLIC_ROUGHNESS
from warp_ar.scene.ray_scene import has_textures, material_model, reflects_diffusely, reflects_glossily, trace_config
from warp_ar.stages.base import Arrays, ArraySpec, Request
from warp_ar.stages.recover import knows_lamps

# Roughness by cosine; bilinear between them, the table stays within 1e-3 of the integral.
DFG_SIZE = 32


def room_config(request: Request) -> RoomConfig:
    """Forms of the room's light that exist for the objects of a request."""
    scene = request.scene
    materials = [thing.material for thing in scene.objects]
    diffuse: RoomDiffuse = "none"
    if scene.probes and any(map(reflects_diffusely, materials)):
        diffuse = "sh" if request.quality.rung("diffuse") == "sh2" else "map"
    return RoomConfig(
        trace=trace_config(scene),
        models=tuple(sorted(set(map(material_model, materials)))),
        textures=has_textures(scene),
        diffuse=diffuse,
        specular=bool(scene.probes) and any(map(reflects_glossily, materials)),
        probes=bool(scene.probes),
        lamps=knows_lamps(request),
    )


def room_reads(config: RoomConfig) -> tuple[str, ...]:
    """Resources that hold the forms of a ``RoomConfig``."""
    diffuse = () if config.diffuse == "none" else (f"irradiance_{config.diffuse}",)
    specular = ("specular_levels",) if config.specular else ()
    return (*diffuse, *specular, *(("lamps",) if config.lamps and (diffuse or specular) else ()))


def room_arrays(config: RoomConfig, stage: str) -> Mapping[str, ArraySpec]:
    """What a stage owns for ``make_room``: for metallic-roughness, the table of its reflectance."""
    return {f"{stage}_dfg": ArraySpec((DFG_SIZE, DFG_SIZE), wp.vec2)} if METALLIC_ROUGHNESS in config.models else {}


def make_room(config: RoomConfig, request: Request, arrays: Arrays, stage: str) -> Room:
    """The room's light as kernels of a stage that owns ``room_arrays`` read it; the table is computed here, once."""
    room = Room()
    if config.diffuse == "sh":
        room.irradiance_sh = arrays["irradiance_sh"]
    if config.diffuse == "map":
        room.irradiance_map = arrays["irradiance_map"]
    if config.specular:
        room.levels = arrays["specular_levels"]
    room.level_height = request.quality.environment_height
    if METALLIC_ROUGHNESS in config.models:
        table = arrays[f"{stage}_dfg"]
        integrate_dfg(table)
        room.dfg = table
    room.probes = arrays["probes"]
    if config.lamps:
        room.lamps = arrays["lamps"]
    return room
