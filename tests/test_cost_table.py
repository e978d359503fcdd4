"""Settings turn what they say; choices are the best there are, against trying all."""

import dataclasses
import itertools

import numpy as np
import pytest

from warp_ar.accuracy.cost_table import (
    SETTINGS,
    MethodCost,
    choose,
    chosen,
    pareto_front,
    pareto_optimal,
    read_errors,
    relevant_settings,
    turn,
)
from warp_ar.errors import UsageError
from warp_ar.scene import load_scene
from warp_ar.stages.quality import PRESETS

# Sums of a handful of float64.
EXACT = 1e-12


@pytest.mark.parametrize("setting", SETTINGS, ids=lambda setting: setting.name)
def test_what_is_turned_is_set(setting):
    for method in setting.methods:
        assert chosen(turn(PRESETS["medium"], {setting.name: method}), setting) == method


def test_turning_changes_nothing_else():
    turned = turn(PRESETS["medium"], {"irradiance": "sh2", "edge_samples": "16"})
    for setting in SETTINGS:
        if setting.name not in ("irradiance", "edge_samples"):
            assert chosen(turned, setting) == chosen(PRESETS["medium"], setting)


def test_bad_turns_are_refused():
    with pytest.raises(UsageError, match="irradiance has no method 'sh9'; expected sphere_mip"):
        turn(PRESETS["medium"], {"irradiance": "sh9"})
    with pytest.raises(UsageError, match="nothing called 'colour'"):
        turn(PRESETS["medium"], {"colour": "red"})


def test_scenes_have_the_settings_that_they_call_for():
    def names(scene):
        return {setting.name for setting in relevant_settings(load_scene(scene), (640, 480))}

    assert "expose" in names("darken")
    assert names("darken").isdisjoint({"irradiance", "prefilter", "relight", "shade", "edge_samples"})
    assert {"irradiance", "prefilter", "relight", "environment_shadow", "environment_height", "mirror_ball"} <= names(
        "desk"
    )
    assert "expose" not in names("desk")
    assert "relight" not in names("torus")


def test_scenes_without_a_ball_or_anything_virtual_have_nothing_to_mirror():
    desk = load_scene("desk")
    for changes in ({"probes": ()}, {"objects": (), "lights": ()}):
        bare = dataclasses.replace(desk, **changes)
        assert "mirror_ball" not in {setting.name for setting in relevant_settings(bare, (640, 480))}


def random_method_costs(seed, settings=4, methods=4):
    rng = np.random.default_rng(seed)
    return [
        MethodCost(f"setting{k}", f"method{r}", float(rng.integers(1, 20)), float(rng.integers(0, 9)))
        for k in range(settings)
        for r in range(methods)
    ]


def check_choices(front, every, budgets):
    """Of all (cost, error), the least error within each budget; where nothing fits, the cheapest."""
    for budget in budgets:
        choice = choose(front, budget)
        fitting = [error for cost, error in every if cost <= budget]
        if fitting:
            assert choice.milliseconds <= budget
            assert choice.error == pytest.approx(min(fitting), abs=EXACT)
        else:
            assert choice.milliseconds == pytest.approx(min(cost for cost, _ in every), abs=EXACT)


@pytest.mark.parametrize("seed", range(8))
def test_choice_is_the_best_of_all(seed):
    method_costs = random_method_costs(seed)
    groups = [list(own) for _, own in itertools.groupby(method_costs, lambda method_cost: method_cost.setting)]
    every = [(sum(p.milliseconds for p in pick), sum(p.error for p in pick)) for pick in itertools.product(*groups)]
    front = pareto_front(method_costs)
    check_choices(front, every, (5.0, 12.0, 25.0, 40.0, 1e9))


@pytest.mark.parametrize("seed", range(8))
def test_choice_is_the_best_of_all_where_settings_multiply(seed):
    """A setting that others share makes each of them dearer by a factor of its own, the more the dearer it is
    itself."""
    method_costs = random_method_costs(seed)
    shared = {
        method_cost.method: method_cost.milliseconds
        for method_cost in method_costs
        if method_cost.setting == "setting0"
    }
    factors = {"setting1": 0.5, "setting2": 0.1}
    scales = {
        "setting0": {
            method: {setting: 1.0 + factor * ms for setting, factor in factors.items()} for method, ms in shared.items()
        }
    }
    groups = [list(own) for _, own in itertools.groupby(method_costs, lambda method_cost: method_cost.setting)]
    every = [
        (
            sum(p.milliseconds * scales["setting0"][pick[0].method].get(p.setting, 1.0) for p in pick),
            sum(p.error for p in pick),
        )
        for pick in itertools.product(*groups)
    ]
    front = pareto_front(method_costs, scales)
    assert front != pareto_front(method_costs)
    check_choices(front, every, (12.0, 25.0, 60.0, 200.0, 1e9))


def test_choice_adds_up_and_covers_every_setting():
    method_costs = random_method_costs(3)
    by_name = {(method_cost.setting, method_cost.method): method_cost for method_cost in method_costs}
    for choice in pareto_front(method_costs):
        assert [setting for setting, _ in choice.settings] == ["setting0", "setting1", "setting2", "setting3"]
        own = [by_name[pair] for pair in choice.settings]
        assert choice.milliseconds == pytest.approx(sum(method_cost.milliseconds for method_cost in own), abs=EXACT)
        assert choice.error == pytest.approx(sum(method_cost.error for method_cost in own), abs=EXACT)


def test_dominated_methods_are_dropped():
    a, b, c, d = (MethodCost("k", n, ms, e) for n, ms, e in (("a", 1, 9), ("b", 2, 9), ("c", 3, 4), ("d", 5, 4.5)))
    assert pareto_optimal([d, c, b, a]) == [a, c]


def test_price_list_is_checked():
    with pytest.raises(UsageError, match="table 'errors'"):
        read_errors({})
    with pytest.raises(UsageError, match=r"errors\.irradiance\.sh2 is -1"):
        read_errors({"errors": {"irradiance": {"sh2": -1}}})
    errors = read_errors({"errors": {"irradiance": {"sphere_mip": 0.5, "clusters": 0.1}}})
    assert errors["irradiance"] == {
        "sphere_mip": 0.5,
        "sh2": 0.5,
        "clusters": 0.1,
        "brute_force": 0.1,
    }
