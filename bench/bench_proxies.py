"""Frames of ``desk`` with 1, 10, 40 and 100 box proxies more, a centimetre wide: how costs grow with them.

Frames are timed by the processor time of all threads, stages by the clock; the first frame apart from those after it:
kernels are loaded before, and light is estimated within the first frames and some later ones. The answer that is
checked is the light: the boxes are not in the picture, so that surfaces there are read wrongly, and still the upward
irradiance must be that of the scene without them within ``MOST_OFF``. ``WARP_AR_BENCH`` names other numbers of boxes,
separated by commas, and ``WARP_AR_QUALITY`` another preset.
"""

from __future__ import annotations

import collections
import dataclasses
import os
import statistics
import time

import numpy as np

from bench.bench_frame import SIZES, Clip, clip
from bench.common import report
from warp_ar.engine.pipeline import TRACK, Pipeline
from warp_ar.scene import Proxy, Scene

COUNTS = (1, 10, 40, 100)
SIDE = 0.01
FRAMES = 8
MOST_OFF = 0.5
UP = 4
"""Place of the irradiance of an upward surface among those that recovery reports."""


def with_boxes(scene: Scene, count: int) -> Scene:
    """The scene with so many boxes of a centimetre, in rows on the table around its card."""
    columns = 10
    boxes = tuple(
        Proxy(
            shape="box",
            at=(-0.27 + 0.06 * (k % columns), -0.09 - 0.03 * (k // columns), 0.5 * SIDE),
            size=(SIDE, SIDE, SIDE),
            rotate=(0.0, 0.0, 7.0 * k),
        )
        for k in range(count)
    )
    return dataclasses.replace(scene, proxies=(*scene.proxies, *boxes))


def frame_times(frames: Clip, device: str, quality: str) -> tuple[list[float], list[dict[str, float]], list[float]]:
    """Milliseconds of each frame and of its stages, and the upward irradiance that recovery reports at the end."""
    whole, stages = [], []
    with Pipeline(frames.scene, device=device, quality=quality, profile=True, estimates="synchronous") as pipeline:
        pipeline.warm_up()
        for index in range(FRAMES):
            start = time.process_time()
            result = pipeline(frames.images[index], time_seconds=index / 4.0, pose=frames.poses[index])
            np.asarray(result.image)
            whole.append((time.process_time() - start) * 1e3)
            stages.append({name: timing.milliseconds for name, timing in result.stages.items() if name != TRACK})
        irradiance = pipeline.arrays["recover_status"]()["irradiance_value"][UP]
    return whole, stages, irradiance


def main(device: str) -> None:
    """One line per number of boxes: the first frame, and the median of those after it."""
    frames = clip("desk", SIZES["480p"], FRAMES)
    counts = [int(word) for word in os.environ.get("WARP_AR_BENCH", "").split(",") if word] or COUNTS
    quality = os.environ.get("WARP_AR_QUALITY", "medium")
    alone = np.array(frame_times(frames, device, quality)[2])
    for count in counts:
        scene = with_boxes(frames.scene, count)
        whole, stages, irradiance = frame_times(dataclasses.replace(frames, scene=scene), device, quality)
        off = float(np.abs(irradiance / alone - 1.0).max())
        if off > MOST_OFF:
            raise AssertionError(f"{count} boxes: irradiance is off by {off:.2f}, more than {MOST_OFF}")
        dearest = collections.Counter(stages[0]).most_common(5)
        report(
            f"proxies {count} {quality}",
            whole[1:],
            device,
            first_ms=round(whole[0], 1),
            mean_ms=round(statistics.mean(whole[1:]), 1),
            irradiance_off=round(off, 3),
            stages_first_ms={name: round(ms, 1) for name, ms in dearest},
            stages_ms={name: round(statistics.median(s.get(name, 0.0) for s in stages[1:]), 1) for name, _ in dearest},
        )
