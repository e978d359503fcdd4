"""Which variant of a kernel a stage compiles: what its scene calls for, or one that every scene shares.

A kernel that holds nothing but what its scene needs is faster, and is compiled anew for each combination of shapes,
materials and lights. On CPU the general one costs a frame a few hundredths more, for it asks a shape for its kind where
it walks memory anyway; there only what a whole stage does without is left out, and kernels call one walk through the
scene instead of holding it. On CUDA code that is never reached still takes registers from what is.
"""

from __future__ import annotations

import os
from typing import Any, Final

from warp_ar.errors import UsageError
from warp_ar.kernels.objects.reflect import DiffuseForm, DistantLightConfig
from warp_ar.kernels.objects.shade import ShadeConfig
from warp_ar.kernels.rays.trace import TraceConfig
from warp_ar.kernels.receiver.receiver import RelightConfig
from warp_ar.stages.features import Features

VARIABLE: Final = "WARP_AR_KERNELS"
"""Environment variable that decides for all devices: ``shared`` or ``specialised``. It is there for measuring."""


def shares_kernels(device: Any) -> bool:
    """Whether kernels on ``device`` are those of any scene.

    Raises:
        UsageError: The environment variable has another value.
    """
    asked = os.environ.get(VARIABLE, "")
    if asked not in ("", "shared", "specialised"):
        raise UsageError(f"{VARIABLE} = {asked!r}: expected shared or specialised")
    return asked == "shared" if asked else bool(device.is_cpu)


def trace_variant(config: TraceConfig, device: Any) -> TraceConfig:
    """Kinds of shape to compile in."""
    return config.general(by_call=device.is_cpu) if shares_kernels(device) else config


def distant_variant(features: Features, device: Any) -> DistantLightConfig:
    """Shapes, materials and forms of light to compile in."""
    if not shares_kernels(device):
        return features.distant
    return features.distant.general(_form(features), by_call=device.is_cpu)


def shade_variant(config: ShadeConfig, features: Features, device: Any) -> ShadeConfig:
    """As ``distant_variant``, and kinds of virtual light."""
    if not shares_kernels(device):
        return config
    return config.general(_form(features), soft=_asks_soft(features), by_call=device.is_cpu)


def relight_variant(config: RelightConfig, features: Features, device: Any) -> RelightConfig:
    """Shapes and shadows to compile in."""
    if not shares_kernels(device):
        return config
    return config.general(soft=_asks_soft(features), by_call=device.is_cpu)


def _form(features: Features) -> DiffuseForm:
    return "sh" if features.irradiance == "irradiance_sh" else "map"


def _asks_soft(features: Features) -> bool:
    return features.request.quality.method("light_shadow") == "soft"
