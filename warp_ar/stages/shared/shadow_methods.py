"""Methods of ``environment_shadow``, in numbers: two stages need them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Final, Literal

REFERENCE_SIZE: Final = (32, 64)
"""Texels of the map that the reference sums over."""


@dataclasses.dataclass(frozen=True)
class Method:
    """How many rays, for how many pixels."""

    count: int
    """Samples of the environment per estimate."""
    side: int
    """Estimates along a tile."""
    stride: int
    """Pixels from one estimate to the next in frames of ``STRIDE_ROWS`` rows."""
    bounce: Literal["estimated", "traced"]
    """How what objects reflect onto the receiver is found."""
    secondary: float = 1.0
    """Share of the rays that look for it: light that takes rays to find is smooth, and half of them find it."""


METHODS: Mapping[str, Method] = {
    "coarse6": Method(32, 4, 6, "estimated"),
    "coarse": Method(32, 4, 5, "estimated"),
    "bounce": Method(64, 4, 2, "traced", 0.5),
    "brute_force": Method(REFERENCE_SIZE[0] * REFERENCE_SIZE[1], 1, 1, "traced"),
}
"""Cheapest first, after ``none``."""
