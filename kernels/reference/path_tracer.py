"""The picture that the local scene would give, by following paths of light: the judge of what is approximated.

A path starts at the camera (``path_vertices``: what it meets; ``path_following``: how it goes on). ``trace_paths``
takes samples, of which ``path_samples`` makes the moments of every pixel, and ``path_picture`` the picture of these:

    find_shown -> trace_paths (IRRADIANCE) -> map_reflectance -> trace_paths (DIFFERENCE) -> finish_picture.

Where no frame is given, all paths are whole (``WHOLE``), and proxies have the reflectance that they are given.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.launch import MOST_REGISTERS, Rows, launch_rows
from warp_ar.kernels.rays.trace import TraceConfig
from warp_ar.kernels.reference.path_following import ENDED, SURFACE, PathPair, end_without, make_visit, meet
from warp_ar.kernels.reference.path_samples import Round
from warp_ar.kernels.reference.path_sampling import PathKey
from warp_ar.kernels.reference.path_starts import (
    DIFFERENCE,
    IRRADIANCE,
    WHOLE,
    begin_path,
    camera_ray,
    sample_key,
    see,
    write_sample,
)
from warp_ar.kernels.reference.path_vertices import PROXY, LocalScene, is_turned, make_find_vertex
from warp_ar.kernels.reference.path_wavefront import Wave, follow_in_waves
from warp_ar.kernels.structs import FrameParams

__all__ = ["DIFFERENCE", "IRRADIANCE", "WHOLE", "find_shown", "trace_paths"]

wp.set_module_options({"enable_backward": False})


# One loop for all rays of a sample, its camera's as well: so what finds a surface is in the kernel once. A warp of a
# GPU waits for the longest of its 32 paths; threads that went on with samples of a shared counter were no faster
# .
@functools.cache
def make_trace_paths_kernel(trace: TraceConfig) -> wp.Kernel:
    """Kernel of ``trace_paths`` for the kinds of shape in ``trace``."""
    find_vertex, visit = make_find_vertex(trace), make_visit(trace)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def trace_paths_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        scene: LocalScene,
        asked: wp.int32,
        seed: wp.int32,
        first: wp.int32,
        done: wp.array2d[wp.int32],
        # Out:
        samples_out: Round,
    ):
        k = wp.tid() + row_start
        begins = bool(True)
        is_done = bool(False)
        lobe = bool(False)
        key = PathKey()
        pair = PathPair()
        while not is_done:
            if begins:
                key = sample_key(samples_out, k, seed, first, done)
                direction = camera_ray(params[0], scene.picture.rays, key)
                pair = begin_path(params[0].camera_position, direction, asked, lobe)
                if lobe:
                    key.seed = ~key.seed
                begins = False
            vertex = find_vertex(scene, pair.path.origin, pair.path.direction, not pair.path.without)
            pair.rays += 1
            if pair.path.depth == 0:
                pair = see(scene, asked, vertex, pair, k, samples_out)
            else:
                pair = meet(scene, vertex, pair)
            if pair.next == SURFACE:
                pair = visit(params[0], scene, vertex, pair, key)
            if pair.next == ENDED and pair.path.without:
                pair = end_without(pair)
            if pair.next == ENDED:
                write_sample(pair, k, samples_out)
                begins = True
                # The gloss of what the pixel shows has a path of its own.
                lobe = pair.glossy and not lobe
                is_done = not lobe

    return trace_paths_kernel


@functools.cache
def make_find_shown_kernel(trace: TraceConfig) -> wp.Kernel:
    """Kernel of ``find_shown`` for the kinds of shape in ``trace``."""
    find_vertex = make_find_vertex(trace)

    @wp.kernel(module="unique", enable_backward=False)
    def find_shown_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        scene: LocalScene,
        # Out:
        shown_out: wp.array2d[wp.int32],
    ):
        i, j = wp.tid()
        i += row_start
        ray = scene.picture.rays[i, j]
        shown = wp.int32(-1)
        for k in range(5):
            # The middle, then the corners: a pixel of two surfaces has the radiance of neither.
            x = wp.where(k == 0, 0.0, wp.where(k % 2 == 0, 0.5, -0.5))
            y = wp.where(k == 0, 0.0, wp.where(k < 3, -0.5, 0.5))
            toward = wp.vec3(ray[0] + x / params[0].focal[0], ray[1] + y / params[0].focal[1], 1.0)
            direction = wp.normalize(params[0].world_from_camera * toward)
            vertex = find_vertex(scene, params[0].camera_position, direction, False)
            seen = wp.int32(-1)
            if vertex.kind == PROXY and not is_turned(vertex, direction):
                seen = vertex.hit.shape
            if k == 0:
                shown = seen
            elif seen != shown:
                shown = -1
        shown_out[i, j] = shown

    return find_shown_kernel


def trace_paths(
    trace: TraceConfig,
    params: wp.array[FrameParams],
    scene: LocalScene,
    done: wp.array2d[wp.int32],
    samples_out: Round,
    *,
    count: int,
    asked: int,
    seed: int,
    first: int,
    part: Rows | None = None,
    wave: Wave | None = None,
) -> None:
    """Trace the samples of a round.

    Args:
        trace: Kinds of shape in the scene.
        params: (1,) FrameParams: the camera.
        scene: All that paths meet.
        done: (H, W) samples of each pixel in rounds before.
        samples_out: Of ``list_samples``.
        count: Its samples.
        asked: ``WHOLE``, ``DIFFERENCE`` or ``IRRADIANCE``; all but the first need the frame's radiance.
        seed: Of the random numbers.
        first: Number of a pixel's first sample among those of the seed.
        part: First sample, and one past the last, on CPU; None means all.
        wave: Of ``make_wave``: all samples are traced kernel after kernel. None: each by one thread, in a loop.
    """
    if wave is not None:
        more = {"count": count, "asked": asked, "seed": seed, "first": first}
        follow_in_waves(trace, params, scene, done, wave, samples_out, **more)
        return
    inputs = [params, scene, asked, seed, first, done]
    kernel = make_trace_paths_kernel(trace)
    launch_rows(kernel, (count,), inputs, [samples_out], rows=part, device=done.device)


def find_shown(
    trace: TraceConfig,
    params: wp.array[FrameParams],
    scene: LocalScene,
    shown_out: wp.array2d[wp.int32],
    *,
    rows: Rows | None = None,
) -> None:
    """Write which proxy alone the frame shows in every pixel, -1 for none or several surfaces; (H, W)."""
    shape, device = shown_out.shape, shown_out.device
    launch_rows(make_find_shown_kernel(trace), shape, [params, scene], [shown_out], rows=rows, device=device)
