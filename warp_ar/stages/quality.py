"""Rungs and presets: how accurately each stage works, as one frozen value."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType


@dataclasses.dataclass(frozen=True)
class Quality:
    """The rung of every stage and the sizes that go with it. Equal values share plans and compiled kernels."""

    name: str
    """Of the preset, or ``custom``."""
    rungs: tuple[tuple[str, str], ...]
    """(stage, rung) pairs, sorted by stage; stages that have only one rung need not be named."""
    environment_height: int
    """Rows of the latlong environment; it has twice as many columns."""
    edge_samples: int
    """Samples per pixel along the edges of virtual objects; a square number."""

    def rung(self, stage: str) -> str:
        """Rung of ``stage``; a stage that is not named has its only rung, ``default``."""
        return dict(self.rungs).get(stage, "default")

    def with_rungs(self, **rungs: str) -> Quality:
        """The same quality with some stages on other rungs."""
        merged = {**dict(self.rungs), **rungs}
        return dataclasses.replace(self, name="custom", rungs=tuple(sorted(merged.items())))


def _preset(name: str, environment_height: int, edge_samples: int, **rungs: str) -> Quality:
    return Quality(name, tuple(sorted(rungs.items())), environment_height, edge_samples)


PRESETS: Mapping[str, Quality] = MappingProxyType(
    {
        preset.name: preset
        for preset in (
            _preset(
                "paper",
                64,
                4,
                diffuse="top_mip",
                specular="box_mip",
                relight="relief",
                recover="clipped",
                room_shadow="none",
                expose="box",
                mirror_ball="none",
                shade="environment",
            ),
            _preset(
                "low",
                64,
                4,
                diffuse="clusters",
                specular="energy_mip",
                light_shadow="hard",
                relight="reflectance",
                recover="white_card",
                room_shadow="none",
                expose="box",
                mirror_ball="none",
                shade="environment",
            ),
            _preset(
                "medium",
                64,
                4,
                diffuse="clusters",
                specular="energy_mip",
                light_shadow="soft",
                relight="reflectance",
                recover="shading",
                room_shadow="coarse",
                expose="glow",
                mirror_ball="single",
                shade="environment",
            ),
            _preset(
                "high",
                128,
                16,
                diffuse="clusters",
                specular="energy_mip",
                light_shadow="soft",
                relight="bounce",
                recover="shading",
                room_shadow="bounce",
                expose="ball",
                mirror_ball="smooth",
                shade="one_bounce",
            ),
            _preset(
                "reference",
                256,
                16,
                diffuse="brute_force",
                specular="fis128",
                light_shadow="soft",
                relight="brute_force",
                recover="shading",
                room_shadow="brute_force",
                expose="ball",
                mirror_ball="brute_force",
                shade="one_bounce",
            ),
        )
    }
)
DEFAULT_PRESET = "medium"
BUDGETS: Mapping[str, float] = MappingProxyType({"low": 1e3 / 30.0, "medium": 50.0, "high": 250.0})
"""Milliseconds per frame of the bundled scene ``desk`` at 640x480 on two CPU cores, tracking included. A preset errs
least by the price list within ``SHARE`` of its budget: docs/prices.md gives the rule and what departs from it,
``python -m bench.write_prices`` applies it. ``paper`` is the paper's method, ``reference`` the last rungs that end
within a lifetime: neither has a budget."""
SHARE = 0.8
"""Of a budget, what is planned with: the rest is for slower moments, as ``--quality auto`` has it."""
