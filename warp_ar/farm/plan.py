"""Expected time and size of a run: jobs are counted, and three are tried on a few frames."""

from __future__ import annotations

import dataclasses
import statistics
import tempfile
from collections.abc import Sequence
from pathlib import Path

from warp_ar.errors import WarpArError, say
from warp_ar.farm.frames import index_frames
from warp_ar.farm.jobs import Context, Job, JobFile, Outcome, job_of_clip, jobs_of_clip, lit_range, source_of
from warp_ar.farm.manifest import RunError, words_of_seconds
from warp_ar.farm.pools import cores_of, keeping_to
from warp_ar.farm.work import Work

PROBES = 3
"""Largest number of clips of which a job is tried."""
FRAMES = 16
"""Largest number of frames of each trial."""


def tell_plan(jobs: JobFile, devices: Sequence[str]) -> tuple[list[str], list[str]]:
    """Count jobs, try a few on the first worker's device, and estimate time and size of the run.

    Args:
        jobs: The job file.
        devices: Device of each planned worker.

    Returns:
        Lines with numbers of jobs, times and sizes; and lines with the reasons why clips cannot be read.

    Raises:
        RunError: No job can be tried.
    """
    lengths: dict[int, int] = {}
    problems = []
    count = lit = surveyed = 0
    copies, every = (1, 1) if jobs.dataset is None else (jobs.dataset.variations, jobs.dataset.every)
    for clip, spec in enumerate(jobs.clips):
        try:
            length = index_frames(*source_of(jobs, clip)).length
            first, end = lit_range(spec, length)
        except WarpArError as error:
            problems.append(f"{spec.name}: {error}")
            continue
        lengths[clip] = length
        count += jobs_of_clip(jobs, clip, length)
        lit += copies * -(-(end - first) // every)
        if jobs.settings.light == "preroll":
            lit += (jobs_of_clip(jobs, clip, length) - 1) * jobs.settings.preroll
        else:
            surveyed += end - first
    if not lengths:
        raise RunError(f"no clip can be tried: {problems[0] if problems else 'there is none'}")
    cores = cores_of(devices)
    with keeping_to(cores[0]):  # as a worker does
        tried = [_try(jobs, clip, lengths[clip], devices[0]) for clip in list(lengths)[:: -(-len(lengths) // PROBES)]]
    survey_ms, frame_ms, size, kept = (statistics.fmean(values) for values in zip(*tried, strict=True))
    kind = "segments" if jobs.dataset is None else "variations"
    lines = [
        f"{len(lengths)} clips, {count} {kind}, {lit} frames to light, {surveyed} to survey",
        f"a frame: {frame_ms:.1f} ms lit and written, {survey_ms:.1f} ms surveyed, at quality {jobs.settings.quality} "
        f"on {devices[0]}",
    ]
    # Workers that share a core count as one. A clip is surveyed by one worker.
    at_once = len({core for own in cores for core in own} or devices) if devices[0] == "cpu" else len(devices)
    for workers in sorted({1, len(devices)}):
        busy = min(workers, at_once)
        seconds = surveyed * survey_ms / min(busy, len(lengths)) + lit * frame_ms / min(busy, count)
        lines.append(f"{workers} worker{'s' if workers > 1 else ''}: {words_of_seconds(1e-3 * seconds)}")
    beside = f", beside {surveyed * kept / 1e6:.1f} MB that surveys keep" if surveyed else ""
    return [*lines, f"output: {lit * size / 1e6:.1f} MB{beside}"], problems


def _try(jobs: JobFile, clip: int, length: int, device: str) -> tuple[float, float, float, float]:
    """Do the survey and the first job of a clip on a few frames, twice each, and time the second.

    In the first, kernels are compiled and files are cached.

    Args:
        jobs: The job file.
        clip: Index of the clip.
        length: Number of frames of its source.
        device: ``cpu`` or ``cuda:N``.

    Returns:
        Milliseconds per surveyed and per lit frame; bytes per lit and per surveyed frame.

    Raises:
        RunError: A job fails.
    """
    first, end = lit_range(jobs.clips[clip], length)
    few = dataclasses.replace(jobs.clips[clip], end=min(end, first + FRAMES))
    tried = dataclasses.replace(jobs, clips=(*jobs.clips[:clip], few, *jobs.clips[clip + 1 :]))
    found: list[Outcome] = []
    with tempfile.TemporaryDirectory(prefix="warp_ar-plan-") as name, Work(Context(tried, Path(name), device)) as work:
        survey, lighting = Job("survey", clip), job_of_clip(tried, clip, 0, length)
        for job in (survey, survey, lighting, lighting):
            place = Path(name) / job.place(tried)
            if place.exists():
                place.rename(place.with_name("first"))
            found.append(work.do(job))
            if found[-1].state != "done":
                raise RunError(f"{job.key(tried)} cannot be tried: {found[-1].reason}")
    seconds, sizes = ([float(outcome.values[key]) for outcome in found] for key in ("seconds", "bytes"))
    looked, frames = max((few.end or 0) - first, 1), max(int(found[-1].values.get("frames", 0)), 1)
    say(f"{few.name}: {frames} frames in {seconds[3]:.2f} s (the first time {seconds[0] + seconds[2]:.2f} s)")
    return 1e3 * seconds[1] / looked, 1e3 * seconds[3] / frames, sizes[3] / frames, sizes[1] / looked
