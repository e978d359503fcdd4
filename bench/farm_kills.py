"""A recording lit while its workers and its driver are killed at random moments, against the same one left alone."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import hashlib
import json
import os
import random
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench.farm_bench import Bench
from bench.farm_clip import surveyed, write_jobs
from bench.farm_recordings import write_recording
from bench.farm_runs import Watched, prepare, work, workers_of
from warp_ar.device import usable_cores

WORKERS = 8
"""But no more than two for each core."""
JOBS_A_DEATH = 4
"""Segments of the recording for each death: between two of them some jobs are done."""
MOST_RUNS = 8
"""Times that a driver is begun beyond the deaths that are asked for, before the benchmark gives up."""


def run_kills(bench: Bench) -> None:
    """One run left alone, one with deaths: the same bytes, and each job once."""
    options = bench.options
    surveyed(bench)
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
    step, dice = count / (deaths + 1), random.Random(5)
    order = order_of_deaths(options.kills, options.driver_kills, dice)
    plan = Deaths(killed, order, lambda died: _segments_done(killed) >= step * (1 + died) - 0.5, dice)
    runs = work_with_deaths(bench, plan, workers, max(bench.left, 240.0))
    lines = lines_of_jobs(killed)
    bench.tell(
        f"a recording of {options.kill_frames} frames in {count} segments under SIGKILL",
        workers=workers,
        worker_deaths=plan.dead["worker"],
        driver_deaths=plan.dead["driver"],
        asked=[options.kills, options.driver_kills],
        ended=runs[-1].code == 0 and left.code == 0,
        error="" if runs[-1].code == 0 else runs[-1].errors[-500:],
        jobs=len(lines),
        jobs_asked=count + 2,  # with the survey and the join
        jobs_done_twice=sorted(key for key, times in lines.items() if times != 1),
        jobs_lost=sorted(set(lines_of_jobs(alone)) - set(lines)),
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


@dataclasses.dataclass
class Deaths:
    """Who is killed, in turn, and who was."""

    folder: Path
    """Of the run."""
    left: list[str]
    """``worker`` or ``driver``; the next one is the last."""
    is_time: Callable[[int], bool]
    """Whether the next one is due, by how many have died."""
    dice: random.Random
    note: Callable[[dict[str, Any]], None] = lambda death: None
    """Called with each death."""
    dead: collections.Counter[str] = dataclasses.field(default_factory=collections.Counter)

    def meddle(self, driver: int) -> None:
        """Kill who is due: a driver, or one of its workers; called five times a second."""
        if not self.left or not self.is_time(sum(self.dead.values())):
            return
        time.sleep(0.4 * self.dice.random())
        victims = [driver] if self.left[-1] == "driver" else workers_of(driver)
        if victims:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.dice.choice(victims), signal.SIGKILL)
                who = self.left.pop()
                self.dead[who] += 1
                self.note({"who": who, **_at_work(self.folder)})


def _at_work(folder: Path) -> dict[str, int]:
    """Workers that were in the midst of a segment at the driver's last word, and frames that they had lit of it."""
    frames = []
    with contextlib.suppress(OSError, ValueError):
        told = json.loads((folder / "progress.json").read_text())["workers"]
        frames = [worker["frames"] for worker in told if worker["job"] and "/segment-" in worker["job"]]
    return {"segments_begun": sum(count > 0 for count in frames), "frames_lit_of_them": sum(frames)}


def order_of_deaths(workers: int, drivers: int, dice: random.Random) -> list[str]:
    """Who dies, as ``Deaths.left``."""
    order = ["worker"] * workers + ["driver"] * drivers
    dice.shuffle(order)
    return order


def work_with_deaths(bench: Bench, deaths: Deaths, workers: int, limit: float) -> list[Watched]:
    """Work a run through, begun again whenever its driver has died; every driver's run."""
    end, runs = time.monotonic() + limit, list[Watched]()
    for _ in range(deaths.left.count("driver") + MOST_RUNS):
        left = end - time.monotonic()
        runs.append(work(deaths.folder, workers, bench.device, bench.say, limit=left, meddle=deaths.meddle))
        if runs[-1].code != -signal.SIGKILL or time.monotonic() > end:
            break
    return runs


def _segments_done(folder: Path) -> int:
    with contextlib.suppress(OSError):
        return (folder / "manifest.jsonl").read_text().count("/segment-")
    return 0


def lines_of_jobs(folder: Path) -> collections.Counter[str]:
    """How often each job has a line that says it is done."""
    lines = [json.loads(line) for line in (folder / "manifest.jsonl").read_text().splitlines()]
    return collections.Counter(line["job"] for line in lines if line["state"] == "done")


def _digest(path: Path) -> str:
    """Of a file; empty where there is none."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
