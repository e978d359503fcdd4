"""Exposure of a 640x480 frame: the frame alone and with layers, every method, a tenth of it saturated."""

from __future__ import annotations

import numpy as np
import warp as wp

from bench.bench_composite import H, W, frame_and_layers
from bench.common import measure, report
from warp_ar.kernels.picture import composite, expose, summed_area
from warp_ar.kernels.structs import make_picture


def main(device: str) -> None:
    params, frame, decode, encode, over = frame_and_layers(device, H)
    picture = frame.numpy()
    picture[: H // 10] = 255
    frame = wp.array(picture, dtype=wp.vec3ub, device=device)
    table, image = wp.zeros((H, W), wp.uint32, device=device), wp.zeros((H, W), wp.vec3ub, device=device)
    scale, codes = wp.zeros(1, wp.float32, device=device), wp.zeros(256, wp.vec3ub, device=device)
    light = decode.numpy()[picture, np.arange(3)]
    declipped = wp.array(np.where(picture >= 254, 2.0 * light, light), dtype=wp.vec3, device=device)
    summed_area.sum_area(frame, table)
    shown, exposure = make_picture(frame, decode, None), expose.make_exposure(encode, scale, codes)
    clipped = expose.make_clipped_evidence(H, table, declipped)
    for name, layers in (("frame", composite.make_layers()), ("layers", over)):
        contenders = {}
        for method in expose.METHODS:

            def call(method: str = method, layers: composite.Layers = layers) -> None:
                expose.read_scale(params, scale)
                expose.expose_codes(decode, encode, scale, codes)
                expose.expose(method, params, shown, layers, clipped, exposure, image)

            call()
            if name == "frame":  # black stays black, nothing that was not clipped brightens
                assert (image.numpy()[H // 10 :] <= picture[H // 10 :]).all()
            contenders[method] = call
        for method, times in measure(contenders, device).items():
            report(f"expose {W}x{H} {name} {method}", times, device)
