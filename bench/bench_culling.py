"""An object far out of view against the scene without it: processor time of a frame on one core, in turn.

``WARP_AR_BENCH`` may say how many frames are measured; 60 are usual. The frames must be equal, and they are single
threads' so that other programs disturb little. CPU only.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import time
from typing import Any

import numpy as np

from bench.bench_frame import SIZES, clip
from bench.common import paired_ratio, report
from warp_ar.engine.pipeline import Pipeline

WARM_UP = 8
FAR = 60.0
"""Metres to the side."""


def main(device: str) -> None:
    """Both scenes at ``medium``."""
    count = int(os.environ.get("WARP_AR_BENCH") or 60)
    frames = clip("desk", SIZES["480p"])
    moved = tuple(dataclasses.replace(item, at=(FAR, 0.0, item.at[2])) for item in frames.scene.objects)
    scenes: dict[str, Any] = {"far": moved, "without": ()}
    times: dict[str, list[float]] = {name: [] for name in scenes}
    with contextlib.ExitStack() as close:
        pipelines = {
            name: close.enter_context(
                Pipeline(dataclasses.replace(frames.scene, objects=objects), device=device, bands=1)
            )
            for name, objects in scenes.items()
        }
        for index in range(WARM_UP + count):
            shown = []
            for name, pipeline in pipelines.items():
                place = index % len(frames.images)
                begin = time.thread_time()
                result = pipeline(frames.images[place], time_seconds=index / 24.0, pose=frames.poses[place])
                shown.append(result.image)
                if index >= WARM_UP:
                    times[name].append((time.thread_time() - begin) * 1e3)
            np.testing.assert_array_equal(*shown)
    over = round(paired_ratio(times, "far", "without"), 3)
    report("culling object far", times["far"], device, over_scene_without=over)
