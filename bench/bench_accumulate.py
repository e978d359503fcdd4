"""Accumulation of the environment, by map size."""

from __future__ import annotations

import numpy as np
import warp as wp

from bench.common import measure, report_map
from bench.environments import HEIGHTS, random_map
from warp_ar.kernels.environment import accumulate
from warp_ar.kernels.structs import FrameParams, make_environment_view

TEXEL_BYTES = 3 * (12 + 4 + 12) + 2 * (12 + 4)
"""Radiance, confidence and clipped are read twice over and written."""


def run_height(height: int, device: str) -> None:
    radiance, known = random_map(height)
    shape = known.shape
    params = np.zeros(1, np.dtype(FrameParams.numpy_dtype()))
    params["time_step"] = 1 / 30
    frame = wp.array(radiance, dtype=wp.vec3), wp.array(known, dtype=wp.float32)
    clipped, total, share = (wp.zeros(shape, dtype=wp.vec3) for _ in range(3))
    confidence, change = wp.zeros(shape, dtype=wp.float32), wp.zeros(accumulate.change_shape(*shape), dtype=wp.vec2)
    params = wp.array(params, dtype=FrameParams)
    view, environment = make_environment_view(*frame, clipped), make_environment_view(total, confidence, share)

    def run() -> None:
        accumulate.measure_change(view, environment, change)
        accumulate.accumulate_environment(view, change, params, environment)

    run()  # right before fast
    assert (total.numpy()[known > 0] == radiance[known > 0]).all()
    report_map("accumulate", height, measure({"accumulate": run}, device)["accumulate"], TEXEL_BYTES, device)


def main(device: str) -> None:
    with wp.ScopedDevice(device):
        for height in HEIGHTS:
            run_height(height, device)
