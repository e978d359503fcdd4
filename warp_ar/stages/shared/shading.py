"""What the shading of objects is compiled for, in the picture and in what mirror balls show."""

from __future__ import annotations

import dataclasses

from warp_ar.kernels.objects.shade import ShadeConfig
from warp_ar.scene.kinds import light_kind
from warp_ar.stages.features import Features


def shade_config(features: Features) -> ShadeConfig:
    """What the shading of a request's objects calls for."""
    return ShadeConfig(
        distant=features.distant,
        lights=tuple(sorted({light_kind(light) for light in features.request.scene.lights})),
        edge_samples=features.request.quality.edge_samples,
        soft=features.soft_lights,
        near_field=bool(features.near_field),
        area_samples=features.area_samples,
    )


def mirrored_shading(features: Features) -> ShadeConfig:
    """The same in what balls and receivers mirror: without what surrounds the objects at close range."""
    return dataclasses.replace(shade_config(features), near_field=False, edge_samples=1)
