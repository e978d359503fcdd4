"""Composite of a 640x480 frame: nothing, a quarter and all of it covered by layers."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from bench.common import measure, report
from warp_ar.kernels import color, composite
from warp_ar.kernels.structs import FrameParams

H, W = 480, 640
CASES = (("untouched", 0), ("quarter", H // 4), ("whole", H))


def frame_and_layers(device: str, rows: int) -> tuple[Any, ...]:
    """FrameParams, frame, tables, and layers: virtual objects and added light over the first ``rows`` rows."""
    rng = np.random.default_rng(0)
    frame = rng.integers(0, 256, (H, W, 3)).astype(np.uint8)
    virtual = np.zeros((H, W, 4), np.float32)
    added = np.zeros((H, W, 3), np.float32)
    virtual[:rows, : W // 2] = 0.3
    added[:rows] = rng.random((rows, W, 3)) * 0.3
    params = np.zeros(1, np.dtype(FrameParams.numpy_dtype()))
    params["object_rect"] = params["light_rect"] = (0, rows, 0, W)
    params["exposure_scale"] = 0.5
    return (
        wp.array(params, dtype=FrameParams, device=device),
        wp.array(frame, dtype=wp.vec3ub, device=device),
        wp.array(color.decode_table("srgb"), dtype=wp.vec3, device=device),
        wp.array(color.encode_table("srgb"), dtype=wp.vec3, device=device),
        composite.make_layers(
            wp.array(virtual, dtype=wp.vec4, device=device), wp.array(added, dtype=wp.vec3, device=device)
        ),
    )


def main(device: str) -> None:
    config = composite.CompositeConfig(virtual=True, added=True)
    for name, rows in CASES:
        inputs = frame_and_layers(device, rows)
        image = wp.zeros((H, W), wp.vec3ub, device=device)
        call = lambda inputs=inputs, image=image: composite.composite(config, *inputs, image)  # noqa: E731
        call()
        np.testing.assert_array_equal(image.numpy()[rows:], inputs[1].numpy()[rows:])
        report(f"composite {W}x{H} {name}", measure({"ours": call}, device)["ours"], device)
