"""Names of the maps that are unwrapped from mirror balls, and the maps as kernels read them."""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.structs import EnvironmentView, make_environment_view
from warp_ar.stages.base import Arrays, ArraySpec
from warp_ar.stages.features import Features

UNWRAPPED = ("radiance", "confidence", "clipped")
"""Parts of an unwrapped frame; their arrays are named ``probe_*``, and ``bracket_*`` for all exposures."""


OTHERS, KEPT = "others", "others_kept"
"""Prefixes of the maps of the balls after the first: of one frame, and accumulated over frames."""


def find_view(arrays: Arrays, name: str) -> EnvironmentView:
    """Return the maps ``NAME_radiance``, ``NAME_confidence`` and ``NAME_clipped``."""
    return make_environment_view(*(arrays[f"{name}_{part}"] for part in UNWRAPPED))


def other_views(features: Features, arrays: Arrays, name: str) -> list[EnvironmentView]:
    """Return the ``EnvironmentView`` of each ball after the first; none if light is not interpolated between balls."""
    maps = [arrays[f"{name}_{part}"] for part in UNWRAPPED] if features.others else []
    return [make_environment_view(*(one[ball] for one in maps)) for ball in range(features.others)]


def other_names(features: Features, name: str) -> tuple[str, ...]:
    """Return the names of the maps of the balls after the first."""
    return tuple(f"{name}_{part}" for part in UNWRAPPED) if features.others else ()


def other_maps(features: Features, name: str, shape: tuple[int, int]) -> dict[str, ArraySpec]:
    """Return the arrays of the maps of the balls after the first, (P - 1, h, w)."""
    types = wp.vec3, wp.float32, wp.vec3
    names = other_names(features, name)
    return {each: ArraySpec((features.others, *shape), dtype) for each, dtype in zip(names, types, strict=False)}
