"""Radiance of clipped pixels: the frame's linear radiance with an estimate wherever a channel clips.

A clipped channel gives only a lower bound, 1. Three sources give an estimate:

**Hue.** Where some channels are clipped and others are not, the unclipped channels u give the brightness, and the hue c
of the surroundings gives the clipped channels:

    k = sum_u L_u / sum_u c_u,   L_clipped = max(1, k c_clipped).

The hue is interpolated from unclipped bright neighbours, with the weight ((m - 1/4) / (3/4))^2 for a largest channel m
above 1/4: dark neighbours may be lit by other light. In a second pass the completed pixels give their hue to the core,
the pixels in which all channels are clipped. The darkest channel of the core is at least 1, so the others are at least
c / min c: red at the edge of a yellow emitter exceeds 1 long before blue clips.

**Depth.** Radiance grows inward from that edge value e toward a value a, ever more slowly. With q, a smooth log2 of the
distance to the nearest known pixel (1 at the edge),

    L = e (a / e)^(1 - 2^(-q / 2)).

Without the ball, a is one stop above e. That is near the median of clipped pixels in panoramas seen in perspective and
in a mirror ball (a third to half a stop at the edge, 0.4 to 1 beyond two pixels).

**The ball.** The light recovered from the ball (``recover``) gives a. A core pixel that shows the ball takes the light
that the ball reflects. A core pixel that shows a modelled surface is not an emitter: hue and depth are used. Any
other shows a point beyond the scene, at an unknown distance t along the pixel's ray o + t d. The ball at p sees this
point in the direction d + (o - p) / t. With 1 / t growing from 0, the first connected run of directions whose light
also clips in the ball is taken for the point, and its brightest texel gives a. Emitters have sharper edges than glow on
surfaces, so there the exponent is 1 - 2^-q. (It is not 1 everywhere, because the recovered energy of a region is spread
evenly over it.)

**Filling.** Push-pull over a pyramid [GGSC96]. Upward, a texel sums the weighted values of its children. Downward, a
texel of less than full weight is completed from the coarser level, bilinearly. The number of levels climbed, a smooth
log2 of the distance, is filled along with the hue. Only tiles with clipped pixels, and their neighbours, take part.

References:
    [GGSC96] Gortler, Grzeszczuk, Szeliski, Cohen, "The Lumigraph", SIGGRAPH 1996, section 3.4 (pull-push).
"""

from __future__ import annotations

import dataclasses
import functools
import math

import warp as wp

from warp_ar.kernels.color import decode
from warp_ar.kernels.latlong import sample_latlong
from warp_ar.kernels.launch import launch, row_launcher
from warp_ar.kernels.rays.shapes import FAR, intersect_sphere
from warp_ar.kernels.rays.trace import TraceConfig, make_trace
from warp_ar.kernels.structs import FrameParams, Picture, Probe, RayScene

wp.set_module_options({"enable_backward": False})

KNEE = wp.constant(wp.float32(250.0))
"""8-bit value above which a channel is partly clipped: noise and video codecs scatter values around clipping."""
CLIPPED = wp.constant(wp.float32(254.0))
"""8-bit value from which a channel is fully clipped."""
TILE_LEVEL = 4
"""Level of the pyramid whose texels are tiles, 2^4 = 16 pixels wide."""
_TILE_LEVEL = wp.constant(TILE_LEVEL)
DARKEST = wp.constant(wp.float32(0.25))
"""Linear value of the largest channel below which a pixel's hue has no weight: two stops below clipping."""
LEAST_HUE = wp.constant(wp.float32(1.0 / 64.0))
"""Smallest channel of a hue; bounds the estimate of one channel from another."""
BRIGHTEST = wp.constant(wp.float32(1.0e4))
"""Upper bound of every estimate."""
NEAREST = wp.constant(wp.float32(2.0))
"""Largest ratio of the distance between camera and ball to the distance t of a point: bounds the search from below."""


@dataclasses.dataclass(frozen=True)
class DeclipConfig:
    """Compile-time configuration of ``complete_core``."""

    ball: bool = False
    """True if the light recovered from the ball is used."""
    proxies: tuple[int, ...] = ()
    """Kinds of proxy in the scene."""


@wp.func
def clipping(code: wp.vec3ub) -> wp.vec3:
    """Return the degree of clipping of each channel: 0 up to ``KNEE``, 1 from ``CLIPPED`` on, linear between."""
    clipped = wp.vec3()
    for channel in range(3):
        clipped[channel] = wp.clamp((wp.float32(code[channel]) - KNEE) / (CLIPPED - KNEE), 0.0, 1.0)
    return clipped


@wp.func
def half(extent: wp.int32) -> wp.int32:
    """Return the rows (or columns) of the pyramid's first level, for a frame of ``extent`` rows (or columns)."""
    return (extent + 1) / 2


@wp.func
def hue_weight(radiance: wp.vec3) -> wp.float32:
    """Return the weight, 0..1, of the hue of an unclipped pixel of linear ``radiance``."""
    w = wp.clamp((wp.max(radiance) - DARKEST) / (1.0 - DARKEST), 0.0, 1.0)
    return w * w


@wp.func
def weighted_hue(radiance: wp.vec3) -> wp.vec4:
    """Return (R, G, B, weight): the hue, scaled to a mean of 1, times its weight; and the weight."""
    w = hue_weight(radiance)
    if w == 0.0:
        return wp.vec4()
    scale = 3.0 * w / (radiance[0] + radiance[1] + radiance[2])
    return wp.vec4(scale * radiance[0], scale * radiance[1], scale * radiance[2], w)


@wp.kernel(enable_backward=False)
def mark_tiles_kernel(
    # In:
    row_start: wp.int32,
    frame: wp.array2d[wp.vec3ub],
    # Out:
    marked_out: wp.array2d[wp.int32],
):
    """Write 1 for tiles with a clipped channel, else 0."""
    i, j = wp.tid()
    i += row_start
    found = wp.int32(0)
    for r in range(i << _TILE_LEVEL, wp.min((i + 1) << _TILE_LEVEL, frame.shape[0])):
        for c in range(j << _TILE_LEVEL, wp.min((j + 1) << _TILE_LEVEL, frame.shape[1])):
            code = frame[r, c]
            if wp.float32(wp.max(wp.max(code[0], code[1]), code[2])) > KNEE:
                found = wp.int32(1)
    marked_out[i, j] = found


@wp.kernel(enable_backward=False)
def widen_tiles_kernel(
    # In:
    marked: wp.array2d[wp.int32],
    # Out:
    active_out: wp.array2d[wp.int32],
):
    """Write 1 for tiles that are marked or have a marked neighbour among eight, else 0."""
    i, j = wp.tid()
    found = wp.int32(0)
    for r in range(wp.max(i - 1, 0), wp.min(i + 2, marked.shape[0])):
        for c in range(wp.max(j - 1, 0), wp.min(j + 2, marked.shape[1])):
            found = wp.max(found, marked[r, c])
    active_out[i, j] = found


@wp.kernel(enable_backward=False)
def pull_frame_kernel(
    # In:
    row_start: wp.int32,
    active: wp.array2d[wp.int32],
    frame: wp.array2d[wp.vec3ub],
    decode_table: wp.array[wp.vec3],
    completed: wp.array2d[wp.vec3],
    # Out:
    levels_out: wp.array[wp.vec4],
):
    """Write the first level: weighted hues of pixels without a clipped channel.

    If there is a ``completed`` frame, pixels with at least one unclipped channel count as well.
    """
    i, j = wp.tid()
    i += row_start
    total = wp.vec4()
    if active[i >> (_TILE_LEVEL - 1), j >> (_TILE_LEVEL - 1)] != 0:
        for r in range(2 * i, wp.min(2 * i + 2, frame.shape[0])):
            for c in range(2 * j, wp.min(2 * j + 2, frame.shape[1])):
                clipped = clipping(frame[r, c])
                if completed.shape[0] > 0:
                    if wp.min(clipped) == 0.0:
                        total += weighted_hue(completed[r, c])
                elif wp.max(clipped) == 0.0:
                    total += weighted_hue(decode(decode_table, frame[r, c]))
    levels_out[i * half(frame.shape[1]) + j] = total


@wp.kernel(enable_backward=False)
def pull_level_kernel(
    # In:
    active: wp.array2d[wp.int32],
    to_tile: wp.int32,
    fine_offset: wp.int32,
    fine_rows: wp.int32,
    fine_columns: wp.int32,
    offset: wp.int32,
    columns: wp.int32,
    # Out (and in: the finer level):
    levels_out: wp.array[wp.vec4],
):
    """Write one texel of a level: the sum of four texels of the next finer level; 0 in inactive tiles."""
    i, j = wp.tid()
    if to_tile >= 0 and active[i >> to_tile, j >> to_tile] == 0:
        levels_out[offset + i * columns + j] = wp.vec4()
        return
    total = wp.vec4()
    for r in range(2 * i, wp.min(2 * i + 2, fine_rows)):
        for c in range(2 * j, wp.min(2 * j + 2, fine_columns)):
            total += levels_out[fine_offset + r * fine_columns + c]
    levels_out[offset + i * columns + j] = total


@wp.func
def sample_coarser(
    levels: wp.array[wp.vec4], offset: wp.int32, rows: wp.int32, columns: wp.int32, i: wp.int32, j: wp.int32
) -> wp.vec4:
    """Return the filled value of a level, bilinear, at texel (i, j) of the next finer level; clamped at the border."""
    y = wp.clamp(0.5 * wp.float32(i) - 0.25, 0.0, wp.float32(rows - 1))
    x = wp.clamp(0.5 * wp.float32(j) - 0.25, 0.0, wp.float32(columns - 1))
    r = wp.int32(y)
    c = wp.int32(x)
    fy = y - wp.float32(r)
    fx = x - wp.float32(c)
    below = wp.min(r + 1, rows - 1)
    right = wp.min(c + 1, columns - 1)
    top = levels[offset + r * columns + c] * (1.0 - fx) + levels[offset + r * columns + right] * fx
    bottom = levels[offset + below * columns + c] * (1.0 - fx) + levels[offset + below * columns + right] * fx
    return top * (1.0 - fy) + bottom * fy


@wp.kernel(enable_backward=False)
def push_level_kernel(
    # In:
    active: wp.array2d[wp.int32],
    to_tile: wp.int32,
    coarse_offset: wp.int32,
    coarse_rows: wp.int32,
    coarse_columns: wp.int32,
    offset: wp.int32,
    columns: wp.int32,
    # Out (and in: the coarser level, and the sums that are replaced):
    levels_out: wp.array[wp.vec4],
):
    """Replace a texel's sums by its value: hue, and levels climbed.

    A texel of weight below 1 is completed from the coarser level; the coarsest level (``coarse_rows`` 0) from grey.
    """
    i, j = wp.tid()
    if to_tile >= 0 and active[i >> to_tile, j >> to_tile] == 0:
        return
    at = offset + i * columns + j
    sums = levels_out[at]
    above = wp.vec4(1.0, 1.0, 1.0, 0.0)
    if coarse_rows > 0:
        above = sample_coarser(levels_out, coarse_offset, coarse_rows, coarse_columns, i, j)
    known = wp.min(sums[3], 1.0)
    unknown = 1.0 - known
    # Sums of a weight up to 1 stay as they are, so there is no division by a weight of 0.
    share = wp.where(sums[3] > 1.0, 1.0 / wp.max(sums[3], 1.0), 1.0)
    levels_out[at] = wp.vec4(
        share * sums[0] + unknown * above[0],
        share * sums[1] + unknown * above[1],
        share * sums[2] + unknown * above[2],
        unknown * (above[3] + 1.0),
    )


@wp.func
def hue_of(filled: wp.vec4) -> wp.vec3:
    """Return the hue of a texel from ``fill_levels``, with channels of at least ``LEAST_HUE``."""
    return wp.vec3(wp.max(filled[0], LEAST_HUE), wp.max(filled[1], LEAST_HUE), wp.max(filled[2], LEAST_HUE))


@wp.kernel(enable_backward=False)
def complete_kernel(
    # In:
    row_start: wp.int32,
    active: wp.array2d[wp.int32],
    frame: wp.array2d[wp.vec3ub],
    decode_table: wp.array[wp.vec3],
    levels: wp.array[wp.vec4],
    # Out:
    declipped_out: wp.array2d[wp.vec3],
):
    """Write one pixel's linear radiance; in active tiles, clipped channels are estimated by the neighbours' hue."""
    i, j = wp.tid()
    i += row_start
    if active[i >> _TILE_LEVEL, j >> _TILE_LEVEL] == 0:
        return
    code = frame[i, j]
    radiance = decode(decode_table, code)
    clipped = clipping(code)
    if wp.max(clipped) > 0.0 and wp.min(clipped) == 0.0:
        hue = hue_of(sample_coarser(levels, 0, half(frame.shape[0]), half(frame.shape[1]), i, j))
        kept = wp.vec3()
        for channel in range(3):
            kept[channel] = wp.where(clipped[channel] > 0.0, 0.0, 1.0)
        k = wp.dot(kept, radiance) / wp.dot(kept, hue)
        for channel in range(3):
            guess = wp.clamp(k * hue[channel], radiance[channel], BRIGHTEST)
            radiance[channel] += clipped[channel] * (guess - radiance[channel])
    declipped_out[i, j] = radiance


@functools.cache
def make_seen_by_ball(config: DeclipConfig) -> wp.Function:
    """Return the function ``seen_by_ball(environment, probes, params, scene, ray) -> vec3``: light along a pixel's ray.

    It is the radiance that was recovered from the ball. It is 0 if the ray meets a proxy, or if the ball shows no
    clipped light in the directions in which the ray's points may lie.
    """
    trace = make_trace(TraceConfig(objects=(), proxies=config.proxies))

    @wp.func(module="unique")
    def seen_by_ball(
        environment: wp.array2d[wp.vec3], probes: wp.array[Probe], params: FrameParams, scene: RayScene, ray: wp.vec2
    ) -> wp.vec3:
        origin = params.camera_position
        direction = wp.normalize(params.world_from_camera * wp.vec3(ray[0], ray[1], 1.0))
        nearest = wp.float32(FAR)
        ball = int(-1)
        for b in range(probes.shape[0]):
            t = intersect_sphere(probes[b].radius, origin - probes[b].center, direction, nearest)
            if t < nearest:
                nearest = t
                ball = b
        if wp.static(len(config.proxies) > 0):
            if trace.occluded_by_proxies(scene, origin, direction, nearest):
                return wp.vec3()
        if ball >= 0:
            normal = wp.normalize(origin + nearest * direction - probes[ball].center)
            wi = direction - 2.0 * wp.dot(direction, normal) * normal
            return wp.cw_mul(probes[ball].reflectance, sample_latlong(environment, wi))
        found = wp.vec3()
        best = float(1.0)
        steps = environment.shape[0] / 2  # uniform in 1 / t: neighbours are less than two texels apart
        for step in range(steps):
            share = NEAREST * wp.float32(step) / wp.float32(steps)
            radiance = sample_latlong(environment, direction + share * wp.normalize(origin - probes[0].center))
            # Light clips in the ball's image from 1 / reflectance on, in every channel.
            if wp.min(wp.cw_mul(probes[0].reflectance, radiance)) >= 1.0:
                if wp.max(radiance) > best:
                    best = wp.max(radiance)
                    found = radiance
            elif best > 1.0:
                break
        return found

    return seen_by_ball


@functools.cache
def make_complete_core_kernel(config: DeclipConfig) -> wp.Kernel:
    """Return the kernel of ``complete_core``; equal configs share one kernel."""
    seen_by_ball = make_seen_by_ball(config) if config.ball else None

    @wp.kernel(module="unique", enable_backward=False)
    def complete_core_kernel(
        # In:
        row_start: wp.int32,
        picture: Picture,
        levels: wp.array[wp.vec4],
        params: wp.array[FrameParams],
        scene: RayScene,
        probes: wp.array[Probe],
        environment: wp.array2d[wp.vec3],
        # Out:
        declipped_out: wp.array2d[wp.vec3],
    ):
        i, j = wp.tid()
        i += row_start
        clipped = clipping(picture.frame[i, j])
        if wp.min(clipped) == 0.0:
            return
        rows = half(declipped_out.shape[0])
        filled = sample_coarser(levels, 0, rows, half(declipped_out.shape[1]), i, j)
        hue = hue_of(filled)
        edge = hue / wp.min(hue)
        inside = 2.0 * edge
        rate = float(0.5)
        if wp.static(config.ball):
            seen = seen_by_ball(environment, probes, params[0], scene, picture.rays[i, j])
            if wp.max(seen) > 0.0:
                inside = seen
                rate = 1.0
        growth = 1.0 - wp.pow(2.0, -rate * (filled[3] + 1.0))
        for channel in range(3):
            stops = wp.log2(wp.clamp(inside[channel], 1.0, BRIGHTEST) / edge[channel])
            guess = wp.max(edge[channel] * wp.pow(2.0, growth * stops), 1.0)
            radiance = declipped_out[i, j][channel]
            declipped_out[i, j][channel] = radiance + clipped[channel] * (guess - radiance)

    return complete_core_kernel


@functools.cache
def level_shapes(height: int, width: int) -> tuple[tuple[int, int], ...]:
    """Return (rows, columns) of all levels, from half the frame's size to one texel."""
    shapes = [(-(-height // 2), -(-width // 2))]
    while max(shapes[-1]) > 1:
        rows, columns = shapes[-1]
        shapes.append((-(-rows // 2), -(-columns // 2)))
    return tuple(shapes)


def level_texels(height: int, width: int) -> int:
    """Return the number of texels of all levels."""
    return sum(map(math.prod, level_shapes(height, width)))


def tile_shape(height: int, width: int) -> tuple[int, int]:
    """Return the rows and columns of tiles."""
    side = 1 << TILE_LEVEL
    return -(-height // side), -(-width // side)


mark_tiles = row_launcher(mark_tiles_kernel)
"""Mark the tiles, ``tile_shape(H, W)`` int32, of a frame, (H, W) vec3ub, in which some channel clips."""


def widen_tiles(marked: wp.array, active_out: wp.array) -> None:
    """Write 1 for marked tiles and their eight neighbours, else 0; both arrays are ``tile_shape(H, W)`` int32."""
    launch(widen_tiles_kernel, active_out.shape, [marked], [active_out], device=marked.device)


pull_frame = row_launcher(pull_frame_kernel, like=lambda active, frame, *_: level_shapes(*frame.shape)[0])
"""Write the first level: weighted hues of unclipped pixels.

Args:
    active: Tiles from ``widen_tiles``; texels of inactive tiles become 0.
    frame: (H, W) vec3ub, RGB.
    decode_table: (256,) vec3 of ``color.decode_table``.
    completed: (H, W) vec3 from ``complete``; if given, its pixels with at least one unclipped channel count. If None,
        pixels of the frame without a clipped channel count.
    levels_out: (``level_texels(H, W)``,) vec4: sums of weighted hue, and of weights.
"""


def fill_levels(active: wp.array, shape: tuple[int, int], levels_out: wp.array) -> None:
    """Sum the first level up to the coarsest, then fill in missing values from the coarsest level down to the first.

    Args:
        active: Tiles from ``widen_tiles``.
        shape: Height and width of the frame.
        levels_out: On entry, the first level holds sums of weighted hue and of weights. On return, all levels hold hue
            and the number of levels climbed.
    """
    shapes = level_shapes(*shape)
    offsets = [sum(map(math.prod, shapes[:level])) for level in range(len(shapes))]
    device = levels_out.device
    for level in range(1, len(shapes)):
        finer = offsets[level - 1], *shapes[level - 1]
        given = [active, TILE_LEVEL - 1 - level, *finer, offsets[level], shapes[level][1]]
        launch(pull_level_kernel, shapes[level], given, [levels_out], device=device)
    coarser = (0, 0, 0)
    for level in reversed(range(len(shapes))):
        given = [active, TILE_LEVEL - 1 - level, *coarser, offsets[level], shapes[level][1]]
        launch(push_level_kernel, shapes[level], given, [levels_out], device=device)
        coarser = (offsets[level], *shapes[level])


complete = row_launcher(complete_kernel)
"""Write the frame's linear radiance, and estimate clipped channels of pixels with unclipped ones by the filled hue.

Args:
    active: Tiles from ``widen_tiles``; other tiles are only decoded.
    frame: (H, W) vec3ub, RGB.
    decode_table: (256,) vec3 of ``color.decode_table``.
    levels: Filled levels from ``pull_frame`` and ``fill_levels``.
    declipped_out: (H, W) vec3.
"""


complete_core = row_launcher(make_complete_core_kernel)
"""Write the estimate of pixels in which all channels are clipped.

Args:
    config: Use of the ball's light, and kinds of proxy.
    picture: (H, W) codes and rays of the frame.
    levels: Filled levels from ``pull_frame`` of the completed frame, and ``fill_levels``.
    params: (1,) FrameParams; the camera's pose.
    scene: Proxies.
    probes: Balls; ``environment`` is the light at the first.
    environment: (rows, columns) vec3, with recovered light; None without ``config.ball``.
    declipped_out: (H, W) vec3; other pixels are left unchanged.
"""
