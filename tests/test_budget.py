"""The budget's controller against a pretended machine; pipelines changed without a trace."""

from __future__ import annotations

import itertools
import json
import math
import statistics
from collections.abc import Mapping

import numpy as np
import pytest

from tests.test_pipeline import Frames, frames, make_scene  # noqa: F401  (a fixture)
from warp_ar.accuracy.budget import AutoPipeline
from warp_ar.accuracy.controller import AIM, LEAST, MEMORY, Controller
from warp_ar.accuracy.cost_table import Setting, chosen, load_errors, relevant_settings
from warp_ar.accuracy.costs import Costs
from warp_ar.errors import UsageError
from warp_ar.stages.quality import PRESETS

pytestmark = pytest.mark.slow

FPS = 30.0
COSTS = Costs(
    20.0,
    {
        "environment_height": {"32": -2.0, "64": 0.0, "128": 8.0, "256": 36.0},
        "irradiance": {"sphere_mip": -2.0, "sh2": 0.0, "clusters": 3.0, "brute_force": 8.0},
        "prefilter": {"sphere_mip": -2.0, "energy_mip": 0.0, "fis128": 5.0, "brute_force": 20.0},
        "environment_shadow": {"none": -8.0, "coarse": 0.0, "bounce": 30.0},
    },
)
BASE = {"environment_height": "64", "irradiance": "sh2", "prefilter": "energy_mip", "environment_shadow": "coarse"}
CHEAPEST = {
    "environment_height": "32",
    "irradiance": "sphere_mip",
    "prefilter": "sphere_mip",
    "environment_shadow": "none",
}
ERRORS = {
    "environment_height": {"32": 0.03, "64": 0.01, "128": 0.007, "256": 0.0},
    "irradiance": {"sphere_mip": 0.1, "sh2": 0.02, "clusters": 0.01, "brute_force": 0.0},
    "prefilter": {"sphere_mip": 0.04, "energy_mip": 0.01, "fis128": 0.005, "brute_force": 0.0},
    "environment_shadow": {"none": 0.06, "coarse": 0.03, "bounce": 0.0},
}


BUILDING = (3, 20)
"""Frames for which a pipeline is built: from, to."""
BESIDE = 1.4
"""What that makes of frames meanwhile."""


class Machine:
    """Frames that take what the true costs say times a load, with noise, and pipelines that are built beside them."""

    def __init__(
        self,
        budget: float,
        seed: int = 0,
        *,
        known: Costs = COSTS,
        truth: Costs = COSTS,
        running: Mapping[str, str] | None = BASE,
        errors: Mapping[str, Mapping[str, float]] = ERRORS,
    ) -> None:
        self.controller = Controller(known, errors, budget, running)
        self._truth = truth
        self.shown = dict(self.controller.settings)
        self.load, self.now = 1.0, 0.0
        self.history: list[tuple[float, float, dict[str, str]]] = []
        self.unfit = 0
        """Frames in which it held that nothing fits."""
        self._kept = [self.shown]
        self._random = np.random.default_rng(seed)
        self._building = 0

    def cost(self, settings: Mapping[str, str]) -> float:
        return self._truth.base + self._truth.excess(settings)

    def run(self, seconds: float, noise: float = 0.05, slow: float = 0.0) -> list[float]:
        """Run frames.

        Args:
            seconds: How long, at 30 frames a second.
            noise: Of the logarithm of a frame's time.
            slow: Share of frames that take five times as long.
        """
        times = []
        controller = self.controller
        for _ in range(int(seconds * FPS)):
            spent = self.load * self.cost(self.shown) * float(self._random.lognormal(0.0, noise))
            spent *= 5.0 if self._random.random() < slow else 1.0
            times.append(spent * (BESIDE if self._building else 1.0))
            self.now += 1.0 / FPS
            self.history.append((self.now, times[-1], dict(self.shown)))
            if self._building:
                self._building -= 1
                if self._building == 0:
                    self._show()
            elif controller.observe(times[-1], self.now):
                if controller.settings in self._kept:
                    self._go_over()
                else:
                    self._building = int(self._random.integers(*BUILDING))
            self.unfit += not controller.fits
        return times

    def _show(self) -> None:
        self._kept.append(dict(self.controller.settings))
        self._go_over()

    def _go_over(self) -> None:
        self.controller.shown(self.now)
        self.shown = dict(self.controller.settings)

    def changes(self, since: float = 0.0) -> int:
        shown = [settings for now, _, settings in self.history if now > since]
        return sum(a != b for a, b in itertools.pairwise(shown))


def best_error(budget: float) -> float:
    """Least error of settings that truly take no longer."""
    names = list(COSTS.methods)
    every = [dict(zip(names, methods, strict=True)) for methods in itertools.product(*COSTS.methods.values())]
    fitting = [own for own in every if COSTS.base + COSTS.excess(own) <= budget]
    return min(sum(ERRORS[setting][method] for setting, method in own.items()) for own in fitting)


@pytest.mark.parametrize("budget", [12.0, 33.0, 400.0])
def test_chooses_once_what_fits_and_keeps_it(budget):
    machine = Machine(budget)
    times = machine.run(20.0)
    assert statistics.median(times[-300:]) <= budget
    assert machine.changes() <= 1, "nothing changed, so nothing may"
    # The load that it chooses by has the noise of a median of nine frames: 2 %.
    assert machine.controller.expected_error <= best_error(0.95 * AIM * budget)


@pytest.mark.parametrize("start", [BASE, None])
def test_a_budget_that_nothing_fits_takes_the_cheapest_and_says_so(start):
    machine = Machine(4.0, running=start)
    machine.run(10.0)
    assert machine.shown == CHEAPEST
    assert not machine.controller.fits
    assert machine.changes() <= 1
    machine.load = 0.3
    machine.run(2.0)
    assert machine.controller.fits


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
    machine.run(16.0)
    assert machine.unfit == 0, "there was always something cheaper"
    assert machine.controller.expected_error <= best_error(0.95 * LEAST * 33.0)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("budget", [12.0, 60.0])
def test_ten_thousand_noisy_frames_bring_no_flicker(budget, seed):
    """Frames whose times scatter by a fifth, every fiftieth five times too long; costs that are a fifth off."""
    off = np.random.default_rng(100 + seed)
    methods = dict(COSTS.methods)
    for setting in ("irradiance", "environment_shadow"):
        methods[setting] = {method: ms * float(off.uniform(0.8, 1.2)) for method, ms in COSTS.methods[setting].items()}
    machine = Machine(budget, seed, known=Costs(COSTS.base, methods))
    times = machine.run(10_000 / FPS, noise=0.2, slow=0.02)
    assert machine.changes() <= 6, "two changes a minute at the very most"
    assert statistics.median(times) <= budget


# ------------------------------------------------------------------------------------------------------ the pipelines


HEIGHT = ("environment_height",)


def even_costs(
    settings: tuple[Setting, ...],
    base: float = 1.0,
    step: float = 1.0,
    most: float = math.inf,
    free: tuple[str, ...] = (),
) -> Costs:
    """Each method a step dearer than the one before, from the base's; beyond ``most`` none can be paid.

    Where settings are ``free``, the others stay as they are: their kernels take long to compile.
    """
    methods = {}
    for setting in settings:
        names = [method for method in setting.methods if method != "brute_force"]
        start = names.index(chosen(PRESETS["medium"], setting))
        held = bool(free) and setting.name not in free
        steps = {
            method: math.inf if held and place != start else step * (place - start)
            for place, method in enumerate(names)
        }
        methods[setting.name] = {method: ms if ms <= most else 1e9 for method, ms in steps.items()}
    return Costs(base, methods)


def light(pipeline: AutoPipeline, image: np.ndarray, count: int = 0) -> None:
    """Show frames until the first choice is made, else so many; what is being built is waited for."""
    for shown in range(count or 200):
        # As in ``show_again``: stages rest where nothing changes, and their times with them.
        pipeline(image - (shown % 2) * (image // 8), time_seconds=shown / FPS)
        if pipeline._switcher.busy:
            pipeline._switcher._building.exception()  # the next frame tells it
        if not count and pipeline.status()["changes"]:
            return


def test_changes_over_and_keeps_the_light(frames: Frames, device: str, tmp_path) -> None:
    """It starts at the base, chooses, goes over as soon as that is built, and the environment goes along."""
    scene = make_scene()
    costs = even_costs(relevant_settings(scene, (320, 240)), most=1.0, free=HEIGHT)
    with AutoPipeline(
        scene,
        device=device,
        budget_ms=1e6,
        costs=costs,
        folder=tmp_path,
        outputs=("image", "environment"),
    ) as pipeline:
        base = pipeline.quality
        before = pipeline(frames[0], time_seconds=0.0).environment
        light(pipeline, frames[0])
        assert pipeline.quality != base
        result = pipeline(frames[0], time_seconds=4.0)
        assert result.pose is not None
        assert result.environment is not None
        assert result.environment.mean() == pytest.approx(before.mean(), rel=0.25)
        status = pipeline.status()
    # Nothing else limits it: the best methods that can be paid.
    errors = load_errors()
    best = sum(min(errors[name][m] for m, ms in own.items() if ms <= 1.0) for name, own in costs.methods.items())
    assert status["expected_error"] == pytest.approx(best, abs=1e-5)
    assert status["budget_ms"] == 1e6
    assert status["fits"]
    assert len(status["changes"]) == 1
    json.dumps(status)


def test_budget_must_be_one():
    with pytest.raises(UsageError, match=r"budget 0\.0 ms"):
        AutoPipeline(make_scene(), budget_ms=0.0)


def test_no_flicker_where_the_better_method_does_not_quite_fit():
    """Costs that promise too much, and no trials: what was shown and took too long is not tried again soon."""
    machine = Machine(33.0, running=None)
    honest_error = machine.controller.expected_error

    def cheat(seconds: float) -> None:
        for _ in range(int(seconds * FPS)):
            dearer = machine.controller.expected_error < honest_error - 1e-9
            machine.now += 1.0 / FPS
            machine.history.append((machine.now, 0.0, dict(machine.controller.settings)))
            machine.controller.observe(50.0 if dearer else 15.0, machine.now)

    cheat(30.0)
    tried = machine.changes()
    assert tried >= 2, "it must have tried"
    cheat(MEMORY)
    assert machine.changes() - tried <= 4


def test_says_once_that_nothing_fits(frames: Frames, tmp_path, capsys) -> None:
    scene = make_scene()
    settings = relevant_settings(scene, (320, 240))
    with AutoPipeline(
        scene, device="cpu", budget_ms=1e-3, costs=even_costs(settings, base=50.0, free=HEIGHT), folder=tmp_path
    ) as pipeline:
        light(pipeline, frames[0], 50)
        status = pipeline.status()
    assert not status["fits"]
    cheapest = {setting.name: chosen(PRESETS["medium"], setting) for setting in settings}
    cheapest["environment_height"] = next(one for one in settings if one.name == "environment_height").methods[0]
    assert status["settings"] == cheapest
    assert status["measured_ms"] > status["budget_ms"]
    assert capsys.readouterr().err.count("0.001 ms cannot be kept: ") == 1
