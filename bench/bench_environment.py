"""The environment: accumulation, filling and key lights, by map size."""

from __future__ import annotations

import numpy as np
import warp as wp

from bench.common import copy_bandwidth, measure, report
from warp_ar.kernels import environment
from warp_ar.kernels.structs import FrameParams, KeyLight

HEIGHTS = (32, 64, 128, 256)
# Bytes per texel: accumulation reads radiance, confidence and clipped twice over and writes them; filling passes
# 16-byte texels down and up a pyramid of 4 / 3 of the map.
ACCUMULATE_BYTES = 3 * (12 + 4 + 12) + 2 * (12 + 4)
FILL_BYTES = 16 + 16 * 4 * 4 // 3 + 12


def run_height(height: int, device: str) -> None:
    shape = (height, 2 * height)
    rng = np.random.default_rng(0)
    surroundings = np.float32(rng.uniform(0, 1, (*shape, 3)) ** 4)
    mask = np.float32(rng.random(shape) > 0.15)
    params = np.zeros(1, np.dtype(FrameParams.numpy_dtype()))
    params["time_step"] = 1 / 30
    params = wp.array(params, dtype=FrameParams)
    radiance, confidence = wp.array(surroundings, dtype=wp.vec3), wp.array(mask, dtype=wp.float32)
    clipped, total, share = (wp.zeros(shape, dtype=wp.vec3) for _ in range(3))
    known = wp.zeros(shape, dtype=wp.float32)
    change = wp.zeros(environment.change_shape(*shape), dtype=wp.vec2)
    levels = wp.zeros(environment.fill_level_offsets(*shape)[-1], dtype=wp.vec4)
    complete, lights = wp.zeros(shape, dtype=wp.vec3), wp.zeros(environment.KEY_LIGHT_COUNT, dtype=KeyLight)
    sums, cells = wp.zeros(height, dtype=wp.vec4), wp.zeros(environment.CELL_SUMS, dtype=wp.vec4)

    def accumulate() -> None:
        environment.measure_change(radiance, confidence, total, known, change)
        environment.accumulate_environment(radiance, confidence, clipped, change, params, total, known, share)

    def fill() -> None:
        environment.seed_fill(total, known, levels)
        environment.push_pull(levels, *shape)
        environment.finish_fill(levels, complete)

    def find() -> None:
        environment.find_key_lights(complete, sums, cells, lights)

    # Right before fast.
    for step in (accumulate, fill, find):
        step()
    assert (total.numpy()[mask > 0] == surroundings[mask > 0]).all()
    assert (complete.numpy()[mask > 0] == surroundings[mask > 0]).all()
    assert np.allclose(np.linalg.norm(lights.numpy()["direction"], axis=1), 1, atol=1e-5)

    times = measure({"accumulate": accumulate, "fill": fill, "key_lights": find}, device)
    bandwidth = copy_bandwidth(device)
    for name, bytes_moved in (("accumulate", ACCUMULATE_BYTES), ("fill", FILL_BYTES), ("key_lights", 0)):
        moved = bytes_moved * shape[0] * shape[1]
        rate = moved / (np.median(times[name]) * 1e-3) / bandwidth
        report(f"{name}_{height}", times[name], device, **({"of_copy_bandwidth": round(rate, 4)} if moved else {}))


def main(device: str) -> None:
    with wp.ScopedDevice(device):
        for height in HEIGHTS:
            run_height(height, device)
