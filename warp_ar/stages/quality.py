"""Methods and presets: how accurately each stage works, as one frozen value."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType


@dataclasses.dataclass(frozen=True)
class Quality:
    """The method of every stage and the sizes that go with it. Equal values share plans and compiled kernels."""

    name: str
    """Of the preset, or ``custom``."""
    methods: tuple[tuple[str, str], ...]
    """(stage, method) pairs, sorted by stage; stages that have only one method need not be named."""
    environment_height: int
    """Rows of the latlong environment; it has twice as many columns."""
    edge_samples: int
    """Samples per pixel along the edges of virtual objects; a square number."""

    def method(self, stage: str) -> str:
        """Method of ``stage``; a stage that is not named has its only method, ``default``."""
        return dict(self.methods).get(stage, "default")

    def with_methods(self, **methods: str) -> Quality:
        """The same quality with some stages on other methods."""
        merged = {**dict(self.methods), **methods}
        return dataclasses.replace(self, name="custom", methods=tuple(sorted(merged.items())))


def _preset(name: str, environment_height: int, edge_samples: int, **methods: str) -> Quality:
    return Quality(name, tuple(sorted(methods.items())), environment_height, edge_samples)


PRESETS: Mapping[str, Quality] = MappingProxyType(
    {
        preset.name: preset
        for preset in (
            _preset(
                "paper",
                64,
                1,
                unwrap="sphere_map",
                irradiance="sphere_mip",
                prefilter="sphere_mip",
                light_shadow="hard",
                area_light="point",
                relight="paper",
                recover="clipped",
                environment_shadow="none",
                expose="paper",
                mirror_ball="none",
                shade="environment",
            ),
            _preset(
                "low",
                64,
                1,
                irradiance="clusters",
                prefilter="energy_mip",
                light_shadow="hard",
                area_light="point",
                relight="reflectance",
                recover="shading",
                environment_shadow="coarse6",
                expose="box",
                mirror_ball="none",
                shade="environment",
            ),
            _preset(
                "medium",
                64,
                4,
                irradiance="clusters",
                prefilter="energy_mip",
                light_shadow="soft",
                area_light="coarse",
                relight="reflectance",
                recover="shading",
                environment_shadow="coarse",
                expose="ball",
                mirror_ball="single",
                shade="environment",
            ),
            _preset(
                "high",
                128,
                16,
                irradiance="clusters",
                prefilter="energy_mip",
                light_shadow="soft",
                area_light="fine",
                relight="bounce",
                recover="shading",
                environment_shadow="bounce",
                expose="ball",
                mirror_ball="smooth",
                shade="one_bounce",
            ),
            _preset(
                "reference",
                256,
                16,
                irradiance="brute_force",
                prefilter="fis128",
                light_shadow="soft",
                area_light="brute_force",
                relight="brute_force",
                recover="shading",
                environment_shadow="brute_force",
                expose="ball",
                mirror_ball="brute_force",
                shade="one_bounce",
            ),
        )
    }
)
DEFAULT_PRESET = "medium"
AUTO = "auto"
"""Name of the quality that is chosen to keep to a budget."""
DEFAULT_BUDGET_MS = 33.0
"""Milliseconds per frame of that budget, where none is given: thirty frames per second."""
BUDGETS: Mapping[str, float] = MappingProxyType({"low": 1e3 / 30.0, "medium": 50.0, "high": 250.0})
"""Milliseconds per frame of the bundled scene ``desk`` at 640x480 on two CPU cores, tracking included. A preset errs
least by the cost table within ``SHARE`` of its budget: docs/accuracy.md gives the rule and what departs from it,
``python -m bench.write_cost_tables`` applies it. ``paper`` is the paper's method, ``reference`` the last methods that
end within a lifetime: neither has a budget."""
SHARE = 0.8
"""Of a budget, what is planned with: the rest is for slower moments, as ``--quality auto`` has it."""
