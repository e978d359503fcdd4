"""Edges that are sampled on their own.

Samples of edges take many times as long as the pixels around them. On a CPU they are taken in place; on CUDA that
holds up whole warps, and edges are listed first, their samples taken side by side and averaged afterwards.
"""

from __future__ import annotations

import dataclasses

import warp as wp

wp.set_module_options({"enable_backward": False})

EDGE_THREADS = 1 << 16
"""Threads that share the samples of all edges."""


@dataclasses.dataclass(frozen=True, eq=False)
class EdgeLists:
    """Scratch arrays for edges that are sampled on their own; where they do not hold all, all are sampled in place."""

    count: wp.array[wp.int32]
    """(1,): edges found."""
    edges: wp.array[wp.vec2i]
    """(n,): row and column of each."""
    samples: wp.array[wp.vec4]
    """(n * edge_samples,): radiance, and coverage or how much the sample counts."""


@wp.func
def list_edge(i: wp.int32, j: wp.int32, edge_count: wp.array[wp.int32], edges: wp.array[wp.vec2i]):
    """Put a pixel on the list, if there is environment; it is counted in any case."""
    place = wp.atomic_add(edge_count, 0, 1)
    if place < edges.shape[0]:
        edges[place] = wp.vec2i(i, j)


@wp.func
def listed_edges(edge_count: wp.array[wp.int32], edges: wp.array[wp.vec2i]) -> wp.int32:
    """Edges in the list; none where it did not hold all."""
    return wp.where(edge_count[0] <= edges.shape[0], edge_count[0], 0)
