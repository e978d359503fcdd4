"""Estimates in a process of their own: the same as here, and a process that dies costs nothing but time."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from tests.recover_rig import solve_here
from warp_ar import Pipeline
from warp_ar.engine.switcher import let_go
from warp_ar.light import solving
from warp_ar.light.solving import SolvingProcess
from warp_ar.scene import load_scene
from warp_ar.sources.sources import open_source
from warp_ar.stages import recover
from warp_ar.stages.quality import PRESETS

pytestmark = pytest.mark.slow

solve = solving.update


class Doubler:
    """Solves by doubling what it is given and what it traces; counts how often."""

    def __init__(self, fails: bool = False) -> None:
        self.count, self.fails = 0, fails

    def update(self, cells, transfer, mirrored, observations, trace, camera):
        if self.fails:
            raise ValueError("no solution")
        self.count += 1
        return 2.0 * cells + trace(camera), self.count


def sides():
    return np.arange(4.0), np.ones((3, 200_000), np.float32), np.zeros(0), np.ones(2), np.array([1.0, 2, 3])


def trace(emitters):
    return float(emitters.sum())


def wait_until_ready(process):
    deadline = time.monotonic() + 60.0
    while not process.ready and time.monotonic() < deadline:
        time.sleep(0.01)
    assert process.ready


@pytest.fixture(scope="module")
def shared():
    with contextlib.closing(SolvingProcess()) as found:
        yield found


@pytest.fixture
def process(shared):
    """The process of this file, started again where a test ended it."""
    shared.prepare()
    wait_until_ready(shared)
    return shared


def test_process_solves_traces_by_the_caller_and_learns(process):
    solver = Doubler()
    for count in (1, 2, 3):
        solver, (values, said) = process.update(solver, sides(), trace)
        np.testing.assert_array_equal(values, 2.0 * np.arange(4.0) + 6.0)
        assert said == count == solver.count


def test_errors_come_back_and_the_process_goes_on(process):
    with pytest.raises(ValueError, match="no solution"):
        process.update(Doubler(fails=True), sides(), trace)
    solver = Doubler()
    assert process.update(solver, sides(), trace)[0] is not solver


def test_it_is_solved_for_here_until_the_process_is_ready():
    with contextlib.closing(SolvingProcess()) as process:
        assert not process.ready
        assert not process.starting
        process.prepare()
        assert process.starting
        solver = Doubler()
        assert process.update(solver, sides(), trace)[0] is solver  # nothing could be ready at once
        wait_until_ready(process)
        assert not process.starting
        assert process.update(solver, sides(), trace)[0] is not solver


def test_it_is_solved_for_here_when_the_process_dies():
    with contextlib.closing(SolvingProcess()) as process:
        process.prepare()
        wait_until_ready(process)
        process._process.kill()
        process._process.wait()
        solver = Doubler()
        found, (_, count) = process.update(solver, sides(), trace)
        assert found is solver
        assert count == 1
        assert not process.ready


def test_a_trace_that_fails_leaves_no_process_waiting(process):
    def failing(emitters):
        raise ArithmeticError("no such ray")

    with pytest.raises(ArithmeticError, match="no such ray"):
        process.update(Doubler(), sides(), failing)
    assert process.update(Doubler(), sides(), trace)[1][1] == 1


def test_two_estimates_take_turns(process):
    tracing, held = threading.Event(), threading.Event()

    def slow(emitters):
        tracing.set()
        assert held.wait(60.0)
        return trace(emitters)

    solvers = Doubler(), Doubler()
    with ThreadPoolExecutor(2) as others:
        first = others.submit(process.update, solvers[0], sides(), slow)
        assert tracing.wait(60.0)
        second = others.submit(process.update, solvers[1], sides(), trace)
        held.set()
        assert first.result(60.0)[0] is not solvers[0]
        assert second.result(60.0)[0] is not solvers[1]


def test_a_background_process_with_delayed_frames_gives_the_same_light(monkeypatch):
    """As on CUDA, where frames are bound by the interpreter's lock: what takes effect, and when, are the same."""
    scene = load_scene("desk")
    with open_source(scene.source.path) as source:
        images = [frame.image[::2, ::2].copy() for frame in itertools.islice(source, 12)]
    quality, shown, solved = PRESETS["low"].with_methods(recover="shading"), [], []
    ask = SolvingProcess._ask
    monkeypatch.setattr(SolvingProcess, "_ask", lambda *given: solved.append(1) or ask(*given))
    take = recover.Recover._solve
    for background in (False, True):
        with contextlib.closing(SolvingProcess()) as process:
            monkeypatch.setattr(solving, "PROCESS", process)
            if background:
                process.prepare()
                wait_until_ready(process)
            monkeypatch.setattr(
                recover.Recover,
                "_solve",
                lambda self, solver, _, camera, background=background: take(self, solver, background, camera),
            )
            with Pipeline(scene, device="cpu", quality=quality, size=(320, 240), outputs=("environment",)) as pipeline:
                light = [
                    pipeline(image, time_seconds=index / 24.0).environment.copy() for index, image in enumerate(images)
                ]
        shown.append(light)
        assert bool(solved) == background
    np.testing.assert_array_equal(shown[0], shown[1])


@pytest.mark.parametrize(("fault", "estimates"), [("singular", "synchronous"), ("not finite", "real_time")])
def test_an_estimate_that_fails_leaves_the_light_and_the_next_one_is_made(monkeypatch, fault, estimates):
    """Frames go on, the reason is in the report, and what failed is forgotten by the solver."""
    scene = load_scene("desk")
    with open_source(scene.source.path) as source:
        frames = list(itertools.islice(source, 3))
    failing, solvers = [False], []

    def faulty(solver, sides, trace):
        found = solve(solver, sides, trace)
        solvers.append(solver)
        if not failing[0]:
            return found
        if fault == "singular":
            raise np.linalg.LinAlgError("Singular matrix")
        return dataclasses.replace(found, recovered=np.full_like(found.recovered, np.nan))

    monkeypatch.setattr(solving, "update", faulty)
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


def test_an_estimate_outlives_the_pipeline_that_began_it(monkeypatch):
    """Another pipeline goes on with it: what it traces with goes no sooner than it is done."""
    scene = load_scene("desk")
    with open_source(scene.source.path) as source:
        frames = list(itertools.islice(source, 12))
    held = threading.Event()

    def slow(solver, sides, trace):
        assert held.wait(60.0)
        trace(np.array([[0.1, 0.1, 0.5, 1.0]], np.float32))
        return solver, solve(solver, sides, trace)

    monkeypatch.setattr(solving.SolvingProcess, "starting", False)
    monkeypatch.setattr(solving.SolvingProcess, "prepare", lambda process: None)
    monkeypatch.setattr(solving.PROCESS, "update", slow)
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
