"""How many workers share a GPU to begin with: found by having one light a few frames alone.

A worker decodes and encodes on the processor, which takes it much longer than its kernels take the GPU: as many fit as
a GPU's share of the cores can feed and its memory holds. What is tried runs in processes of its own, so that the driver
holds no part of a GPU. While cores stand idle, more come later (``growth.py``).
"""

from __future__ import annotations

import concurrent.futures
import concurrent.futures.process
import contextlib
import dataclasses
import math
import multiprocessing
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from warp_ar.errors import WarpArError
from warp_ar.farm.frames import index_frames
from warp_ar.farm.jobs import Job, JobFile, job_of_clip, lit_range, source_of
from warp_ar.farm.records import Context

FRAMES = 24
"""That the worker lights, twice: the first time kernels are loaded and arrays allocated."""
CLIPS = 3
"""That are tried before the probe gives up."""
MOST = 32
"""Workers of a GPU."""
LOOK_SECONDS = 0.05
"""Between two looks at how much of a GPU's memory is free."""
SPARE = 0.9
"""Share of a GPU's memory that workers may fill."""
GROWN = 0.6
"""Share up to which more come later: other clips may take more than the one that was tried."""


@dataclasses.dataclass(frozen=True)
class Probe:
    """What one worker alone was seen to need."""

    frames_per_second: float
    cores: float
    """That it kept busy: processor time over time."""
    bytes: int
    """Of the device's memory, the most that its process took; 0 on CPU."""
    free_bytes: int
    """Of the device's memory before."""


def workers_of_gpu(probe: Probe, cores: int, gpus: int) -> int:
    """How many workers share each GPU to begin with.

    Args:
        probe: Of one worker.
        cores: Of the machine.
        gpus: Of the machine.
    """
    by_cores = cores / gpus / max(probe.cores, 0.1)
    return max(1, min(MOST, round(by_cores), held_by_memory(probe, SPARE)))


def held_by_memory(probe: Probe, share: float) -> int:
    """How many workers a share of a GPU's memory holds."""
    return math.floor(share * probe.free_bytes / max(probe.bytes, 1))


def jobs_at_once(jobs: JobFile) -> int | None:
    """How many jobs there are at most; None: that is known when the clips have been surveyed."""
    if jobs.dataset is not None or jobs.settings.segment_frames is not None:
        return None
    return len(jobs.clips)


def probe_worker(jobs: JobFile, device: str) -> Probe | None:
    """Have one worker of a process of its own light a few frames; None where no clip can be tried.

    A process beside it sees how much memory of the device goes, with what the driver takes for the worker's process.

    Args:
        jobs: The job file.
        device: ``cpu`` or ``cuda:N``.
    """
    spawn = multiprocessing.get_context("spawn")
    with (
        concurrent.futures.ProcessPoolExecutor(1, mp_context=spawn) as beside,
        concurrent.futures.ProcessPoolExecutor(1, mp_context=spawn) as process,
    ):
        try:
            free = beside.submit(_free_bytes, device).result()
            trial = process.submit(_probe, jobs, device)
            least = free
            while not trial.done():  # where one job's pipeline follows another's, both are there for a while
                concurrent.futures.wait([trial], LOOK_SECONDS)
                least = min(least, beside.submit(_free_bytes, device).result())
            seen = trial.result()
            process.submit(_end_trial).result()
        except concurrent.futures.process.BrokenProcessPool:
            return None
    return None if seen is None else Probe(*seen, free - least, free)


def fit_workers(jobs: JobFile, devices: list[str], cores: int, say: Callable[[str], None]) -> tuple[int, int]:
    """Workers for GPUs, all told: to begin with, and at most.

    Args:
        jobs: The job file.
        devices: The GPUs.
        cores: Of the machine.
        say: Called with a line for people.
    """
    jobs_most = jobs_at_once(jobs)
    if jobs_most is not None and jobs_most <= len(devices):
        return len(devices), len(devices)
    probe = probe_worker(jobs, devices[0])
    if probe is None:
        return len(devices), len(devices)
    each = workers_of_gpu(probe, cores, len(devices))
    say(
        f"a worker alone lights {probe.frames_per_second:.0f} frames/s and keeps {probe.cores:.1f} of {cores} cores "
        f"busy: {each} workers for each of {len(devices)} GPUs to begin with; --workers says otherwise"
    )
    most = max(each, min(MOST, held_by_memory(probe, GROWN)))
    total, at_most = each * len(devices), most * len(devices)
    return (total, at_most) if jobs_most is None else (min(total, jobs_most), min(at_most, jobs_most))


_TRIED = contextlib.ExitStack()
"""What a trial's process keeps until its memory has been looked at."""


def _free_bytes(device: str) -> int:
    """Of a device's memory, as this process sees it; 0 on CPU."""
    import warp as wp

    from warp_ar.device import start_warp

    start_warp()
    target = wp.get_device(device)
    return int(target.free_memory) if target.is_cuda else 0


def _end_trial() -> None:
    """Let go of what was kept."""
    _TRIED.close()


def _probe(jobs: JobFile, device: str) -> tuple[float, float] | None:
    """Frames a second of a worker, and cores that it kept busy; in this process, which keeps the worker."""
    from warp_ar.device import start_warp
    from warp_ar.farm.work import Work

    start_warp()
    for clip in range(min(len(jobs.clips), CLIPS)):
        try:
            length = index_frames(*source_of(jobs, clip)).length
            first, end = lit_range(jobs.clips[clip], length)
        except WarpArError:
            continue
        few = dataclasses.replace(jobs.clips[clip], end=min(end, first + FRAMES))
        tried = dataclasses.replace(jobs, clips=(*jobs.clips[:clip], few, *jobs.clips[clip + 1 :]))
        _TRIED.close()
        name = _TRIED.enter_context(tempfile.TemporaryDirectory(prefix="warp_ar-probe-"))
        work = _TRIED.enter_context(Work(Context(tried, Path(name), device)))
        if work.do(Job("survey", clip), lambda _: None).state != "done":
            continue
        job = job_of_clip(tried, clip, 0, length)
        wall = busy = 0.0
        frames = 0
        for turn in range(2):
            start, spent = time.perf_counter(), time.process_time()
            outcome = work.do(job, lambda _: None)
            wall, busy = time.perf_counter() - start, time.process_time() - spent
            if outcome.state != "done":
                break
            frames = int(outcome.values["frames"])
            place = Path(name) / job.place(tried)
            place.rename(place.with_name(f"tried-{turn}"))
        else:
            return frames / wall, busy / wall
    return None
