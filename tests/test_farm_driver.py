"""The driver against workers that do, fail and die as a test says."""

from __future__ import annotations

import json
from concurrent.futures import Future

import pytest

from tests.farm_rig import make_jobs
from warp_ar.errors import UsageError
from warp_ar.farm.driver import Driver
from warp_ar.farm.jobs import Job, Outcome, variations_of
from warp_ar.farm.manifest import RECORD, Manifest, RunError, describe_inputs

FRAMES = 10


class Workers:
    """A pool whose workers do as ``behave(job, times it was given before)`` says: an outcome, or None to do the job."""

    def __init__(self, jobs, folder, behave=lambda job, before: None, size=3):
        self.size = size
        self.jobs, self.folder, self.behave = jobs, folder, behave
        self.given: list[Job] = []
        self.busy, self.most = set(), 0
        self.closed = False

    def submit(self, worker, job):
        self.busy.add(worker)
        self.most = max(self.most, len(self.busy))
        said = self.behave(job, self.given.count(job))
        self.given.append(job)
        future: Future = Future()
        future.set_result(self.do(job) if said is None else said)
        return future

    def do(self, job):
        place = self.folder / job.place(self.jobs)
        values = {"length": FRAMES, "found": FRAMES} if job.kind == "survey" else {"frames": 2}
        if job.kind in ("join", "index"):
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_text("x")
        else:
            place.mkdir(parents=True)
            (place / "data").write_text("x")
            (place / RECORD).write_text(json.dumps({**values, "job": job.key(self.jobs), "bytes": 1}))
        return Outcome("done", {**values, "bytes": 1})

    def close(self):
        self.closed = True


def drive(jobs, folder, behave=lambda job, before: None, **options):
    folder.mkdir(exist_ok=True)
    pool = Workers(jobs, folder, behave, **options)
    try:
        failed = Driver(jobs, folder, Manifest(folder), pool).run()
    finally:
        assert pool.closed
    return pool, failed


@pytest.fixture
def jobs(tmp_path):
    return make_jobs(tmp_path, [{"name": "a"}, {"name": "b"}, {"name": "c"}], run={"segment_frames": 2})


def keys(jobs, given):
    return [job.key(jobs) for job in given]


def test_every_job_is_given_once_and_joined_last(jobs, tmp_path):
    pool, failed = drive(jobs, tmp_path / "run")
    given = keys(jobs, pool.given)
    assert len(given) == len(set(given)) == 3 * (1 + 5 + 1)
    for name in "abc":
        mine = [key for key in given if key.startswith(name)]
        assert (mine[0], mine[-1]) == (f"{name}/survey", f"{name}/join")
    assert not failed
    assert pool.most == 3, "all workers must have been busy at once"


def test_a_poisoned_job_fails_alone_after_two_tries(jobs, tmp_path, capsys):
    def behave(job, before):
        return Outcome("failed", reason="frame 3 cannot be decoded") if job == Job("segment", 1, 2, 4, 6) else None

    pool, failed = drive(jobs, tmp_path / "run", behave)
    given = keys(jobs, pool.given)
    assert given.count("b/segment-000002") == 2
    assert failed == {"b/segment-000002": "frame 3 cannot be decoded"}
    assert capsys.readouterr().err == "warp_ar: b/segment-000002 failed: frame 3 cannot be decoded\n"
    assert "b/join" not in given
    assert {"a/join", "c/join"} <= set(given)
    # It stays failed until it is asked for again.
    assert drive(jobs, tmp_path / "run")[0].given == []


def test_a_second_try_may_succeed(jobs, tmp_path):
    pool, failed = drive(
        jobs,
        tmp_path / "run",
        lambda job, before: Outcome("failed", reason="once") if job.kind == "join" and not before else None,
    )
    assert not failed
    assert keys(jobs, pool.given).count("a/join") == 2


def test_a_job_whose_workers_always_die_fails_alone(jobs, tmp_path):
    killed = Job("segment", 0, 1, 2, 4)
    lost = Outcome("lost", reason="its worker died")
    pool, failed = drive(jobs, tmp_path / "run", lambda job, _: lost if job == killed else None)
    assert pool.given.count(killed) == 1, "the pool has given it again"
    assert failed == {"a/segment-000001": "its worker died"}
    assert {"b/join", "c/join"} <= set(keys(jobs, pool.given))


def test_outputs_without_a_line_are_taken_over(jobs, tmp_path):
    """The worker had moved them to their place, and the driver died before it wrote the line."""
    run = tmp_path / "run"
    drive(jobs, run)
    lines = (run / "manifest.jsonl").read_text().splitlines()
    lost = [line for line in lines if any(f'"{key}"' in line for key in ("b/segment-000003", "b/join", "b/survey"))]
    (run / "manifest.jsonl").write_text("".join(f"{line}\n" for line in lines if line not in lost))
    (run / "b.mp4").unlink()
    pool, _ = drive(jobs, run)
    assert keys(jobs, pool.given) == ["b/join"]
    done = {line["job"]: line for line in map(json.loads, (run / "manifest.jsonl").read_text().splitlines())}
    assert len(done) == len((run / "manifest.jsonl").read_text().splitlines()) == 21
    assert done["b/survey"]["length"] == FRAMES, "a survey takes an hour, and is not done again"
    assert done["b/segment-000003"]["frames"] == 2


def test_a_full_disk_ends_the_run_and_says_how_to_go_on(jobs, tmp_path):
    with pytest.raises(RunError, match=r"the disk of .* is full \(no room\); free some space, then: farm resume"):
        drive(
            jobs, tmp_path / "run", lambda job, _: Outcome("full", reason="no room") if job.kind == "segment" else None
        )
    pool, failed = drive(jobs, tmp_path / "run")
    assert not failed
    assert len([key for key in keys(jobs, pool.given) if "segment" in key]) == 15


def test_an_output_that_is_not_whole_is_made_again(jobs, tmp_path):
    """Of a finished run a joined recording and a segment are cut to nothing; of another the survey is."""
    run = tmp_path / "run"
    drive(jobs, run)
    (run / "b.mp4").write_text("")
    (run / "parts/b/000003/data").write_text("")
    pool, failed = drive(jobs, run)
    assert keys(jobs, pool.given) == ["b/segment-000003", "b/join"]
    assert not failed
    assert (run / "b.mp4").read_text() == (run / "parts/b/000003/data").read_text() == "x"


def test_a_file_that_is_another_one_now_is_refused_by_its_name(jobs, tmp_path):
    clip = tmp_path / "a.mp4"
    clip.write_text("first")

    def behave(job, before):
        if job.kind != "survey":
            return None
        made = pools[-1].do(job)
        return Outcome("done", {**made.values, "inputs": describe_inputs([clip])})

    pools = []

    class Kept(Workers):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            pools.append(self)

    def run():
        return Driver(jobs, tmp_path, Manifest(tmp_path), Kept(jobs, tmp_path, behave)).run()

    assert run() == {}
    clip.write_text("first")  # another time, the same bytes
    assert run() == {}
    clip.write_text("other")
    with pytest.raises(UsageError, match=r"a\.mp4 is not the file, which .* was begun with; put it back"):
        run()
    clip.unlink()
    with pytest.raises(UsageError, match=r"a\.mp4 is gone"):
        run()


def test_frames_beyond_the_end_are_told(tmp_path, capsys):
    jobs = make_jobs(tmp_path, [{"name": "a", "frames": [0, 100000]}])
    _, failed = drive(jobs, tmp_path / "run")
    assert not failed
    assert capsys.readouterr().err == "warp_ar: clip a: frames = [0, 100000], but it ends with frame 9\n"


def test_variations_are_numbered_over_all_clips_and_indexed_once(tmp_path):
    section = {"variations": 4, "object": [{"shape": "sphere", "radius": 0.02}]}
    jobs = make_jobs(tmp_path, [{"name": "a"}, {"name": "b"}], dataset=section)
    for count in (1, 0):
        pool = Workers(jobs, tmp_path)
        manifest = Manifest(tmp_path)
        Driver(jobs, tmp_path, manifest, pool).run()
        assert pool.given.count(Job("index")) == count
    done = [job.place(jobs).as_posix() for job in variations_of(jobs) if job.key(jobs) in manifest.done]
    assert done == [f"dataset/train/{number:06d}" for number in range(8)]
