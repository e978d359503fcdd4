"""A recording lit while its workers and its driver are killed at random moments, against the same one left alone."""

from __future__ import annotations

import collections
import contextlib
import hashlib
import json
import os
import random
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from bench.farm_recordings import write_recording
from bench.farm_runs import Watched, prepare, work, workers_of, write_jobs
from warp_ar.device import usable_cores

if TYPE_CHECKING:
    from bench.bench_farm import Bench

WORKERS = 8
"""But no more than two for each core."""
JOBS_A_DEATH = 4
"""Segments of the recording for each death: between two of them some jobs are done."""
MOST_RUNS = 8
"""Times that a driver is begun beyond the deaths that are asked for, before the benchmark gives up."""


def run_kills(bench: Bench) -> None:
    """One run left alone, one with deaths: the same bytes, and each job once."""
    options = bench.options
    bench.surveyed()
    workers = min(WORKERS, 2 * usable_cores())
    deaths = options.kills + options.driver_kills
    segment = max(2, options.kill_frames // (JOBS_A_DEATH * max(deaths, 1)))
    write_recording(bench.folder / "kills.mp4", bench.size, options.kill_frames)
    jobs = write_jobs(bench, "kills", segment)
    alone, killed = bench.folder / "alone", bench.folder / "killed"
    prepare(alone, jobs, None)
    left = work(alone, workers, bench.device, bench.say, limit=max(0.4 * bench.left, 120.0))
    bench.say(f"left alone: {left.seconds:.0f} s, exit code {left.code}")
    prepare(killed, jobs, None)
    count = -(-options.kill_frames // segment)
    dead, runs = _work_with_deaths(bench, killed, workers, count, max(bench.left, 240.0))
    lines = _lines_of_jobs(killed)
    bench.tell(
        f"a recording of {options.kill_frames} frames in {count} segments under SIGKILL",
        workers=workers,
        worker_deaths=dead["worker"],
        driver_deaths=dead["driver"],
        asked=[options.kills, options.driver_kills],
        ended=runs[-1].code == 0 and left.code == 0,
        error="" if runs[-1].code == 0 else runs[-1].errors[-500:],
        jobs=len(lines),
        jobs_asked=count + 2,  # with the survey and the join
        jobs_done_twice=sorted(key for key, times in lines.items() if times != 1),
        jobs_lost=sorted(set(_lines_of_jobs(alone)) - set(lines)),
        same_bytes=_digest(alone / "kills.mp4") == _digest(killed / "kills.mp4") != "",
        left_aside=len(list((killed / ".aside").iterdir())) if (killed / ".aside").is_dir() else 0,
        seconds=round(sum(run.seconds for run in runs), 1),
        seconds_left_alone=round(left.seconds, 1),
        driver_peak_mb=round(max(max(run.driver_mb, default=0.0) for run in runs)),
        largest_worker_peak_mb=round(max(max(run.worker_mb, default=0.0) for run in runs)),
    )
    for folder in (alone, killed):
        shutil.rmtree(folder, ignore_errors=True)
    (bench.folder / "kills.mp4").unlink()


def _work_with_deaths(
    bench: Bench, folder: Path, workers: int, count: int, limit: float
) -> tuple[collections.Counter[str], list[Watched]]:
    """Work a run through, begun again whenever its driver has died; how many of each died, and every driver's run."""
    dice = random.Random(5)
    order = ["worker"] * bench.options.kills + ["driver"] * bench.options.driver_kills
    dice.shuffle(order)
    dead: collections.Counter[str] = collections.Counter()
    step = count / (len(order) + 1)
    end, runs = time.monotonic() + limit, list[Watched]()
    meddle = _killer(folder, order, dead, step, dice)
    for _ in range(bench.options.driver_kills + MOST_RUNS):
        runs.append(work(folder, workers, bench.device, bench.say, limit=end - time.monotonic(), meddle=meddle))
        if runs[-1].code == 0 or time.monotonic() > end:
            break
    return dead, runs


def _killer(
    folder: Path, order: list[str], dead: collections.Counter[str], step: float, dice: random.Random
) -> Callable[[int], None]:
    """What kills whose turn it is, once as many segments are done as stand between two deaths."""

    def meddle(driver: int) -> None:
        if not order or _segments_done(folder) < step * (1 + sum(dead.values())) - 0.5:
            return
        time.sleep(0.4 * dice.random())
        victims = [driver] if order[-1] == "driver" else workers_of(driver)
        if victims:
            with contextlib.suppress(ProcessLookupError):
                os.kill(dice.choice(victims), signal.SIGKILL)
                dead[order.pop()] += 1

    return meddle


def _segments_done(folder: Path) -> int:
    with contextlib.suppress(OSError):
        return (folder / "manifest.jsonl").read_text().count("/segment-")
    return 0


def _lines_of_jobs(folder: Path) -> collections.Counter[str]:
    """How often each job has a line that says it is done."""
    lines = [json.loads(line) for line in (folder / "manifest.jsonl").read_text().splitlines()]
    return collections.Counter(line["job"] for line in lines if line["state"] == "done")


def _digest(path: Path) -> str:
    """Of a file; empty where there is none."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
