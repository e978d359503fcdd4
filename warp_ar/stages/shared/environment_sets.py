"""Sets of samples that stand for the environment, and methods of ``environment_shadow`` in numbers."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Final, Literal

from warp_ar.stages.features import Features

REFERENCE_SIZE: Final = (32, 64)
"""Texels of the map that the reference sums over."""


@dataclasses.dataclass(frozen=True)
class Method:
    """Rays per estimate, and estimates per frame."""

    count: int
    """Samples of the environment per estimate."""
    side: int
    """Estimates along a tile."""
    stride: int
    """Pixels from one estimate to the next in frames of ``STRIDE_ROWS`` rows."""
    bounce: Literal["estimated", "traced"]
    """Method by which light from objects onto the receiver is found."""
    secondary: float = 1.0
    """Share of the rays that look for it: light that takes rays to find is smooth, and half of them find it."""


METHODS: Mapping[str, Method] = {
    "coarse": Method(32, 4, 6, "estimated"),
    "bounce": Method(64, 4, 2, "traced", 0.5),
    "brute_force": Method(REFERENCE_SIZE[0] * REFERENCE_SIZE[1], 1, 1, "traced"),
}
"""Cheapest first, after ``none``."""


SAMPLES = 1024
"""Of all sets together, at least: what an 8-bit picture of their mean can tell apart, four times over."""


def lists_texels(features: Features) -> bool:
    """Return whether the reference asks for every texel of the environment, beside samples that follow its light."""
    return features.request.quality.method("environment_shadow") == "brute_force"


def sample_count(features: Features) -> int:
    """Samples of all sets together: as many as one tile of shadows asks for."""
    method = METHODS.get(features.request.quality.method("environment_shadow"))
    return SAMPLES if method is None or lists_texels(features) else max(SAMPLES, method.count * method.side**2)


def sample_slots(features: Features) -> int:
    """Samples of which each of the balls whose light is interpolated has one or two."""
    return 1 << features.others.bit_length()


def sample_names(features: Features) -> tuple[str, str, str]:
    """Arrays that shadows read: directions, flux, samples."""
    listed = "environment_samples_texel_directions", "environment_samples_texel_flux", "environment_samples_texels"
    return (
        listed
        if lists_texels(features)
        else ("environment_samples_directions", "environment_samples_flux", "environment_samples")
    )
