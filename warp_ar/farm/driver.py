"""Assignment of jobs to workers until all are done, with retries and final failures.

The driver holds neither frames nor a list of jobs. It counts the open jobs of each clip, those neither done nor failed.
"""

from __future__ import annotations

import collections
import shutil
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from pathlib import Path

from warp_ar.errors import UsageError, say
from warp_ar.farm.dataset import in_kindred_order
from warp_ar.farm.jobs import Job, JobFile, Outcome, job_of_clip, jobs_of_clip
from warp_ar.farm.manifest import Manifest, RunError, bytes_of, changed_input, record_at
from warp_ar.farm.pools import Pool

TRIES = 2
"""Number of failed attempts after which a job has failed for good."""
LIGHTING = ("segment", "variation")
"""Kinds of jobs that light frames."""


class Driver:
    """Driver of a run, which has its jobs done by a pool of workers."""

    def __init__(self, jobs: JobFile, folder: Path, manifest: Manifest, pool: Pool) -> None:
        """Prepare the run; jobs that are done already are found when their turn comes.

        Args:
            jobs: The job file.
            folder: Folder of the run.
            manifest: Manifest of the run, open for writing.
            pool: Workers.
        """
        self._jobs, self._folder, self._manifest, self._pool = jobs, folder, manifest, pool
        self._again: collections.deque[Job] = collections.deque()
        self._open: dict[int, int] = {}
        """Number of jobs of each surveyed clip that are not done; a clip with a failed job is never joined."""
        self._coming = self._list_jobs()
        self._surveyed: collections.deque[Iterator[Job]] = collections.deque()
        self._joins: collections.deque[Job] = collections.deque()

    def _list_jobs(self) -> Iterator[Job]:
        """Yield the surveys that are still to be done; open the jobs of clips that are surveyed already.

        Raises:
            UsageError: A file that a survey has read has changed.
        """
        for clip in range(len(self._jobs.clips)):
            survey = Job("survey", clip)
            key = survey.key(self._jobs)
            if key in self._manifest.failed:
                continue
            surveyed = self._is_done(survey)
            if surveyed and (told := changed_input(self._manifest.done[key].get("inputs") or {})):
                raise UsageError(
                    f"{told}, which {self._folder} was begun with; put it back, or begin a new run in another folder"
                )
            if self._jobs.dataset is None and self._is_done(Job("join", clip)):
                continue
            if surveyed:
                self._open_clip(clip)
            else:
                yield survey

    def _is_done(self, job: Job) -> bool:
        """Return True if a job's outputs are complete.

        If the manifest says otherwise, it is corrected. Incomplete outputs are removed.
        """
        key, place = job.key(self._jobs), self._folder / job.place(self._jobs)
        line = self._manifest.done.get(key)
        record = line if job.kind in ("join", "index") else record_at(place, key)
        if record is not None and bytes_of(place) == record.get("bytes"):
            if line is not None:
                return True
            if job.kind != "survey" or isinstance(record.get("length"), int):
                # The worker had finished when the driver died: its outputs are kept.
                self._manifest.add("done", key, **{k: v for k, v in record.items() if k != "job"}, adopted=True)
                return True
        if line is not None:
            self._manifest.add("again", key, reason="its outputs have gone or are not whole")
        if record_at(place, key) is not None:
            shutil.rmtree(place)
        return False

    def _open_clip(self, clip: int) -> None:
        """Count a surveyed clip's jobs and add them to those to be done."""
        length = int(self._manifest.done[Job("survey", clip).key(self._jobs)]["length"])
        spec = self._jobs.clips[clip]
        if spec.end is not None and spec.end > length:
            say(f"clip {spec.name}: frames = [{spec.first}, {spec.end}], but it ends with frame {length - 1}")
        count = jobs_of_clip(self._jobs, clip, length)
        self._open[clip] = count
        self._surveyed.append(self._jobs_of(clip, count, length))

    def _jobs_of(self, clip: int, count: int, length: int) -> Iterator[Job]:
        dataset = self._jobs.dataset
        for number in range(count) if dataset is None else in_kindred_order(dataset, clip, count):
            job = job_of_clip(self._jobs, clip, number, length)
            if job.key(self._jobs) in self._manifest.failed:
                continue
            if self._is_done(job):
                self._settle(clip)
            else:
                yield job

    def _settle(self, clip: int) -> None:
        """Count one of a clip's jobs as done; after the last segment of a recording, plan to join them."""
        self._open[clip] -= 1
        join = Job("join", clip)
        if not self._open[clip] and self._jobs.dataset is None and join.key(self._jobs) not in self._manifest.failed:
            self._joins.append(join)

    def _next_job(self) -> Job | None:
        """Return the next job to submit; None if none can begin now."""
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
        """Run all jobs; return the reasons of failed jobs, by their keys.

        Raises:
            RunError: The run cannot go on: a full disk, workers of another version, workers that do not start.
            UsageError: A file has changed since it was read.
        """
        try:
            self._work()
            if self._jobs.dataset is not None and not self._is_done(Job("index")):
                self._joins.append(Job("index"))
                self._work()
        finally:
            self._pool.close()
        return dict(self._manifest.failed)

    def _work(self) -> None:
        """Submit jobs to idle workers and record their outcomes, until no job is left or running."""
        running: dict[Future[Outcome], tuple[int, Job]] = {}
        idle = collections.deque(range(self._pool.size))
        while True:
            while idle and (job := self._next_job()) is not None:
                worker = idle.popleft()
                running[self._pool.submit(worker, job)] = worker, job
            if not running:
                return
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                worker, job = running.pop(future)
                self._take(job, future.result())
                idle.append(worker)

    def _take(self, job: Job, outcome: Outcome) -> None:
        """Record the outcome of a job, and plan the jobs that follow from it: a retry, or the jobs of a surveyed clip.

        Raises:
            RunError: The disk is full.
        """
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
        if outcome.state != "done":
            self._manifest.add("failed", key, reason=outcome.reason)
            say(f"{key} failed: {outcome.reason}")
            return
        self._manifest.add("done", key, **outcome.values)
        if job.kind == "survey":
            self._open_clip(job.clip)
        elif job.kind in LIGHTING:
            self._settle(job.clip)
            if (index := Job("index").key(self._jobs)) in self._manifest.done:
                self._manifest.add("again", index, reason="variations were added")
