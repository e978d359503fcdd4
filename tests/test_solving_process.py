"""Estimates in a process of their own: the same as here, and a process that dies costs nothing but time."""

from __future__ import annotations

import dataclasses
import io
import itertools
import pickle
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from tests.recover_rig import solve_here
from warp_ar import Pipeline
from warp_ar.engine.switcher import let_go
from warp_ar.light import solving_process
from warp_ar.light.solver import ONE_BLAS_THREAD
from warp_ar.light.solving_process import SolvingPool, SolvingProcess, read_message, solve_by, write_message
from warp_ar.scene import load_scene
from warp_ar.sources.sources import open_source
from warp_ar.stages import recover


class Doubler:
    """Solves by doubling what it is given and what it traces; counts how often."""

    def __init__(self, fails: bool = False) -> None:
        self.count, self.fails = 0, fails

    def rests(self, cells, observations) -> bool:
        return bool(observations.sum() == 0.0)

    def update(self, cells, transfer, mirrored, observations, trace, camera):
        if self.fails:
            raise ValueError("no solution")
        self.count += 1
        return 2.0 * cells + trace(camera), self.count


class Noting(Doubler):
    """Rests in a light that it has been asked about."""

    seen = None

    def rests(self, cells, observations) -> bool:
        before, self.seen = self.seen, float(observations.sum())
        return before == self.seen


def sides(observed: float = 1.0):
    return np.arange(4.0), np.ones((3, 200_000), np.float32), np.zeros(0), np.full(2, observed), np.array([1.0, 2, 3])


def trace(emitters):
    return float(emitters.sum())


@pytest.fixture
def process():
    found = SolvingProcess()
    deadline = time.monotonic() + 60.0
    while not found.ready and time.monotonic() < deadline:
        time.sleep(0.05)
    assert found.ready
    yield found
    found.close()


def test_messages_hold_values_and_arrays():
    values = {"a": np.arange(12.0).reshape(3, 4), "b": ("text", None), "c": np.zeros((0, 3))}
    stream = io.BytesIO()
    write_message(stream, values)
    stream.seek(0)
    found = read_message(stream)
    np.testing.assert_array_equal(found["a"], values["a"])
    assert found["b"] == values["b"]
    assert found["c"].shape == (0, 3)
    assert found["a"].flags.writeable
    with pytest.raises(EOFError):
        read_message(stream)


def test_process_solves_traces_by_the_caller_and_learns(process):
    solver = Doubler()
    for count in (1, 2, 3):
        solver, (values, said) = process.solve(solver, sides(), trace)
        np.testing.assert_array_equal(values, 2.0 * np.arange(4.0) + 6.0)
        assert said == count == solver.count


def test_errors_come_back_and_the_process_goes_on(process):
    with pytest.raises(ValueError, match="no solution"):
        process.solve(Doubler(fails=True), sides(), trace)
    assert process.solve(Doubler(), sides(), trace)[1][1] == 1


def test_pool_solves_here_until_a_process_is_ready_and_when_it_dies():
    pool = SolvingPool(1)
    try:
        solver = Doubler()
        solved, _ = pool.solve(solver, sides(), trace)
        assert solved is solver  # nothing could be ready at once
        deadline = time.monotonic() + 60.0
        while solved is solver and time.monotonic() < deadline:
            solved, _ = pool.solve(solver, sides(), trace)
        assert solved is not solver
        pool._all[0]._process.kill()
        pool._all[0]._process.wait()
        again, (_, count) = pool.solve(solved, sides(), trace)
        assert again is solved
        assert count == solved.count
        assert not pool._all
    finally:
        pool.close()
    assert pool.solve(Doubler(), sides(), trace)[1][1] == 1


def test_nothing_goes_to_a_process_while_the_last_solution_holds(monkeypatch):
    pool = SolvingPool(1)
    try:
        pool.prepare()
        wait_until_ready(pool)
        asked = []
        monkeypatch.setattr(pool._all[0], "solve", lambda solver, *sides: asked.append(sides) or (solver, "solved"))
        solver = Doubler()
        assert pool.solve(solver, sides(0.0), trace) == (solver, None)
        assert not asked
        assert pool.solve(solver, sides(), trace) == (solver, "solved")
        assert len(asked) == 1
    finally:
        pool.close()


def test_light_is_noted_once_where_a_process_dies():
    """A solver that is asked twice about one light would find that it stands still, and nothing would be solved for."""
    pool = SolvingPool(1)
    try:
        pool.prepare()
        wait_until_ready(pool)
        pool._all[0]._process.kill()
        pool._all[0]._process.wait()
        assert pool.solve(Noting(), sides(), trace)[1][1] == 1
    finally:
        pool.close()


def test_a_pool_starts_a_process_before_it_is_asked():
    pool = SolvingPool(1)
    try:
        assert not pool.ready
        pool.prepare()
        wait_until_ready(pool)
        solver = Doubler()
        assert pool.solve(solver, sides(), trace)[0] is not solver
    finally:
        pool.close()


def test_a_pool_says_whether_a_process_is_about_to_be_ready():
    pool = SolvingPool(1)
    try:
        assert not pool.starting
        pool.prepare()
        assert pool.starting
        wait_until_ready(pool)
        assert not pool.starting
    finally:
        pool.close()
    assert not pool.starting


def test_a_process_that_ends_as_it_starts_is_waited_for_no_longer(monkeypatch):
    start = solving_process.start_process
    monkeypatch.setattr(solving_process, "start_process", lambda name: start("tests.no_such_module"))
    pool = SolvingPool(1)
    try:
        pool.prepare()
        pool._all[0]._greeting.join(60.0)
        assert not pool.starting
        assert not pool.ready
        assert pool.solve(Doubler(), sides(), trace)[1][1] == 1
    finally:
        pool.close()


def test_who_finds_all_at_work_waits_for_one_and_for_none_that_is_just_started(process):
    """A process takes seconds to be ready, and an estimate of this one holds up the frames."""
    tracing, held = threading.Event(), threading.Event()

    def slow(emitters):
        tracing.set()
        assert held.wait(60.0)
        return trace(emitters)

    pool = SolvingPool(2)
    pool._all, pool._idle = [process], [process]
    solvers = Doubler(), Doubler()
    with ThreadPoolExecutor(2) as others:
        first = others.submit(pool.solve, solvers[0], sides(), slow)
        assert tracing.wait(60.0)
        second = others.submit(pool.solve, solvers[1], sides(), trace)
        deadline = time.monotonic() + 60.0
        while not pool._changed._waiters and time.monotonic() < deadline:
            time.sleep(0.01)
        assert len(pool._all) == 2
        held.set()
        assert first.result(60.0)[0] is not solvers[0]
        assert second.result(60.0)[0] is not solvers[1]
    pool._all.remove(process)
    pool._idle.remove(process)
    pool.close()


def wait_until_ready(pool):
    deadline = time.monotonic() + 60.0
    while not pool.ready and time.monotonic() < deadline:
        time.sleep(0.01)
    assert pool.ready


def test_all_who_wait_for_a_process_that_dies_solve_for_themselves(monkeypatch):
    """Three estimates, one process: two wait for it, and neither is left waiting when it has gone."""
    dies = threading.Event()

    class Dying:
        ready = True

        def solve(self, *_):
            assert dies.wait(60.0)
            raise EOFError

        def close(self):
            pass

    monkeypatch.setattr(solving_process, "SolvingProcess", Dying)
    pool = SolvingPool(1)
    solved = []
    threads = [
        threading.Thread(target=lambda: solved.append(pool.solve(Doubler(), sides(), trace)), daemon=True)
        for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    deadline = time.monotonic() + 60.0
    while len(pool._changed._waiters) < 2 and time.monotonic() < deadline:
        time.sleep(0.01)
    dies.set()
    for thread in threads:
        thread.join(30.0)
    assert len(solved) == 3, "one waits for ever"


def test_a_pool_that_is_closed_leaves_who_solves_to_himself(process):
    """In the midst of a trace: the answer has nowhere to go, and the estimate is made here."""
    pool = SolvingPool(1)
    pool._all, pool._idle = [process], [process]
    tracing, closed = threading.Event(), threading.Event()

    def held(emitters):
        tracing.set()
        assert closed.wait(60.0)
        return trace(emitters)

    solver = Doubler()
    with ThreadPoolExecutor(1) as other:
        solving = other.submit(pool.solve, solver, sides(), held)
        assert tracing.wait(60.0)
        pool.close()
        closed.set()
        here, (_, count) = solving.result(60.0)
    assert here is solver
    assert count == 1
    assert process._process.stdin.closed
    assert process._process.stdout.closed


@pytest.mark.parametrize("fault", ["singular", "not finite"])
@pytest.mark.parametrize("estimates", ["synchronous", "real_time"])
def test_an_estimate_that_fails_leaves_the_light_and_the_next_one_is_made(monkeypatch, fault, estimates):
    """Frames go on, the reason is in the report, and what failed is forgotten by the solver."""
    scene = load_scene("desk")
    with open_source(scene.source.path) as source:
        frames = list(itertools.islice(source, 3))
    failing, solvers = [False], []

    def faulty(solver, sides, trace):
        found = solve_by(solver, sides, trace)
        solvers.append(solver)
        if not failing[0]:
            return found
        if fault == "singular":
            raise np.linalg.LinAlgError("Singular matrix")
        assert found is not None
        return dataclasses.replace(found, recovered=np.full_like(found.recovered, np.nan))

    monkeypatch.setattr(recover, "solve_by", faulty)
    solve_here(monkeypatch)
    with Pipeline(scene, device="cpu", quality="low", estimates=estimates) as pipeline:
        status = pipeline.arrays["recover_status"]
        pipeline(frames[0].image, time_seconds=frames[0].time)
        recovered = pipeline.arrays["recover_recovered"].numpy().copy()
        assert recovered.any()
        failing[0] = True
        pipeline(frames[1].image, time_seconds=frames[1].time)
        assert "ingular" in status()["failed"] or "not finite" in status()["failed"]
        assert status()["factor"] > 0.0, "the last estimate holds"
        np.testing.assert_array_equal(pipeline.arrays["recover_recovered"].numpy(), recovered)
        failing[0] = False
        pipeline(frames[2].image, time_seconds=frames[2].time)
        assert "failed" not in status()
        assert np.isfinite(pipeline.arrays["environment"].numpy()).all()
    assert solvers[2] is not solvers[1]


def test_estimates_of_a_process_are_those_made_here(process, monkeypatch):
    """Of `desk`: the same equations, solved in both, to the bit; and frames that do not wait show them in the end."""
    given = []

    def noting(solver, sides, trace):
        kept = pickle.dumps((solver, sides), 5)
        traced = []

        def listening(emitters):
            traced.append((emitters.copy(), trace(emitters)))
            return traced[-1][1]

        found = solve_by(solver, sides, listening)
        given.append((kept, traced, found))
        return found

    monkeypatch.setattr(recover, "solve_by", noting)
    scene = load_scene("desk")
    with open_source(scene.source.path) as source, Pipeline(scene, device="cpu") as pipeline:
        for frame in itertools.islice(source, 2):
            pipeline(frame.image, time_seconds=frame.time)
    assert len(given) == 2
    for kept, traced, found in given:
        answers = iter(traced)

        def replay(emitters, answers=answers):
            asked, answer = next(answers)
            np.testing.assert_array_equal(emitters, asked)
            return answer

        _, solved = process.solve(*pickle.loads(kept), replay)
        np.testing.assert_array_equal(solved.recovered, found.recovered)
        assert solved.method == found.method
        assert solved.factor == found.factor
        assert len(solved.emitters) == len(found.emitters)


def test_frames_in_real_time_begin_alike_and_take_what_is_there(monkeypatch):
    """The first frames wait in both ways; then none waits for a solution that never comes, and none is lost."""
    scene = load_scene("desk")
    with open_source(scene.source.path) as source:
        frames = list(itertools.islice(source, 12))
    held = threading.Event()

    def slow(solver, sides, trace):
        assert held.wait(60.0)
        return solver, solve_by(solver, sides, trace)

    monkeypatch.setattr(solving_process.SolvingPool, "starting", False)
    monkeypatch.setattr(recover.POOL, "solve", slow)
    monkeypatch.setattr(recover, "REST", -1.0)  # however long the first ones took
    with (
        Pipeline(scene, device="cpu") as usual,
        Pipeline(scene, device="cpu", estimates="real_time") as live,
    ):
        for frame in frames[: recover.EVERY_FRAME]:
            expected = usual(frame.image, time_seconds=frame.time).image
            np.testing.assert_array_equal(live(frame.image, time_seconds=frame.time).image, expected)
        stage = live.scheduler.stage("recover")
        for frame in frames[recover.EVERY_FRAME :]:
            live(frame.image, time_seconds=frame.time)  # the estimate is held: this returns all the same
        assert stage._progress.pending is not None
        pending = stage._progress.pending
        held.set()
        pending.result(60.0)
        live(frames[-1].image, time_seconds=frames[-1].time + 0.05)
        assert stage._progress.pending is None or stage._progress.pending is not pending
        assert stage._progress.took > 0.0


def test_a_live_camera_begins_no_estimate_while_a_process_is_about_to_be_ready(monkeypatch):
    """This process would solve it, and hold the frames up; the frame after it is ready begins one."""
    scene = load_scene("desk")
    with open_source(scene.source.path) as source:
        frames = list(itertools.islice(source, 14))
    begun, starting = [], [True]
    ask = recover.Recover._ask
    monkeypatch.setattr(recover.Recover, "_ask", lambda self, rows: begun.append(index) or ask(self, rows))
    monkeypatch.setattr(solving_process.SolvingPool, "starting", property(lambda pool: starting[0]))
    monkeypatch.setattr(recover.POOL, "solve", lambda solver, given, trace: (solver, solve_by(solver, given, trace)))
    monkeypatch.setattr(recover, "REST", -1.0)
    with Pipeline(scene, device="cpu", quality="low", estimates="real_time") as live:
        for index, frame in enumerate(frames):
            starting[0] = index < 12
            live(frame.image, time_seconds=frame.time)
    assert begun == [0, 1, 2, 12]


def test_an_estimate_outlives_the_pipeline_that_began_it(monkeypatch):
    """Another pipeline goes on with it: what it traces with goes no sooner than it is done."""
    scene = load_scene("desk")
    with open_source(scene.source.path) as source:
        frames = list(itertools.islice(source, 12))
    held = threading.Event()

    def slow(solver, sides, trace):
        assert held.wait(60.0)
        trace(np.array([[0.1, 0.1, 0.5, 1.0]], np.float32))
        return solver, solve_by(solver, sides, trace)

    monkeypatch.setattr(solving_process.SolvingPool, "starting", False)
    monkeypatch.setattr(recover.POOL, "solve", slow)
    monkeypatch.setattr(recover, "REST", -1.0)  # however long the first ones took
    before = Pipeline(scene, device="cpu", quality="low", estimates="real_time")
    for frame in frames:
        before(frame.image, time_seconds=frame.time)
    pending = before.scheduler.stage("recover")._progress.pending
    assert pending is not None
    with Pipeline(scene, device="cpu", quality="low", estimates="real_time") as after:
        after.continue_from(before)
        assert after.scheduler.stage("recover")._progress.pending is pending
        going = threading.Thread(target=let_go, args=(before,))
        going.start()
        going.join(0.5)
        held.set()
        going.join(60.0)
        assert not going.is_alive()
        assert pending.exception(60.0) is None
        after(frames[-1].image, time_seconds=frames[-1].time + 0.2)
        assert after.scheduler.stage("recover")._progress.pending is not pending


def test_every_thread_solves_with_one_thread_of_blas():
    """Whichever thread asks first, whichever leaves last: sums in another order would be another picture."""
    before = [entry["num_threads"] for entry in threadpool_info() if entry["user_api"] == "blas"]
    seen: list[list[int]] = []
    barrier = threading.Barrier(3)

    def solve(alone: bool) -> None:
        with ONE_BLAS_THREAD:
            if not alone:
                barrier.wait(30.0)
            seen.append([entry["num_threads"] for entry in threadpool_info() if entry["user_api"] == "blas"])

    for alone in (True, True, False):
        threads = [threading.Thread(target=solve, args=(alone,)) for _ in range(1 if alone else 3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60.0)
    assert len(seen) == 5
    assert all(entry == [1] * len(before) for entry in seen)
    assert [entry["num_threads"] for entry in threadpool_info() if entry["user_api"] == "blas"] == before


def test_a_process_that_is_let_go_closes_what_it_has_opened():
    command = [sys.executable, "-W", "always::ResourceWarning", "-c"]
    command.append("from warp_ar.light.solving_process import serve; serve()")
    streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "bufsize": 0}
    with subprocess.Popen(command, **streams) as process:
        assert read_message(process.stdout) == "ready"
        process.stdin.close()
        assert process.wait(60.0) == 0
        assert process.stderr.read() == b""
