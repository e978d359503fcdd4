"""Virtual light on the receiver: linear radiance that virtual lights add to each pixel of the camera's frame.

Every pixel's ray is traced to the nearest proxy. Pixels that show a mirror ball get no light here (see
``mirror_ball``). A light of irradiance E_v (facing it) arrives along wi, unless a virtual object, a proxy or a ball
hides it, and adds

    added = sum over lights of  Kd / pi * E_v * visible * response.

``kernels/receiver/receiver.py`` defines Kd and the response of each method. With *cells*
(``kernels/receiver/receiver_cells.py``), Kd takes into account that boxes and balls hide part of the environment, and
the irradiance of virtual light that lit proxies reflect to each other is added:

    added += Kd / pi * E_bounced.

Edges. Point lights have shadows without penumbra. If a pixel and a neighbour show different surfaces, of which one is
lit, or if other lights are hidden from them, the pixel is traced again with n^2 samples and averaged, as ``shade`` does
along outlines. All samples use the frame's radiance at the pixel to find the receiver's reflectance.
"""

from __future__ import annotations

import functools
import math

import warp as wp

from warp_ar.kernels.cells import any_cell_above_zero, look_up_cells
from warp_ar.kernels.edges import EdgeList, EdgeLists, holds_all, list_edge, listed_edges, sample_listed_edges
from warp_ar.kernels.launch import MOST_REGISTERS, Rows, launch_rows, row_launcher
from warp_ar.kernels.rays.area_lights import make_area_count, make_area_sample
from warp_ar.kernels.rays.shadow import (
    LightSample,
    has_penumbra,
    make_shadow,
    make_visible_share,
    sample_light,
    tile_turn,
)
from warp_ar.kernels.rays.shapes import FAR, surface_key
from warp_ar.kernels.rays.trace import make_trace, meets_probe
from warp_ar.kernels.rays.visibility import inside_rect, make_sample_direction
from warp_ar.kernels.receiver.receiver import (
    DEFAULT_REFLECTANCE,
    READINGS,
    Matter,
    Receiver,
    RelightConfig,
    frame_size,
    make_find_matter,
    make_respond,
)
from warp_ar.kernels.structs import FrameParams, Hit, Light, RayScene

wp.set_module_options({"enable_backward": False})

_INV_PI = wp.constant(wp.float32(1.0 / math.pi))
_MASKED = 8
"""Number of lights with a bit of their own, 1 if the light is hidden, in the ``visibility`` that ``relight`` writes."""
_LIT = wp.constant(1 << _MASKED)
"""Bit of ``visibility`` that is set if any virtual light arrives; higher bits hold the ``surface_key``."""
_SURFACE = wp.constant(_MASKED + 1)
_NOTHING = wp.constant(-1 << (_MASKED + 1))
_BALL = wp.constant(-2 << (_MASKED + 1))


@wp.struct
class DirectLighting:
    """Virtual light at a point of the receiver."""

    added: wp.vec3  # radiance
    visibility: wp.int32  # bits of the lights that are hidden, and ``_LIT`` if any light arrives


@functools.cache
def make_area_response(config: RelightConfig) -> wp.Function:
    """Return ``area_response(scene, receiver, hit, matter, turn)``: the sum of E_v response over emitting objects."""
    is_lit, respond = make_shadow(config.trace), make_respond(config.method)
    area_count, area_sample = make_area_count(config.area_samples), make_area_sample(config.area_samples)

    @wp.func(module="unique")
    def area_response(scene: RayScene, receiver: Receiver, hit: Hit, matter: Matter, turn: wp.float32) -> wp.vec3:
        total = wp.vec3()
        count = area_count(scene)
        for k in range(count):
            area = area_sample(scene, hit.point, hit.normal, k, count, turn)
            n_dot_l = wp.max(wp.dot(hit.normal, area.wi), 0.0)
            if wp.max(area.irradiance_normal) <= 0.0 or wp.dot(hit.geometric_normal, area.wi) <= 0.0:
                continue
            light = LightSample()
            light.wi = area.wi
            light.distance = area.distance
            if not is_lit(scene, hit.point, hit.geometric_normal, hit.error, light):
                continue
            if meets_probe(receiver.probes, hit.point, area.wi, area.distance):
                continue
            total += respond(matter, area.wi, n_dot_l) * area.irradiance_normal
        return total

    return area_response


@functools.cache
def make_direct_lighting(config: RelightConfig) -> wp.Function:
    """Return ``direct_lighting(scene, lights, receiver, hit, row, col, mirror, turn) -> DirectLighting`` of a hit.

    The pixel (row, col) shows the hit directly if ``mirror`` is zero. Otherwise it shows the hit reflected in a mirror
    ball of reflectance ``mirror``; then values of cells are not used. ``turn`` is passed to ``visible_share``.
    """
    is_lit = make_shadow(config.trace)
    visible_share = make_visible_share(config.trace) if config.soft else None
    find_matter, respond = make_find_matter(config), make_respond(config.method)
    blends = config.method in READINGS
    area_response = make_area_response(config) if config.area_samples > 0 else None

    @wp.func(module="unique")
    def direct_lighting(
        scene: RayScene,
        lights: wp.array[Light],
        receiver: Receiver,
        hit: Hit,
        row: wp.int32,
        col: wp.int32,
        mirror: wp.vec3,
        turn: wp.float32,
    ) -> DirectLighting:
        result = DirectLighting()
        key = surface_key(scene, hit)
        size = frame_size(receiver)
        matter = Matter()
        matter.kd = wp.vec3(DEFAULT_REFLECTANCE, DEFAULT_REFLECTANCE, DEFAULT_REFLECTANCE)
        if wp.static(blends):
            matter = find_matter(receiver, hit, key, row, col, mirror)
        added = wp.vec3()
        for index in range(lights.shape[0]):
            light = sample_light(lights[index], hit.point)
            n_dot_l = wp.max(wp.dot(hit.normal, light.wi), 0.0)
            if wp.dot(hit.geometric_normal, light.wi) <= 0.0 or wp.max(light.irradiance_normal) <= 0.0:
                continue
            bit = 1 << (index % wp.static(_MASKED))
            visible = float(1.0)
            if wp.static(config.soft):
                visible = visible_share(scene, hit.point, hit.geometric_normal, hit.error, lights[index], light, turn)
                if visible <= 0.0:
                    if not has_penumbra(lights[index], light):
                        result.visibility |= bit
                    continue
            else:
                if not is_lit(scene, hit.point, hit.geometric_normal, hit.error, light):
                    result.visibility |= bit
                    continue
            if meets_probe(receiver.probes, hit.point, light.wi, light.distance):
                result.visibility |= bit
                continue
            result.visibility |= _LIT
            added += visible * respond(matter, light.wi, n_dot_l) * light.irradiance_normal
        if wp.static(config.area_samples > 0):
            if scene.area_lights.shape[0] > 0:
                stored = wp.vec4()
                if wp.static(config.area_cells):
                    if mirror[0] <= 0.0:
                        stored = look_up_cells(receiver.cells.area, key, size, row, col)
                by_areas = wp.vec3(stored[0], stored[1], stored[2])
                if stored[3] <= 0.0:
                    by_areas = area_response(scene, receiver, hit, matter, turn)
                if wp.max(by_areas) > 0.0:
                    result.visibility |= _LIT
                    added += by_areas
        if wp.static(config.bounced):
            if mirror[0] <= 0.0:
                bounced = look_up_cells(receiver.cells.bounced, key, size, row, col)
                if bounced[0] + bounced[1] + bounced[2] > 0.0:
                    result.visibility |= _LIT
                    added += wp.vec3(bounced[0], bounced[1], bounced[2])
        if wp.static(config.method == "reflectance"):
            if wp.max(added) > 0.0:
                matter = find_matter(receiver, hit, key, row, col, mirror)
        result.added = wp.cw_mul(matter.kd, added) * _INV_PI
        return result

    return direct_lighting


@functools.cache
def make_relight_kernel(config: RelightConfig) -> wp.Kernel:
    """Return the kernel specialised to ``config``; equal configs share one kernel."""
    closest_proxy = make_trace(config.trace).closest_proxy
    direct_lighting = make_direct_lighting(config)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def relight_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        scene: RayScene,
        lights: wp.array[Light],
        receiver: Receiver,
        # Out:
        added_out: wp.array2d[wp.vec3],
        visibility_out: wp.array2d[wp.int32],
    ):
        i, j = wp.tid()
        i += row_start
        black = wp.vec3(0.0, 0.0, 0.0)
        added_out[i, j] = black
        if not inside_rect(i, j, params[0].light_rect):
            return
        if wp.static(config.edge_samples > 1):
            visibility_out[i, j] = _NOTHING
        if wp.static(config.bounced):
            if not inside_rect(i, j, params[0].direct_rect):
                if not any_cell_above_zero(receiver.cells.bounced, frame_size(receiver), i, j):
                    return
        ray = receiver.picture.rays[i, j]
        direction = params[0].world_from_camera * wp.vec3(ray[0], ray[1], 1.0)
        hit = closest_proxy(scene, params[0].camera_position, direction, FAR)
        # A proxy seen from behind is not a visible surface.
        if hit.shape < 0 or wp.dot(hit.geometric_normal, direction) >= 0.0:
            return
        if meets_probe(receiver.probes, params[0].camera_position, direction, hit.t):
            if wp.static(config.edge_samples > 1):
                visibility_out[i, j] = _BALL
            return
        lit = direct_lighting(scene, lights, receiver, hit, i, j, black, tile_turn(i, j))
        added_out[i, j] = lit.added
        if wp.static(config.edge_samples > 1):
            surface = surface_key(scene, hit)
            visibility_out[i, j] = (surface << _SURFACE) | lit.visibility

    return relight_kernel


@wp.func
def is_edge(visibility: wp.array2d[wp.int32], rect: wp.vec4i, row: wp.int32, column: wp.int32) -> wp.bool:
    """Return whether virtual light may have an edge between a pixel and one of its four neighbours.

    It has one if a light without penumbra is hidden from only one of the two pixels, or if they show different surfaces
    and light arrives at either. Pixels that show a ball have no edges: ``mirror_ball`` adds their light.
    """
    here = visibility[row, column]
    if here == _BALL:
        return False
    for k in range(4):
        i = row + wp.where(k == 0, -1, 0) + wp.where(k == 1, 1, 0)
        j = column + wp.where(k == 2, -1, 0) + wp.where(k == 3, 1, 0)
        if inside_rect(i, j, rect):
            there = visibility[i, j]
            if there != here and there != _BALL:
                differs = here ^ there
                if (differs & (_LIT - 1)) != 0:
                    return True
                if (differs >> _SURFACE) != 0 and ((here | there) & _LIT) != 0:
                    return True
    return False


@functools.cache
def make_sample_lighting(config: RelightConfig) -> wp.Function:
    """Return ``sample_lighting(params, scene, lights, receiver, row, col, sample) -> vec4``: (radiance, 1) of a sample.

    It is zero if the sample shows a ball: such samples are left out of the mean.
    """
    closest_proxy = make_trace(config.trace).closest_proxy
    direct_lighting = make_direct_lighting(config)
    sample_direction = make_sample_direction(config.edge_samples)

    @wp.func(module="unique")
    def sample_lighting(
        params: wp.array[FrameParams],
        scene: RayScene,
        lights: wp.array[Light],
        receiver: Receiver,
        row: wp.int32,
        col: wp.int32,
        sample: wp.int32,
    ) -> wp.vec4:
        direction = sample_direction(params, receiver.picture.rays[row, col], sample)
        hit = closest_proxy(scene, params[0].camera_position, direction, FAR)
        if meets_probe(receiver.probes, params[0].camera_position, direction, hit.t):
            return wp.vec4(0.0)
        if hit.shape < 0 or wp.dot(hit.geometric_normal, direction) >= 0.0:
            return wp.vec4(0.0, 0.0, 0.0, 1.0)
        lit = direct_lighting(scene, lights, receiver, hit, row, col, wp.vec3(), tile_turn(row, col))
        return wp.vec4(lit.added[0], lit.added[1], lit.added[2], 1.0)

    return sample_lighting


@functools.cache
def make_smooth_edges_kernel(config: RelightConfig, *, left: bool = False) -> wp.Kernel:
    """Return a kernel that finds edge pixels and samples them; if ``left``, only when the list of edges overflowed."""
    sample_lighting = make_sample_lighting(config)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def smooth_edges_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        scene: RayScene,
        lights: wp.array[Light],
        receiver: Receiver,
        visibility: wp.array2d[wp.int32],
        listed: EdgeList,
        # Out:
        added_out: wp.array2d[wp.vec3],
    ):
        i, j = wp.tid()
        if wp.static(left):
            if holds_all(listed):
                return
        rect = params[0].light_rect
        i += row_start
        if not inside_rect(i, j, rect):
            return
        if not is_edge(visibility, rect, i, j):
            return
        total = wp.vec4()
        count = wp.int32(wp.static(config.edge_samples))  # a variable: the loop must not be unrolled
        for sample in range(count):
            total += sample_lighting(params, scene, lights, receiver, i, j, sample)
        if total[3] > 0.0:
            added_out[i, j] = wp.vec3(total[0], total[1], total[2]) / total[3]

    return smooth_edges_kernel


@wp.kernel(enable_backward=False)
def list_edges_kernel(
    # In:
    row_start: wp.int32,
    params: wp.array[FrameParams],
    visibility: wp.array2d[wp.int32],
    # Out:
    list_out: EdgeList,
):
    """Append a pixel to the list if it is an edge by ``is_edge``."""
    i, j = wp.tid()
    rect = params[0].light_rect
    i += row_start
    if inside_rect(i, j, rect):
        if is_edge(visibility, rect, i, j):
            list_edge(i, j, list_out)


@functools.cache
def make_sample_edges_kernel(config: RelightConfig) -> wp.Kernel:
    """Return a kernel that computes every sample of the listed edge pixels."""
    sample_lighting = make_sample_lighting(config)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def sample_lighting_edges_kernel(
        # In:
        threads: wp.int32,
        params: wp.array[FrameParams],
        scene: RayScene,
        lights: wp.array[Light],
        receiver: Receiver,
        listed: EdgeList,
        # Out:
        samples_out: wp.array[wp.vec4],
    ):
        item = wp.tid()
        stop = listed_edges(listed) * wp.static(config.edge_samples)
        while item < stop:
            edge = listed.edges[item / wp.static(config.edge_samples)]
            sample = item % wp.static(config.edge_samples)
            samples_out[item] = sample_lighting(params, scene, lights, receiver, edge[0], edge[1], sample)
            item += threads

    return sample_lighting_edges_kernel


relight = row_launcher(make_relight_kernel, outputs=2)
"""Write the radiance that virtual lights add to the receiver; zero outside ``params[0].light_rect``.

Each pixel has one sample; if ``config.edge_samples`` exceeds 1, call ``smooth_edges`` next.

Args:
    config: Method and kinds of shape.
    params: (1,) FrameParams: camera, light_rect and, if ``config.bounced``, direct_rect.
    scene: Objects and proxies.
    lights: (n,) Light.
    receiver: From ``make_receiver``.
    added_out: (H, W) linear radiance in camera values.
    visibility_out: (H, W) bits: key of a pixel's surface, and lights hidden from it. Written only inside
        ``light_rect``; None if ``config.edge_samples`` is 1.
"""


def smooth_edges(
    config: RelightConfig,
    params: wp.array[FrameParams],
    scene: RayScene,
    lights: wp.array[Light],
    receiver: Receiver,
    visibility: wp.array2d[wp.int32],
    added_out: wp.array2d[wp.vec3],
    *,
    edge_lists: EdgeLists | None = None,
    rows: Rows | None = None,
) -> None:
    """Average ``config.edge_samples`` samples in pixels along the edges of shadows and of lit proxies.

    Args:
        config: Configuration of ``relight``.
        params: (1,) FrameParams: camera and light_rect.
        scene: Objects and proxies.
        lights: (n,) Light.
        receiver: From ``make_receiver``.
        visibility: (H, W), written by ``relight``.
        added_out: (H, W), written by ``relight``; changed in edge pixels.
        edge_lists: Scratch memory; if given, edges of all rows are listed first, then sampled in another kernel.
        rows: Band of rows; None means all.
    """
    shape, device = receiver.picture.rays.shape, receiver.picture.rays.device
    inputs = [params, scene, lights, receiver]
    if edge_lists is None:
        kernel = make_smooth_edges_kernel(config)
        launch_rows(kernel, shape, [*inputs, visibility, EdgeList()], [added_out], rows=rows, device=device)
        return
    edge_lists.listed.count.zero_()
    launch_rows(list_edges_kernel, shape, [params, visibility], [edge_lists.listed], rows=None)
    kernel = make_smooth_edges_kernel(config, left=True)
    launch_rows(kernel, shape, [*inputs, visibility, edge_lists.listed], [added_out], rows=None)
    kernel = make_sample_edges_kernel(config)
    sample_listed_edges(kernel, inputs, edge_lists, config.edge_samples, added_out, weighted=True)
