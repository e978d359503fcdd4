"""The stages, in the order in which they may run.

They are imported when ``STAGES`` is first read, so that presets and descriptions of this layer are available without
Warp.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from warp_ar.stages.base import Stage

_ORDER = (
    "captured.Captured",
    "sphere_map.SphereMap",
    "unwrap.Unwrap",
    "bracket.Bracket",
    "accumulate.Accumulate",
    "fill.Fill",
    "recover.Recover",
    "key_lights.KeyLights",
    "irradiance.Irradiance",
    "prefilter.Prefilter",
    "visibility.Visibility",
    "summed_area.SummedArea",
    "environment_samples.EnvironmentSamples",
    "relight.Relight",
    "environment_shadow.EnvironmentShadow",
    "near_field.NearField",
    "shade.Shade",
    "mirror_ball.MirrorBall",
    "gloss.Gloss",
    "composite.Composite",
    "declip.Declip",
    "expose.Expose",
    "separate.Separate",
    "surfaces.Surfaces",
    "coverage.Coverage",
    "motion.Motion",
)
"""Module and class of every stage; new stages are registered here."""

STAGES: tuple[type[Stage], ...]
"""Classes of all stages."""


def __getattr__(name: str) -> Any:
    if name != "STAGES":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    stages = tuple(
        getattr(importlib.import_module(f"{__name__}.{module}"), kind)
        for module, kind in (entry.split(".") for entry in _ORDER)
    )
    globals()["STAGES"] = stages
    return stages
