"""Anti-aliasing of the edges of objects and shadows, in kernels of its own.

Edge pixels take many samples, other pixels one. On a CPU edges are sampled in place. On CUDA that would stall whole
warps, so edge pixels are listed first, their samples are computed in parallel, and averaged afterwards.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import warp as wp

from warp_ar.kernels.launch import launch

wp.set_module_options({"enable_backward": False})

EDGE_THREADS = 1 << 16
"""Threads that share the samples of all edges."""


@wp.struct
class EdgeList:
    """List of the pixels in which edges lie."""

    count: wp.array[wp.int32]  # (1,): number of edges found, which may exceed n
    edges: wp.array[wp.vec2i]  # (n,): row and column of each


@dataclasses.dataclass(frozen=True, eq=False)
class EdgeLists:
    """Scratch arrays for listed edges. If they cannot hold all edges, all are sampled in place instead."""

    listed: EdgeList
    """Edges found."""
    samples: wp.array[wp.vec4]
    """(n * edge_samples,): radiance, and coverage or the sample's weight."""

    @classmethod
    def of(cls, count: wp.array, edges: wp.array, samples: wp.array) -> "EdgeLists":
        """Return ``EdgeLists`` of arrays (1,) int32, (n,) vec2i and (n * edge_samples,) vec4."""
        listed = EdgeList()
        listed.count, listed.edges = count, edges
        return cls(listed, samples)


@wp.func
def list_edge(i: wp.int32, j: wp.int32, list_out: EdgeList):
    """Count an edge pixel, and append it to the list if there is room."""
    place = wp.atomic_add(list_out.count, 0, 1)
    if place < list_out.edges.shape[0]:
        list_out.edges[place] = wp.vec2i(i, j)


@wp.func
def holds_all(listed: EdgeList) -> wp.bool:
    """Return whether the list holds every edge."""
    return listed.count[0] <= listed.edges.shape[0]


@wp.func
def listed_edges(listed: EdgeList) -> wp.int32:
    """Return the number of listed edges; 0 if the list does not hold all."""
    return wp.where(holds_all(listed), listed.count[0], 0)


@functools.cache
def make_average_edges_kernel(weighted: bool) -> wp.Kernel:
    """Return a kernel that averages the samples of every listed edge pixel, in the order of the samples.

    Args:
        weighted: If True, the fourth component is the sample's weight, 0 or 1, and not written. If False, it is
            averaged like the other three.
    """
    value_type = wp.vec3 if weighted else wp.vec4

    @wp.kernel(module="unique", enable_backward=False)
    def average_edges_kernel(
        # In:
        threads: wp.int32,
        count: wp.int32,
        listed: EdgeList,
        samples: wp.array[wp.vec4],
        # Out:
        values_out: wp.array2d[value_type],
    ):
        item = wp.tid()
        stop = listed_edges(listed)
        while item < stop:
            total = wp.vec4(0.0)
            for sample in range(count):
                total += samples[item * count + sample]
            edge = listed.edges[item]
            if wp.static(weighted):
                if total[3] > 0.0:
                    values_out[edge[0], edge[1]] = wp.vec3(total[0], total[1], total[2]) / total[3]
            else:
                values_out[edge[0], edge[1]] = total / wp.float32(count)
            item += threads

    return average_edges_kernel


def sample_listed_edges(
    kernel: wp.Kernel, inputs: Sequence[Any], lists: EdgeLists, count: int, values_out: wp.array, *, weighted: bool
) -> None:
    """Compute the samples of all listed edges in parallel, and write their means.

    Args:
        kernel: Kernel that takes the number of threads, ``inputs`` and the listed edges, and writes samples.
        inputs: Inputs of the kernel.
        lists: Listed edges; samples are written.
        count: Samples per edge pixel.
        values_out: (H, W) vec3 if ``weighted``, else vec4; written in edge pixels only.
        weighted: True if the fourth component of a sample is its weight; only its RGB is then averaged.
    """
    device = values_out.device
    launch(kernel, EDGE_THREADS, [EDGE_THREADS, *inputs, lists.listed], [lists.samples], device=device)
    averaging = [EDGE_THREADS, count, lists.listed, lists.samples]
    launch(make_average_edges_kernel(weighted), EDGE_THREADS, averaging, [values_out], device=device)
