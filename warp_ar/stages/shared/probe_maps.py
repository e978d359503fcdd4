"""The maps that unwrapping a mirror ball gives: their names, and as stages hand them to their kernels."""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.structs import EnvironmentView, make_environment_view
from warp_ar.stages.base import Arrays, ArraySpec
from warp_ar.stages.features import Features

UNWRAPPED = ("radiance", "confidence", "clipped")
"""Parts of what unwrapping a frame gives; arrays are named ``probe_*``, those of all exposures ``bracket_*``."""


OTHERS, KEPT = "others", "others_kept"
"""Names of the maps of each ball after the first, where there are several: of a frame, and over frames."""


def find_view(arrays: Arrays, name: str) -> EnvironmentView:
    """The maps ``NAME_radiance``, ``NAME_confidence`` and ``NAME_clipped``."""
    return make_environment_view(*(arrays[f"{name}_{part}"] for part in UNWRAPPED))


def other_views(features: Features, arrays: Arrays, name: str) -> list[EnvironmentView]:
    """The same of each ball after the first; none where the light is not interpolated."""
    maps = [arrays[f"{name}_{part}"] for part in UNWRAPPED] if features.others else []
    return [make_environment_view(*(one[ball] for one in maps)) for ball in range(features.others)]


def other_names(features: Features, name: str) -> tuple[str, ...]:
    """Names of those maps."""
    return tuple(f"{name}_{part}" for part in UNWRAPPED) if features.others else ()


def other_maps(features: Features, name: str, shape: tuple[int, int]) -> dict[str, ArraySpec]:
    """Those maps, (P - 1, h, w)."""
    types = wp.vec3, wp.float32, wp.vec3
    names = other_names(features, name)
    return {each: ArraySpec((features.others, *shape), dtype) for each, dtype in zip(names, types, strict=False)}
