"""How many workers come while a run goes on: against machines that a test makes up, and by the driver."""

from __future__ import annotations

import itertools
import os

import pytest

from tests.farm_rig import make_jobs
from tests.test_farm_driver import VERSION, Workers
from warp_ar.farm import growth as subject
from warp_ar.farm.driver import Driver
from warp_ar.farm.growth import SECONDS, WARM, Growth, idle_seconds
from warp_ar.farm.manifest import Manifest
from warp_ar.farm.pool import Event


class Machine:
    """Cores that ``n`` workers keep busy, and frames that they light, as a test says."""

    def __init__(self, workers, most, busy, rate, *, cores, gpus=1):
        self.workers, self.busy, self.rate, self.cores = workers, busy, rate, cores
        self.seconds, self.idled, self.said, self.added = 0.0, 0.0, [], []
        devices = [f"cuda:{number}" for number in range(gpus)]
        self.growth = Growth(
            devices,
            most,
            self.added.extend,
            self.said.append,
            cores=cores,
            idle=lambda: self.idled,
            clock=lambda: self.seconds,
        )
        self.lit = 0.0

    def run(self, seconds):
        """Let time pass; returns how many workers there were after each change."""
        counts = [self.workers]
        for _ in range(int(seconds)):
            self.seconds += 1.0
            self.idled += self.cores - min(self.busy(self.workers), self.cores)
            self.lit += self.rate(self.workers)
            # Each has lit enough from the beginning, and all of them what they have lit since.
            frames = [WARM] * (self.workers - 1) + [WARM + int(self.lit)]
            more = self.growth.look(frames)
            if more:
                self.workers += more
                counts.append(self.workers)
        return counts


def bounded(each, cores, frames_of_a_core):
    """Workers that keep ``each`` cores busy until there are none left, and light in proportion."""
    return (lambda n: min(n * each, cores)), (lambda n: frames_of_a_core * min(n * each, cores))


@pytest.mark.parametrize(
    ("begin", "each", "cores", "gpus", "most", "end"),
    [
        (6, 1.2, 16, 1, 32, 12),  # 16 cores and a GPU: what a worker alone keeps busy told 6
        (12, 1.2, 32, 2, 64, 24),
        (6, 2.6, 16, 1, 32, 6),  # as many as were told keep all cores busy
        (1, 2.0, 2, 1, 32, 1),
        (6, 1.2, 16, 1, 9, 9),  # by the GPU's memory
        (4, 1.2, 32, 2, 9, 8),  # as many on each GPU
        (1, 0.5, 64, 1, 32, 32),
    ],
)
def test_workers_come_until_the_cores_are_busy(begin, each, cores, gpus, most, end):
    machine = Machine(begin, most, *bounded(each, cores, 10.0), cores=cores, gpus=gpus)
    counts = machine.run(40 * SECONDS)
    assert counts == sorted(counts), "where each brings frames, none goes"
    assert counts[-1] == end
    assert len(machine.added) == end - begin
    assert len(machine.said) == len(counts) - 1
    assert all(machine.added.count(f"cuda:{gpu}") == (end - begin) // gpus for gpu in range(gpus))
    assert all(after <= 2 * before for before, after in itertools.pairwise(counts))


def test_no_more_come_once_the_last_ones_brought_nothing():
    """The GPU, the disk or what a container may use bounds them: cores stand idle for ever."""
    machine = Machine(4, 32, lambda n: 6.0, lambda n: 100.0, cores=16)
    assert machine.run(40 * SECONDS) == [4, 8]


def test_those_that_bring_fewer_frames_get_no_more_jobs():
    machine = Machine(4, 32, lambda n: 6.0, lambda n: 100.0 if n <= 4 else 80.0, cores=16)
    assert machine.run(40 * SECONDS) == [4, 8, 4]
    assert "those go on" in machine.said[-1]


def test_workers_that_load_or_survey_are_not_looked_at():
    machine = Machine(4, 32, *bounded(1.0, 16, 10.0), cores=16)
    for frames in (None, [WARM] * 3 + [WARM - 1]):
        for _ in range(3):
            machine.seconds += SECONDS
            machine.idled += 12 * SECONDS
            assert machine.growth.look(frames) == 0
    # What one of them did meanwhile does not count: the time begins anew.
    assert machine.growth.look([WARM] * 4) == 0
    machine.seconds += 0.9 * SECONDS
    assert machine.growth.look([WARM] * 4) == 0
    assert machine.growth.look(None) == 0
    machine.seconds += 0.9 * SECONDS
    assert machine.growth.look([WARM] * 4) == 0


def test_where_the_system_tells_nothing_none_come():
    growth = Growth(
        ["cuda:0"], 8, pytest.fail, pytest.fail, cores=8, idle=lambda: None, clock=iter(range(999)).__next__
    )
    assert [growth.look([WARM]) for _ in range(50)] == [0] * 50


@pytest.mark.skipif(not os.path.exists("/proc/stat"), reason="needs the cores' times as Linux tells them")
def test_idle_time_is_that_of_the_own_cores(monkeypatch):
    both = idle_seconds()
    assert both > 0.0
    own = min(os.sched_getaffinity(0))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {own})
    assert 0.0 < idle_seconds() <= both + 1.0
    monkeypatch.setattr(subject, "Path", lambda name: subject.os)  # nothing that can be read
    assert idle_seconds() is None


class GrowingWorkers(Workers):
    """Workers to which others come."""

    def add(self, devices):
        first, self.size = self.size, self.size + len(devices)
        self.names += devices
        self.events += [Event(worker, "ready", VERSION) for worker in range(first, self.size)]


class Planned:
    """A growth that answers as it is told, and keeps what it was asked."""

    def __init__(self, pool, answers):
        self.pool, self.answers, self.asked = pool, answers, []

    def look(self, frames):
        self.asked.append(frames)
        more = self.answers.pop(0) if self.answers and frames is not None else 0
        if more > 0:
            self.pool.add(["cuda:0"] * more)
        return more


def test_the_driver_gives_jobs_to_those_that_came_and_none_to_those_that_rest(tmp_path):
    jobs = make_jobs(tmp_path, [{"name": "a"}], run={"segment_frames": 1})
    folder = tmp_path / "run"
    folder.mkdir()
    manifest = Manifest(folder, write=True)
    given: list[tuple[int, str]] = []
    length = 40

    class Noting(GrowingWorkers):
        def give(self, worker, job, arguments):
            given.append((worker, job.kind))
            super().give(worker, job, arguments)

        def do(self, job):
            outcome = super().do(job)
            return outcome if job.kind != "survey" else type(outcome)("done", {**outcome.values, "length": length})

        def wait(self, seconds):
            # One at a time: the others go on with their jobs.
            events, self.events = self.events[:1], self.events[1:]
            return events

    pool = Noting(jobs, folder, size=2)
    growth = Planned(pool, [2, 0, 0, 0, -2])
    try:
        summary = Driver(jobs, folder, manifest, pool, VERSION, pytest.fail, growth).run()
    finally:
        manifest.close()
    segments = [worker for worker, kind in given if kind == "segment"]
    assert not summary.failed
    assert len(segments) == length
    assert {2, 3} <= set(segments)
    assert not {2, 3} & set(segments[-10:]), "those that rest get no more jobs"
    asked = [frames for frames in growth.asked if frames is not None]
    assert {len(frames) for frames in asked} == {2, 4}
    assert None in growth.asked, "a survey, a beginning and an end are not looked at"
    assert max(map(max, asked)) > min(map(min, asked))


def test_workers_are_looked_at_while_one_joins(tmp_path):
    """In a run of short clips there is a join every few seconds."""
    jobs = make_jobs(tmp_path, [{"name": name} for name in "abcd"], run={"segment_frames": 1})
    folder = tmp_path / "run"
    folder.mkdir()
    manifest = Manifest(folder, write=True)
    doing: dict[int, str] = {}

    class Noting(GrowingWorkers):
        def give(self, worker, job, arguments):
            doing[worker] = job.kind
            super().give(worker, job, arguments)

        def wait(self, seconds):
            events, self.events = self.events[:1], self.events[1:]
            return events

    class Looking(Planned):
        def look(self, frames):
            self.asked.append((set(doing.values()), frames))
            return 0

    growth = Looking(None, [])
    try:
        Driver(jobs, folder, manifest, Noting(jobs, folder, size=2), VERSION, pytest.fail, growth).run()
    finally:
        manifest.close()
    looked_at = [kinds for kinds, frames in growth.asked if frames is not None]
    assert {"segment", "join"} in looked_at
    assert not any("survey" in kinds for kinds in looked_at)
