"""Sample sets of the environment, and the sample counts of the methods of ``environment_shadow``."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Final, Literal

from warp_ar.stages.features import Features

REFERENCE_SIZE: Final = (32, 64)
"""Rows and columns of the map over which the reference sums."""


@dataclasses.dataclass(frozen=True)
class Method:
    """Numbers of rays per estimate and of estimates per frame, for one method of ``environment_shadow``."""

    count: int
    """Samples of the environment per estimate."""
    side: int
    """Estimates along one side of a tile."""
    stride: int
    """Pixels between neighbouring estimates, in frames of ``STRIDE_ROWS`` rows."""
    bounce: Literal["estimated", "traced"]
    """Method for light that objects reflect onto the receiver."""
    secondary: float = 1.0
    """Share of the rays for which light reflected by objects is found; that light is smooth, so half may suffice."""


METHODS: Mapping[str, Method] = {
    "coarse": Method(32, 4, 6, "estimated"),
    "bounce": Method(64, 4, 2, "traced", 0.5),
    "brute_force": Method(REFERENCE_SIZE[0] * REFERENCE_SIZE[1], 1, 1, "traced"),
}
"""Methods, cheapest first, after ``none``."""


SAMPLES = 1024
"""Least total number of samples of all sets: four for each of the 256 values of 8 bits."""


def lists_texels(features: Features) -> bool:
    """Return True if the reference samples every texel of the environment, besides samples by its light."""
    return features.request.quality.method("environment_shadow") == "brute_force"


def sample_count(features: Features) -> int:
    """Return the number of samples of all sets: as many as one tile of shadow estimates uses."""
    method = METHODS.get(features.request.quality.method("environment_shadow"))
    return SAMPLES if method is None or lists_texels(features) else max(SAMPLES, method.count * method.side**2)


def sample_slots(features: Features) -> int:
    """Return the number of subsets of the samples; each ball with interpolated light has one or two of them."""
    return 1 << features.others.bit_length()


def sample_names(features: Features) -> tuple[str, str, str]:
    """Return the names of the arrays that shadows read: directions, flux, samples."""
    listed = "environment_samples_texel_directions", "environment_samples_texel_flux", "environment_samples_texels"
    return (
        listed
        if lists_texels(features)
        else ("environment_samples_directions", "environment_samples_flux", "environment_samples")
    )
