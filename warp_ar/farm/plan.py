"""The time and the bytes that a run would take: jobs counted, and three of them tried on a few frames."""

from __future__ import annotations

import dataclasses
import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path

from warp_ar.errors import WarpArError
from warp_ar.farm.frames import index_frames
from warp_ar.farm.jobs import Context, Job, JobFile, Outcome, job_of_clip, jobs_of_clip, lit_range, source_of
from warp_ar.farm.manifest import RunError
from warp_ar.farm.work import Work

PROBES = 3
"""Clips of which a job is tried."""
FRAMES = 16
"""Frames of each."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """The time and space of a run, on workers that are all as fast as the one that was tried."""

    clips: int
    jobs: int
    """Segments or variations."""
    frames: int
    """That are lit."""
    surveyed: int
    """Frames that are looked at once before."""
    survey_ms: float
    """Milliseconds of such a frame."""
    frame_ms: float
    """Milliseconds of a frame that is lit and written."""
    bytes: float
    """Of all outputs."""
    survey_bytes: float
    """That surveys keep in the run's folder."""
    problems: tuple[str, ...] = ()
    """Clips that cannot be read, and why."""

    def seconds(self, workers: int) -> float:
        """Return the seconds that so many workers take; a clip is surveyed by one."""
        surveys = self.surveyed * self.survey_ms / min(workers, self.clips)
        return (surveys + self.frames * self.frame_ms / min(workers, self.jobs)) / 1e3


def make_plan(jobs: JobFile, device: str, say: Callable[[str], None]) -> Plan:
    """Count jobs and try a few.

    Args:
        jobs: The job file.
        device: ``cpu`` or ``cuda:N``.
        say: Called with a line for people now and then.

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
    trials = [_try(jobs, clip, lengths[clip], device, say) for clip in list(lengths)[:: -(-len(lengths) // PROBES)]]
    survey_ms, frame_ms, size, kept = (statistics.fmean(values) for values in zip(*trials, strict=True))
    return Plan(len(lengths), count, lit, surveyed, survey_ms, frame_ms, lit * size, surveyed * kept, tuple(problems))


def _try(
    jobs: JobFile, clip: int, length: int, device: str, say: Callable[[str], None]
) -> tuple[float, float, float, float]:
    """Do the first job of a clip on a few frames, twice: the second time all is compiled and read.

    Returns:
        Milliseconds of a surveyed frame and of a lit one; bytes of a lit frame and of a surveyed one.
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
