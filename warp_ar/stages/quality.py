"""Methods and presets: how accurately each stage works, as one frozen value."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType

from warp_ar.declared import check_fields
from warp_ar.errors import UsageError


@dataclasses.dataclass(frozen=True)
class Quality:
    """Method of every stage, and the sizes of maps and samples. Equal values share plans and compiled kernels."""

    name: str
    """Name of the preset, or ``custom``."""
    methods: tuple[tuple[str, str], ...]
    """Pairs (stage, method), sorted by stage; a stage with only one method need not be named."""
    environment_height: int
    """Rows of the latlong environment; it has twice as many columns."""
    edge_samples: int
    """Samples per pixel along the edges of virtual objects; a square number."""

    def __post_init__(self) -> None:
        """Check all values.

        Raises:
            UsageError: A value has another type, or a size is impossible. A pipeline checks the names of methods.
        """
        check_fields(self)
        if not 1 <= self.environment_height <= 4096:
            raise UsageError(f"Quality: environment_height = {self.environment_height}: expected 1 to 4096 rows")
        if not 1 <= self.edge_samples <= 4096 or math.isqrt(self.edge_samples) ** 2 != self.edge_samples:
            raise UsageError(f"Quality: edge_samples = {self.edge_samples}: expected a square number, such as 4")

    def method(self, stage: str) -> str:
        """Return the method of ``stage``; ``default`` if the stage is not named."""
        return dict(self.methods).get(stage, "default")

    def with_methods(self, **methods: str) -> Quality:
        """Return this quality with other methods for the named stages."""
        merged = {**dict(self.methods), **methods}
        return dataclasses.replace(self, name="custom", methods=tuple(sorted(merged.items())))


_NAMES = ("paper", "low", "medium", "high", "reference")
_HEIGHTS, _EDGE_SAMPLES = (64, 64, 64, 128, 256), (1, 1, 4, 4, 16)
_METHODS: Mapping[str, tuple[str, str, str, str, str]] = {
    "unwrap": ("sphere_map", "", "", "", ""),
    "irradiance": ("sphere_mip", "clusters", "clusters", "clusters", "brute_force"),
    "prefilter": ("sphere_mip", "energy_mip", "energy_mip", "energy_mip", "fis128"),
    "light_shadow": ("hard", "hard", "soft", "soft", "soft"),
    "area_light": ("point", "point", "coarse", "fine", "brute_force"),
    "relight": ("paper", "reflectance", "reflectance", "bounce", "brute_force"),
    "recover": ("clipped", "shading", "shading", "shading", "shading"),
    "environment_shadow": ("none", "coarse", "coarse", "bounce", "brute_force"),
    "expose": ("paper", "ball", "ball", "ball", "ball"),
    "mirror_ball": ("none", "none", "single", "smooth", "brute_force"),
    "shade": ("environment", "environment", "few_rays", "one_bounce", "one_bounce"),
}
"""Method of each stage by preset; empty: the stage's default."""


def _preset(index: int) -> Quality:
    methods = tuple(sorted((stage, names[index]) for stage, names in _METHODS.items() if names[index]))
    return Quality(_NAMES[index], methods, _HEIGHTS[index], _EDGE_SAMPLES[index])


PRESETS: Mapping[str, Quality] = MappingProxyType({name: _preset(index) for index, name in enumerate(_NAMES)})
DEFAULT_PRESET = "medium"
AUTO = "auto"
"""Name of the quality that adapts its methods to a time budget."""
DEFAULT_BUDGET_MS = 33.0
"""Default budget in milliseconds per frame: thirty frames per second."""
BUDGETS: Mapping[str, float] = MappingProxyType({"low": 1e3 / 30.0, "medium": 50.0, "high": 250.0})
"""Milliseconds that a preset may take for a whole frame of a bundled scene, 640x480 on two CPU cores; docs/accuracy.md
marks those that take more. Two presets have no budget: ``paper`` is the paper's method, and ``reference`` the most
accurate methods that finish in practical time."""
