"""What a run would take: jobs counted, and three of them tried on a few frames; nothing else is run."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from warp_ar.errors import WarpArError
from warp_ar.farm.frames import index_frames
from warp_ar.farm.jobs import Job, JobFile, job_of_clip, jobs_of_clip, lit_range, source_of
from warp_ar.farm.manifest import RunError
from warp_ar.farm.pool import keeping_to
from warp_ar.farm.records import Context
from warp_ar.farm.work import Work

PROBES = 3
"""Jobs that are tried."""
FRAMES = 16
"""Frames of each."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """What a run would take, on one worker unless it says otherwise."""

    clips: int
    jobs: int
    """Segments or variations."""
    frames: int
    """That are lit."""
    surveyed: int
    """Frames that are looked at once before."""
    survey_ms: float
    """Milliseconds of such a frame."""
    clip_ms: float
    """Milliseconds of a survey beside its frames."""
    frame_ms: float
    """Milliseconds of a frame that is lit and written."""
    job_ms: float
    """Milliseconds of a job beside its frames."""
    bytes: float
    """Of all outputs."""
    survey_bytes: float
    """That surveys keep in the run's folder."""
    problems: tuple[str, ...] = ()
    """Clips that cannot be read, and why."""

    def seconds(self, workers: int) -> float:
        """Seconds on so many workers that are all as fast as the one that was tried; a clip is surveyed by one."""
        surveys = (self.surveyed * self.survey_ms + self.clips * self.clip_ms) if self.surveyed else 0.0
        lighting = self.frames * self.frame_ms + self.jobs * self.job_ms
        return (surveys / min(workers, self.clips) + lighting / min(workers, self.jobs)) / 1e3


def make_plan(jobs: JobFile, device: str, say: Callable[[str], None], cores: Sequence[int] = ()) -> Plan:
    """Count jobs and try a few.

    Args:
        jobs: The job file.
        device: ``cpu`` or ``cuda:N``.
        say: Called with a line for people now and then.
        cores: Of all workers, which a survey may use; empty: those that this thread keeps to.

    Raises:
        RunError: No job can be tried.
    """
    lengths: dict[int, int] = {}
    problems = []
    for clip in range(len(jobs.clips)):
        try:
            lengths[clip] = index_frames(*source_of(jobs, clip)).length
            lit_range(jobs.clips[clip], lengths[clip])
        except WarpArError as error:
            lengths.pop(clip, None)
            problems.append(f"{jobs.clips[clip].name}: {error}")
    count = sum(jobs_of_clip(jobs, clip, length) for clip, length in lengths.items())
    every = 1 if jobs.dataset is None else jobs.dataset.every
    lit = surveyed = 0
    for clip, length in lengths.items():
        first, end = lit_range(jobs.clips[clip], length)
        surveyed += 0 if jobs.settings.light == "preroll" else end - first
        copies = 1 if jobs.dataset is None else jobs.dataset.variations
        lit += copies * -(-(end - first) // every)
        if jobs.settings.light == "preroll":
            lit += (jobs_of_clip(jobs, clip, length) - 1) * jobs.settings.preroll
    step = max(1, len(lengths) // PROBES)
    trials = [_try(jobs, clip, lengths[clip], device, say, cores) for clip in list(lengths)[::step][:PROBES]]
    if not trials:
        raise RunError(f"no clip can be tried: {problems[0] if problems else 'there is none'}")
    survey_ms, clip_ms, frame_ms, job_ms, size, kept = (
        sum(values) / len(trials) for values in zip(*trials, strict=True)
    )
    found = survey_ms, clip_ms, frame_ms, job_ms, lit * size, surveyed * kept
    return Plan(len(lengths), count, lit, surveyed, *found, tuple(problems))


def _try(
    jobs: JobFile, clip: int, length: int, device: str, say: Callable[[str], None], cores: Sequence[int]
) -> tuple[float, float, float, float, float, float]:
    """Do the first job of a clip on a few frames, twice: the second time all is compiled and read.

    Returns:
        Milliseconds of a surveyed frame, of a survey beside its frames, of a lit frame, of a job beside its frames;
        bytes of a lit frame, and of a surveyed one.
    """
    first, end = lit_range(jobs.clips[clip], length)
    few = dataclasses.replace(jobs.clips[clip], end=min(end, first + FRAMES))
    clips = (*jobs.clips[:clip], few, *jobs.clips[clip + 1 :])
    tried = dataclasses.replace(jobs, clips=clips)
    with tempfile.TemporaryDirectory(prefix="warp_ar-plan-") as name:
        work = Work(Context(tried, Path(name), device))
        try:
            job = job_of_clip(tried, clip, 0, length)
            with keeping_to(cores):
                whole = _time(work, Job("survey", clip))
                again = Path(name) / Job("survey", clip).place(tried)
                again.rename(again.with_name("first"))
                survey, kept, _, looked_since = _time(work, Job("survey", clip))
            times = []
            for _ in range(2):
                seconds, size, frames, begun = _time(work, job)
                times.append((seconds, size, frames, begun))
                place = Path(name) / job.place(tried)
                place.rename(place.with_name(f"{place.name}-{len(times)}"))
        finally:
            work.close()
    seconds, size, frames, begun = times[1]
    looked = max((few.end or 0) - first, 1)
    say(f"{jobs.clips[clip].name}: {frames} frames in {seconds:.2f} s (the first time {whole[0] + times[0][0]:.2f} s)")
    per_frame = (seconds - begun) / max(frames - 1, 1)
    per_look = (survey - looked_since) / max(looked - 1, 1)
    return (
        1e3 * per_look,
        1e3 * max(survey - looked * per_look, 0.0),
        1e3 * per_frame,
        1e3 * max(seconds - frames * per_frame, 0.0),
        size / max(frames, 1),
        kept / looked,
    )


def _time(work: Work, job: Job) -> tuple[float, float, int, float]:
    """Seconds of a job, its bytes, its frames, and seconds until its first frame was done."""
    start = time.perf_counter()
    begun: list[float] = []

    def tell(_: int) -> None:
        if not begun:
            begun.append(time.perf_counter() - start)

    outcome = work.do(job, tell)
    if outcome.state != "done":
        raise RunError(f"{job.key(work.context.jobs)} cannot be tried: {outcome.reason}")
    seconds = time.perf_counter() - start
    return (
        seconds,
        float(outcome.values.get("bytes", 0)),
        int(outcome.values.get("frames", 0)),
        begun[0] if begun else 0.0,
    )
