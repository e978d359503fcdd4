"""The environment as stages hand it to their kernels: which of its forms a request's objects reflect, and where."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import warp as wp

from warp_ar.kernels.environment.interpolated_irradiance import OtherBalls
from warp_ar.kernels.objects.reflect import DistantLight
from warp_ar.kernels.split_sum import integrate_dfg
from warp_ar.kernels.structs import METALLIC_ROUGHNESS
from warp_ar.stages.base import Arrays, ArraySpec
from warp_ar.stages.features import Features

# Roughness by cosine; bilinear between them, the table stays within 1e-3 of the integral.
DFG_SIZE = 32


def distant_light_reads(features: Features) -> tuple[str, ...]:
    """Resources that hold the forms of the environment that objects reflect."""
    config = features.distant
    diffuse = () if config.diffuse == "none" else (f"irradiance_{config.diffuse}",)
    specular = ("prefilter_levels",) if config.specular else ()
    placed = config.emitters and bool(diffuse or specular)
    return (*diffuse, *specular, *(("emitters",) if placed else ()), *_other_reads(features))


def _other_reads(features: Features) -> tuple[str, ...]:
    """The same of the balls after the first, and the places of all."""
    config = features.distant
    if not config.several or (config.diffuse == "none" and not config.specular):
        return ()
    diffuse = () if config.diffuse == "none" else ("others_irradiance",)
    specular = ("others_levels",) if config.specular else ()
    return (*diffuse, *specular, *(("others_emitters",) if config.emitters else ()), "probe_places")


def distant_light_arrays(features: Features, stage: str) -> Mapping[str, ArraySpec]:
    """What a stage owns for ``make_distant_light``: for metallic-roughness, the table of its reflectance."""
    return (
        {f"{stage}_dfg": ArraySpec((DFG_SIZE, DFG_SIZE), wp.vec2)}
        if METALLIC_ROUGHNESS in features.distant.models
        else {}
    )


def make_distant_light(features: Features, arrays: Arrays, stage: str) -> DistantLight:
    """The environment as kernels of a stage with ``distant_light_arrays`` read it; the table is made here, once."""
    config = features.distant
    distant = DistantLight()
    if config.diffuse == "sh":
        distant.irradiance_sh = arrays["irradiance_sh"]
    if config.diffuse == "map":
        distant.irradiance_map = arrays["irradiance_map"]
    if config.specular:
        distant.levels = arrays["prefilter_levels"]
    distant.level_height = features.request.quality.environment_height
    if METALLIC_ROUGHNESS in config.models:
        table = arrays[f"{stage}_dfg"]
        integrate_dfg(table)
        distant.dfg = table
    distant.probes = arrays["probes"]
    if config.emitters:
        distant.emitters = arrays["emitters"]
    if names := _other_reads(features):
        distant.others = make_other_balls(features, arrays, names)
    return distant


def make_other_balls(features: Features, arrays: Arrays, names: Iterable[str]) -> OtherBalls:
    """The light at the balls after the first, as far as these resources hold it."""
    fields = {
        "probe_places": "places",
        "others_irradiance": features.irradiance,
        "others_levels": "levels",
        "others_environment": "environment",
        "others_emitters": "emitters",
    }
    others = OtherBalls()
    for name in names:
        if name in fields:
            setattr(others, fields[name], arrays[name])
    return others
