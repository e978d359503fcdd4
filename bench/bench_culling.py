"""What changes no pixel against the scene without it: processor time of a frame on one core, in turn.

Cases: an object far out of view; a light without power; a spot that falls beside all that the picture shows.
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


def cases(scene: Any) -> dict[str, tuple[Any, Any]]:
    """Scenes that hold what changes no pixel, and the same without it."""
    objects = tuple(dataclasses.replace(item, at=(FAR, 0.0, item.at[2])) for item in scene.objects)
    no_objects, no_lights = (dataclasses.replace(scene, **{name: ()}) for name in ("objects", "lights"))
    dark = tuple(dataclasses.replace(light, intensity=0.0) for light in scene.lights)
    aside = tuple(
        dataclasses.replace(light, at=(FAR, *light.at[1:]), target=(FAR, *light.target[1:])) for light in scene.lights
    )
    return {
        "object far": (dataclasses.replace(scene, objects=objects), no_objects),
        "light dark": (dataclasses.replace(scene, lights=dark), no_lights),
        "spot aside": (dataclasses.replace(scene, lights=aside), no_lights),
    }


def compare(frames: Any, holding: Any, without: Any, device: str, count: int) -> dict[str, list[float]]:
    """Milliseconds of every frame of two scenes, in turn, whose pictures must be equal."""
    times: dict[str, list[float]] = {"holding": [], "without": []}
    with contextlib.ExitStack() as close:
        pipelines = {
            name: close.enter_context(Pipeline(scene, device=device, bands=1))
            for name, scene in (("holding", holding), ("without", without))
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
    return times


def main(device: str) -> None:
    """All cases at ``medium``."""
    count = int(os.environ.get("WARP_AR_BENCH") or 60)
    frames = clip("desk", SIZES["480p"])
    for name, (holding, without) in cases(frames.scene).items():
        times = compare(frames, holding, without, device, count)
        over = round(paired_ratio(times, "holding", "without"), 3)
        report(f"culling {name}", times["holding"], device, over_scene_without=over)
