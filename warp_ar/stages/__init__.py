"""The stages, in the order in which they may run.

They are imported when ``STAGES`` is first asked for: presets and words of this layer can be read without loading Warp.
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
    "composite.Composite",
    "declip.Declip",
    "expose.Expose",
    "separate.Separate",
    "surfaces.Surfaces",
    "coverage.Coverage",
    "motion.Motion",
)
"""Module and class of every stage: a new one is registered here."""

STAGES: tuple[type[Stage], ...]
"""Every stage's class."""


def __getattr__(name: str) -> Any:
    if name != "STAGES":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    stages = tuple(
        getattr(importlib.import_module(f"{__name__}.{module}"), kind)
        for module, kind in (entry.split(".") for entry in _ORDER)
    )
    globals()["STAGES"] = stages
    return stages
