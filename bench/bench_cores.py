"""Time of whole frames on 1, 2, 4, ... cores of one machine: elapsed time and processor time.

Each run is a process that is restricted to a number of cores. All numbers are run in turn, several times.
``WARP_AR_BENCH`` may state the height of frames (480 or 1080) and the number of turns, as in ``1080,3``; the default is
``480,2``. The clip is repeated without a break, and the first frames are not measured.

A second table divides the time of a frame for each number of cores: tracking; rendering, in Python and in native
threads; and each stage, summed over all threads. ``whole`` is the time of passes that cannot be split into bands.
``path`` is a lower bound on the time with any number of cores: the longest chain of stages that wait for each other,
where a pass takes its whole time if it cannot be split, else that of the smallest piece.
"""

from __future__ import annotations

import collections
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from bench.bench_frame import SIZES, clip, stream_frames
from bench.common import commit
from warp_ar.engine.cpu_threads import CpuThreads
from warp_ar.engine.pipeline import Pipeline
from warp_ar.kernels import bands

WARM_UP = 12
"""Number of frames before the measured ones."""
FRAMES = 60
"""Number of measured frames."""
_LABELS = {"480": "480p", "1080": "1080p"}


class Watch:
    """Times of the parts of a pipeline's frames, in milliseconds."""

    def __init__(self, pipeline: Pipeline) -> None:
        """Begin to measure a pipeline."""
        self.parts: dict[str, list[float]] = collections.defaultdict(list)
        self.stages: dict[str, list[float]] = collections.defaultdict(list)
        pipeline.warm_up()
        self._time(pipeline, "_look", "track")
        self._time(pipeline, "_render", "render")
        threads = pipeline._scheduler._cpu_threads
        if threads is not None:
            self._follow(threads)

    def _time(self, owner: Any, name: str, part: str) -> None:
        function = getattr(owner, name)

        def timed(*arguments: Any) -> Any:
            begin = time.perf_counter()
            try:
                return function(*arguments)
            finally:
                self.parts[part].append((time.perf_counter() - begin) * 1e3)

        setattr(owner, name, timed)

    def _follow(self, threads: CpuThreads) -> None:
        run: Callable[..., Any] = threads.run

        def followed(*due: Any) -> Any:
            begin = time.perf_counter()
            times = run(*due)
            self.parts["native"].append((time.perf_counter() - begin) * 1e3)
            for name, nanoseconds in times.items():
                self.stages[name].append(nanoseconds * 1e-6)
            unsplit, path = least_times(threads)
            self.parts["whole"].append(unsplit)
            self.parts["path"].append(path)
            return times

        threads.run = followed  # type: ignore[method-assign]

    def forget(self) -> None:
        """Discard the times of the frames so far."""
        self.parts.clear()
        self.stages.clear()

    def means(self) -> dict[str, dict[str, float]]:
        """Return the mean times over frames, of parts and of stages."""
        parts = {name: statistics.mean(values) for name, values in self.parts.items()}
        parts["python"] = parts["render"] - parts.get("native", 0.0)
        stages = {name: round(statistics.mean(values), 3) for name, values in self.stages.items()}
        return {"parts": {name: round(value, 3) for name, value in parts.items()}, "stages": stages}


def least_times(threads: CpuThreads) -> tuple[float, float]:
    """Return the last frame's ``whole`` and ``path``, which the module defines, in milliseconds."""
    table, stages = threads._passes, threads._stages
    spent = table[:, bands.PASS.index("time")] * 1e-6
    whole = table[:, bands.PASS.index("whole")] == 1
    least = np.where(whole, spent, np.minimum(spent, bands.WORTH * 1e-6))
    first, last, reader, readers_end = (
        stages[:, bands.STAGE.index(name)] for name in ("first_pass", "last_pass", "first_reader", "last_reader")
    )
    begun = np.zeros(len(stages))
    for stage in range(len(stages)):  # every stage comes after those that it waits for
        done = begun[stage] + least[first[stage] : last[stage]].sum()
        for other in threads._readers[reader[stage] : readers_end[stage]]:
            begun[other] = max(begun[other], done)
    ends = [begun[stage] + least[first[stage] : last[stage]].sum() for stage in range(len(stages))]
    return float(spent[whole].sum()), float(max(ends))


def run_frames(size: str) -> dict[str, Any]:
    """Return median elapsed time (with tracking), mean processor time and parts of frames of ``desk`` at ``medium``."""
    frames = clip("desk", SIZES[size])
    wall, spent = [], []
    with Pipeline(frames.scene, device="cpu") as pipeline:
        watch = Watch(pipeline)
        for index, (passed, busy) in enumerate(stream_frames(pipeline, frames, WARM_UP + FRAMES)):
            if index < WARM_UP:
                watch.forget()
                continue
            wall.append(passed)
            spent.append(busy)
    return {"ms": statistics.median(wall), "processor_ms": statistics.mean(spent), **watch.means()}


def print_parts(runs: dict[int, list[dict[str, Any]]]) -> None:
    """Print the second table: a line for each part of a frame, a column for each number of cores."""

    def means(kind: str, name: str) -> list[float]:
        return [round(float(np.mean([run[kind].get(name, 0.0) for run in found])), 3) for found in runs.values()]

    print(f"\n{'ms of a frame on cores':<28}" + "".join(f"{count:>9}" for count in runs))
    words = {
        "track": "look for the marker",
        "render": "render",
        "python": "  of it Python",
        "native": "  of it native threads",
        "whole": "  whole passes, all threads",
        "path": "  path, cores without end",
    }
    for name, label in words.items():
        print(f"{label:<28}" + "".join(f"{value:>9.2f}" for value in means("parts", name)))
    names = dict.fromkeys(name for found in runs.values() for run in found for name in run["stages"])
    table = {name: means("stages", name) for name in names}
    for name, values in sorted(table.items(), key=lambda item: -max(item[1])):
        if max(values) >= 0.01:
            print(f"  {name:<26}" + "".join(f"{value:>9.2f}" for value in values))
    parts = {name: dict(zip(map(str, runs), means("parts", name), strict=True)) for name in words}
    stages = {name: dict(zip(map(str, runs), values, strict=True)) for name, values in table.items()}
    print(json.dumps({"case": "cores parts", "parts": parts, "stages": stages, "commit": commit()}), flush=True)


def main(device: str) -> None:
    """Run all numbers of cores in turn and print both tables; only the CPU is measured."""
    del device
    asked = [part for part in os.environ.get("WARP_AR_BENCH", "").split(",") if part]
    size = _LABELS[asked[0]] if asked else "480p"
    turns = int(asked[1]) if len(asked) > 1 else 2
    own = sorted(os.sched_getaffinity(0))
    counts = [count for count in (1, 2, 4, 8, 16, 32, 64) if count <= len(own)]
    runs: dict[int, list[dict[str, Any]]] = {count: [] for count in counts}
    run_frames(size)  # compiles kernels that are not in the cache
    for _ in range(turns):
        for count in counts:
            cores = ",".join(map(str, own[:count]))
            command = [sys.executable, "-m", "bench.bench_cores", size, cores]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            runs[count].append(json.loads(done.stdout.splitlines()[-1]))
    base = np.median([run["ms"] for run in runs[counts[min(1, len(counts) - 1)]]])
    print(f"{'cores':>5} {'ms':>8} {'fps':>7} {'of 2 cores':>10} {'processor ms':>12}   runs in turn, ms")
    for count, found in runs.items():
        each = [run["ms"] for run in found]
        ms, busy = float(np.median(each)), float(np.median([run["processor_ms"] for run in found]))
        turned = ", ".join(f"{value:.1f}" for value in each)
        print(f"{count:>5} {ms:>8.1f} {1e3 / ms:>7.1f} {base / ms:>10.2f} {busy:>12.1f}   {turned}")
        record = {"case": f"cores {size} {count}", "median_ms": round(ms, 3), "processor_ms": round(busy, 3)}
        print(json.dumps({**record, "fps": round(1e3 / ms, 1), "runs": len(found), "commit": commit()}), flush=True)
    print_parts(runs)


if __name__ == "__main__":
    os.sched_setaffinity(0, set(map(int, sys.argv[2].split(","))))
    from warp_ar.device import resolve_device

    resolve_device("cpu")
    print(json.dumps(run_frames(sys.argv[1])))
