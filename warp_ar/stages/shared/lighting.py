"""Environment light as kernels read it, and the kernel variants that stages compile."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import warp as wp

from warp_ar.kernels.environment.interpolated_irradiance import OtherBalls
from warp_ar.kernels.objects.reflect import DiffuseForm, DistantLight, DistantLightConfig
from warp_ar.kernels.objects.shade import ShadeConfig
from warp_ar.kernels.rays.trace import TraceConfig
from warp_ar.kernels.receiver.receiver import Receiver, ReceiverCells, RelightConfig, make_receiver
from warp_ar.kernels.split_sum import integrate_dfg
from warp_ar.kernels.structs import METALLIC_ROUGHNESS, filled
from warp_ar.scene.kinds import light_kind, trace_config
from warp_ar.stages.base import Arrays
from warp_ar.stages.features import LOCAL, MEASURED, Features
from warp_ar.stages.shared.picture import find_picture, frame_reads


def shares_kernels(device: Any) -> bool:
    """Return True if one compiled kernel serves all scenes: on CPU, where compiling special kernels costs too much."""
    return bool(device.is_cpu)


def trace_variant(config: TraceConfig, device: Any) -> TraceConfig:
    """Return the key of the compiled kernel: the scene's kinds of shape or, on CPU, all kinds."""
    return config.general() if shares_kernels(device) else config


def distant_variant(features: Features, device: Any) -> DistantLightConfig:
    """Return the key of the compiled kernel: shapes, materials and forms of the environment; on CPU, for any scene."""
    if not shares_kernels(device):
        return features.distant
    return features.distant.general(_form(features))


def shade_variant(config: ShadeConfig, features: Features, device: Any) -> ShadeConfig:
    """Return the key of the compiled kernel: ``config`` or, on CPU, that of any scene with all kinds of light."""
    if not shares_kernels(device):
        return config
    return config.general(_form(features), soft=_asks_soft(features))


def relight_variant(config: RelightConfig, features: Features, device: Any) -> RelightConfig:
    """Return the key of the compiled kernel: ``config`` or, on CPU, that of any kinds of shape."""
    if not shares_kernels(device):
        return config
    return config.general(soft=_asks_soft(features))


def _form(features: Features) -> DiffuseForm:
    return "sh" if features.irradiance == "irradiance_sh" else "map"


def _asks_soft(features: Features) -> bool:
    return features.request.quality.method("light_shadow") == "soft"


# Roughness by cosine. With bilinear interpolation the table is within 1e-3 of the integral.
DFG_SIZE = 32


def distant_light_reads(features: Features) -> tuple[str, ...]:
    """Return the resources with the forms of the environment that objects reflect."""
    config = features.distant
    diffuse = () if config.diffuse == "none" else (f"irradiance_{config.diffuse}",)
    specular = ("prefilter_levels",) if config.specular else ()
    placed = config.emitters and bool(diffuse or specular)
    return (*diffuse, *specular, *(("emitters",) if placed else ()), *_other_reads(features))


def _other_reads(features: Features) -> tuple[str, ...]:
    """Return the resources of the environment at the balls after the first, and of all balls' positions."""
    config = features.distant
    if not config.several or (config.diffuse == "none" and not config.specular):
        return ()
    diffuse = () if config.diffuse == "none" else ("others_irradiance",)
    specular = ("others_levels",) if config.specular else ()
    return (*diffuse, *specular, *(("others_emitters",) if config.emitters else ()), "probe_places")


def _make_dfg() -> Any:
    """Return the table of directional albedo for metallic-roughness materials, on the current device."""
    table = wp.empty((DFG_SIZE, DFG_SIZE), dtype=wp.vec2)
    integrate_dfg(table)
    return table


def make_distant_light(features: Features, arrays: Arrays) -> DistantLight:
    """Return the ``DistantLight`` of the arrays that hold the environment."""
    config, names = features.distant, _other_reads(features)
    form = f"irradiance_{config.diffuse}"
    return filled(
        DistantLight(),
        levels=arrays["prefilter_levels"] if config.specular else None,
        level_height=features.request.quality.environment_height,
        dfg=arrays.constant("dfg", _make_dfg) if METALLIC_ROUGHNESS in config.models else None,
        probes=arrays["probes"],
        emitters=arrays["emitters"] if config.emitters else None,
        others=make_other_balls(features, arrays, names) if names else None,
        **({} if config.diffuse == "none" else {form: arrays[form]}),
    )


def make_other_balls(features: Features, arrays: Arrays, names: Iterable[str]) -> OtherBalls:
    """Return the light at the balls after the first, from the named resources."""
    fields = {
        "probe_places": "places",
        "others_irradiance": features.irradiance,
        "others_levels": "levels",
        "others_environment": "environment",
        "others_emitters": "emitters",
    }
    return filled(OtherBalls(), **{fields[name]: arrays[name] for name in names if name in fields})


def find_receiver(
    config: RelightConfig, features: Features, arrays: Arrays, reads: Sequence[str], cells: ReceiverCells | None = None
) -> Receiver:
    """Return the ``Receiver`` of the arrays named in ``reads``, the resources that the stage reads."""
    names = {"key_lights": "key_lights", "irradiance": features.irradiance, "emitters": "emitters"}
    known = {word: arrays[name] for word, name in names.items() if name in reads}
    others = make_other_balls(features, arrays, reads)
    return make_receiver(config, find_picture(arrays), probes=arrays["probes"], others=others, cells=cells, **known)


def shade_config(features: Features) -> ShadeConfig:
    """Return the compile-time configuration for shading a request's objects: their materials and lights."""
    return ShadeConfig(
        distant=features.distant,
        lights=tuple(sorted({light_kind(light) for light in features.request.scene.lights})),
        edge_samples=features.request.quality.edge_samples,
        soft=features.soft_lights,
        near_field=bool(features.near_field),
        area_samples=features.area_samples,
    )


def mirrored_shading(features: Features) -> ShadeConfig:
    """Return the shading configuration of objects in reflections: without the near field."""
    return dataclasses.replace(shade_config(features), near_field=False, edge_samples=1)


def relight_reads(features: Features) -> tuple[str, ...]:
    """Return the resources of the environment and the receiver that the method of ``relight`` reads."""
    method = features.relight_method
    reads = ["pose", "lights", "objects"]
    measured = method in MEASURED
    if method != "flat":
        reads += frame_reads(features) if measured else [*frame_reads(features), "key_lights"]
    if measured:
        reads.append(features.irradiance)
        reads += ["emitters"] * features.emitters
        if features.others:
            reads += ["others_irradiance", "probe_places", *(["others_emitters"] * features.emitters)]
    if features.ambient_visibility:
        reads.append("environment_samples")
    return tuple(reads)


def relight_config(features: Features) -> RelightConfig:
    """Return the compile-time configuration for adding virtual light to a request's receiver."""
    method = features.relight_method
    return RelightConfig(
        "reflectance" if method in LOCAL else method,
        trace_config(features.request.scene),
        "sh" if features.irradiance == "irradiance_sh" else "map",
        features.soft_lights,
        method in MEASURED and features.emitters,
        features.ambient_visibility,
        features.bounced,
        features.request.quality.edge_samples,
        several=method in MEASURED and features.others > 0,
        area_samples=features.area_samples,
        area_cells=features.area_cells,
    )
