"""What a frame of a survey costs: by the clock, of each thread's processor time, and where threads wait.

Two ways in turn, each in a process of its own: all steps in threads, and reading and tracking in a process beside them.
Both write the same bytes.
"""

from __future__ import annotations

import collections
import concurrent.futures
import dataclasses
import hashlib
import multiprocessing
import os
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import cv2

from bench.farm_bench import Bench
from bench.farm_clip import keep_kernels, write_clips
from bench.farm_recordings import write_recording, write_scene
from warp_ar.farm import survey
from warp_ar.farm.jobs import parse_jobs, read_jobs
from warp_ar.farm.records import OPENCV_THREADS

FRAMES = {"cpu": 240, "cuda": 600}
TURNS = 2
WARM = 0.35
"""Share of the frames at the begin that is left out: a clip's first seconds ask more of the light that clips."""
END = 30
"""Frames at the end that are: what reads has ended by then."""
LOOK_SECONDS = 0.01
"""Between two looks at where threads are."""


def run_survey(bench: Bench) -> None:
    """Both ways in turn."""
    frames, name = FRAMES[bench.device], "long" if (bench.folder / "long.mp4").exists() else "desk"
    if not (bench.folder / f"{name}.mp4").exists():
        write_scene(bench.folder / "desk.toml", bench.size)
        write_recording(bench.folder / "desk.mp4", bench.size, frames)
    keep_kernels(bench, name)
    jobs = write_clips(bench, "steps.toml", 1, frames, end=frames, recording=name)
    found: dict[str, list[dict[str, Any]]] = {"in threads": [], "beside": []}
    spawn = multiprocessing.get_context("spawn")
    for _ in range(TURNS):
        for way, figures in found.items():
            with concurrent.futures.ProcessPoolExecutor(1, mp_context=spawn) as pool:
                figures.append(pool.submit(survey_steps, jobs, bench.one_device, frames, way == "beside").result())
            bench.tell(f"steps of a survey, {way}", frames=frames, **figures[-1])
    bytes_of = [figures["bytes"] for turns in found.values() for figures in turns]
    bench.tell("bytes of surveys", compared=len(bytes_of), same=all(own == bytes_of[0] for own in bytes_of))


def survey_steps(path: Path, device: str, frames: int, beside: bool) -> dict[str, Any]:
    """Survey as a worker does; in a process of its own.

    Args:
        path: The job file.
        device: ``cpu`` or ``cuda:N``.
        frames: Of the clip.
        beside: Whether another process reads and tracks.
    """
    cv2.setNumThreads(OPENCV_THREADS)
    survey.BESIDE_FRAMES, survey.BESIDE_CORES = (1, 1) if beside else (sys.maxsize, 1)
    jobs = parse_jobs(read_jobs(path), str(path))
    begin, end = int(WARM * frames), frames - END
    seen: dict[int, _Moment] = {}
    places: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)

    def look() -> None:
        while end not in seen:
            time.sleep(LOOK_SECONDS)
            if begin in seen:
                _note_places(places)

    def tell(count: int) -> None:
        if count in (begin, end):
            seen[count] = _Moment.now()

    threading.Thread(target=look, name="look", daemon=True).start()
    with tempfile.TemporaryDirectory() as name:
        survey.survey_clip(jobs, 0, Path(name), device, tell)
        digest = hashlib.sha256(b"".join(file.read_bytes() for file in sorted(Path(name).iterdir()))).hexdigest()
    return {**seen[end].since(seen[begin], end - begin), "bytes": digest[:16], "where": _most(places)}


@dataclasses.dataclass
class _Moment:
    """The clock, and processor time until then, seconds."""

    clock: float
    threads: dict[int, tuple[str, float]]
    children: float

    @classmethod
    def now(cls) -> _Moment:
        names = {thread.native_id: thread.name for thread in threading.enumerate()}
        threads, children = {}, 0.0
        for task in Path("/proc/self/task").iterdir():
            number = int(task.name)
            threads[number] = names.get(number, "native"), _processor_seconds(task / "stat")
            if (task / "children").exists():
                own = (task / "children").read_text().split()
                children += sum(_processor_seconds(Path(f"/proc/{child}/stat")) for child in own)
        return cls(time.perf_counter(), threads, children)

    def since(self, before: _Moment, frames: int) -> dict[str, Any]:
        """Milliseconds of a frame; threads of one name together."""
        each: collections.Counter[str] = collections.Counter()
        for number, (name, seconds) in self.threads.items():
            each[name.rsplit("_", 1)[0]] += seconds - before.threads.get(number, ("", 0.0))[1]
        of_frame = {name: round(1e3 * seconds / frames, 2) for name, seconds in each.most_common() if name != "look"}
        return {
            "ms_per_frame": round(1e3 * (self.clock - before.clock) / frames, 2),
            "processor_ms": round(sum(of_frame.values()), 2),
            "processor_ms_beside": round(1e3 * (self.children - before.children) / frames, 2),
            "threads_ms": of_frame,
        }


def _processor_seconds(path: Path) -> float:
    """Of a process or a thread, by its ``stat``; 0 where it has gone."""
    try:
        fields = path.read_text(encoding="utf-8").rsplit(")", 1)[1].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _note_places(places: dict[str, collections.Counter[str]]) -> None:
    """Count where in the package each thread is now, and what that waits for or calls."""
    names = {thread.ident: thread.name for thread in threading.enumerate()}
    for number, top in sys._current_frames().items():
        own: Any = top
        while own is not None and "warp_ar" not in own.f_code.co_filename:
            own = own.f_back
        if own is not None:
            line = f"{Path(own.f_code.co_filename).name}:{own.f_lineno}"
            places[names.get(number, "?")][f"{line} {own.f_code.co_name} {top.f_code.co_name}"] += 1


def _most(places: dict[str, collections.Counter[str]]) -> dict[str, dict[str, float]]:
    """Shares of the places in which threads were most often."""
    return {
        name: {place: round(count / found.total(), 2) for place, count in found.most_common(5)}
        for name, found in places.items()
        if name != "look"
    }
