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
from warp_ar.kernels.path_following import make_follow_path
from warp_ar.kernels.path_samples import Round
from warp_ar.kernels.path_sampling import NO_DENSITY, PathKey, sky_radiance
from warp_ar.kernels.path_vertices import (
    BALL,
    NOTHING,
    OBJECT,
    PROXY,
    LocalScene,
    Vertex,
    is_glossy,
    is_turned,
    make_find_vertex,
)
from warp_ar.kernels.sampling import pcg3d_hash, uniform_from_bits
from warp_ar.kernels.structs import FrameParams
from warp_ar.kernels.trace import TraceConfig

wp.set_module_options({"enable_backward": False})

WHOLE, DIFFERENCE, IRRADIANCE = 0, 1, 2
"""What is asked of pixels: radiance of the scene; what virtual content changes in the frame; or only what makes
reflectance known."""


@wp.struct
class PixelSample:
    """What one path, or those of both lobes of a glossy surface, tell of a pixel; as ``add_sample`` takes it."""

    z: wp.vec3
    g: wp.vec3
    e: wp.vec3
    shows: wp.float32
    rays: wp.int32  # that were traced for it


@functools.cache
def make_sample_pixel(trace: TraceConfig) -> wp.Function:
    """``sample_pixel(params, scene, asked, vertex, direction, shown, key) -> PixelSample``.

    ``vertex`` is what the camera's ray meets; ``shown`` what the frame holds there.
    """
    follow_path = make_follow_path(trace)

    @wp.func(module="unique")
    def sample_pixel(
        params: FrameParams,
        scene: LocalScene,
        asked: wp.int32,
        vertex: Vertex,
        direction: wp.vec3,
        shown: wp.vec3,
        key: PathKey,
    ) -> PixelSample:
        out = PixelSample()
        whole = asked == wp.static(WHOLE)
        only_light = asked == wp.static(IRRADIANCE)
        paths = wp.int32(0)
        white = bool(False)
        if whole and vertex.kind == NOTHING:
            out.z = sky_radiance(scene.sky, direction, NO_DENSITY)
        elif whole or vertex.kind == OBJECT:
            paths = wp.where(only_light, 0, 1)
        else:
            out.z = shown
            # A face that is seen from behind is not the surface that the camera sees.
            if vertex.kind == PROXY and not is_turned(vertex, direction):
                white = True
                paths = wp.where(is_glossy(scene, vertex), 2, 1)
                out.shows = 1.0
            elif vertex.kind == BALL and not only_light:
                paths = 1
        difference = not whole and vertex.kind != OBJECT
        # All kinds of path by one call: each would be a copy of what follows paths, by far the largest part.
        for lobe in range(paths):
            of_lobe = key
            if lobe == 1:
                of_lobe.seed = ~key.seed
            one = follow_path(params, scene, vertex, direction, difference, white, lobe == 1, only_light, of_lobe)
            out.rays += one.rays
            if not white or (lobe == 1 and not only_light):
                out.z += one.radiance
            elif lobe == 0:
                out.g = one.radiance
                out.e = one.light
            else:
                out.g = one.light  # what the frame shows mirrored
        return out

    return sample_pixel


@functools.cache
def make_trace_paths_kernel(trace: TraceConfig) -> wp.Kernel:
    """Kernel of ``trace_paths`` for the kinds of shape in ``trace``."""
    find_vertex, sample_pixel = make_find_vertex(trace), make_sample_pixel(trace)

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
        pixel = samples_out.pixels[k]
        rays = scene.picture.rays
        i = pixel / rays.shape[1]
        j = pixel % rays.shape[1]
        key = PathKey()
        key.pixel = wp.uint32(pixel)
        key.seed = wp.uint32(seed)
        key.sample = wp.uint32(first + done[i, j] + k - (samples_out.ends[pixel] - samples_out.counts[pixel]))
        # A stream of its own: the vertices of the path use those from 0 on.
        bits = pcg3d_hash(key.pixel, key.sample, ~key.seed)
        x = rays[i, j][0] + (uniform_from_bits(bits[0]) - 0.5) / params[0].focal[0]
        y = rays[i, j][1] + (uniform_from_bits(bits[1]) - 0.5) / params[0].focal[1]
        direction = wp.normalize(params[0].world_from_camera * wp.vec3(x, y, 1.0))
        vertex = find_vertex(scene, params[0].camera_position, direction, True)
        shown = wp.vec3(0.0, 0.0, 0.0)
        if asked != wp.static(WHOLE):
            shown = scene.radiance[i, j]
        one = sample_pixel(params[0], scene, asked, vertex, direction, shown, key)
        samples_out.z[k] = one.z
        samples_out.g[k] = one.g
        samples_out.e[k] = one.e
        samples_out.shows[k] = one.shows
        samples_out.rays[k] = one.rays + 1

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
        part: First sample, and one past the last; None means all.
    """
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
