"""Primary rays: the object and the proxy that each pixel of a frame shows, and the rays of samples within a pixel.

``trace_pixels`` writes the objects that pixels show. Other stages use ``make_visible_proxy`` for the proxy in a pixel,
and ``make_sample_direction`` for samples within a pixel. ``kernels/rays/trace.py`` intersects rays with the scene.
"""

from __future__ import annotations

import functools
import math

import warp as wp

from warp_ar.kernels.cells import cell_pixel
from warp_ar.kernels.launch import row_launcher
from warp_ar.kernels.rays.shapes import FAR, ROUNDING
from warp_ar.kernels.rays.trace import TraceConfig, make_trace, meets_probe
from warp_ar.kernels.structs import FrameParams, Hit, Probe, RayScene

wp.set_module_options({"enable_backward": False})


@wp.struct
class VisibleObjects:
    """The virtual objects that pixels show."""

    objects: wp.array2d[wp.int32]  # index of the object; -1 where there is none
    hits: wp.array2d[Hit]  # defined only where there is an object


@wp.func
def inside_rect(row: wp.int32, column: wp.int32, rect: wp.vec4i) -> wp.bool:
    """Return whether a pixel lies in a rectangle (row_start, row_stop, column_start, column_stop), stops excluded."""
    return row >= rect[0] and row < rect[1] and column >= rect[2] and column < rect[3]


@functools.cache
def make_primary(config: TraceConfig) -> wp.Function:
    """Return the function ``closest_visible(scene, origin, direction) -> Hit``.

    Its result is the closest object, if no proxy hides it, else a hit of shape -1.
    """
    trace = make_trace(config)
    closest_object, occluded_by_proxies = trace.closest_object, trace.occluded_by_proxies

    @wp.func(module="unique")
    def closest_visible(scene: RayScene, origin: wp.vec3, direction: wp.vec3) -> Hit:
        hit = closest_object(scene, origin, direction, FAR)
        if wp.static(len(config.proxies) > 0):
            if hit.shape >= 0:
                # Where object and proxy touch, the object is visible: both depths have rounding errors.
                if occluded_by_proxies(scene, origin, direction, hit.t * (1.0 - 16.0 * ROUNDING)):
                    hit.shape = -1
        return hit

    return closest_visible


@functools.cache
def make_visible_proxy(config: TraceConfig) -> wp.Function:
    """Return the function ``visible_proxy(params, ray, scene, probes) -> Hit``: the proxy in a pixel, or shape -1.

    A proxy that is seen from behind, or hidden by a mirror ball, does not count.
    """
    closest_proxy = make_trace(config).closest_proxy

    @wp.func(module="unique")
    def visible_proxy(params: FrameParams, ray: wp.vec2, scene: RayScene, balls: wp.array[Probe]) -> Hit:
        direction = params.world_from_camera * wp.vec3(ray[0], ray[1], 1.0)
        hit = closest_proxy(scene, params.camera_position, direction, FAR)
        if hit.shape >= 0:
            if wp.dot(hit.geometric_normal, direction) >= 0.0:
                hit.shape = -1
            if meets_probe(balls, params.camera_position, direction, hit.t):
                hit.shape = -1
        return hit

    return visible_proxy


@functools.cache
def make_visible_cell(config: TraceConfig) -> wp.Function:
    """Return the function ``visible_cell(params, rays, scene, balls, cell, stride, margin, rect) -> Hit``.

    Its result is the hit of the proxy that a cell (block of pixels) shows. The shape is -1 if the cell shows no proxy
    from its front, or if it lies more than ``margin`` pixels outside ``rect``, so that no pixel reads it.
    """
    visible_proxy = make_visible_proxy(config)

    @wp.func(module="unique")
    def visible_cell(
        params: FrameParams,
        rays: wp.array2d[wp.vec2],
        scene: RayScene,
        balls: wp.array[Probe],
        cell: wp.vec2i,
        stride: wp.int32,
        margin: wp.int32,
        rect: wp.vec4i,
    ) -> Hit:
        row = cell_pixel(cell[0], stride, rays.shape[0])
        column = cell_pixel(cell[1], stride, rays.shape[1])
        hit = Hit()
        hit.shape = -1
        wide = wp.vec4i(rect[0] - margin, rect[1] + margin, rect[2] - margin, rect[3] + margin)
        if rect[0] < rect[1] and inside_rect(row, column, wide):
            hit = visible_proxy(params, rays[row, column], scene, balls)
        return hit

    return visible_cell


def check_edge_samples(count: int) -> None:
    """Raise an error unless ``count`` is a number of samples that ``make_sample_direction`` can place.

    Raises:
        ValueError: ``count`` is no square number.
    """
    if count < 1 or math.isqrt(count) ** 2 != count:
        raise ValueError(f"edge_samples is {count}; expected a square number such as 1, 4 or 16")


@wp.func
def look_within_pixel(params: wp.array[FrameParams], ray: wp.vec2, sample: wp.int32, side: wp.int32) -> wp.vec3:
    """Return the direction, not unit, of one of a pixel's ``side**2`` samples; a single one is at its centre."""
    inner = wp.vec3(ray[0], ray[1], 1.0)
    if side > 1:
        step = 1.0 / wp.float32(side)
        a = wp.float32(sample % side)
        b = wp.float32(sample / side)
        inner[0] += ((a + (b + 0.5) * step) * step - 0.5) / params[0].focal[0]
        inner[1] += ((b + 1.0 - (a + 0.5) * step) * step - 0.5) / params[0].focal[1]
    return params[0].world_from_camera * inner


@functools.cache
def make_sample_direction(count: int) -> wp.Function:
    """Return ``sample_direction(params, ray, sample) -> vec3``: direction of a pixel's sample in the world, not unit.

    Args:
        count: Samples of a pixel, a square number; the only one is at the centre.
    """
    side = math.isqrt(count)

    @wp.func(module="unique")
    def sample_direction(params: wp.array[FrameParams], ray: wp.vec2, sample: wp.int32) -> wp.vec3:
        return look_within_pixel(params, ray, sample, wp.static(side))

    return sample_direction


def make_visible(objects: wp.array, hits: wp.array) -> VisibleObjects:
    """Return ``VisibleObjects`` of these arrays."""
    visible = VisibleObjects()
    visible.objects, visible.hits = objects, hits
    return visible


@functools.cache
def make_trace_pixels_kernel(config: TraceConfig) -> wp.Kernel:
    """Return the kernel of ``trace_pixels``, specialised to the kinds of shape that exist."""
    closest_visible = make_primary(config)

    @wp.kernel(module="unique", enable_backward=False)
    def trace_pixels_kernel(
        row_start: wp.int32,
        # In:
        params: wp.array[FrameParams],
        rays: wp.array2d[wp.vec2],
        scene: RayScene,
        # Out:
        visible_out: VisibleObjects,
    ):
        i, j = wp.tid()
        i += row_start
        found = wp.int32(-1)
        if inside_rect(i, j, params[0].object_rect):
            ray = rays[i, j]
            direction = params[0].world_from_camera * wp.vec3(ray[0], ray[1], 1.0)
            hit = closest_visible(scene, params[0].camera_position, direction)
            if hit.shape >= 0:
                found = hit.shape
                visible_out.hits[i, j] = hit
        visible_out.objects[i, j] = found

    return trace_pixels_kernel


trace_pixels = row_launcher(make_trace_pixels_kernel, like=lambda params, rays, *_: rays)
"""Trace a ray through the centre of every pixel of ``params.object_rect``.

Args:
    config: Kinds of shape in ``scene``.
    params: (1,) FrameParams: camera and object_rect.
    rays: (H, W) undistorted x / z and y / z of each pixel centre.
    scene: Objects and proxies.
    visible_out: (H, W) objects and hits.
"""
