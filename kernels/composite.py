"""The picture: the camera's frame, what virtual light adds to it, and the virtual objects over it.

    radiance = (1 - alpha) (frame * physical_ratio + physical_added) + virtual

in linear light; ``virtual`` is premultiplied by its coverage alpha. A pixel that none of these layers changes keeps
the frame's code bit for bit, whatever the transfer. Layers count only inside their rectangle of ``FrameParams``: what
an earlier frame left elsewhere is not seen.
"""

from __future__ import annotations

import dataclasses
import functools

import warp as wp

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


@wp.func
def in_rect(rect: wp.vec4i, row: wp.int32, col: wp.int32) -> wp.bool:
    """Whether a pixel lies in (row_start, row_stop, col_start, col_stop)."""
    return row >= rect[0] and row < rect[1] and col >= rect[2] and col < rect[3]


@functools.cache
def make_is_changed(config: CompositeConfig) -> wp.Function:
    """Whether a layer touches a pixel: ``is_changed(params, virtual, added, ratio, row, col) -> bool``."""

    @wp.func(module="unique")
    def is_changed(
        params: wp.array[FrameParams],
        virtual_layer: wp.array2d[wp.vec4],
        physical_added: wp.array2d[wp.vec3],
        physical_ratio: wp.array2d[wp.vec3],
        row: wp.int32,
        col: wp.int32,
    ) -> wp.bool:
        if wp.static(config.virtual):
            if in_rect(params[0].object_rect, row, col):
                neutral = virtual_layer[row, col] == wp.vec4(0.0, 0.0, 0.0, 0.0)
                if not neutral:  # NaN is a change
                    return True
        if wp.static(config.added):
            if in_rect(params[0].light_rect, row, col):
                neutral = physical_added[row, col] == wp.vec3(0.0, 0.0, 0.0)
                if not neutral:  # NaN is a change
                    return True
        if wp.static(config.ratio):
            neutral = physical_ratio[row, col] == wp.vec3(1.0, 1.0, 1.0)
            if not neutral:  # NaN is a change
                return True
        return False

    return is_changed


@functools.cache
def make_compose(config: CompositeConfig) -> wp.Function:
    """All layers over the frame's radiance: ``compose(radiance, params, virtual, added, ratio, row, col) -> vec3``."""

    @wp.func(module="unique")
    def compose(
        frame_radiance: wp.vec3,
        params: wp.array[FrameParams],
        virtual_layer: wp.array2d[wp.vec4],
        physical_added: wp.array2d[wp.vec3],
        physical_ratio: wp.array2d[wp.vec3],
        row: wp.int32,
        col: wp.int32,
    ) -> wp.vec3:
        radiance = frame_radiance
        if wp.static(config.ratio):
            radiance = wp.cw_mul(radiance, physical_ratio[row, col])
        if wp.static(config.added):
            if in_rect(params[0].light_rect, row, col):
                radiance += physical_added[row, col]
        if wp.static(config.virtual):
            if in_rect(params[0].object_rect, row, col):
                layer = virtual_layer[row, col]
                radiance = (1.0 - layer[3]) * radiance + wp.vec3(layer[0], layer[1], layer[2])
        return radiance

    return compose


@functools.cache
def make_composite_kernel(config: CompositeConfig) -> wp.Kernel:
    """Kernel specialised to ``config``; equal configs share one kernel."""
    is_changed = make_is_changed(config)
    compose = make_compose(config)

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
        run: wp.int32,
        # Out:
        image_out: wp.array2d[wp.vec3ub],
    ):
        i, part = wp.tid()
        i += row_start
        for j in range(part * run, wp.min(part * run + run, frame.shape[1])):
            code = frame[i, j]
            if is_changed(params, virtual_layer, physical_added, physical_ratio, i, j):
                radiance = decode(decode_table, code)
                radiance = compose(radiance, params, virtual_layer, physical_added, physical_ratio, i, j)
                code = encode(encode_table, radiance)
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
    rows: Rows | None = None,
) -> None:
    """Write the picture.

    Args:
        config: Layers; those that it leaves out may be None.
        params: (1,) FrameParams; its rectangles bound the layers.
        frame: (H, W) vec3ub, the camera's frame, RGB.
        decode_table: (256,) vec3 of ``color.decode_table``.
        encode_table: Table of ``color.encode_table``.
        virtual: (H, W) vec4, premultiplied linear radiance and coverage.
        physical_added: (H, W) vec3, linear radiance.
        physical_ratio: (H, W) vec3, factor on the frame's linear radiance.
        image_out: (H, W) vec3ub; values above clipping give 255, NaN gives 0.
        rows: Band of rows; None means all.
    """
    height, width = frame.shape
    run = CPU_RUN if frame.device.is_cpu else 1
    launch_rows(
        make_composite_kernel(config),
        (height, -(-width // run)),
        [params, frame, decode_table, encode_table, virtual, physical_added, physical_ratio, run],
        [image_out],
        rows=rows,
        device=frame.device,
    )
