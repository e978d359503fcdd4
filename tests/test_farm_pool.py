"""Which cores and devices workers have, and how their ends are told."""

from __future__ import annotations

import multiprocessing
import os
import signal

import pytest

from tests.farm_rig import make_jobs
from warp_ar.errors import UsageError
from warp_ar.farm import pools
from warp_ar.farm.jobs import Context, Job
from warp_ar.farm.pools import ProcessPool, _connect, keeping_to, share_of_gpu

pytestmark = pytest.mark.slow

PATIENCE = 120.0
"""Seconds within which a worker starts."""


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="needs cores to keep to")
def test_cores_are_kept_to_for_a_while():
    before = os.sched_getaffinity(0)
    with keeping_to([min(before)]):
        assert os.sched_getaffinity(0) == {min(before)}
    assert os.sched_getaffinity(0) == before
    with keeping_to([]):
        assert os.sched_getaffinity(0) == before


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("somewhere", "--ray somewhere: no cluster answers"),
        ("127.0.0.1:99999", "--ray 127.0.0.1:99999: no cluster answers"),
        ("127.0.0.1:1", "--ray 127.0.0.1:1: no cluster answers"),
    ],
)
def test_an_address_of_no_cluster_is_told_at_once(address, words):
    with pytest.raises(UsageError) as caught:
        _connect(None, address)
    assert str(caught.value).startswith(words)


@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="needs the masks of processes as Linux tells them")
def test_workers_see_no_interrupt_and_another_takes_the_place_of_one_that_dies(tmp_path):
    """Ctrl-C reaches all processes of a terminal: one that imports would end with a traceback."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [])
    others = set(multiprocessing.active_children())
    pool = ProcessPool(Context(make_jobs(tmp_path, [{}]), tmp_path, "cpu"), ["cpu", "cpu"])
    job = Job("index")  # it fails at once: there is no data set
    try:
        assert [pool.submit(worker, job).result(PATIENCE).state for worker in range(2)] == ["failed"] * 2
        mine = set(multiprocessing.active_children()) - others
        assert len(mine) == 2
        for process in mine:
            with open(f"/proc/{process.pid}/status", encoding="ascii") as file:
                held = next(int(line.split()[1], 16) for line in file if line.startswith("SigBlk"))
            assert held >> (signal.SIGINT - 1) & 1
            assert not held >> (signal.SIGTERM - 1) & 1
            process.kill()
        assert pool.submit(0, job).result(PATIENCE).state == "failed"
    finally:
        pool.close()
    assert set(multiprocessing.active_children()) <= others
    assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == before


@pytest.mark.parametrize(("begins", "told"), [(True, "its worker died 5 times"), (False, "died 3 times before it was")])
def test_a_worker_that_always_dies_is_told(tmp_path, monkeypatch, begins, told):
    monkeypatch.setattr(pools, "_begin", _do_nothing if begins else _die)
    monkeypatch.setattr(pools, "_do", _die)
    pool = ProcessPool(Context(make_jobs(tmp_path, [{}]), tmp_path, "cpu"), ["cpu"])
    try:
        future = pool.submit(0, Job("survey"))
        found = future.result(PATIENCE).reason if begins else str(future.exception(PATIENCE))
        assert told in found
        assert str(tmp_path / "log/worker-0.log") in found
    finally:
        pool.close()


def _do_nothing(*_):
    pass


def _die(*_):
    os._exit(1)


@pytest.mark.parametrize(("workers", "gpus"), [(1, 1), (2, 2), (1, 4), (3, 1), (7, 2), (16, 2), (48, 8)])
def test_all_actors_find_room_on_the_gpus(workers, gpus):
    share = share_of_gpu(workers, gpus)
    assert 0 < share <= 1
    assert gpus * int(1 / share + 1e-9) >= workers
