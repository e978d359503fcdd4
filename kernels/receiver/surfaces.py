"""Geometry layers of the picture: the index, depth, normal and position of the modelled surface in each pixel.

A modelled surface is a virtual object, a proxy or a mirror ball. One ray is traced per pixel, through its centre, and
nothing is filtered: the mean of two depths is the depth of neither surface. Depth is measured along the camera's axis,
like that of depth cameras and OpenEXR's ``Z``. Visibility is that of the picture: only proxies hide objects, and a
proxy is seen from its front.

Coverage is the share of a pixel that each surface covers, as in Cryptomatte. If all eight neighbours show the pixel's
own surface, it covers the pixel. Otherwise the samples by which ``shade`` smooths edges are traced and counted by
surface. The first ``RANKS`` surfaces found are kept, by falling share. The part of a pixel that shows no
modelled surface is not stored.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.launch import row_launcher
from warp_ar.kernels.rays.shapes import FAR, intersect_sphere
from warp_ar.kernels.rays.trace import TraceConfig, make_trace
from warp_ar.kernels.rays.visibility import (
    VisibleObjects,
    check_edge_samples,
    inside_rect,
    make_primary,
    make_sample_direction,
)
from warp_ar.kernels.structs import FrameParams, Probe, RayScene, vec8

wp.set_module_options({"enable_backward": False})

RANKS = 4
"""Number of surfaces stored per pixel."""


@wp.struct
class Surface:
    """First surface that a ray from the camera meets."""

    index: wp.int32  # counted over objects, then proxies, then mirror balls; -1: no modelled surface
    depth: wp.float32  # metres along the camera's axis, infinite where there is nothing
    normal: wp.vec3  # unit, world, toward the camera; zero where there is nothing
    position: wp.vec3  # world, metres; zero where there is nothing


@wp.struct
class Surfaces:
    """``Surface`` of every pixel, (H, W) each."""

    index: wp.array2d[wp.int32]
    depth: wp.array2d[wp.float32]
    normal: wp.array2d[wp.vec3]
    position: wp.array2d[wp.vec3]


@functools.cache
def make_physical_surface(config: TraceConfig) -> wp.Function:
    """Return ``physical_surface(scene, balls, origin, direction) -> Surface``: the proxy or ball that a ray meets.

    ``direction`` is scaled so that its component along the camera's axis is 1.
    """
    closest_proxy = make_trace(config).closest_proxy

    @wp.func(module="unique")
    def physical_surface(scene: RayScene, balls: wp.array[Probe], origin: wp.vec3, direction: wp.vec3) -> Surface:
        surface = Surface()
        surface.index = -1
        surface.depth = wp.inf
        objects = scene.objects.shape[0]
        nearest = FAR
        for k in range(balls.shape[0]):
            t = intersect_sphere(balls[k].radius, origin - balls[k].center, direction, nearest)
            if t < nearest:
                nearest = t
                surface.index = objects + scene.proxies.shape[0] + k
                surface.depth = t
                surface.normal = wp.normalize(origin + t * direction - balls[k].center)
                surface.position = balls[k].center + balls[k].radius * surface.normal
        if wp.static(len(config.proxies) > 0):
            hit = closest_proxy(scene, origin, direction, nearest)
            if hit.shape >= 0:
                surface = Surface()
                surface.index = -1
                surface.depth = wp.inf
                # A proxy seen from behind hides the surfaces beyond it, and is itself not visible.
                if wp.dot(hit.geometric_normal, direction) < 0.0:
                    surface.index = objects + hit.shape
                    surface.depth = hit.t
                    surface.normal = hit.normal
                    surface.position = hit.point
        return surface

    return physical_surface


@functools.cache
def make_trace_surfaces_kernel(config: TraceConfig) -> wp.Kernel:
    """Return the kernel of ``trace_surfaces``, specialised to the kinds of shape that exist."""
    physical_surface = make_physical_surface(config)

    @wp.kernel(module="unique", enable_backward=False)
    def trace_surfaces_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        rays: wp.array2d[wp.vec2],
        scene: RayScene,
        balls: wp.array[Probe],
        visible: VisibleObjects,
        # Out:
        out: Surfaces,
    ):
        i, j = wp.tid()
        i += row_start
        direction = params[0].world_from_camera * wp.vec3(rays[i, j][0], rays[i, j][1], 1.0)
        found = wp.int32(-1)
        if visible.objects.shape[0] > 0 and inside_rect(i, j, params[0].object_rect):
            found = visible.objects[i, j]
        surface = Surface()
        if found >= 0:
            hit = visible.hits[i, j]
            surface.index = found
            surface.depth = hit.t
            surface.normal = wp.where(wp.dot(hit.geometric_normal, direction) > 0.0, -hit.normal, hit.normal)
            surface.position = hit.point
        else:
            surface = physical_surface(scene, balls, params[0].camera_position, direction)
        out.index[i, j] = surface.index
        out.depth[i, j] = surface.depth
        out.normal[i, j] = surface.normal
        out.position[i, j] = surface.position

    return trace_surfaces_kernel


trace_surfaces = row_launcher(make_trace_surfaces_kernel, like=lambda params, rays, *_: rays)
"""Write the surface at the centre of every pixel.

Args:
    config: Kinds of shape in ``scene``.
    params: (1,) FrameParams: camera and ``object_rect``.
    rays: (H, W) undistorted x / z and y / z of each pixel centre.
    scene: Objects and proxies.
    balls: (n,) Probe, the mirror balls.
    visible: (H, W) from ``trace_pixels``; its arrays are empty in a scene without objects.
    out: (H, W) arrays, all four.
"""


@wp.func
def add_to_rank(ranks: vec8, found: wp.int32, share: wp.float32) -> vec8:
    """Return ``ranks``, pairs of surface and share, with ``share`` added to that of ``found``, if a pair is free."""
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
    """Return ``ranks`` sorted by falling share; equal shares keep their order. A bubble sort suffices for a few."""
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
    """Return ``shown(scene, balls, origin, direction) -> int32``: index of a camera ray's first surface, or -1."""
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
    """Return the kernel of ``count_coverage`` for the kinds of shape that exist and the samples of a pixel."""
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


count_coverage = row_launcher(make_count_coverage_kernel, configs=2)
"""Write the share of every pixel that each surface covers.

Args:
    config: Kinds of shape in ``scene``.
    edge_samples: Samples of a pixel at an edge, a square number; 1 leaves edges hard.
    params: (1,) FrameParams, the camera.
    rays: (H, W) undistorted x / z and y / z of each pixel centre.
    scene: Objects and proxies.
    balls: (n,) Probe, the mirror balls.
    index: (H, W) int32, from ``trace_surfaces``.
    coverage_out: (H, W) vec8: ``RANKS`` pairs of index and share, by falling share; unused pairs hold -1 and 0.
"""
