"""The budget's controller against a pretended machine; costs kept and measured; pipelines changed without a trace."""

from __future__ import annotations

import itertools
import json
import statistics

import numpy as np
import pytest

from tests.test_pipeline import Frames, frames, make_scene  # noqa: F401  (a fixture)
from warp_ar import auto_quality
from warp_ar.auto_quality import (
    AIM,
    GAIN,
    KNOB_SECONDS,
    RAISE,
    AutoPipeline,
    Controller,
    Costs,
    measure_costs,
    read_costs,
    write_costs,
)
from warp_ar.errors import UsageError
from warp_ar.ladder import KNOBS, Knob, load_errors, relevant_knobs, setting
from warp_ar.pipeline import Pipeline
from warp_ar.quality import PRESETS

FPS = 30.0
COSTS = Costs(
    20.0,
    {
        "diffuse": {"top_mip": -2.0, "sh2": 0.0, "sh4": 3.0, "clusters": 8.0},
        "specular": {"box_mip": -4.0, "energy_mip": 0.0, "fis32": 5.0, "fis128": 20.0},
        "room_shadow": {"none": -8.0, "coarse": 0.0, "fine": 30.0},
    },
)
ERRORS = {
    "diffuse": {"top_mip": 0.1, "sh2": 0.02, "sh4": 0.01, "clusters": 0.0},
    "specular": {"box_mip": 0.04, "energy_mip": 0.01, "fis32": 0.005, "fis128": 0.0},
    "room_shadow": {"none": 0.06, "coarse": 0.03, "fine": 0.0},
}


class Machine:
    """Frames that take what the costs say times a load, with a little noise."""

    def __init__(self, budget: float, seed: int = 0) -> None:
        self.controller = Controller(COSTS, ERRORS, budget)
        self.load, self.now = 1.0, 0.0
        self.history: list[tuple[float, float, dict[str, str]]] = []
        self._random = np.random.default_rng(seed)

    def run(self, seconds: float, noise: float = 0.05) -> list[float]:
        times = []
        for _ in range(int(seconds * FPS)):
            settings = self.controller.settings
            cost = COSTS.base + sum(COSTS.rungs[knob][rung] for knob, rung in settings.items())
            times.append(self.load * cost * float(self._random.lognormal(0.0, noise)))
            self.now += 1.0 / FPS
            self.history.append((self.now, times[-1], dict(settings)))
            self.controller.observe(times[-1], self.now)
        return times

    def changes(self, since: float = 0.0) -> int:
        shown = [settings for now, _, settings in self.history if now > since]
        return sum(a != b for a, b in itertools.pairwise(shown))


@pytest.mark.parametrize("budget", [12.0, 20.0, 33.0, 60.0, 100.0])
def test_starts_with_what_fits_and_keeps_it(budget):
    machine = Machine(budget)
    times = machine.run(20.0)
    assert statistics.median(times) <= budget
    assert machine.changes() == 0, "nothing changed, so nothing may"


def test_a_tighter_budget_never_errs_less():
    errors = [Machine(budget).controller.expected_error for budget in (8.0, 12.0, 20.0, 33.0, 60.0, 100.0)]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] == 0.0


def test_a_budget_that_nothing_fits_takes_the_cheapest():
    assert Machine(1.0).controller.settings == {"diffuse": "top_mip", "specular": "box_mip", "room_shadow": "none"}


def test_load_is_answered_and_taken_back_when_it_goes():
    machine = Machine(33.0)
    machine.run(5.0)
    before = machine.controller.expected_error
    machine.load = 2.0
    machine.run(4.0)
    loaded = machine.run(4.0)
    assert statistics.median(loaded) <= 33.0
    assert machine.controller.expected_error > before
    machine.load = 1.0
    machine.run(12.0)
    assert machine.controller.expected_error <= Machine(33.0 * RAISE / AIM).controller.expected_error


@pytest.mark.parametrize("seed", range(4))
def test_no_knob_moves_twice_in_half_a_second_or_by_two_rungs(seed):
    machine = Machine(33.0, seed)
    loads = np.random.default_rng(seed)
    for _ in range(30):
        machine.load = float(loads.choice([0.5, 1.0, 1.5, 3.0]))
        machine.run(1.3, noise=0.3)
    moved: dict[str, float] = {}
    assert machine.changes() > 5, "the load must have moved it at all"
    for (_, _, a), (now, _, b) in itertools.pairwise(machine.history):
        for knob in a:
            if a[knob] == b[knob]:
                continue
            ladder = machine.controller._ladders[knob]
            assert abs(ladder.index(a[knob]) - ladder.index(b[knob])) == 1
            assert now - moved.get(knob, -1.0) >= KNOB_SECONDS - 1e-9
            moved[knob] = now


def test_no_flicker_where_the_better_rung_does_not_quite_fit():
    """Prices that promise too much: tries of the dearer rung must become rare."""
    machine = Machine(33.0)
    honest = machine.controller.settings
    machine.run(3.0)

    def cheat(seconds: float) -> None:
        for _ in range(int(seconds * FPS)):
            dearer = machine.controller.expected_error < honest_error - 1e-9
            machine.now += 1.0 / FPS
            machine.history.append((machine.now, 0.0, dict(machine.controller.settings)))
            machine.controller.observe(50.0 if dearer else 15.0, machine.now)

    honest_error = machine.controller.expected_error
    cheat(60.0)
    assert machine.changes(3.0) >= 2, "it must have tried"
    late = machine.changes(33.0)
    assert late <= 4, f"{late} changes in the last half minute are flicker"
    assert honest.keys() == machine.controller.settings.keys()


def test_a_single_slow_frame_changes_nothing():
    machine = Machine(33.0)
    machine.run(2.0)
    machine.controller.observe(900.0, machine.now)
    machine.run(5.0)
    assert machine.changes() == 0


def test_what_is_hardly_better_is_not_worth_a_change():
    errors = {"diffuse": {"sh2": 1.0, "sh4": 1.0 - 0.5 * GAIN}}
    costs = Costs(20.0, {"diffuse": {"sh2": 0.0, "sh4": 12.0}})
    controller = Controller(costs, errors, 30.0)
    assert controller.settings == {"diffuse": "sh2"}
    assert not any(controller.observe(1.0, index / FPS) for index in range(600))


# ------------------------------------------------------------------------------------------------------ costs, kept


KNOB = next(knob for knob in KNOBS if knob.name == "diffuse")
KEPT = Costs(12.5, {"diffuse": {"sh2": 0.0, "sh4": 1.25}})


def test_costs_are_kept(tmp_path):
    write_costs(tmp_path / "new", "a", KEPT)
    write_costs(tmp_path / "new", "b", Costs(1.0, {"diffuse": {"sh2": 0.0}}))
    assert read_costs(tmp_path / "new", "a", [KNOB]) == KEPT
    assert read_costs(tmp_path / "new", "c", [KNOB]) is None


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        '{"a": 3}',
        '{"a": {"base": 1}}',
        '{"a": {"base": "x", "rungs": {"diffuse": {"sh2": 0}}}}',
        '{"a": {"base": 1, "rungs": {"diffuse": {"sh9": 0}}}}',
        '{"a": {"base": 1, "rungs": {"diffuse": {}}}}',
        '{"a": {"base": 1, "rungs": {"specular": {"box_mip": 0}}}}',
    ],
)
def test_costs_that_are_not_ours_are_measured_anew(tmp_path, text):
    (tmp_path / "costs.json").write_text(text)
    assert read_costs(tmp_path, "a", [KNOB]) is None
    write_costs(tmp_path, "a", KEPT)
    assert read_costs(tmp_path, "a", [KNOB]) == KEPT


def test_a_cache_that_cannot_be_written_is_no_failure(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    write_costs(tmp_path / "file", "a", KEPT)
    assert "cannot keep measured costs" in capsys.readouterr().err


def test_key_follows_device_version_scene_and_size(monkeypatch):
    def key(size=(320, 240), **changes):
        with Pipeline(make_scene(**changes), device="cpu", quality="low", size=size) as pipeline:
            return auto_quality.cost_key(pipeline.plan, pipeline.device, [KNOB])

    keys = [key(), key((160, 120)), key(lights=()), key(objects=())]
    assert key() == keys[0]
    monkeypatch.setattr(auto_quality, "package_version", lambda: "another")
    keys.append(key())
    assert len(set(keys)) == len(keys)


def test_measured_costs_cover_every_rung_but_brute_force(frames: Frames, device: str) -> None:
    scene = make_scene()
    with Pipeline(scene, device=device, quality="low") as pipeline:
        pose = pipeline(frames[0]).pose
    knobs = [knob for knob in relevant_knobs(scene, (320, 240)) if knob.name in ("diffuse", "expose")]
    costs = measure_costs(scene, frames[0], pose, device, (320, 240), knobs)
    assert costs.base > 0.0
    for knob in knobs:
        assert set(costs.rungs[knob.name]) == set(knob.rungs) - {"brute_force"}
        assert costs.rungs[knob.name][setting(PRESETS["medium"], knob)] == 0.0


# ------------------------------------------------------------------------------------------------------ the pipelines


def even_costs(knobs: tuple[Knob, ...], base: float = 1.0, step: float = 1.0) -> Costs:
    """Each rung a step dearer than the one before, from the base's."""
    rungs = {}
    for knob in knobs:
        names = [rung for rung in knob.rungs if rung != "brute_force"]
        start = names.index(setting(PRESETS["medium"], knob))
        rungs[knob.name] = {rung: step * (place - start) for place, rung in enumerate(names)}
    return Costs(base, rungs)


def test_changes_over_and_keeps_the_light(frames: Frames, device: str, tmp_path) -> None:
    """It starts at the base, chooses, goes over as soon as that is built, and the room's light goes along."""
    scene = make_scene()
    knobs = relevant_knobs(scene, (320, 240))
    with AutoPipeline(
        scene, device=device, budget_ms=1e6, costs=even_costs(knobs), folder=tmp_path, outputs=("image", "environment")
    ) as pipeline:
        base = pipeline.quality
        before = pipeline(frames[0], time_seconds=0.0).environment
        assert pipeline._building is not None
        pipeline._building.result()
        result = pipeline(frames[0], time_seconds=1 / FPS)
        assert pipeline.quality != base
        assert result.pose is not None
        assert result.environment is not None
        assert result.environment.mean() == pytest.approx(before.mean(), rel=0.25)
        status = pipeline.status()
    # Nothing limits it: the best rungs there are, brute force aside.
    errors = load_errors()
    best = sum(min(errors[knob.name][rung] for rung in knob.rungs if rung != "brute_force") for knob in knobs)
    assert status["expected_error"] == pytest.approx(best, abs=1e-5)
    assert status["budget_ms"] == 1e6
    assert len(status["changes"]) == 1
    json.dumps(status)


def test_costs_are_measured_once(frames: Frames, device: str, tmp_path, monkeypatch, capsys) -> None:
    calls = []

    def measure(scene, image, pose, device, size, knobs):
        calls.append(pose)
        return even_costs(knobs)

    monkeypatch.setattr(auto_quality, "measure_costs", measure)
    for _ in range(2):
        with AutoPipeline(make_scene(), device=device, budget_ms=40.0, folder=tmp_path) as pipeline:
            pipeline(np.zeros_like(frames[0]))
            assert pipeline.status()["changes"] == [], "no marker yet: nothing to measure on"
            pipeline(frames[0])
            assert pipeline.status()["changes"]
    assert len(calls) == 1
    assert calls[0] is not None
    assert capsys.readouterr().err.count("measuring") == 1


def test_budget_must_be_one():
    with pytest.raises(UsageError, match=r"a budget of 0\.0 ms is none"):
        AutoPipeline(make_scene(), budget_ms=0.0)
