"""Path tracer of the local scene: the reference picture, against which approximations are measured.

A path starts at the camera. ``path_vertices`` defines the surfaces that it meets, ``path_following`` its next ray.
``trace_paths`` takes samples. ``path_picture`` computes moments of every pixel's samples, and the picture from them:

    find_shown -> trace_paths (IRRADIANCE) -> map_reflectance -> trace_paths (DIFFERENCE) -> finish_picture.

Without a frame all paths carry whole radiance (``WHOLE``), and proxies have the reflectance that the scene gives.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.launch import MOST_REGISTERS, row_launcher
from warp_ar.kernels.rays.trace import TraceConfig
from warp_ar.kernels.reference.path_following import ENDED, SURFACE, PathPair, end_without, make_visit, meet
from warp_ar.kernels.reference.path_picture import Round
from warp_ar.kernels.reference.path_sampling import NO_DENSITY, PathKey, sky_radiance
from warp_ar.kernels.reference.path_vertices import (
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

__all__ = ["DIFFERENCE", "IRRADIANCE", "WHOLE", "find_shown", "trace_paths"]

wp.set_module_options({"enable_backward": False})


WHOLE, DIFFERENCE, IRRADIANCE = 0, 1, 2
"""Tasks of the tracer: radiance of the scene; change of the frame by virtual content; irradiance for reflectance."""


@wp.func
def sample_key(samples: Round, k: wp.int32, seed: wp.int32, first: wp.int32, done: wp.array2d[wp.int32]) -> PathKey:
    """Return the key of the random numbers of sample ``k`` of a round."""
    pixel = samples.pixels[k]
    i = pixel / done.shape[1]
    j = pixel % done.shape[1]
    key = PathKey()
    key.pixel = wp.uint32(pixel)
    key.seed = wp.uint32(seed)
    key.sample = wp.uint32(first + done[i, j] + k - (samples.ends[pixel] - samples.counts[pixel]))
    return key


@wp.func
def camera_ray(params: FrameParams, rays: wp.array2d[wp.vec2], key: PathKey) -> wp.vec3:
    """Return the unit direction through a random point of a pixel."""
    # A random stream of its own: the vertices of the path use streams from 0 on.
    bits = pcg3d_hash(key.pixel, key.sample, ~key.seed)
    pixel = wp.int32(key.pixel)
    ray = rays[pixel / rays.shape[1], pixel % rays.shape[1]]
    x = ray[0] + (uniform_from_bits(bits[0]) - 0.5) / params.focal[0]
    y = ray[1] + (uniform_from_bits(bits[1]) - 0.5) / params.focal[1]
    return wp.normalize(params.world_from_camera * wp.vec3(x, y, 1.0))


@wp.func
def begin_path(origin: wp.vec3, direction: wp.vec3, asked: wp.int32, lobe: wp.bool) -> PathPair:
    """Return a path that starts on the camera's ray, for the task ``asked``; ``lobe``: of a proxy's specular lobe."""
    pair = PathPair()
    pair.path.throughput = wp.vec3(1.0, 1.0, 1.0)
    pair.path.origin = origin
    pair.path.direction = direction
    pair.path.density = NO_DENSITY
    pair.lobe = lobe
    pair.only_light = asked == wp.static(IRRADIANCE)
    return pair


@wp.func
def see(
    scene: LocalScene, asked: wp.int32, vertex: Vertex, pair: PathPair, k: wp.int32, samples_out: Round
) -> PathPair:
    """Start sample ``k`` at the first surface of the camera's ray, and write the radiance that needs no path.

    ``next`` of the result is ``SURFACE`` if there is a path to follow, else ``ENDED``.
    """
    out = pair
    out.next = ENDED
    whole = asked == wp.static(WHOLE)
    z = wp.vec3(0.0, 0.0, 0.0)
    if whole and vertex.kind == NOTHING:
        z = sky_radiance(scene.sky, pair.path.direction, NO_DENSITY)
    elif whole or vertex.kind == OBJECT:
        out.next = wp.where(pair.only_light, ENDED, SURFACE)
    else:
        pixel = samples_out.pixels[k]
        z = scene.radiance[pixel / scene.radiance.shape[1], pixel % scene.radiance.shape[1]]
        out.path.changes_only = True
        # A proxy seen from behind is not a visible surface.
        if vertex.kind == PROXY and not is_turned(vertex, pair.path.direction):
            out.white = True
            out.glossy = is_glossy(scene, vertex)
            out.next = SURFACE
        elif vertex.kind == BALL and not pair.only_light:
            out.next = SURFACE
    if not pair.lobe:
        samples_out.z[k] = z
        samples_out.g[k] = wp.vec3(0.0, 0.0, 0.0)
        samples_out.e[k] = wp.vec3(0.0, 0.0, 0.0)
        samples_out.shows[k] = wp.where(out.white, 1.0, 0.0)
        samples_out.rays[k] = 0
    return out


@wp.func
def write_sample(pair: PathPair, k: wp.int32, samples_out: Round):
    """Write the quantities z, g and e of a path that has ended, for ``add_sample``."""
    samples_out.rays[k] = samples_out.rays[k] + pair.rays
    if not pair.white or (pair.lobe and not pair.only_light):
        samples_out.z[k] = samples_out.z[k] + pair.radiance
    elif pair.lobe:
        samples_out.g[k] = pair.light  # radiance that the proxy reflects specularly in the frame
    else:
        samples_out.g[k] = pair.radiance
        samples_out.e[k] = pair.light


# One loop for all rays of a sample, the camera's included, so that the code that finds a surface is in the kernel once.
# A warp of a GPU waits for the longest of its 32 paths; threads that took further samples from a shared counter were
# no faster.
@functools.cache
def make_trace_paths_kernel(trace: TraceConfig) -> wp.Kernel:
    """Return the kernel of ``trace_paths`` for the kinds of shape in ``trace``."""
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
                # The specular lobe of the pixel's proxy has a path of its own.
                lobe = pair.glossy and not lobe
                is_done = not lobe

    return trace_paths_kernel


@functools.cache
def make_find_shown_kernel(trace: TraceConfig) -> wp.Kernel:
    """Return the kernel of ``find_shown`` for the kinds of shape in ``trace``."""
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
            # The centre, then the corners: a pixel of two surfaces has the radiance of neither.
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


trace_paths = row_launcher(make_trace_paths_kernel, like=lambda *given: (given[-1].count,))
"""Trace the samples of a round.

Args:
    trace: Kinds of shape in the scene.
    params: (1,) FrameParams: the camera.
    scene: Surfaces and lights that paths meet.
    asked: ``WHOLE``, ``DIFFERENCE`` or ``IRRADIANCE``; all but the first need the frame's radiance.
    seed: Seed of the random numbers.
    first: Index of a pixel's first sample among those of the seed.
    done: (H, W) number of each pixel's samples in earlier rounds.
    samples_out: From ``list_samples``.
"""


find_shown = row_launcher(make_find_shown_kernel)
"""Write the index of the proxy that fills each pixel, -1 if the pixel shows no proxy or several surfaces; (H, W)."""
