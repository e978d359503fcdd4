"""Composite on one core or a device: nothing, a quarter and all of a frame covered, against a copy of as many bytes.

On CPU both run on one thread and are timed by its processor time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from bench.common import measure, paired_ratio, report
from warp_ar.kernels import color
from warp_ar.kernels.picture import composite
from warp_ar.kernels.structs import FrameParams

SIZES = ((480, 640), (1080, 1920))
CASES = (("untouched", 0.0), ("quarter", 0.25), ("whole", 1.0))


def frame_and_layers(device: str, height: int, width: int, rows: int) -> tuple[Any, ...]:
    """FrameParams, frame, tables, and layers: all four kinds over the first ``rows`` rows."""
    rng = np.random.default_rng(0)
    frame = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    virtual = np.zeros((height, width, 4), np.float32)
    added, mirror_ball = np.zeros((2, height, width, 3), np.float32)
    ratio = np.ones((height, width, 3), np.float32)
    virtual[:rows, : width // 2] = 0.3
    added[:rows] = rng.random((rows, width, 3)) * 0.3
    ratio[:rows] = rng.random((rows, width, 3))
    mirror_ball[:rows, : width // 8] = 0.1
    params = np.zeros(1, np.dtype(FrameParams.numpy_dtype()))
    for name in ("object", "light", "shadow", "ball"):
        params[f"{name}_rect"] = (0, rows, 0, width)
    params["exposure_scale"] = 0.5
    arrays = {"virtual": (virtual, wp.vec4), "added_light": (added, wp.vec3), "shadow_ratio": (ratio, wp.vec3)}
    arrays["mirror_ball"] = (mirror_ball, wp.vec3)
    given = {name: wp.array(values, dtype=dtype, device=device) for name, (values, dtype) in arrays.items()}
    return (
        wp.array(params, dtype=FrameParams, device=device),
        wp.array(frame, dtype=wp.vec3ub, device=device),
        wp.array(color.decode_table("srgb"), dtype=wp.vec3, device=device),
        wp.array(color.encode_table("srgb"), dtype=wp.vec3, device=device),
        composite.make_layers(**given),
    )


def main(device: str) -> None:
    for height, width in SIZES:
        for name, share in CASES:
            rows = round(share * height)
            inputs = frame_and_layers(device, height, width, rows)
            image = wp.zeros((height, width), wp.vec3ub, device=device)
            # The frame is read, the picture written, layers read where they reach.
            moved = height * width * 6 + rows * width * (16 + 3 * 12)
            source, target = (wp.zeros(moved // 2, dtype=wp.uint8, device=device) for _ in range(2))
            calls = {
                "ours": lambda inputs=inputs, image=image: composite.composite(*inputs, image),
                "copy": lambda source=source, target=target: wp.copy(target, source),
            }
            calls["ours"]()
            np.testing.assert_array_equal(image.numpy()[rows:], inputs[1].numpy()[rows:])
            times = measure(calls, device, one_thread=True)
            over = round(paired_ratio(times, "ours", "copy"), 2)
            report(f"composite {width}x{height} {name}", times["ours"], device, over_copy=over)
