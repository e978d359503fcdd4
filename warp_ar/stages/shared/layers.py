"""The layers over the frame, as the kernels that compose the picture take them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from warp_ar.kernels.picture import composite


def layers_of(arrays: Mapping[str, Any]) -> composite.Layers:
    """The layers that there are, as kernels read them."""
    mirror_ball = "reflected" if "reflected" in arrays else "mirror_ball"
    names = ("virtual", "added_light", "shadow_ratio", mirror_ball)
    return composite.make_layers(*(arrays.get(name) for name in names))
