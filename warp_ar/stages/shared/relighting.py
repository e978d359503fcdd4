"""What relighting is compiled for and reads, in the picture and in what mirror balls show of the receiver."""

from __future__ import annotations

from warp_ar.kernels.receiver.receiver import RelightConfig
from warp_ar.scene.kinds import trace_config
from warp_ar.stages.features import LOCAL, MEASURED, Features
from warp_ar.stages.shared.picture import frame_reads


def relight_reads(features: Features) -> tuple[str, ...]:
    """What the method of ``relight`` needs to know of the environment and the receiver."""
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
    """What the relighting of a request's receiver calls for."""
    method = features.relight_method
    return RelightConfig(
        "reflectance" if method in LOCAL else method,
        trace_config(features.request.scene),
        "sh" if features.irradiance == "irradiance_sh" else "map",
        bool(features.request.scene.probes),
        features.soft_lights,
        method in MEASURED and features.emitters,
        features.ambient_visibility,
        features.bounced,
        features.request.quality.edge_samples,
        several=method in MEASURED and features.others > 0,
        area_samples=features.area_samples,
    )
