"""Gives jobs to workers until all are done: what is next, what is tried again, what has failed for good.

The driver holds no frame and no list of jobs: of each clip it knows how many jobs there are and which are open.
"""

from __future__ import annotations

import collections
import dataclasses
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from warp_ar.errors import reason
from warp_ar.farm.jobs import Job, JobFile, job_of_clip, jobs_of_clip
from warp_ar.farm.manifest import PROGRESS, Manifest, RunError, is_no_space, record_at
from warp_ar.farm.pool import Event, Pool, is_from_outside, words_of_exit
from warp_ar.farm.records import Outcome
from warp_ar.farm.variations import in_kindred_order
from warp_ar.files import write_whole

TRIES = 2
"""Times that a job may fail."""
INTERRUPTIONS = 10
"""Times that a job's worker may be ended from outside, which need not be the job's fault."""
PROGRESS_SECONDS = 2.0
"""Between two looks at progress."""
FRAMES_OF = ("segment", "variation")
"""Kinds of jobs that light frames."""
STARTS = 3
"""Times in a row that a worker may die before it is ready."""


@dataclasses.dataclass
class Summary:
    """How a run went."""

    done: int = 0
    failed: dict[str, str] = dataclasses.field(default_factory=dict)
    """Reasons by job."""


@dataclasses.dataclass
class _Worker:
    """What the driver knows of a worker."""

    ready: bool = False
    job: Job | None = None
    frames: int = 0
    """Of its job."""
    since: float = 0.0
    total: int = 0
    """Frames of its finished jobs."""
    busy: float = 0.0
    """Seconds that they took."""
    deaths: int = 0
    """Before it was ready, in a row."""


class Driver:
    """Works through a run with a pool of workers."""

    def __init__(
        self,
        jobs: JobFile,
        folder: Path,
        manifest: Manifest,
        pool: Pool,
        version: str,
        say: Callable[[str], None],
    ) -> None:
        """Find out what is open.

        Args:
            jobs: The job file.
            folder: Of the run.
            manifest: Of the run, open for writing.
            pool: Workers.
            version: Of the program, which all workers must be of.
            say: Called with a line for people now and then.
        """
        self._jobs, self._folder, self._manifest, self._pool = jobs, folder, manifest, pool
        self._version, self._say = version, say
        self._workers = [_Worker() for _ in range(pool.size)]
        self._again: collections.deque[Job] = collections.deque()
        self._interrupted: collections.Counter[str] = collections.Counter()
        self._open: dict[int, int] = {}
        """Jobs of a surveyed clip that are neither done nor failed."""
        self._spent: set[int] = set()
        """Clips with a job that failed for good."""
        self._running: set[Job] = set()
        self._coming = self._list_jobs()
        self._surveyed: collections.deque[Iterator[Job]] = collections.deque()
        self._joins: collections.deque[Job] = collections.deque()
        self._lines_since, self._started = 0.0, time.monotonic()
        self._known = 0
        """Jobs of surveyed clips."""
        self._finished_now = 0
        self.summary = Summary()

    def _list_jobs(self) -> Iterator[Job]:
        """Surveys, one clip after another; clips that are surveyed or joined already are opened on the way."""
        for clip in range(len(self._jobs.clips)):
            survey = Job("survey", clip)
            if self._jobs.dataset is None and self._is_done(Job("join", clip)):
                continue
            if survey.key(self._jobs) in self._manifest.failed:
                continue
            if self._is_done(survey):
                self._open_clip(clip)
            else:
                yield survey

    def _is_done(self, job: Job) -> bool:
        """Whether a job's outputs are there; a line without them, or they without a line, are put right."""
        key, place = job.key(self._jobs), self._folder / job.place(self._jobs)
        listed = key in self._manifest.done
        if job.kind in ("join", "index"):
            there = place.is_file()
        else:
            record = record_at(place, key)
            there = record is not None
            if record is not None and not listed:
                if job.kind == "survey" and not isinstance(record.get("length"), int):
                    return False  # damaged: without it nobody knows the clip's jobs
                # Its worker had finished when the driver died: taken over.
                self._manifest.add("done", key, **{k: v for k, v in record.items() if k != "job"}, adopted=True)
                return True
        if listed and not there:
            self._manifest.add("again", key, reason="its outputs have gone")
            return False
        return listed and there

    def _open_clip(self, clip: int) -> None:
        """Take the jobs of a clip that has been surveyed."""
        key = Job("survey", clip).key(self._jobs)
        length = int(self._manifest.done[key]["length"])
        count = jobs_of_clip(self._jobs, clip, length)
        self._open[clip] = count
        self._known += count
        self._surveyed.append(self._jobs_of(clip, count, length))

    def _jobs_of(self, clip: int, count: int, length: int) -> Iterator[Job]:
        dataset = self._jobs.dataset
        for number in range(count) if dataset is None else in_kindred_order(dataset, clip, count):
            job = job_of_clip(self._jobs, clip, number, length)
            if job.key(self._jobs) in self._manifest.failed:
                self._settle(clip, failed=True)
            elif self._is_done(job):
                self._settle(clip, failed=False)
            else:
                yield job

    def _settle(self, clip: int, *, failed: bool) -> None:
        """One job less is open; the last of a recording's lets it be joined."""
        self._open[clip] -= 1
        if failed:
            self._spent.add(clip)
        if not self._open[clip] and self._jobs.dataset is None and clip not in self._spent:
            join = Job("join", clip)
            if join.key(self._jobs) not in self._manifest.failed and not self._is_done(join):
                self._joins.append(join)

    def _next_job(self) -> Job | None:
        """What to do next; None: nothing that could begin now."""
        if self._again:
            return self._again.popleft()
        if self._joins:
            return self._joins.popleft()
        while self._surveyed:
            job = next(self._surveyed[0], None)
            if job is not None:
                return job
            self._surveyed.popleft()
            if self._joins:
                return self._joins.popleft()
        survey = next(self._coming, None)
        if survey is None and (self._surveyed or self._joins):
            return self._next_job()
        return survey

    def run(self) -> Summary:
        """Work until nothing is left; returns how it went.

        Raises:
            RunError: The run cannot go on: a full disk, workers of another version, workers that do not start.
        """
        try:
            self._work(self._next_job)
            if self._jobs.dataset is not None:
                self._index()
        finally:
            self._pool.close()
            self._write_progress(ended=True)
        self.summary.failed = dict(self._manifest.failed)
        self.summary.done = len(self._manifest.done)
        return self.summary

    def _index(self) -> None:
        """Write what a data set has as a whole, anew if a variation was added."""
        done = [job for clip in sorted(self._open) for job in self._finished_jobs(clip)]
        if not done or (not self._finished_now and self._is_done(Job("index"))):
            return
        if Job("index").key(self._jobs) in self._manifest.done:
            self._manifest.add("again", Job("index").key(self._jobs), reason="variations were added")
        left: list[Job] = [Job("index")]
        self._work(lambda: left.pop() if left else None, [job.place(self._jobs).as_posix() for job in done])

    def _finished_jobs(self, clip: int) -> Iterator[Job]:
        length = int(self._manifest.done[Job("survey", clip).key(self._jobs)]["length"])
        for number in range(jobs_of_clip(self._jobs, clip, length)):
            job = job_of_clip(self._jobs, clip, number, length)
            if job.key(self._jobs) in self._manifest.done:
                yield job

    def _work(self, next_job: Callable[[], Job | None], arguments: Any = None) -> None:
        """Give out jobs and take results until there are none of either."""
        waiting: Job | None = None
        while True:
            for worker, state in enumerate(self._workers):
                if not state.ready or state.job is not None:
                    continue
                job, waiting = waiting or next_job(), None
                if job is None:
                    break
                state.job, state.frames, state.since = job, 0, time.monotonic()
                self._running.add(job)
                self._pool.give(worker, job, arguments)
            if not self._running and any(state.ready for state in self._workers):
                waiting = self._again.popleft() if self._again else next_job()
                if waiting is None:
                    return
                continue
            for event in self._pool.wait(1.0):
                self._hear(event)
            if time.monotonic() - self._lines_since > PROGRESS_SECONDS:
                self._lines_since = time.monotonic()
                self._write_progress()

    def _hear(self, event: Event) -> None:
        """Take what a worker says."""
        state = self._workers[event.worker]
        match event.kind:
            case "ready":
                if event.value != self._version:
                    raise RunError(
                        f"worker {event.worker} is {event.value}, the driver is {self._version}; "
                        "install one version on all"
                    )
                state.ready, state.deaths = True, 0
            case "frames":
                state.frames = event.value
            case "outcome":
                job, state.job = state.job, None
                if job is not None:
                    self._running.discard(job)
                    state.busy += time.monotonic() - state.since
                    frames = int(event.value.values.get("frames", 0))
                    state.total += frames
                    state.frames = 0
                    self._take(job, event.value)
            case "died":
                self._bury(event, state)

    def _bury(self, event: Event, state: _Worker) -> None:
        """A worker has died; another has been started."""
        job, state.job = state.job, None
        outside = isinstance(event.value, str) or is_from_outside(event.value)
        if not state.ready and not (outside and isinstance(event.value, int)):
            state.deaths += 1
            if state.deaths >= STARTS:
                raise RunError(
                    f"worker {event.worker} died {STARTS} times before it was ready; see "
                    f"{self._folder / 'log' / f'worker-{event.worker}.log'}"
                )
        state.ready, state.frames = False, 0
        if job is None:
            return
        self._running.discard(job)
        key = job.key(self._jobs)
        how = event.value if isinstance(event.value, str) else words_of_exit(event.value)
        if outside and self._interrupted[key] + 1 < INTERRUPTIONS:
            self._interrupted[key] += 1
            self._again.append(job)
        else:
            self._take(job, Outcome("failed", reason=how))

    def _take(self, job: Job, outcome: Outcome) -> None:
        """Write down what became of a job."""
        key = job.key(self._jobs)
        if outcome.state == "full":
            raise RunError(
                f"the disk of {self._folder} is full ({outcome.reason}); free some space, then: "
                f"farm resume {self._folder}"
            )
        if outcome.state == "failed":
            self._manifest.add("try", key, reason=outcome.reason)
            if self._manifest.tries[key] < TRIES:
                self._again.append(job)
                return
            self._manifest.add("failed", key, reason=outcome.reason)
            self._say(f"{key} failed: {outcome.reason}")
            if job.kind in FRAMES_OF:
                self._settle(job.clip, failed=True)
            return
        self._manifest.add("done", key, **outcome.values)
        if job.kind == "survey":
            self._open_clip(job.clip)
        elif job.kind in FRAMES_OF:
            self._finished_now += 1
            self._settle(job.clip, failed=False)

    def _write_progress(self, *, ended: bool = False) -> None:
        """Leave word of where things stand for ``farm status``; a disk that is full loses it, no more."""
        now = time.monotonic()
        workers = []
        for state, name in zip(self._workers, self._pool.names, strict=True):
            spent = state.busy + (now - state.since if state.job is not None else 0.0)
            rate = (state.total + state.frames) / spent if spent > 0.0 else 0.0
            key = None if state.job is None else state.job.key(self._jobs)
            workers.append({"device": name, "job": key, "frames": state.frames, "fps": round(rate, 2)})
        told = {
            "program": "warp_ar",
            "time": time.time(),
            "ended": ended,
            "workers": workers,
            "clips": len(self._jobs.clips),
            "clips_surveyed": len(self._open),
            "jobs_known": self._known,
            "jobs_open": sum(self._open.values()),
            "seconds_left": self._seconds_left(now),
        }
        try:
            write_whole(self._folder / PROGRESS, json.dumps(told).encode())
        except OSError as error:
            if is_no_space(error):
                return  # a job or the manifest says so
            self._say(f"{self._folder / PROGRESS} cannot be written: {reason(error)}")

    def _jobs_left(self) -> float:
        """That are open, if other clips have as many jobs as those that are known."""
        clips = len(self._open)
        unknown = (len(self._jobs.clips) - clips) * self._known / clips if clips else 0.0
        return sum(self._open.values()) + unknown

    def _seconds_left(self, now: float) -> float | None:
        """By the pace of this driver; None: too early."""
        if not self._finished_now or not self._open:
            return None
        return round((now - self._started) / self._finished_now * self._jobs_left(), 1)
