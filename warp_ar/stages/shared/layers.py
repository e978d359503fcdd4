"""The layers over the frame, as the kernels that compose the picture take them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from warp_ar.kernels import composite


def layers_of(arrays: Mapping[str, Any]) -> composite.Layers:
    """The layers that there are, as kernels read them."""
    mirrored = "reflected" if "reflected" in arrays else "mirrored"
    names = ("virtual", "physical_added", "shadow_ratio", mirrored)
    return composite.make_layers(*(arrays.get(name) for name in names))


def composite_config(layers: tuple[str, ...]) -> composite.CompositeConfig:
    """Which layers to compile in."""
    return composite.CompositeConfig(
        virtual="virtual" in layers,
        added="physical_added" in layers,
        ratio="shadow_ratio" in layers,
        mirrored="mirrored" in layers or "reflected" in layers,
    )
