"""Composition of the picture: the camera's frame, virtual light on it, and virtual objects over it.

    radiance = (1 - alpha) (frame * shadow_ratio + added_light + mirror_ball) + virtual

in linear light; ``virtual`` is premultiplied by its coverage alpha. A *code* is an 8-bit pixel value. A pixel that no
layer changes keeps the frame's code exactly. A layer is read only inside its rectangle of ``FrameParams``: values
outside it may belong to an earlier frame.

Output codes are limited to those at which the camera's channels saturate, or to the frame's code if that is higher.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.color import below_saturation, decode, encode, saturation_codes
from warp_ar.kernels.launch import row_launcher
from warp_ar.kernels.rays.visibility import inside_rect
from warp_ar.kernels.structs import FrameParams, filled

wp.set_module_options({"enable_backward": False})


@wp.struct
class Layers:
    """Layers composed over the camera's frame, (H, W) each; a layer that the scene does not need is empty."""

    objects: wp.array2d[wp.vec4]  # premultiplied linear radiance and coverage; ``virtual`` is a keyword of C++
    added: wp.array2d[wp.vec3]  # linear radiance
    ratio: wp.array2d[wp.vec3]  # factor on the frame's linear radiance
    mirror_ball: wp.array2d[wp.vec3]  # change of linear radiance


@wp.struct
class LayersAt:
    """``Layers`` at one pixel."""

    objects: wp.vec4
    added: wp.vec3
    ratio: wp.vec3
    mirror_ball: wp.vec3


@wp.func
def read_layers(params: wp.array[FrameParams], layers: Layers, row: wp.int32, col: wp.int32) -> LayersAt:
    """Return the value of every layer at a pixel.

    A layer that is empty, or whose rectangle excludes the pixel, has the value 0; the shadow ratio then is 1.

    All layers are read before any value is used, so that their memory latencies overlap.
    """
    at = LayersAt()
    at.ratio = wp.vec3(1.0, 1.0, 1.0)
    if layers.objects.shape[0] > 0 and inside_rect(row, col, params[0].object_rect):
        at.objects = layers.objects[row, col]
    if layers.added.shape[0] > 0 and inside_rect(row, col, params[0].light_rect):
        at.added = layers.added[row, col]
    if layers.ratio.shape[0] > 0 and inside_rect(row, col, params[0].shadow_rect):
        at.ratio = layers.ratio[row, col]
    if layers.mirror_ball.shape[0] > 0 and inside_rect(row, col, params[0].ball_rect):
        at.mirror_ball = layers.mirror_ball[row, col]
    return at


@wp.func
def is_changed(at: LayersAt) -> wp.bool:
    """Return whether any layer changes the pixel's radiance; NaN counts as a change."""
    neutral = at.objects == wp.vec4(0.0, 0.0, 0.0, 0.0) and at.added == wp.vec3(0.0, 0.0, 0.0)
    neutral = neutral and at.ratio == wp.vec3(1.0, 1.0, 1.0) and at.mirror_ball == wp.vec3(0.0, 0.0, 0.0)
    return not neutral


@wp.func
def compose(radiance: wp.vec3, at: LayersAt) -> wp.vec3:
    """Return the radiance of a pixel with its layers over the frame's ``radiance``, which they reduce to 0 at most."""
    physical = wp.max(wp.cw_mul(radiance, at.ratio) + at.added + at.mirror_ball, wp.vec3(0.0, 0.0, 0.0))
    return (1.0 - at.objects[3]) * physical + wp.vec3(at.objects[0], at.objects[1], at.objects[2])


@wp.kernel(enable_backward=False)
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
    """Compose a run of pixels of one row."""
    i, part = wp.tid()
    i += row_start
    saturation = saturation_codes(decode_table)
    for j in range(part * run, wp.min(part * run + run, frame.shape[1])):
        code = frame[i, j]
        at = read_layers(params, layers, i, j)
        if is_changed(at):
            made = encode(encode_table, compose(decode(decode_table, code), at))
            code = below_saturation(made, code, saturation)
        image_out[i, j] = code


def make_layers(
    virtual: wp.array | None = None,
    added_light: wp.array | None = None,
    shadow_ratio: wp.array | None = None,
    mirror_ball: wp.array | None = None,
) -> Layers:
    """Return ``Layers`` of these arrays; None leaves a layer empty.

    Args:
        virtual: (H, W) vec4, premultiplied radiance of virtual objects and their coverage.
        added_light: (H, W) vec3, radiance that virtual lights add to physical surfaces.
        shadow_ratio: (H, W) vec3, factor on the frame's radiance.
        mirror_ball: (H, W) vec3, change of the frame's radiance in the mirror balls.
    """
    return filled(Layers(), objects=virtual, added=added_light, ratio=shadow_ratio, mirror_ball=mirror_ball)


composite = row_launcher(composite_kernel, runs=True)
"""Write the picture.

Args:
    params: (1,) FrameParams; its rectangles bound the layers.
    frame: (H, W) vec3ub, the camera's frame, RGB, contiguous.
    decode_table: (257,) vec3 of ``color.camera_table``, or (256,) of ``color.decode_table``.
    encode_table: Table of ``color.encode_table``.
    layers: From ``make_layers``.
    image_out: (H, W) vec3ub, contiguous; values above clipping give the code at which the camera saturates or the
        frame's code, whichever is higher; NaN gives 0.
"""
