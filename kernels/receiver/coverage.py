"""Which surfaces share a pixel, and how much of it each covers: what Cryptomatte keeps of a picture.

Within a surface a pixel shows that alone. Where one of the eight neighbours shows another, the pixel's samples are
traced, the same as those by which ``shade`` smooths edges, and counted by surface. The ``RANKS`` that cover most are
kept, in falling order; what nothing modelled covers is in no rank.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.launch import Rows, launch_rows
from warp_ar.kernels.rays.trace import TraceConfig
from warp_ar.kernels.rays.visibility import check_edge_samples, make_primary, make_sample_direction
from warp_ar.kernels.receiver.surfaces import make_physical_surface
from warp_ar.kernels.structs import FrameParams, Probe, RayScene, vec8

wp.set_module_options({"enable_backward": False})

RANKS = 4
"""Surfaces that a pixel keeps."""


@wp.func
def add_to_rank(ranks: vec8, found: wp.int32, share: wp.float32) -> vec8:
    """Count a share of the pixel for a surface: in its rank, else in the first that is free, else in none."""
    out = ranks
    taken = bool(found < 0)
    for k in range(wp.static(RANKS)):
        if not taken and (out[2 * k] == wp.float32(found) or out[2 * k] < 0.0):
            out[2 * k] = wp.float32(found)
            out[2 * k + 1] = out[2 * k + 1] + share
            taken = True
    return out


@wp.func
def sort_ranks(ranks: vec8) -> vec8:
    """In falling order; few, so the plainest way to sort them. Equal ones keep the order of their samples."""
    out = ranks
    for _ in range(wp.static(RANKS - 1)):
        for k in range(wp.static(RANKS - 1)):
            if out[2 * k + 3] > out[2 * k + 1]:
                which = out[2 * k]
                much = out[2 * k + 1]
                out[2 * k] = out[2 * k + 2]
                out[2 * k + 1] = out[2 * k + 3]
                out[2 * k + 2] = which
                out[2 * k + 3] = much
    return out


@functools.cache
def make_shown(config: TraceConfig) -> wp.Function:
    """``shown(scene, balls, origin, direction) -> int32``: number of the surface that a ray meets first, or -1."""
    closest_visible = make_primary(config)
    physical_surface = make_physical_surface(config)

    @wp.func(module="unique")
    def shown(scene: RayScene, balls: wp.array[Probe], origin: wp.vec3, direction: wp.vec3) -> wp.int32:
        hit = closest_visible(scene, origin, direction)
        found = hit.shape
        if found < 0:
            surface = physical_surface(scene, balls, origin, direction)
            found = surface.index
        return found

    return shown


@functools.cache
def make_count_coverage_kernel(config: TraceConfig, edge_samples: int) -> wp.Kernel:
    """Kernel of ``count_coverage``, specialised to the kinds of shape that exist and to the samples of a pixel."""
    check_edge_samples(edge_samples)
    shown, sample_direction = make_shown(config), make_sample_direction(edge_samples)

    @wp.kernel(module="unique", enable_backward=False)
    def count_coverage_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        rays: wp.array2d[wp.vec2],
        scene: RayScene,
        balls: wp.array[Probe],
        index: wp.array2d[wp.int32],
        # Out:
        coverage_out: wp.array2d[vec8],
    ):
        i, j = wp.tid()
        i += row_start
        own = index[i, j]
        edge = bool(False)
        if wp.static(edge_samples > 1):
            for a in range(wp.max(i - 1, 0), wp.min(i + 2, index.shape[0])):
                for b in range(wp.max(j - 1, 0), wp.min(j + 2, index.shape[1])):
                    edge = edge or index[a, b] != own
        ranks = vec8()
        for k in range(wp.static(RANKS)):
            ranks[2 * k] = -1.0
        if not edge:
            if own >= 0:
                ranks[0] = wp.float32(own)
                ranks[1] = 1.0
        else:
            for sample in range(wp.static(edge_samples)):
                found = shown(scene, balls, params[0].camera_position, sample_direction(params, rays[i, j], sample))
                ranks = add_to_rank(ranks, found, wp.static(1.0 / edge_samples))
            ranks = sort_ranks(ranks)
        coverage_out[i, j] = ranks

    return count_coverage_kernel


def count_coverage(
    config: TraceConfig,
    edge_samples: int,
    params: wp.array,
    rays: wp.array,
    scene: RayScene,
    balls: wp.array,
    index: wp.array,
    coverage_out: wp.array,
    *,
    rows: Rows | None = None,
) -> None:
    """Write what share of every pixel which surface covers.

    Args:
        config: Kinds of shape in ``scene``.
        edge_samples: Samples of a pixel at an edge, a square number; 1 leaves edges hard.
        params: (1,) FrameParams, the camera.
        rays: (H, W) undistorted x / z and y / z of each pixel centre.
        scene: What rays meet.
        balls: (n,) Probe, the mirror balls.
        index: (H, W) int32, as ``trace_surfaces`` writes.
        coverage_out: (H, W) of index and share in turn, ``RANKS`` times, in falling order; index -1 with share 0
            where there are fewer.
        rows: Band of rows; None means all.
    """
    launch_rows(
        make_count_coverage_kernel(config, edge_samples),
        index.shape,
        [params, rays, scene, balls, index],
        [coverage_out],
        rows=rows,
        device=index.device,
    )
