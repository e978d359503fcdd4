"""A long recording through segments while workers and driver are killed, and in one run: each picture the same.

Its phases can be called one by one, in this order; what each leaves for the next lies in the bench's folder, so that a
measurement of an hour is made by calls of some minutes:

- ``recording``: ``long.mp4``; what is there already is taken;
- ``survey``: of the whole, by one worker;
- ``segments``: through ``SEGMENTS`` segments; workers and driver are killed at random moments of the first
  ``--kill-seconds``. Called again, it goes on where it was ended;
- ``one``: all pictures in order by one pipeline, for their digests alone;
- ``check``: each job once; the joined recording whole, its times those of the recording; digests of all pictures equal.
"""

from __future__ import annotations

import collections
import concurrent.futures
import itertools
import json
import multiprocessing
import random
import shutil
import statistics
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import av
import numpy as np

from bench.farm_bench import Bench
from bench.farm_bounds import measure_worker
from bench.farm_clip import keep_kernels, surveyed, write_jobs
from bench.farm_kills import Deaths, lines_of_jobs, order_of_deaths, work_with_deaths
from bench.farm_recordings import write_recording, write_scene
from bench.farm_runs import Watched, jobs_done, prepare, rates, together, work
from warp_ar.device import usable_cores
from warp_ar.farm.frames import index_frames, open_part
from warp_ar.farm.jobs import Job, parse_jobs, read_jobs
from warp_ar.farm.lighting import Lighter
from warp_ar.farm.work import digest_of

SEGMENTS = 8
LEAST_SECONDS = 120.0
"""That segments have where all phases share some minutes."""
EDGE = 24
"""Frames from a segment's begin on that are taken for its beginning."""
CONVERTERS = 4
"""Threads that convert to RGB for the one run, which nothing encodes."""
DIGESTING = 4
"""Threads that digest its pictures."""
TELL_FRAMES = 2000
"""Between two lines of its progress."""


def run_long(bench: Bench) -> None:
    """The phases that were asked for of as many frames as were; or all phases of as many frames as fit."""
    asked = bench.options.phases.split(",") if bench.options.phases else list(PHASES)
    if bench.options.phases:
        frames = bench.options.long_frames
    else:
        surveyed(bench)
        measure_worker(bench)
        frames = frames_that_fit(bench)
    for name, phase in PHASES.items():
        if name in asked:
            bench.say(f"phase {name}")
            phase(bench, frames)
    if not bench.options.phases:
        for path in bench.folder.glob("long*"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def frames_that_fit(bench: Bench) -> int:
    """Frames that the part's time is enough for, by what a survey and a worker were measured to take."""
    cores = usable_cores()
    lit = max(bench.costs["worker"] / SEGMENTS, bench.costs["worker_processor"] / cores)
    # Surveyed once; lit by the run, then once in order, without being encoded, which is half of a worker's time.
    each = bench.costs["survey"] + lit + 0.5 * bench.costs["worker"] + 2.0
    fixed = 40.0 + bench.options.kill_seconds  # workers' starts, the recording; what is done until the last death
    frames = int(0.85 * (bench.left - fixed) * 1e3 / each)
    frames = max(min(frames, bench.options.long_frames), SEGMENTS * EDGE * 2)
    bench.say(f"{frames} of {bench.options.long_frames} frames fit {bench.left:.0f} s at {each:.1f} ms each")
    return frames


def _write(bench: Bench, frames: int) -> None:
    """Phase ``recording``."""
    video = bench.folder / "long.mp4"
    if video.exists():
        bench.say(f"{video.name} is there")
        return
    start, making = time.monotonic(), bench.folder / "long-making.mp4"
    write_scene(bench.folder / "desk.toml", bench.size)
    rate = bench.options.long_rate
    encoded = write_recording(making, bench.size, frames, rate)
    making.rename(video)
    bench.tell(
        f"recording of {frames} frames",
        seconds=round(time.monotonic() - start, 1),
        frames_a_second=rate,
        minutes=round(frames / rate / 60, 1),
        encoded_frames=encoded,
        megabytes=round(video.stat().st_size / 1e6),
    )


def _survey(bench: Bench, frames: int) -> None:
    """Phase ``survey``: in a run of its own, which is ended at its first segment."""
    place, making = bench.folder / "long-surveyed", bench.folder / "long-surveying"
    if place.exists():
        bench.say("it is surveyed")
        return
    keep_kernels(bench, "long")
    shutil.rmtree(making, ignore_errors=True)
    prepare(making, write_jobs(bench, "long", 8), None)
    seen = work(making, 1, bench.device, bench.say, limit=bench.left, steady=0.0)
    done = jobs_done(making, "survey")
    figures = {"seconds": round(seen.seconds, 1), **seen.memory()}
    if not done:
        bench.tell("survey", whole=False, frames=frames, error=seen.errors[-500:], **figures)
        raise RuntimeError("the survey was not finished")
    line = next(line for line in _lines(making) if line["job"] == done[0].key)
    bench.tell(
        "survey",
        whole=True,
        frames=int(line["length"]),
        ms_per_frame=round(1e3 * (done[0].end - done[0].start) / int(line["length"]), 2),
        # With the worker's start, which is a small part of a long one.
        processor_ms_per_frame=round(1e3 * seen.processor_seconds / int(line["length"]), 2),
        markers_found=line["found"],
        maps=line["keys"],
        bytes=done[0].bytes,
        **figures,
    )
    making.rename(place)


def _light_segments(bench: Bench, frames: int) -> None:
    """Phase ``segments``."""
    folder, noted = bench.folder / "long-run", bench.folder / "long-deaths.jsonl"
    options = bench.options
    if not folder.exists():
        noted.unlink(missing_ok=True)
        jobs = write_jobs(bench, "long", -(-_length(bench) // SEGMENTS), digests=True)
        prepare(folder, jobs, bench.folder / "long-surveyed")
    start, dice = time.monotonic(), random.Random(5)
    order = order_of_deaths(options.kills, options.driver_kills, dice)
    moments = sorted(options.kill_seconds * dice.random() for _ in order)
    before = [json.loads(line) for line in noted.read_text().splitlines()] if noted.exists() else []

    def note(death: dict[str, Any]) -> None:
        with open(noted, "a", encoding="utf-8") as stream:
            stream.write(json.dumps({"seconds": round(time.monotonic() - start, 1), **death}) + "\n")

    deaths = Deaths(
        folder,
        order[: len(order) - len(before)],
        lambda died: time.monotonic() - start >= moments[min(len(before) + died, len(moments) - 1)],
        dice,
        note,
    )
    runs = work_with_deaths(bench, deaths, SEGMENTS, bench.left if options.phases else max(bench.left, LEAST_SECONDS))
    _tell_run(bench, folder, runs, [json.loads(line) for line in noted.read_text().splitlines()])


def _tell_run(bench: Bench, folder: Path, runs: list[Watched], dead: list[dict[str, Any]]) -> None:
    """How a run of segments went, in this call, and who died, in all calls."""
    segments, whole = jobs_done(folder, "segment"), runs[-1].code == 0 and (folder / "long.mp4").is_file()
    seen = together(runs)
    bench.tell(
        f"recording of {_length(bench)} frames in {SEGMENTS} segments",
        whole=whole,
        seconds=round(seen.seconds, 1),
        **{f"segments_{name}": value for name, value in rates(segments, SEGMENTS).items()},
        deaths={who: sum(death["who"] == who for death in dead) for who in ("worker", "driver")},
        asked_deaths=[bench.options.kills, bench.options.driver_kills],
        deaths_while_segments_were_lit=sum(death["segments_begun"] > 0 for death in dead),
        most_frames_lit_at_a_death=max((death["frames_lit_of_them"] for death in dead), default=0),
        drivers=len(runs),
        processor_cores=round(seen.processor_seconds / max(seen.seconds, 1e-9), 2),
        **seen.memory(),
        last_driver=runs[-1].memory(),
        **runs[-1].gpu_figures(),
        error="" if whole else runs[-1].errors[-500:],
    )


def _light_in_order(bench: Bench, frames: int) -> None:
    """Phase ``one``."""
    start, place = time.monotonic(), bench.folder / "long-one.sha256"
    jobs = write_jobs(bench, "long", -(-_length(bench) // SEGMENTS), digests=True)
    digests = _in_a_process(digest_in_order, jobs, bench.folder / "long-surveyed", bench.one_device, _length(bench))
    place.write_text("".join(digest + "\n" for digest in digests), encoding="ascii")
    seconds = time.monotonic() - start
    bench.tell(
        f"one run of {len(digests)} frames, not encoded",
        seconds=round(seconds, 1),
        ms_per_frame=round(1e3 * seconds / len(digests), 2),
    )


def digest_in_order(jobs: Path, folder: Path, device: str, frames: int) -> list[str]:
    """Light all frames in order by one pipeline; digests of their pictures. In a process of its own.

    Args:
        jobs: The job file.
        folder: Of a run that has surveyed its clip.
        device: ``cpu`` or ``cuda:N``.
        frames: How many.
    """
    file, start = parse_jobs(read_jobs(jobs), str(jobs)), time.monotonic()
    digests: list[str] = []
    waiting: collections.deque[Future[str]] = collections.deque()
    with (
        Lighter(file, folder, device, converters=min(CONVERTERS, usable_cores())) as lighter,
        concurrent.futures.ThreadPoolExecutor(DIGESTING) as threads,
    ):
        for lit in lighter.light(Job("segment", 0, 0, 0, frames)):
            waiting.append(threads.submit(digest_of, lit.image))
            while len(waiting) > DIGESTING:
                digests.append(waiting.popleft().result())
            if lit.frame.index % TELL_FRAMES == TELL_FRAMES - 1:
                rate = (lit.frame.index + 1) / (time.monotonic() - start)
                print(f"one run: {lit.frame.index + 1} frames, {rate:.1f} a second", file=sys.stderr, flush=True)
        digests += [task.result() for task in waiting]
    return digests


def _check(bench: Bench, frames: int) -> None:
    """Phase ``check``; pictures of a run that is not whole yet are not compared."""
    folder, length = bench.folder / "long-run", _length(bench)
    lines = lines_of_jobs(folder)
    wanted = {"long/survey", "long/join", *(f"long/segment-{number:06d}" for number in range(SEGMENTS))}
    bench.tell(
        "jobs of the long recording",
        jobs=len(lines),
        lost=sorted(wanted - set(lines)),
        unknown=sorted(set(lines) - wanted),
        done_twice=sorted(key for key, times in lines.items() if times != 1),
        left_aside=len(list((folder / ".aside").iterdir())) if (folder / ".aside").is_dir() else 0,
    )
    own, one = ((path.read_text().split() if path.is_file() else []) for path in _digest_files(bench))
    unlike = [number for number, (a, b) in enumerate(itertools.zip_longest(own, one)) if a != b]
    bench.tell(
        "pictures of segments against one run",
        pictures=len(own),
        of_one_run=len(one),
        asked=length,
        unlike=len(unlike) if own and one else None,
        first_unlike=unlike[:10] if own and one else None,
        different_pictures=len(set(own)),
    )
    if (folder / "long.mp4").is_file():
        _check_video(bench, length)


def _check_video(bench: Bench, length: int) -> None:
    """The joined recording: times, every frame decoded, and how far encoded pictures are from lit ones."""
    start = time.monotonic()
    video, recording = bench.folder / "long-run/long.mp4", bench.folder / "long.mp4"
    mine, theirs = index_frames(video, None), index_frames(recording, None)
    times = [[float(int(tick - index.ticks[0]) * index.tick) for tick in index.ticks] for index in (mine, theirs)]
    parts = _parts(length)
    spawn = multiprocessing.get_context("spawn")
    jobs, surveyed_in = bench.folder / "long.toml", bench.folder / "long-surveyed"
    with (
        concurrent.futures.ProcessPoolExecutor(1, mp_context=spawn) as beside,
        concurrent.futures.ProcessPoolExecutor(max(1, usable_cores() // 2), mp_context=spawn) as pool,
    ):
        compared = beside.submit(compare_encoded, jobs, surveyed_in, bench.one_device, video, parts)
        stamps = mine.ticks.tolist()
        pieces = [piece for first, end in parts for piece in _halves(first, end)]
        tasks = [pool.submit(count_decoded, video, stamps[first:end]) for first, end in pieces]
        decoded = [task.result() for task in tasks]
        edges, inner, same = compared.result()
    bench.tell(
        "the joined recording",
        frames=mine.length,
        asked=length,
        same_times=times[0] == times[1],
        decoded=sum(decoded),
        encoded_minus_lit_mean_codes={
            f"within_{EDGE}_frames_of_a_segment": round(statistics.mean(edges), 3),
            "in_its_midst": round(statistics.mean(inner), 3),
            "largest_of_a_frame": round(max(edges + inner), 3),
        },
        lit_again=len(edges) + len(inner),
        lit_again_same=same,
        seconds=round(time.monotonic() - start, 1),
    )


def count_decoded(video: Path, stamps: list[int]) -> int:
    """Frames of a stretch of a video that decode and have the time stamps that were expected, in ticks."""
    count = 0
    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        stream.thread_count = 2
        container.seek(stamps[0], stream=stream, backward=True)
        for picture in container.decode(stream):
            if picture.pts < stamps[0]:
                continue
            count += picture.pts == stamps[count] and not picture.is_corrupt
            if picture.pts >= stamps[-1]:
                break
    return count


def compare_encoded(
    jobs: Path, folder: Path, device: str, video: Path, parts: list[tuple[int, int]]
) -> tuple[list[float], list[float], int]:
    """How far encoded pictures are from lit ones, where segments begin and in their midst; in a process of its own.

    Returns:
        Means of the difference in 8-bit codes, and how many of the pictures have the digests of the run.
    """
    file, index = parse_jobs(read_jobs(jobs), str(jobs)), index_frames(video, None)
    digests = video.with_suffix(".sha256").read_text().split()
    found: tuple[list[float], list[float]] = [], []
    same = 0
    with Lighter(file, folder, device) as lighter:
        for first, end in parts:
            middle = (first + end) // 2
            for means, begin in zip(found, (first, middle), strict=True):
                until = min(begin + EDGE, end)
                lit = lighter.light(Job("segment", 0, 0, begin, until))
                with open_part(video, index, begin, until, None) as encoded:
                    for own, other in zip(lit, encoded, strict=True):
                        same += digest_of(own.image) == digests[own.frame.index]
                        means.append(float(np.abs(own.image.astype(np.int16) - other.image).mean()))
    return *found, same


def _parts(length: int) -> list[tuple[int, int]]:
    """First frame and the one behind the last of each segment."""
    size = -(-length // SEGMENTS)
    return [(first, min(first + size, length)) for first in range(0, length, size)]


def _halves(first: int, end: int) -> list[tuple[int, int]]:
    """Both halves of a stretch; one of a single frame is whole."""
    middle = (first + end) // 2
    return [(first, middle), (middle, end)] if first < middle else [(first, end)]


def _digest_files(bench: Bench) -> tuple[Path, Path]:
    return bench.folder / "long-run/long.sha256", bench.folder / "long-one.sha256"


def _length(bench: Bench) -> int:
    """Frames of the recording that is there."""
    return index_frames(bench.folder / "long.mp4", None).length


def _lines(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "manifest.jsonl").read_text().splitlines()]


def _in_a_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """What a function gives in a process of its own, whose part of a GPU goes with it."""
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, mp_context=spawn) as pool:
        return pool.submit(function, *arguments).result()


PHASES: dict[str, Callable[[Bench, int], None]] = {
    "recording": _write,
    "survey": _survey,
    "segments": _light_segments,
    "one": _light_in_order,
    "check": _check,
}
"""Phases in their order."""
