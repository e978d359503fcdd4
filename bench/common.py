"""Timing and reports of benchmarks: contenders in turn, medians of paired ratios, one JSON line per case."""

from __future__ import annotations

import importlib.util
import json
import shutil
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warp_ar.accuracy.report import commit
from warp_ar.device import capturing

WARM_UP = 3
"""Number of calls before the timed ones."""
RUNS = 30
"""Default number of timed calls."""


def find_chromium() -> str | None:
    """Return the path of Chromium; if Chromium or playwright is missing, print a line and return None."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None or importlib.util.find_spec("playwright") is None:
        print(json.dumps({"case": "browser", "left_out": "needs playwright and Chromium"}))
        return None
    return chromium


def time_thread(function: Callable[[], object], device: Any) -> float:
    """Return the milliseconds of this thread's processor time in one call; other programs have little effect on it."""
    start = time.thread_time()
    function()
    return (time.thread_time() - start) * 1e3


def time_once(function: Callable[[], object], device: Any) -> float:
    """Return the elapsed milliseconds of one call, until the device has finished."""
    wp.synchronize_device(device)
    start = time.perf_counter()
    function()
    wp.synchronize_device(device)
    return (time.perf_counter() - start) * 1e3


def measure(
    functions: Mapping[str, Callable[[], object]], device: Any, runs: int = RUNS, *, one_thread: bool = False
) -> dict[str, list[float]]:
    """Return the milliseconds of every run of contenders, which are timed in turn, A B A B ..., after a warm-up.

    On CUDA each function is captured as a graph and its replay is timed with events, without launches from Python.

    Args:
        functions: Contenders by name.
        device: Device that the functions use.
        runs: Number of timed runs of each.
        one_thread: True to time functions on CPU that work on this thread alone by its processor time.
    """
    device = wp.get_device(device)
    if device.is_cuda:
        functions = {name: _captured(function, device) for name, function in functions.items()}
    timer = _time_with_events if device.is_cuda else time_thread if one_thread else time_once
    for _ in range(WARM_UP):
        for function in functions.values():
            function()
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(runs):
        for name, function in functions.items():
            times[name].append(timer(function, device))
    return times


def _captured(function: Callable[[], object], device: Any) -> Callable[[], object]:
    function()
    with capturing(), wp.ScopedCapture(device=device) as capture:
        function()
    return lambda: wp.capture_launch(capture.graph)


def _time_with_events(function: Callable[[], object], device: Any) -> float:
    stream = wp.get_stream(device)
    begin, end = wp.Event(device, enable_timing=True), wp.Event(device, enable_timing=True)
    stream.record_event(begin)
    function()
    stream.record_event(end)
    return float(wp.get_event_elapsed_time(begin, end))


def paired_ratio(times: Mapping[str, list[float]], over: str, under: str) -> float:
    """Return the median over runs of the ratio of two contenders' times, ``over`` / ``under``."""
    return statistics.median(a / b for a, b in zip(times[over], times[under], strict=True))


def report(case: str, milliseconds: list[float], device: Any, **more: Any) -> None:
    """Print one JSON line with the median and the spread of a case, and further values ``more``."""
    low, median, high = np.percentile(milliseconds, [10, 50, 90])
    record = {
        "case": case,
        "median_ms": round(float(median), 5),
        "p10_ms": round(float(low), 5),
        "p90_ms": round(float(high), 5),
        "runs": len(milliseconds),
        **more,
        "device": wp.get_device(device).name,
        "warp": wp.__version__,
        "commit": commit(),
    }
    print(json.dumps(record), flush=True)


class KeptLines:
    """JSON lines of a long run, which are printed and stored in a file, so that an interrupted run can be continued."""

    def __init__(self, path: Path | None) -> None:
        """Read the lines in a file; an incomplete line is removed. None: lines are only printed."""
        self._path = path
        self.records: list[dict[str, Any]] = []
        if path is None or not path.exists():
            return
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                record = json.loads(line)
            except json.JSONDecodeError:
                continue
            if isinstance(record, dict):
                self.records.append(record)
        path.write_text("".join(json.dumps(record) + "\n" for record in self.records), encoding="utf-8")

    def has(self, **key: Any) -> bool:
        """Return True if there is a record with these values."""
        return any(all(record.get(name) == value for name, value in key.items()) for record in self.records)

    def add(self, record: Mapping[str, Any]) -> None:
        """Print a record and store it."""
        line = json.dumps(record)
        print(line, flush=True)
        self.records.append(json.loads(line))
        if self._path is not None:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(line + "\n")
