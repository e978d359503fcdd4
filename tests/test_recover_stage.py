"""When light is recovered while frames flow: how often, how late, and what may stand."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import itertools
import time

import numpy as np
import pytest

from tests.recover_rig import scene, solve_here  # noqa: F401
from tests.twins import recover as reference
from warp_ar.engine.pipeline import Pipeline
from warp_ar.kernels.recovery import recover as kernels
from warp_ar.kernels.recovery.recover_cells import CELL_COLUMNS, CELL_ROWS, Cell
from warp_ar.light import recovery
from warp_ar.light import surfaces as light_surfaces
from warp_ar.light.config import CONFIG
from warp_ar.light.estimate import Estimate
from warp_ar.scene import Pose
from warp_ar.scene.description import SourceSpec
from warp_ar.stages.quality import PRESETS
from warp_ar.stages.recover import LATENCY, Recover


@pytest.fixture(autouse=True)
def solves_here(monkeypatch):
    """Estimates are counted here."""
    solve_here(monkeypatch)


@pytest.mark.parametrize(("fps", "expected"), [(12, [0, 1, 2, 5, 8, 11]), (30, [0, 1, 2, 8, 14]), (3, [0, 1, 2, 5, 8])])
def test_estimates_are_a_few_a_second(scene, monkeypatch, fps, expected):
    frames, ask = [], Recover._ask

    def counted(self, rows):
        frames.append(index)
        ask(self, rows)

    monkeypatch.setattr(Recover, "_ask", counted)
    rng = np.random.default_rng(5)
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))
    quality = PRESETS["low"].with_methods(recover="white_card")
    with Pipeline(scene, device="cpu", quality=quality, outputs=("environment",)) as pipeline:
        for index in range(expected[-1] + 1):
            image = rng.integers(0, 255, (240, 320, 3), np.uint8)
            pipeline(image, time_seconds=index / fps, pose=pose)
    assert frames == expected


def spied_estimates(monkeypatch, seconds=0.0):
    """Let a solver's n-th estimate, from 1 on, put n into every cell; it takes ``seconds``."""
    # By solver: that of a pipeline which is closed already may still be at its last one.
    numbers = collections.defaultdict(lambda: itertools.count(1))

    def update(self, cells, *_):
        time.sleep(seconds)
        return Estimate(np.full((*cells.shape, 3), next(numbers[self]), np.float32), (False,) * 3)

    monkeypatch.setattr(recovery.Recovery, "update", update)


def shown_estimates(scene, device, count, turns=1, estimates="delayed"):
    """Number of the estimate that each of ``count`` frames, 30 a second, was lit by; pipelines take turns."""
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))
    rng = np.random.default_rng(6)
    shown = []
    with contextlib.ExitStack() as stack:
        quality = PRESETS["low"].with_methods(recover="white_card")
        arguments = {"device": device, "quality": quality, "outputs": ("environment",), "estimates": estimates}
        pipelines = [stack.enter_context(Pipeline(scene, **arguments)) for _ in range(turns)]
        for index in range(count):
            now, before = pipelines[index % turns], pipelines[(index - 1) % turns]
            if index and turns > 1:
                now.continue_from(before)
            now(rng.integers(0, 255, (240, 320, 3), np.uint8), time_seconds=index / 30, pose=pose)
            shown.append(int(now.arrays["recover_recovered"].numpy()[0, 0, 0]))
    return shown


@pytest.mark.parametrize("turns", [1, 2])
def test_estimates_take_effect_a_fixed_time_later(scene, device, monkeypatch, turns):
    """The first frames wait for theirs; however long one takes, and whoever has the frames meanwhile."""
    spied_estimates(monkeypatch, 0.05)
    # Begun in frames 0, 1, 2, 8 and 14.
    expected = [1, 2, *[3] * (8 + round(30 * LATENCY) - 2), *[4] * 6, 5, 5]
    assert shown_estimates(scene, device, len(expected), turns) == expected


def what_is_seen(surroundings=0.4, table=0.3):
    """Cells and observations of an environment that does not clip."""
    cells = np.zeros((CELL_ROWS, CELL_COLUMNS), np.dtype(Cell.numpy_dtype()))
    cells["solid_angle"], cells["radiance"] = (
        reference.cell_directions(CELL_ROWS, CELL_COLUMNS)[1].reshape(CELL_ROWS, CELL_COLUMNS),
        surroundings,
    )
    observations = np.zeros(40, np.dtype(kernels.Observation.numpy_dtype()))
    observations["visible"], observations["radiance"] = 1.0, table
    return cells, observations


def settled_solver(scene):
    """A solver that has made as many estimates as it takes."""
    solver = recovery.Recovery(light_surfaces.find_surfaces(scene), 0.85, (-0.12, 0.03, 0.035))
    solver._frames = CONFIG.solver.settled
    return solver


@pytest.mark.parametrize(
    "changed", [{"surroundings": 0.4 * 1.4}, {"table": 0.3 * 0.7}, {"surroundings": 0.25, "table": 0.2}]
)
def test_a_switched_emitter_is_solved_for_at_once(scene, changed):
    solver = settled_solver(scene)
    assert not solver.rests(*what_is_seen())
    assert not solver.rests(*what_is_seen(**changed))


@pytest.mark.parametrize("changed", [{"surroundings": 0.4 * 1.05}, {"surroundings": 0.35, "table": 0.25}])
def test_other_light_waits_once_at_most(scene, changed):
    solver = settled_solver(scene)
    assert not solver.rests(*what_is_seen())
    assert [solver.rests(*what_is_seen(**changed)) for _ in range(2)] == [True, False]
    solver = settled_solver(scene)
    assert [solver.rests(*what_is_seen()) for _ in range(2)] == [False, True]
    assert not solver.rests(*what_is_seen(**changed))


def test_a_failing_estimate_is_reported_with_its_frame(scene, monkeypatch):
    def update(*_):
        raise ArithmeticError("no such light")

    monkeypatch.setattr(recovery.Recovery, "update", update)
    with pytest.raises(ArithmeticError, match="no such light"):
        shown_estimates(scene, "cpu", 1)


@pytest.mark.parametrize("metering", ["fixed", "automatic"])
def test_light_between_estimates_follows_the_card(scene, device, monkeypatch, metering):
    """Until the next estimate; a camera that meters by itself changes the card for reasons of its own."""

    def update(self, cells, *_):
        return Estimate(np.ones((*cells.shape, 3), np.float32), (False,) * 3, card_share=(0.5, 0.5, 0.25))

    monkeypatch.setattr(recovery.Recovery, "update", update)
    quality = PRESETS["low"].with_methods(recover="white_card")
    source = SourceSpec(camera=0, metering=metering)
    pose = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.6]))
    levels, added = [], []
    with Pipeline(
        dataclasses.replace(scene, source=source), device=device, quality=quality, outputs=("environment",)
    ) as pipeline:
        for index, shown in enumerate([100, 100, 100, 80, 60, 60, 100]):
            image = np.full((240, 320, 3), 100, np.uint8)
            image[80:160, 120:200] = shown
            image[:40] = 255
            pipeline(image, time_seconds=index / 30, pose=pose)
            levels.append(pipeline.arrays["recover_level"].numpy().copy())
            found = pipeline.arrays["recover_recovered"].numpy()
            assert pipeline.arrays["recover_levelled"].numpy() == pytest.approx(found * levels[-1])
            captured, shown = (pipeline.arrays[name].numpy() for name in ("filled_radiance", "environment"))
            added.append((shown - captured).sum(axis=(0, 1)))
    assert np.array(added) == pytest.approx(added[0] * np.array(levels), rel=1e-3)
    # 1 - (1 - ratio) / share
    expected = np.array([[1, 1, 1]] * 3 + [[0.6, 0.6, 0.2]] + [[0.2, 0.2, 0.0]] * 2 + [[1, 1, 1]])
    assert np.array(levels) == pytest.approx(expected if metering == "fixed" else 1.0, abs=1e-4)


def test_an_estimate_that_is_waited_for_lights_its_own_frame(scene, device, monkeypatch):
    spied_estimates(monkeypatch, 0.05)
    expected = [1, 2, *[3] * 6, *[4] * 6, 5, 5]
    assert shown_estimates(scene, device, len(expected), estimates="synchronous") == expected
