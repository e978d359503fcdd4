"""Filling of the environment, by map size."""

from __future__ import annotations

import warp as wp

from bench.common import measure, report_map
from bench.environments import HEIGHTS, random_map
from warp_ar.kernels.environment import fill

TEXEL_BYTES = 16 + 16 * 4 * 4 // 3 + 12
"""Texels of 16 bytes pass down and up a pyramid of 4 / 3 of the map."""


def run_height(height: int, device: str) -> None:
    radiance, known = random_map(height)
    shape = known.shape
    light, confidence = wp.array(radiance, dtype=wp.vec3), wp.array(known, dtype=wp.float32)
    levels = wp.zeros(fill.fill_level_offsets(*shape)[-1], dtype=wp.vec4)
    complete = wp.zeros(shape, dtype=wp.vec3)

    def run() -> None:
        fill.seed_fill(light, confidence, levels)
        fill.push_pull(levels, *shape)
        fill.finish_fill(levels, complete)

    run()  # right before fast
    assert (complete.numpy()[known > 0] == radiance[known > 0]).all()
    report_map("fill", height, measure({"fill": run}, device)["fill"], TEXEL_BYTES, device)


def main(device: str) -> None:
    with wp.ScopedDevice(device):
        for height in HEIGHTS:
            run_height(height, device)
