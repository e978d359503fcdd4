"""Whole frames on 1, 2, 4, ... cores of one machine: milliseconds and processor time, in turn, and a table of both.

Each run is a process of its own that may use so many cores, as ``taskset`` would have it. ``WARP_AR_BENCH`` may name a
height of frames (480 or 1080) and how often all counts are run in turn, as in ``1080,3``; 480 and 2 are usual. Settled
frames are measured: the clip goes round, as a stream's does.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from typing import Any

import numpy as np

from bench.bench_frame import SIZES, clip
from bench.common import commit
from warp_ar.engine.pipeline import Pipeline

WARM_UP = 12
FRAMES = 60
_LABELS = {"480": "480p", "1080": "1080p"}


def run_frames(size: str) -> dict[str, Any]:
    """Medians over settled frames of ``desk`` at ``medium``: by the clock, tracking included, and of all threads."""
    frames = clip("desk", SIZES[size])
    wall, spent = [], []
    with Pipeline(frames.scene, device="cpu") as pipeline:
        before = None
        for index in range(WARM_UP + FRAMES):
            begin, busy = time.perf_counter(), time.process_time()
            result = pipeline.submit(frames.images[index % len(frames.images)], time_seconds=index / 24.0)
            if before is not None:
                _ = before.image
            before = result
            if index >= WARM_UP:
                wall.append((time.perf_counter() - begin) * 1e3)
                spent.append((time.process_time() - busy) * 1e3)
    return {"ms": statistics.median(wall), "processor_ms": statistics.mean(spent)}


def main(device: str) -> None:
    """The table; on CPU only."""
    del device
    asked = [part for part in os.environ.get("WARP_AR_BENCH", "").split(",") if part]
    size = _LABELS[asked[0]] if asked else "480p"
    turns = int(asked[1]) if len(asked) > 1 else 2
    own = sorted(os.sched_getaffinity(0))
    counts = [count for count in (1, 2, 4, 8, 16, 32, 64) if count <= len(own)]
    runs: dict[int, list[dict[str, Any]]] = {count: [] for count in counts}
    run_frames(size)  # compiles what is missing
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


if __name__ == "__main__":
    os.sched_setaffinity(0, set(map(int, sys.argv[2].split(","))))
    from warp_ar.device import resolve_device

    resolve_device("cpu")
    print(json.dumps(run_frames(sys.argv[1])))
