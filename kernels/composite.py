"""The picture: the camera's frame, what virtual light adds to it, and the virtual objects over it.

    radiance = (1 - alpha) (frame * shadow_ratio + physical_added + mirrored) + virtual

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
    row_parts,
    set_code,
    store_codes,
)
from warp_ar.kernels.color import decode, encode
from warp_ar.kernels.launch import Rows, launch_rows
from warp_ar.kernels.structs import FrameParams
from warp_ar.kernels.visibility import inside_rect

wp.set_module_options({"enable_backward": False})


@dataclasses.dataclass(frozen=True)
class CompositeConfig:
    """Which layers there are; the others are not compiled in."""

    virtual: bool = False
    """Virtual objects."""
    added: bool = False
    """Virtual light on the receiver."""
    ratio: bool = False
    """Shadows of the environment, a factor on the frame."""
    mirrored: bool = False
    """What mirror balls show of what is virtual, a change of the frame."""

    def general(self) -> CompositeConfig:
        """For any scene: layers that it lacks may then be empty."""
        return CompositeConfig(True, True, True, True)


@wp.struct
class Layers:
    """What is laid over the frame, (H, W) each; what a ``CompositeConfig`` leaves out may be empty."""

    objects: wp.array2d[wp.vec4]  # ``virtual``, which C++ keeps for itself: premultiplied linear radiance and coverage
    added: wp.array2d[wp.vec3]  # linear radiance
    ratio: wp.array2d[wp.vec3]  # factor on the frame's linear radiance
    mirrored: wp.array2d[wp.vec3]  # change of linear radiance


@wp.struct
class LayersAt:
    """``Layers`` at one pixel."""

    objects: wp.vec4
    added: wp.vec3
    ratio: wp.vec3
    mirrored: wp.vec3


@functools.cache
def make_read_layers(config: CompositeConfig) -> wp.Function:
    """``read_layers(params, layers, row, col) -> LayersAt``.

    A layer that is not there, or does not reach the pixel, changes nothing: it is 0, or a ratio of 1. All are read
    before any is looked at: one after another would be as many times the memory's latency.
    """

    @wp.func(module="unique")
    def read_layers(params: wp.array[FrameParams], layers: Layers, row: wp.int32, col: wp.int32) -> LayersAt:
        at = LayersAt()
        at.ratio = wp.vec3(1.0, 1.0, 1.0)
        if wp.static(config.virtual):
            if layers.objects.shape[0] > 0 and inside_rect(row, col, params[0].object_rect):
                at.objects = layers.objects[row, col]
        if wp.static(config.added):
            if layers.added.shape[0] > 0 and inside_rect(row, col, params[0].light_rect):
                at.added = layers.added[row, col]
        if wp.static(config.ratio):
            if layers.ratio.shape[0] > 0 and inside_rect(row, col, params[0].shadow_rect):
                at.ratio = layers.ratio[row, col]
        if wp.static(config.mirrored):
            if layers.mirrored.shape[0] > 0 and inside_rect(row, col, params[0].ball_rect):
                at.mirrored = layers.mirrored[row, col]
        return at

    return read_layers


@wp.func
def is_changed(at: LayersAt) -> wp.bool:
    """Whether layers touch a pixel; NaN does."""
    neutral = at.objects == wp.vec4(0.0, 0.0, 0.0, 0.0) and at.added == wp.vec3(0.0, 0.0, 0.0)
    neutral = neutral and at.ratio == wp.vec3(1.0, 1.0, 1.0) and at.mirrored == wp.vec3(0.0, 0.0, 0.0)
    return not neutral


@wp.func
def compose(radiance: wp.vec3, at: LayersAt) -> wp.vec3:
    """All layers over the frame's radiance; no more is taken from it than there is."""
    physical = wp.max(wp.cw_mul(radiance, at.ratio) + at.added + at.mirrored, wp.vec3(0.0, 0.0, 0.0))
    return (1.0 - at.objects[3]) * physical + wp.vec3(at.objects[0], at.objects[1], at.objects[2])


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
        layers: Layers,
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
                    at = read_layers(params, layers, i, j)
                    if is_changed(at):
                        radiance = compose(decode(decode_table, get_code(codes, k)), at)
                        set_code(codes, k, encode(encode_table, radiance))
                k += WARP_LANES
            store_codes(codes, image_out, i, first)
        else:
            for j in range(part * run, wp.min(part * run + run, frame.shape[1])):
                code = frame[i, j]
                at = read_layers(params, layers, i, j)
                if is_changed(at):
                    code = encode(encode_table, compose(decode(decode_table, code), at))
                image_out[i, j] = code

    return composite_kernel


def make_layers(
    virtual: wp.array | None = None,
    physical_added: wp.array | None = None,
    shadow_ratio: wp.array | None = None,
    mirrored: wp.array | None = None,
) -> Layers:
    """Layers as kernels read them; None leaves one empty."""
    layers = Layers()
    given = {"objects": virtual, "added": physical_added, "ratio": shadow_ratio, "mirrored": mirrored}
    for name, array in given.items():
        if array is not None:
            setattr(layers, name, array)
    return layers


def composite(
    config: CompositeConfig,
    params: wp.array,
    frame: wp.array,
    decode_table: wp.array,
    encode_table: wp.array,
    layers: Layers,
    image_out: wp.array,
    *,
    rows: Rows | None = None,
) -> None:
    """Write the picture.

    Args:
        config: Which layers there are.
        params: (1,) FrameParams; its rectangles bound the layers.
        frame: (H, W) vec3ub, the camera's frame, RGB, contiguous.
        decode_table: (256,) vec3 of ``color.decode_table``.
        encode_table: Table of ``color.encode_table``.
        layers: From ``make_layers``.
        image_out: (H, W) vec3ub, contiguous; values above clipping give 255, NaN gives 0.
        rows: Band of rows; None means all.
    """
    height, width = frame.shape
    threads, run = row_parts(frame.device, width)
    launch_rows(
        make_composite_kernel(config, by_warps(frame.device, width)),
        (height, threads),
        [params, frame, decode_table, encode_table, layers, run],
        [image_out],
        rows=rows,
        device=frame.device,
    )
