"""Time that each layer adds to a frame, measured in turn with the picture alone; and time and size of its file.

``again`` is the picture alone a second time: its difference is the measurement error. ``WARP_AR_BENCH`` sets the number
of measured frames; the default is 30. On CPU, times are processor time of one thread; on CUDA, elapsed time until the
layers are on the host. ``file_ms`` is the processor time of encoding a frame as OpenEXR, ``file_kb`` the file's size.
"""

from __future__ import annotations

import contextlib
import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from bench.bench_frame import SIZES, clip
from bench.common import paired_ratio, report
from warp_ar import LAYERS
from warp_ar.engine.layers import RADIANCE
from warp_ar.engine.pipeline import Pipeline
from warp_ar.output.layer_file import layer_frame, write_layers

WARM_UP = 3
PLAIN = "picture"


def contenders() -> dict[str, tuple[str, ...]]:
    """Return the outputs of each contender, by the name of the layer that it adds to the picture."""
    single = {name: ("image", name) for name in (*LAYERS, RADIANCE)}
    return {PLAIN: ("image",), "again": ("image",), **single, "all": ("image", *LAYERS)}


def main(device: str) -> None:
    """Measure the scene ``desk`` at the default quality and 480p."""
    count = int(os.environ.get("WARP_AR_BENCH") or 30)
    frames = clip("desk", SIZES["480p"])
    clock = time.thread_time if device == "cpu" else time.perf_counter
    times: dict[str, list[float]] = {name: [] for name in contenders()}
    files: dict[str, tuple[float, int]] = {}
    with contextlib.ExitStack() as close:
        folder = Path(close.enter_context(tempfile.TemporaryDirectory()))
        pipelines = {
            name: close.enter_context(Pipeline(frames.scene, device=device, bands=1, outputs=outputs))
            for name, outputs in contenders().items()
        }
        for index in range(WARM_UP + count):
            place = index % len(frames.images)
            for name, pipeline in pipelines.items():
                begin = clock()
                result = pipeline(frames.images[place], time_seconds=index / 24.0, pose=frames.poses[place])
                read: Any = (result.image, result.layers, result.radiance if name == RADIANCE else None)
                if index >= WARM_UP:
                    times[name].append((clock() - begin) * 1e3)
                del read
                if index == WARM_UP and result.layers:
                    begin = time.thread_time()
                    write_layers(folder / "0.exr", layer_frame(frames.images[place], result, frames.scene))
                    files[name] = (time.thread_time() - begin) * 1e3, (folder / "0.exr").stat().st_size
    plain = statistics.median(times[PLAIN])
    for name, milliseconds in times.items():
        ratio = paired_ratio(times, name, PLAIN)
        more: dict[str, Any] = {"over_picture": round(ratio, 3), "adds_ms": round((ratio - 1.0) * plain, 2)}
        if name in files:
            more |= {"file_ms": round(files[name][0], 1), "file_kb": round(files[name][1] / 1e3)}
        report(f"layers {name}", milliseconds, device, **more)
