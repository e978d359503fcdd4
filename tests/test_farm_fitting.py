"""How many workers share a GPU, by what one alone was seen to need."""

from __future__ import annotations

import concurrent.futures

import pytest

from tests.farm_rig import make_jobs, write_recording
from warp_ar.farm import fitting
from warp_ar.farm.fitting import Probe, fit_workers, jobs_at_once, probe_worker, workers_of_gpu
from warp_ar.farm.ray_pool import share_of_gpu

GIB = 1 << 30


@pytest.mark.parametrize(
    ("cores_kept_busy", "cores", "gpus", "bytes_used", "free", "expected"),
    [
        (3.2, 16, 1, 1 * GIB, 78 * GIB, 5),
        (3.2, 32, 2, 1 * GIB, 78 * GIB, 5),
        (3.2, 32, 1, 1 * GIB, 78 * GIB, 10),
        (3.2, 32, 1, 3 * GIB, 10 * GIB, 3),  # by its memory
        (3.2, 2, 1, 1 * GIB, 78 * GIB, 1),
        (3.2, 32, 1, 20 * GIB, 10 * GIB, 1),  # one there must be; what it lacks it says itself
        (0.1, 256, 1, 1 * GIB, 200 * GIB, fitting.MOST),
    ],
)
def test_as_many_as_cores_feed_and_memory_holds(cores_kept_busy, cores, gpus, bytes_used, free, expected):
    assert workers_of_gpu(Probe(40.0, cores_kept_busy, bytes_used, free), cores, gpus) == expected


def test_one_worker_is_tried_and_a_clip_that_cannot_be_is_passed_over(tmp_path):
    write_recording(tmp_path / "good.mp4", 4)
    (tmp_path / "bad.mp4").write_bytes(b"no video")
    clips = [{"scene": "torus", "path": "bad.mp4"}, {"scene": "torus", "path": "good.mp4"}]
    probe = probe_worker(make_jobs(tmp_path, clips), "cpu")
    assert probe is not None
    assert probe.frames_per_second > 0.0
    assert probe.cores > 0.0
    assert (probe.bytes, probe.free_bytes) == (0, 0), "there is no device's memory on CPU"
    assert probe_worker(make_jobs(tmp_path, clips[:1]), "cpu") is None


def test_memory_is_the_most_that_goes_while_a_worker_is_tried(monkeypatch):
    """A process beside it looks before the worker's begins, and until the trial is over."""
    free, done = [78 * GIB, 77 * GIB, 75 * GIB, 76 * GIB], []
    trial = concurrent.futures.Future()

    class Here:
        """An executor in this process."""

        def __init__(self, *_, **__):
            done.append("started")

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def submit(self, function, *arguments):
            if function is fitting._probe:
                function()
                return trial
            future = concurrent.futures.Future()
            future.set_result(function(*arguments))
            return future

    def answer(name, value):
        monkeypatch.setattr(fitting, name, lambda *_: (done.append(name), value())[1])

    def look():
        if len(free) == 1:
            trial.set_result((20.0, 2.6))
        return free.pop(0) if len(free) > 1 else free[0]

    answer("_free_bytes", look)
    answer("_probe", lambda: None)
    monkeypatch.setattr(fitting, "LOOK_SECONDS", 0.0)
    answer("_end_trial", lambda: None)
    monkeypatch.setattr(fitting.concurrent.futures, "ProcessPoolExecutor", Here)
    assert probe_worker(None, "cuda:0") == Probe(20.0, 2.6, 3 * GIB, 78 * GIB)
    assert [done[2], done[3], done[-1]] == ["_free_bytes", "_probe", "_end_trial"]
    assert done.count("_free_bytes") >= 4, "before the trial, and while it runs"


def test_no_more_workers_than_there_are_jobs(tmp_path, monkeypatch):
    write_recording(tmp_path / "good.mp4", 4)
    clips = [{"scene": "torus", "path": "good.mp4"}] * 3
    whole = make_jobs(tmp_path, clips)
    cut = make_jobs(tmp_path, clips, run={"quality": "low", "segment_frames": 2})
    assert jobs_at_once(whole) == 3
    assert jobs_at_once(cut) is None
    monkeypatch.setattr(fitting, "probe_worker", lambda jobs, device: Probe(40.0, 2.0, GIB, 78 * GIB))
    said = []
    two = ["cuda:0", "cuda:1"]
    assert fit_workers(cut, two, 16, said.append) == (8, 2 * fitting.MOST)
    assert fit_workers(whole, two, 16, said.append) == (3, 3)
    assert "4 workers for each of 2 GPUs" in said[0]
    # Six tenths of the memory hold nine; of a GPU that holds two at most, no more come.
    monkeypatch.setattr(fitting, "probe_worker", lambda jobs, device: Probe(40.0, 2.0, 5 * GIB, 78 * GIB))
    assert fit_workers(cut, two, 16, said.append) == (8, 18)
    monkeypatch.setattr(fitting, "probe_worker", lambda jobs, device: Probe(40.0, 2.0, 5 * GIB, 12 * GIB))
    assert fit_workers(cut, two, 16, said.append) == (4, 4)
    monkeypatch.setattr(fitting, "probe_worker", lambda jobs, device: pytest.fail("three clips keep three GPUs busy"))
    assert fit_workers(whole, [*two, "cuda:2"], 16, said.append) == (3, 3)


@pytest.mark.parametrize(("workers", "gpus"), [(1, 1), (2, 2), (1, 4), (3, 1), (7, 2), (16, 2), (48, 8)])
def test_all_actors_find_room_on_the_gpus(workers, gpus):
    share = share_of_gpu(workers, gpus)
    assert 0 < share <= 1
    assert gpus * int(1 / share + 1e-9) >= workers
