"""Separate layers of the picture: the frame as linear radiance, and the layers that are composed over it.

    picture = encode(s ((1 - alpha) max(plate * shadow_ratio + added_light + mirror_ball, 0) + objects))

with the exposure scale s (1 if the scene keeps the camera's exposure) and ``objects`` premultiplied by its coverage
alpha. ``composite`` and ``expose`` make the picture from these values. Outside a layer's rectangle, where its array may
hold values of an earlier frame, neutral values are written. ``plate`` is the camera's frame without virtual content,
with clipped pixels estimated by the method of ``expose``.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.color import decode, is_clipped
from warp_ar.kernels.launch import row_launcher
from warp_ar.kernels.picture.composite import Layers, read_layers
from warp_ar.kernels.picture.expose import ClippedEvidence, make_find_gain
from warp_ar.kernels.structs import FrameParams, Picture

wp.set_module_options({"enable_backward": False})


@wp.struct
class SeparateLayers:
    """Separate layers of the picture, (H, W) each; a layer that is not requested is empty."""

    plate: wp.array2d[wp.vec3]  # linear radiance
    objects: wp.array2d[wp.vec4]  # premultiplied linear radiance and coverage
    shadow_ratio: wp.array2d[wp.vec3]  # factor on the plate
    added_light: wp.array2d[wp.vec3]  # linear radiance
    mirror_ball: wp.array2d[wp.vec3]  # change of linear radiance, of either sign


@functools.cache
def make_separate_layers_kernel(method: str) -> wp.Kernel:
    """Return the kernel for one of the methods of ``expose``; calls with the same method share one kernel."""
    find_gain = make_find_gain(method)

    @wp.kernel(module="unique", enable_backward=False)
    def separate_layers_kernel(
        # In:
        row_start: wp.int32,
        params: wp.array[FrameParams],
        picture: Picture,
        layers: Layers,
        clipped: ClippedEvidence,
        scale: wp.array[wp.float32],
        # Out:
        out: SeparateLayers,
    ):
        i, j = wp.tid()
        i += row_start
        if out.plate.shape[0] > 0:
            code = picture.frame[i, j]
            s = float(1.0)
            if scale.shape[0] > 0:
                s = scale[0]
            radiance = find_gain(code, i, j, clipped, s) * decode(picture.decode_table, code)
            if wp.static(method == "declipped"):
                if s < 1.0 and wp.max(is_clipped(code)) > 0.0:
                    radiance = clipped.declipped[i, j]
            out.plate[i, j] = radiance
        at = read_layers(params, layers, i, j)
        if out.objects.shape[0] > 0:
            out.objects[i, j] = at.objects
        if out.shadow_ratio.shape[0] > 0:
            out.shadow_ratio[i, j] = at.ratio
        if out.added_light.shape[0] > 0:
            out.added_light[i, j] = at.added
        if out.mirror_ball.shape[0] > 0:
            out.mirror_ball[i, j] = at.mirror_ball

    return separate_layers_kernel


separate_layers = row_launcher(make_separate_layers_kernel, like=lambda params, picture, *_: picture.frame)
"""Write every layer that has an array in ``out``.

Args:
    method: Method by which ``expose`` estimates clipped pixels; ``plain`` if that stage does not run.
    params: (1,) FrameParams; its rectangles bound the layers.
    picture: (H, W) the camera's frame; rays are not read.
    layers: From ``composite.make_layers``.
    clipped: From ``expose.make_clipped_evidence``.
    scale: (1,) float32, the exposure scale; None means 1.
    out: (H, W) arrays of the requested layers.
"""
