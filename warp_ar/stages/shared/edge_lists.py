"""Scratch arrays of stages that resample edge pixels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import warp as wp

from warp_ar.kernels.edges import EdgeLists
from warp_ar.stages.base import Arrays, ArraySpec
from warp_ar.stages.request import Request

LISTED_SHARE = 16
"""Pixels per edge that a list can hold."""
LISTED_LEAST = 1 << 12
"""Least capacity of a list, limited by the number of pixels: in a small picture most pixels may be edges."""


def edge_arrays(request: Request, stage: str) -> Mapping[str, ArraySpec]:
    """Return the arrays of ``make_edge_lists``; none if a pixel has one sample."""
    samples = request.quality.edge_samples
    if samples == 1:
        return {}
    width, height = request.size
    edges = min(width * height, max(width * height // LISTED_SHARE, LISTED_LEAST))
    return {
        f"{stage}_edge_count": ArraySpec((1,), wp.int32),
        f"{stage}_edges": ArraySpec((edges,), wp.vec2i),
        f"{stage}_edge_samples": ArraySpec((edges * samples,), wp.vec4),
    }


def make_edge_lists(arrays: Arrays, device: Any, stage: str) -> EdgeLists | None:
    """Return a stage's edge lists on CUDA; None on CPU or if a pixel has one sample."""
    if device.is_cpu or f"{stage}_edges" not in arrays:
        return None
    return EdgeLists.of(*(arrays[f"{stage}_{name}"] for name in ("edge_count", "edges", "edge_samples")))
