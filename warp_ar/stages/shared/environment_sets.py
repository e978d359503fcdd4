"""Sets of samples that stand for the environment: how large they are, and in which arrays they lie."""

from __future__ import annotations

from warp_ar.stages.features import Features
from warp_ar.stages.shared.shadow_methods import METHODS

SAMPLES = 1024
"""Of all sets together, at least: what an 8-bit picture of their mean can tell apart, four times over."""


def lists_texels(features: Features) -> bool:
    """Whether the reference asks for every texel of the environment, beside the samples that follow its light."""
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
