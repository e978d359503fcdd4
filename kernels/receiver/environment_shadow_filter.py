"""Filter of the environment shadow's cells, and interpolation to pixels.

A cell is a block of pixels with one estimate. The filter is a mean over a window of ``side + 1`` cells squared, edge
cells at half weight, so it is centred and gives each set of samples the same weight. A window half as wide has half the
blur and twice the noise. Its mean is used where the two means differ by more than noise: at contacts and at the edges
of an emitter's shadow. With this filter, few cells of many samples have a smaller error than many cells of few samples
and twice the rays. Cells on other surfaces are left out. A pixel between cells of several surfaces interpolates the
cells of its own surface.

Ratios within ``NEGLIGIBLE`` of 1 are set to exactly 1.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.launch import MOST_REGISTERS, row_launcher
from warp_ar.kernels.rays.shapes import FACES, MESH_KEY, surface_key
from warp_ar.kernels.rays.visibility import inside_rect, make_visible_proxy
from warp_ar.kernels.receiver.environment_shadow import EnvironmentShadowConfig, ShadowCells
from warp_ar.kernels.structs import FrameParams, Probe, RayScene

wp.set_module_options({"enable_backward": False})

CONTRAST = wp.constant(wp.float32(0.03))
"""Least difference of the narrow and the wide mean at which the narrow one is used."""
NOISE = wp.constant(wp.float32(1.0))
"""Least difference of the two means at which the narrow one is used, in standard errors of the narrow one."""
NEGLIGIBLE = wp.constant(wp.float32(1.0 / 512.0))
"""Change of the ratio that is treated as 0: at most a quarter of an 8-bit code."""
DEPTH_STEP = wp.constant(wp.float32(0.03))
"""Largest relative difference of depth at which neighbours on a mesh count as the same part of it."""


@wp.func
def window_weight(offset: wp.int32, reach: wp.int32) -> wp.float32:
    """Return the weight of a cell in a window: 1 inside, 1/2 at its edge, 0 beyond."""
    distance = wp.abs(offset)
    if distance < wp.max(reach, 1):
        return 1.0
    if distance == reach:
        return 0.5
    return 0.0


@functools.cache
def make_filter_ratio_kernel(config: EnvironmentShadowConfig) -> wp.Kernel:
    """Return the kernel of ``filter_ratio`` for the given configuration."""
    wide, narrow = config.side // 2, config.side // 4
    width = 2 * wide + 1

    # Loops are not unrolled: that takes seconds of compiling and gains no speed.
    @wp.kernel(module="unique", enable_backward=False, module_options={"max_unroll": 1})
    def filter_ratio_kernel(
        # In:
        row_start: wp.int32,
        # Out:
        cells_out: ShadowCells,
    ):
        """Average a cell's neighbours on the same surface, over a window of a tile's size or one half as wide.

        The window is chosen by the means of hidden light alone: light that objects bounce is too noisy.
        """
        i, j = wp.tid()
        i += row_start
        surface = cells_out.surface
        ratio = cells_out.ratio
        bounced = cells_out.bounced
        key = surface[i, j]
        if key < 0:
            return
        depth = ratio[i, j][3]
        # Means of all neighbours, and of the nearer ones; the fourth component sums the weights.
        far_left = wp.vec4(0.0)
        near_left = wp.vec4(0.0)
        squares = wp.vec4(0.0)
        far_sent = wp.vec3(0.0)
        near_sent = wp.vec3(0.0)
        for a in range(wp.static(width)):
            ni = i + a - wp.static(wide)
            wide_row = window_weight(ni - i, wp.static(wide))
            narrow_row = window_weight(ni - i, wp.static(narrow))
            for b in range(wp.static(width)):
                nj = j + b - wp.static(wide)
                if ni >= 0 and nj >= 0 and ni < surface.shape[0] and nj < surface.shape[1]:
                    if surface[ni, nj] == key:
                        value = ratio[ni, nj]
                        # A mesh has one key for all its faces: a step of depth tells its parts apart.
                        if key % FACES != MESH_KEY or wp.abs(value[3] - depth) <= DEPTH_STEP * depth:
                            value[3] = 1.0
                            weight = wide_row * window_weight(nj - j, wp.static(wide))
                            near = narrow_row * window_weight(nj - j, wp.static(narrow))
                            sent = bounced[ni, nj]
                            far_left += weight * value
                            far_sent += weight * sent
                            if near > 0.0:
                                near_left += near * value
                                squares += near * wp.cw_mul(value, value)
                                near_sent += near * sent
        left = wp.vec3(far_left[0], far_left[1], far_left[2]) / far_left[3]
        mean = left + far_sent / far_left[3]
        if wp.static(wide > 1):
            sharp = wp.vec3(near_left[0], near_left[1], near_left[2]) / near_left[3]
            # The cells' variance is due to noise, or to an edge. At the middle of an edge both means agree.
            count = near_left[3]
            spread = wp.vec3(squares[0], squares[1], squares[2]) / count - wp.cw_mul(sharp, sharp)
            error = wp.sqrt(wp.max(wp.max(spread), 0.0) / count)
            share = wp.clamp(wp.max(wp.abs(sharp - left)) / wp.max(CONTRAST, NOISE * error) - 0.5, 0.0, 1.0)
            mean += share * (sharp + near_sent / near_left[3] - mean)
        if wp.max(wp.abs(mean - wp.vec3(1.0, 1.0, 1.0))) < NEGLIGIBLE:
            mean = wp.vec3(1.0, 1.0, 1.0)
        cells_out.filtered[i, j] = mean

    return filter_ratio_kernel


@wp.func
def between_surfaces(surface: wp.array2d[wp.int32], row: wp.int32, column: wp.int32) -> wp.vec2i:
    """Return (key, differs): the first cell's surface, and 1 if one of the other three shows another, else 0.

    The four cells have the corner (row, column) and the next row and column.
    """
    key = surface[wp.clamp(row, 0, surface.shape[0] - 1), wp.clamp(column, 0, surface.shape[1] - 1)]
    mixed = wp.bool(False)
    for corner in range(1, 4):
        ni = wp.clamp(row + corner / 2, 0, surface.shape[0] - 1)
        nj = wp.clamp(column + corner % 2, 0, surface.shape[1] - 1)
        mixed = mixed or surface[ni, nj] != key
    return wp.vec2i(key, wp.where(mixed, 1, 0))


@wp.func
def ratio_between(cells: ShadowCells, key: wp.int32, y: wp.float32, x: wp.float32) -> wp.vec3:
    """Return the ratio at (y, x), in cells, bilinearly interpolated among cells that show the surface ``key``."""
    filtered = cells.filtered
    surface = cells.surface
    row = wp.int32(wp.floor(y))
    column = wp.int32(wp.floor(x))
    total = wp.vec3(0.0)
    weights = float(0.0)
    for corner in range(4):
        ni = wp.clamp(row + corner / 2, 0, surface.shape[0] - 1)
        nj = wp.clamp(column + corner % 2, 0, surface.shape[1] - 1)
        weight = 1.0 - wp.abs(y - wp.float32(row + corner / 2))
        weight *= 1.0 - wp.abs(x - wp.float32(column + corner % 2))
        if weight > 0.0 and surface[ni, nj] == key:
            total += weight * filtered[ni, nj]
            weights += weight
    if weights == 0.0:
        # None of the four is on this surface: use the cells around them.
        for a in range(wp.max(row - 1, 0), wp.min(row + 3, surface.shape[0])):
            for b in range(wp.max(column - 1, 0), wp.min(column + 3, surface.shape[1])):
                if surface[a, b] == key:
                    total += filtered[a, b]
                    weights += 1.0
    if weights > 0.0:
        return total / weights
    return wp.vec3(1.0, 1.0, 1.0)


@functools.cache
def make_spread_ratio_kernel(config: EnvironmentShadowConfig) -> wp.Kernel:
    """Return the kernel of ``spread_ratio``, specialised to ``config``."""
    visible_proxy = make_visible_proxy(config.distant.trace)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=MOST_REGISTERS)
    def spread_ratio_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        rays: wp.array2d[wp.vec2],
        scene: RayScene,
        probes: wp.array[Probe],
        cells: ShadowCells,
        run: wp.int32,
        # Out:
        shadow_ratio_out: wp.array2d[wp.vec3],
    ):
        """Interpolate a run of pixels of one row; between several surfaces, a ray finds the pixel's own."""
        i, place = wp.tid()
        rect = params[0].shadow_rect
        begin = place * run
        i += row_start
        stride = cells.stride
        stop = wp.min(begin + run, shadow_ratio_out.shape[1])
        # Cell c was estimated at pixel c * stride + stride / 2.
        y = wp.float32(i - stride / 2) / wp.float32(stride)
        row = wp.int32(wp.floor(y))
        for j in range(begin, stop):
            value = wp.vec3(1.0, 1.0, 1.0)
            if inside_rect(i, j, rect):
                x = wp.float32(j - stride / 2) / wp.float32(stride)
                found = between_surfaces(cells.surface, row, wp.int32(wp.floor(x)))
                key = found[0]
                if found[1] != 0:
                    hit = visible_proxy(params[0], rays[i, j], scene, probes)
                    key = surface_key(scene, hit)
                if key >= 0:
                    value = ratio_between(cells, key, y, x)
            shadow_ratio_out[i, j] = value

    return spread_ratio_kernel


filter_ratio = row_launcher(make_filter_ratio_kernel, like=lambda cells: cells.surface)
"""Average the cells' estimates along surfaces; ratios within ``NEGLIGIBLE`` of 1 become exactly 1.

Args:
    config: Configuration of ``shade_environment``.
    cells_out: From ``shade_environment``; filtered is written.
"""


spread_ratio = row_launcher(make_spread_ratio_kernel, runs=True)
"""Interpolate the filtered ratio of cells to every pixel.

Args:
    config: Configuration of ``shade_environment``.
    params: (1,) FrameParams: camera, shadow_rect.
    rays: (H, W) undistorted (x / z, y / z) of each pixel's centre.
    scene: Proxies.
    probes: Mirror balls.
    cells: From ``filter_ratio``.
    shadow_ratio_out: (H, W) factor on the frame; 1 outside the rectangle and where no proxy is seen.
"""
