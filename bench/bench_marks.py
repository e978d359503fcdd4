"""Table of targets for a CUDA machine and of measured values, made in less than five minutes.

The first part, ``start``, measures starts of the program: with empty caches, with a scene started before, and with
another scene at ``high``. Other parts use its caches: ``frame`` (whole frames at 480p, 1080p and 4K), ``streams``, and
``cores`` (frames on the host's cores). Their output is printed as well. A part that the time does not allow is not run.
``WARP_AR_BENCH`` may name parts, separated by commas.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.bench_start import cache_variables, start
from bench.common import commit

SECONDS = 290.0
"""Time in seconds after which no part is begun, and a running one is ended."""
STARTS: Mapping[str, tuple[str, str]] = {
    "cold": ("desk", "medium"),
    "seen": ("desk", "medium"),
    "new scene high": ("torus", "high"),
}
PARTS: Mapping[str, str] = {"frame": "graph", "streams": "1080,60,1,4,16,8x2,16x1", "cores": "480,1"}
"""Benchmarks to run, with the value of ``WARP_AR_BENCH`` for each."""
MARKS: Mapping[str, tuple[str, str, str]] = {
    "nothing cached, s": ("15", "start cold", "median_s"),
    "seen before, s": ("2", "start seen", "median_s"),
    "a new scene at high, s": ("6", "start new scene high", "median_s"),
    "480p medium, device, ms": ("-", "graph 480p medium", "median_ms"),
    "1080p medium, device, ms": ("0.75", "graph 1080p medium", "median_ms"),
    "1080p high, device, ms": ("2.2", "graph 1080p high", "median_ms"),
    "4K medium, device, ms": ("1.5", "graph 4K medium", "median_ms"),
    "1080p medium, both transfers, frames a second": (
        "1300",
        "stream 1080p medium, live camera, frames in pinned memory",
        "fps",
    ),
    "1 camera of 1080p, frames a second": ("60", "streams 1 of 1080 rows, 60 frames a second each", "fps"),
    "4 cameras": ("240", "streams 4 of 1080 rows, 60 frames a second each", "fps"),
    "16 cameras": ("960", "streams 16 of 1080 rows, 60 frames a second each", "fps"),
    "16 cameras, median latency, ms": ("-", "streams 16 of 1080 rows, 60 frames a second each", "median_ms"),
    "16 cameras, 99th percentile of latency, ms": ("-", "streams 16 of 1080 rows, 60 frames a second each", "p99_ms"),
    "8 processes of 2 cameras": ("960", "streams 8 processes of 2 of 1080 rows, 60 frames a second each", "fps"),
    "the same, 99th percentile, ms": ("-", "streams 8 processes of 2 of 1080 rows, 60 frames a second each", "p99_ms"),
    "16 processes of a camera": ("960", "streams 16 processes of 1 of 1080 rows, 60 frames a second each", "fps"),
    "the same again, 99th percentile, ms": (
        "-",
        "streams 16 processes of 1 of 1080 rows, 60 frames a second each",
        "p99_ms",
    ),
    "480p medium on 2 cores, ms": ("-", "cores 480p 2", "median_ms"),
    "8 cores over 2": ("2.5", "cores 480p 8", "of_2"),
    "16 cores over 2": ("3.5", "cores 480p 16", "of_2"),
    "processor time on 16 cores over that on 2": ("at most 1.3", "cores 480p 16", "busy_of_2"),
}
"""Target of each line of the table, and the case and field with the measured value."""


def run_part(name: str, asked: str, device: str, caches: Path, end: float) -> dict[str, dict[str, Any]]:
    """Run a benchmark in a separate process, print its output, and return its records by case.

    Args:
        name: Name of the benchmark.
        asked: Value of ``WARP_AR_BENCH`` for it.
        device: Option ``--device``.
        caches: Folder of caches.
        end: Time on the performance counter at which it is ended.
    """
    environment = {**os.environ, **cache_variables(caches), "WARP_AR_BENCH": asked}
    command = [sys.executable, "-m", "bench", name, "--device", device]
    found: dict[str, dict[str, Any]] = {}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        timer = threading.Timer(max(end - time.perf_counter(), 0.0), process.kill)
        timer.start()
        for line in process.stdout:
            print(line, end="", flush=True)
            if line.startswith("{"):
                record = json.loads(line)
                found[record["case"]] = record
        timer.cancel()
    if process.returncode:
        print(f"bench marks: {name} did not come to its end, exit code {process.returncode}", flush=True)
    return found


def add_ratios(found: dict[str, dict[str, Any]]) -> None:
    """Add the ratios of times on two cores to those on other numbers of cores."""
    base = found.get("cores 480p 2")
    for case, record in found.items():
        if base is not None and case.startswith("cores 480p"):
            record["of_2"] = base["median_ms"] / record["median_ms"]
            record["busy_of_2"] = record["processor_ms"] / base["processor_ms"]


def main(device: str) -> None:
    """Run all parts, or those that ``WARP_AR_BENCH`` names, and print the table."""
    begun = time.perf_counter()
    wanted = set(filter(None, os.environ.get("WARP_AR_BENCH", "").split(","))) or {"start", *PARTS}
    found: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        caches = Path(folder) / "caches"
        for index, (label, (scene, quality)) in enumerate(STARTS.items() if "start" in wanted else ()):
            wall, busy = start(scene, device, caches, Path(folder) / f"out_{index}", quality)
            record = {"case": f"start {label}", "median_s": wall * 1e-3, "processor_s": busy * 1e-3, "commit": commit()}
            found[str(record["case"])] = record
            print(json.dumps(record), flush=True)
        for name, asked in PARTS.items():
            if name in wanted and time.perf_counter() - begun < SECONDS:
                found |= run_part(name, asked, device, caches, begun + SECONDS)
    add_ratios(found)
    print(f"\n{'what':<48} {'asked':>12} {'measured':>12}")
    for what, (mark, case, field) in MARKS.items():
        measured = f"{found[case][field]:.2f}" if field in found.get(case, {}) else "not run"
        print(f"{what:<48} {mark:>12} {measured:>12}")
    print(f"{time.perf_counter() - begun:.0f} s")
