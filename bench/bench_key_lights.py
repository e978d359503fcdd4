"""Key lights of the environment, by map size."""

from __future__ import annotations

import numpy as np
import warp as wp

from bench.common import measure, report
from bench.environments import HEIGHTS, random_map
from warp_ar.kernels.environment import key_lights
from warp_ar.kernels.structs import KeyLight


def run_height(height: int, device: str) -> None:
    environment = wp.array(random_map(height)[0], dtype=wp.vec3)
    lights = wp.zeros(key_lights.KEY_LIGHT_COUNT, dtype=KeyLight)
    sums, sectors = wp.zeros(height, dtype=wp.vec4), wp.zeros(key_lights.SECTOR_SUMS, dtype=wp.vec4)

    def run() -> None:
        key_lights.find_key_lights(environment, sums, sectors, lights)

    run()  # right before fast
    assert np.allclose(np.linalg.norm(lights.numpy()["direction"], axis=1), 1, atol=1e-5)
    report(f"key_lights_{height}", measure({"key_lights": run}, device)["key_lights"], device)


def main(device: str) -> None:
    with wp.ScopedDevice(device):
        for height in HEIGHTS:
            run_height(height, device)
