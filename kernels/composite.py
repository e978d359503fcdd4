"""The picture: the camera's frame, what virtual light adds to it, and the virtual objects over it.

    radiance = (1 - alpha) (frame * physical_ratio + physical_added + mirrored) + virtual

in linear light; ``virtual`` is premultiplied by its coverage alpha. A pixel that none of these layers changes keeps
the frame's code bit for bit, whatever the transfer. Layers count only inside their rectangle of ``FrameParams``: what
an earlier frame left elsewhere is not seen, and not read.
"""

from __future__ import annotations

import dataclasses
import functools

import warp as wp

from warp_ar.kernels.codes import (
    WARP_LANES,
    WARP_PIXELS,
    by_warps,
    get_code,
    load_codes,
    set_code,
    store_codes,
    warp_threads,
)
from warp_ar.kernels.color import decode, encode
from warp_ar.kernels.launch import Rows, launch_rows
from warp_ar.kernels.structs import FrameParams

wp.set_module_options({"enable_backward": False})

CPU_RUN = 32
"""Pixels of a row that one thread of a CPU does."""


@dataclasses.dataclass(frozen=True)
class CompositeConfig:
    """Which layers there are; the others are not compiled in."""

    virtual: bool = False
    """Virtual objects."""
    added: bool = False
    """Virtual light on the desk."""
    ratio: bool = False
    """Shadows of the room's light, a factor on the frame."""
    mirrored: bool = False
    """What mirror balls show of what is virtual, a change of the frame."""


@wp.func
def in_rect(rect: wp.vec4i, row: wp.int32, col: wp.int32) -> wp.bool:
    """Whether a pixel lies in (row_start, row_stop, col_start, col_stop)."""
    return row >= rect[0] and row < rect[1] and col >= rect[2] and col < rect[3]


@functools.cache
def make_read_layers(config: CompositeConfig) -> wp.Function:
    """``virtual, added, ratio, change = read_layers(params, virtual, added, ratio, mirrored, row, col)`` of a pixel.

    A layer that is not there, or does not reach the pixel, changes nothing: it is 0, or a ratio of 1. All are read
    before any is looked at: one after another would be as many times the memory's latency.
    """

    @wp.func(module="unique")
    def read_layers(
        params: wp.array[FrameParams],
        virtual_layer: wp.array2d[wp.vec4],
        physical_added: wp.array2d[wp.vec3],
        physical_ratio: wp.array2d[wp.vec3],
        mirrored: wp.array2d[wp.vec3],
        row: wp.int32,
        col: wp.int32,
    ):
        virtual = wp.vec4(0.0, 0.0, 0.0, 0.0)
        added = wp.vec3(0.0, 0.0, 0.0)
        ratio = wp.vec3(1.0, 1.0, 1.0)
        change = wp.vec3(0.0, 0.0, 0.0)
        if wp.static(config.virtual):
            if in_rect(params[0].object_rect, row, col):
                virtual = virtual_layer[row, col]
        if wp.static(config.added):
            if in_rect(params[0].light_rect, row, col):
                added = physical_added[row, col]
        if wp.static(config.ratio):
            if in_rect(params[0].shadow_rect, row, col):
                ratio = physical_ratio[row, col]
        if wp.static(config.mirrored):
            if in_rect(params[0].ball_rect, row, col):
                change = mirrored[row, col]
        return virtual, added, ratio, change

    return read_layers


@wp.func
def is_changed(virtual: wp.vec4, added: wp.vec3, ratio: wp.vec3, mirrored: wp.vec3) -> wp.bool:
    """Whether layers touch a pixel; NaN does."""
    neutral = virtual == wp.vec4(0.0, 0.0, 0.0, 0.0) and added == wp.vec3(0.0, 0.0, 0.0)
    neutral = neutral and ratio == wp.vec3(1.0, 1.0, 1.0) and mirrored == wp.vec3(0.0, 0.0, 0.0)
    return not neutral


@wp.func
def compose(radiance: wp.vec3, virtual: wp.vec4, added: wp.vec3, ratio: wp.vec3, mirrored: wp.vec3) -> wp.vec3:
    """All layers over the frame's radiance; no more is taken from it than there is."""
    physical = wp.max(wp.cw_mul(radiance, ratio) + added + mirrored, wp.vec3(0.0, 0.0, 0.0))
    return (1.0 - virtual[3]) * physical + wp.vec3(virtual[0], virtual[1], virtual[2])


@functools.cache
def make_composite_kernel(config: CompositeConfig, warps: bool) -> wp.Kernel:
    """Kernel specialised to ``config``, by warps (see ``codes``) or by runs of pixels; equal ones share one kernel."""
    read_layers = make_read_layers(config)

    @wp.kernel(module="unique", enable_backward=False)
    def composite_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        frame: wp.array2d[wp.vec3ub],
        decode_table: wp.array[wp.vec3],
        encode_table: wp.array[wp.vec3],
        virtual_layer: wp.array2d[wp.vec4],
        physical_added: wp.array2d[wp.vec3],
        physical_ratio: wp.array2d[wp.vec3],
        mirrored: wp.array2d[wp.vec3],
        run: wp.int32,
        # Out:
        image_out: wp.array2d[wp.vec3ub],
    ):
        i, part = wp.tid()
        i += row_start
        if wp.static(warps):
            first = part // WARP_LANES * WARP_PIXELS
            codes = load_codes(frame, i, first)
            k = part % WARP_LANES
            while k < WARP_PIXELS:
                j = first + k
                if j < frame.shape[1]:
                    virtual, added, ratio, change = read_layers(
                        params, virtual_layer, physical_added, physical_ratio, mirrored, i, j
                    )
                    if is_changed(virtual, added, ratio, change):
                        radiance = compose(decode(decode_table, get_code(codes, k)), virtual, added, ratio, change)
                        set_code(codes, k, encode(encode_table, radiance))
                k += WARP_LANES
            store_codes(codes, image_out, i, first)
        else:
            for j in range(part * run, wp.min(part * run + run, frame.shape[1])):
                code = frame[i, j]
                virtual, added, ratio, change = read_layers(
                    params, virtual_layer, physical_added, physical_ratio, mirrored, i, j
                )
                if is_changed(virtual, added, ratio, change):
                    code = encode(encode_table, compose(decode(decode_table, code), virtual, added, ratio, change))
                image_out[i, j] = code

    return composite_kernel


def composite(
    config: CompositeConfig,
    params: wp.array,
    frame: wp.array,
    decode_table: wp.array,
    encode_table: wp.array,
    virtual: wp.array | None,
    physical_added: wp.array | None,
    physical_ratio: wp.array | None,
    image_out: wp.array,
    *,
    mirrored: wp.array | None = None,
    rows: Rows | None = None,
) -> None:
    """Write the picture.

    Args:
        config: Layers; those that it leaves out may be None.
        params: (1,) FrameParams; its rectangles bound the layers.
        frame: (H, W) vec3ub, the camera's frame, RGB, contiguous.
        decode_table: (256,) vec3 of ``color.decode_table``.
        encode_table: Table of ``color.encode_table``.
        virtual: (H, W) vec4, premultiplied linear radiance and coverage.
        physical_added: (H, W) vec3, linear radiance.
        physical_ratio: (H, W) vec3, factor on the frame's linear radiance.
        image_out: (H, W) vec3ub, contiguous; values above clipping give 255, NaN gives 0.
        mirrored: (H, W) vec3, change of linear radiance.
        rows: Band of rows; None means all.
    """
    height, width = frame.shape
    run = CPU_RUN if frame.device.is_cpu else 1
    warps = by_warps(frame.device, width)
    launch_rows(
        make_composite_kernel(config, warps),
        (height, warp_threads(width) if warps else -(-width // run)),
        [params, frame, decode_table, encode_table, virtual, physical_added, physical_ratio, mirrored, run],
        [image_out],
        rows=rows,
        device=frame.device,
    )
