"""Time from an edit of an object (move, paint, add, remove) until the next frame can begin, and time of a frame.

The modules in the kernel cache are counted as well. If the folder ``WARP_CACHE_PATH`` was empty at the start, these are
the modules compiled so far.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import warp as wp

from bench.common import time_once
from warp_ar.engine.pipeline import Pipeline
from warp_ar.scene import MetallicRoughnessMaterial, load_scene
from warp_ar.sources.sources import open_scene_source

ROUNDS = 12
"""Number of measured rounds of all edits."""


def main(device: str) -> None:
    """Print the median of each edit; every round contains all edits, so that all are measured under equal load."""
    scene = load_scene("desk")
    with open_scene_source(scene, None, loop=False) as source, Pipeline(scene, device=device) as pipeline:
        frames = itertools.cycle([frame.image for frame in itertools.islice(source, 4)])
        model = scene.objects[0]
        compiled: list[int] = []
        cache = Path(wp.config.kernel_cache_dir)
        place = np.eye(4)
        place[:3, :3] *= model.scale
        blue = MetallicRoughnessMaterial((0.2, 0.3, 0.9), 1.0, 0.4)
        works: dict[str, Callable[[], object]] = {
            "frame": lambda: pipeline(next(frames)).image,
            "add": lambda: pipeline.objects.add(dataclasses.replace(model, name="other", at=(0.1, -0.05, 0.0))),
            "frame with it": lambda: pipeline(next(frames)).image,
            "move": lambda: setattr(pipeline.objects["other"], "world_from_object", place),
            "paint": lambda: setattr(pipeline.objects["other"], "material", blue),
            "remove": lambda: pipeline.objects.remove("other"),
        }
        times: dict[str, list[float]] = {name: [] for name in works}
        for turn in range(ROUNDS + 2):
            for name, work in works.items():
                taken = time_once(lambda: (work(), pipeline.warm_up()), pipeline.device)  # noqa: B023
                if turn > 1:
                    times[name].append(taken)
                compiled.append(sum(1 for _ in cache.iterdir()))
    told = ", ".join(f"{name} {np.median(values):.1f} ms (least {min(values):.1f})" for name, values in times.items())
    counts = f"{compiled[0]}, {compiled[len(works) - 1]}, {compiled[-1]}"
    print(f"{told}; modules in the cache after the first frame, all edits, all rounds: {counts}")
