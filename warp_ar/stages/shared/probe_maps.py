"""The maps that unwrapping a mirror ball gives: their names, and as stages hand them to their kernels."""

from __future__ import annotations

from warp_ar.kernels.structs import EnvironmentView, make_environment_view
from warp_ar.stages.base import Arrays

UNWRAPPED = ("radiance", "confidence", "clipped")
"""Parts of what unwrapping a frame gives; arrays are named ``probe_*``, those of all exposures ``bracket_*``."""


def find_view(arrays: Arrays, name: str) -> EnvironmentView:
    """The maps ``NAME_radiance``, ``NAME_confidence`` and ``NAME_clipped``."""
    return make_environment_view(*(arrays[f"{name}_{part}"] for part in UNWRAPPED))
