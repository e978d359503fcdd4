"""Gives jobs to workers until all are done: the next one, one that is tried again, one that has failed for good.

The driver holds no frame and no list of jobs: of each clip it knows how many jobs there are and which are open.
"""

from __future__ import annotations

import collections
import json
import shutil
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from pathlib import Path
from typing import Any

from warp_ar.errors import UsageError, reason
from warp_ar.farm.dataset import in_kindred_order
from warp_ar.farm.jobs import Job, JobFile, Outcome, job_of_clip, jobs_of_clip
from warp_ar.farm.manifest import PROGRESS, Manifest, RunError, bytes_of, changed_input, is_no_space, record_at
from warp_ar.farm.pools import Pool
from warp_ar.files import write_whole

TRIES = 2
"""Times that a job may fail."""
STARTS = 3
"""Times in a row that a worker may die before it is ready."""
PROGRESS_SECONDS = 2.0
"""Between two words of where things stand."""
LIGHTING = ("segment", "variation")
"""Kinds of jobs that light frames."""


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
        self._running: dict[Future[Any], tuple[int, Job | None]] = {}
        """The worker of each future, and its job; None while the worker starts."""
        self._idle: collections.deque[int] = collections.deque()
        self._starts, self._deaths = collections.Counter[int](), collections.Counter[str]()
        self._lit, self._busy = collections.Counter[int](), collections.Counter[int]()
        """Frames of each worker's finished jobs, and the milliseconds that they took."""
        self._again: collections.deque[Job] = collections.deque()
        self._open: dict[int, int] = {}
        """Jobs of a surveyed clip that are neither done nor failed."""
        self._spent: set[int] = set()
        """Clips with a job that failed for good."""
        self._coming = self._list_jobs()
        self._surveyed: collections.deque[Iterator[Job]] = collections.deque()
        self._joins: collections.deque[Job] = collections.deque()
        self._told, self._started = 0.0, time.monotonic()
        self._known = self._finished_now = 0

    def _list_jobs(self) -> Iterator[Job]:
        """Yield surveys, one clip after another; clips that are surveyed or joined already are opened on the way."""
        for clip in range(len(self._jobs.clips)):
            survey = Job("survey", clip)
            if survey.key(self._jobs) in self._manifest.failed:
                continue
            surveyed = self._is_done(survey)
            if surveyed:
                self._refuse_changed(survey.key(self._jobs))
            if self._jobs.dataset is None and self._is_done(Job("join", clip)):
                continue
            if surveyed:
                self._open_clip(clip)
            else:
                yield survey

    def _refuse_changed(self, key: str) -> None:
        """Refuse to go on where a file that a survey has read is another one now.

        Raises:
            UsageError: It is.
        """
        if told := changed_input(self._manifest.done[key].get("inputs") or {}):
            raise UsageError(
                f"{told}, which {self._folder} was begun with; put it back, or begin a new run in another folder"
            )

    def _is_done(self, job: Job) -> bool:
        """Return whether a job's outputs are there and whole; a manifest that says otherwise is put right."""
        key, place = job.key(self._jobs), self._folder / job.place(self._jobs)
        line = self._manifest.done.get(key)
        record = line if job.kind in ("join", "index") else record_at(place, key)
        if record is not None and bytes_of(place) == record.get("bytes"):
            if line is not None:
                return True
            if job.kind != "survey" or isinstance(record.get("length"), int):
                # Its worker had finished when the driver died: taken over.
                self._manifest.add("done", key, **{k: v for k, v in record.items() if k != "job"}, adopted=True)
                return True
        if line is not None:
            self._manifest.add("again", key, reason="its outputs have gone or are not whole")
        if record_at(place, key) is not None:
            shutil.rmtree(place)
        return False

    def _open_clip(self, clip: int) -> None:
        """Take the jobs of a clip that has been surveyed."""
        length = int(self._manifest.done[Job("survey", clip).key(self._jobs)]["length"])
        spec = self._jobs.clips[clip]
        if spec.end is not None and spec.end > length:
            self._say(f"clip {spec.name}: frames = [{spec.first}, {spec.end}], but it ends with frame {length - 1}")
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
        """Count one open job less; the last of a recording's lets it be joined."""
        self._open[clip] -= 1
        if failed:
            self._spent.add(clip)
        if not self._open[clip] and self._jobs.dataset is None and clip not in self._spent:
            join = Job("join", clip)
            if join.key(self._jobs) not in self._manifest.failed:
                self._joins.append(join)

    def _next_job(self) -> Job | None:
        """Return what to do next; None where nothing could begin now."""
        while True:
            for waiting in (self._again, self._joins):
                if waiting:
                    return waiting.popleft()
            if self._surveyed:
                job = next(self._surveyed[0], None)
                if job is not None:
                    return job
                self._surveyed.popleft()
                continue
            survey = next(self._coming, None)
            if survey is not None or not (self._surveyed or self._joins):
                return survey

    def run(self) -> dict[str, str]:
        """Work until nothing is left; return the reasons of jobs that failed, by their keys.

        Raises:
            RunError: The run cannot go on: a full disk, workers of another version, workers that do not start.
            UsageError: A file that was read before is another one now.
        """
        try:
            for worker in range(len(self._pool.names)):
                self._running[self._pool.start(worker)] = worker, None
            self._work(self._next_job)
            if self._jobs.dataset is not None:
                self._index()
        finally:
            self._pool.close()
            self._write_progress(ended=True)
        return dict(self._manifest.failed)

    def _index(self) -> None:
        """Write what a data set has as a whole, anew if a variation was added."""
        done = [job for clip in sorted(self._open) for job in self._finished_jobs(clip)]
        if not done or (not self._finished_now and self._is_done(Job("index"))):
            return
        key = Job("index").key(self._jobs)
        if key in self._manifest.done:
            self._manifest.add("again", key, reason="variations were added")
        left = [Job("index")]
        arguments = [job.place(self._jobs).as_posix() for job in done]
        self._work(lambda: self._again.popleft() if self._again else left.pop() if left else None, arguments)

    def _finished_jobs(self, clip: int) -> Iterator[Job]:
        length = int(self._manifest.done[Job("survey", clip).key(self._jobs)]["length"])
        for number in range(jobs_of_clip(self._jobs, clip, length)):
            job = job_of_clip(self._jobs, clip, number, length)
            if job.key(self._jobs) in self._manifest.done:
                yield job

    def _work(self, next_job: Callable[[], Job | None], arguments: Any = None) -> None:
        """Give out jobs and take results until there are none of either."""
        while True:
            job = None
            while self._idle and (job := next_job()) is not None:
                worker = self._idle.popleft()
                self._running[self._pool.submit(worker, job, arguments)] = worker, job
            if job is None and self._idle and all(job is None for _, job in self._running.values()):
                return
            done, _ = wait(self._running, PROGRESS_SECONDS, FIRST_COMPLETED)
            for future in done:
                self._hear(future, *self._running.pop(future))
            if time.monotonic() - self._told > PROGRESS_SECONDS:
                self._told = time.monotonic()
                self._write_progress()

    def _hear(self, future: Future[Any], worker: int, job: Job | None) -> None:
        """Take what a worker gives back: its version as it starts, later records of its jobs."""
        try:
            value = future.result()
        except self._pool.died as error:
            self._bury(worker, job, error)
            return
        self._idle.append(worker)
        self._starts[worker] = 0
        if job is not None:
            self._lit[worker] += int(value.values.get("frames", 0))
            self._busy[worker] += int(1e3 * value.values.get("seconds", 0))
            self._take(job, value)
        elif value != self._version:
            raise RunError(f"worker {worker} is {value}, the driver is {self._version}; install one version on all")

    def _bury(self, worker: int, job: Job | None, error: BaseException) -> None:
        """Have a worker that has died started again, and its job given again."""
        log = self._folder / "log" / f"worker-{worker}.log"
        if job is None:
            self._starts[worker] += 1
            if self._starts[worker] >= STARTS:
                raise RunError(f"worker {worker} died {STARTS} times before it was ready; see {log}") from error
        else:
            key = job.key(self._jobs)
            self._deaths[key] += 1
            if self._deaths[key] < self._pool.tries:
                self._again.append(job)
            else:
                self._fail(job, f"its worker died {self._pool.tries} times, killed or crashed; see {log}")
        self._running[self._pool.start(worker)] = worker, None

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
            else:
                self._fail(job, outcome.reason)
            return
        self._manifest.add("done", key, **outcome.values)
        if job.kind == "survey":
            self._open_clip(job.clip)
        elif job.kind in LIGHTING:
            self._finished_now += 1
            self._settle(job.clip, failed=False)

    def _fail(self, job: Job, why: str) -> None:
        """Give a job up for good."""
        key = job.key(self._jobs)
        self._manifest.add("failed", key, reason=why)
        self._say(f"{key} failed: {why}")
        if job.kind in LIGHTING:
            self._settle(job.clip, failed=True)

    def _write_progress(self, *, ended: bool = False) -> None:
        """Leave word of where things stand for ``farm status``; a disk that is full loses it, no more."""
        at_work = {worker: job.key(self._jobs) for worker, job in self._running.values() if job is not None}
        rates = [1e3 * self._lit[n] / max(self._busy[n], 1) for n in range(len(self._pool.names))]
        told = {
            "program": "warp_ar",
            "time": time.time(),
            "ended": ended,
            "workers": [
                {"device": device, "job": at_work.get(n), "fps": round(rates[n], 2)}
                for n, device in enumerate(self._pool.names)
            ],
            "clips_surveyed": len(self._open),
            "jobs_known": self._known,
            "jobs_open": sum(self._open.values()),
            "seconds_left": self._seconds_left(),
        }
        try:
            write_whole(self._folder / PROGRESS, json.dumps(told).encode())
        except OSError as error:
            if not is_no_space(error):  # that a job or the manifest tells
                self._say(f"{self._folder / PROGRESS} cannot be written: {reason(error)}")

    def _seconds_left(self) -> float | None:
        """Return the time left by the pace of this driver, if other clips have as many jobs; None: too early."""
        clips = len(self._open)
        if not self._finished_now or not clips:
            return None
        left = sum(self._open.values()) + (len(self._jobs.clips) - clips) * self._known / clips
        return round((time.monotonic() - self._started) / self._finished_now * left, 1)
