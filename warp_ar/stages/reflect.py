"""The environment as stages hand it to their kernels: which of its forms a request's objects reflect, and where."""

from __future__ import annotations

from collections.abc import Mapping

import warp as wp

from warp_ar.kernels.prefilter import integrate_dfg
from warp_ar.kernels.reflect import DiffuseForm, DistantLight, DistantLightConfig
from warp_ar.kernels.structs import METALLIC_ROUGHNESS
from warp_ar.scene.ray_scene import has_textures, material_model, reflects_diffusely, reflects_glossily, trace_config
from warp_ar.stages.base import Arrays, ArraySpec, Request
from warp_ar.stages.recover import knows_emitters

# Roughness by cosine; bilinear between them, the table stays within 1e-3 of the integral.
DFG_SIZE = 32


def distant_light_config(request: Request) -> DistantLightConfig:
    """Forms of the environment that exist for the objects of a request."""
    scene = request.scene
    materials = [item.material for item in scene.objects]
    diffuse: DiffuseForm = "none"
    if scene.probes and any(map(reflects_diffusely, materials)):
        diffuse = "sh" if request.quality.method("irradiance") == "sh2" else "map"
    return DistantLightConfig(
        trace=trace_config(scene),
        models=tuple(sorted(set(map(material_model, materials)))),
        textures=has_textures(scene),
        diffuse=diffuse,
        specular=bool(scene.probes) and any(map(reflects_glossily, materials)),
        probes=bool(scene.probes),
        lamps=knows_emitters(request),
    )


def distant_light_reads(config: DistantLightConfig) -> tuple[str, ...]:
    """Resources that hold the forms of a ``DistantLightConfig``."""
    diffuse = () if config.diffuse == "none" else (f"irradiance_{config.diffuse}",)
    specular = ("prefilter_levels",) if config.specular else ()
    return (*diffuse, *specular, *(("lamps",) if config.lamps and (diffuse or specular) else ()))


def distant_light_arrays(config: DistantLightConfig, stage: str) -> Mapping[str, ArraySpec]:
    """What a stage owns for ``make_distant_light``: for metallic-roughness, the table of its reflectance."""
    return {f"{stage}_dfg": ArraySpec((DFG_SIZE, DFG_SIZE), wp.vec2)} if METALLIC_ROUGHNESS in config.models else {}


def make_distant_light(config: DistantLightConfig, request: Request, arrays: Arrays, stage: str) -> DistantLight:
    """The environment as kernels of a stage with ``distant_light_arrays`` read it; the table is made here, once."""
    distant = DistantLight()
    if config.diffuse == "sh":
        distant.irradiance_sh = arrays["irradiance_sh"]
    if config.diffuse == "map":
        distant.irradiance_map = arrays["irradiance_map"]
    if config.specular:
        distant.levels = arrays["prefilter_levels"]
    distant.level_height = request.quality.environment_height
    if METALLIC_ROUGHNESS in config.models:
        table = arrays[f"{stage}_dfg"]
        integrate_dfg(table)
        distant.dfg = table
    distant.probes = arrays["probes"]
    if config.lamps:
        distant.lamps = arrays["lamps"]
    return distant
