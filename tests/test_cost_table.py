"""Knobs turn what they say; choices are the best there are, against trying all."""

import dataclasses
import itertools

import numpy as np
import pytest

from warp_ar.accuracy.cost_table import (
    KNOBS,
    Price,
    choose,
    choose_for_error,
    frontier,
    read_errors,
    relevant_knobs,
    setting,
    turn,
    undominated,
)
from warp_ar.errors import UsageError
from warp_ar.scene import load_scene
from warp_ar.stages.quality import PRESETS

# Sums of a handful of float64.
EXACT = 1e-12


@pytest.mark.parametrize("knob", KNOBS, ids=lambda knob: knob.name)
def test_what_is_turned_is_set(knob):
    for rung in knob.rungs:
        assert setting(turn(PRESETS["medium"], {knob.name: rung}), knob) == rung


def test_turning_changes_nothing_else():
    turned = turn(PRESETS["medium"], {"diffuse": "sh4", "edge_samples": "16"})
    for knob in KNOBS:
        if knob.name not in ("diffuse", "edge_samples"):
            assert setting(turned, knob) == setting(PRESETS["medium"], knob)


def test_bad_turns_are_refused():
    with pytest.raises(UsageError, match="diffuse has no rung 'sh9'; expected top_mip"):
        turn(PRESETS["medium"], {"diffuse": "sh9"})
    with pytest.raises(UsageError, match="nothing called 'colour'"):
        turn(PRESETS["medium"], {"colour": "red"})


def test_scenes_have_the_knobs_that_they_call_for():
    def names(scene):
        return {knob.name for knob in relevant_knobs(load_scene(scene), (640, 480))}

    assert "expose" in names("darken")
    assert names("darken").isdisjoint({"diffuse", "specular", "relight", "shade", "edge_samples"})
    assert {"diffuse", "specular", "relight", "room_shadow", "environment_height", "mirror_ball"} <= names("desk")
    assert "expose" not in names("desk")
    assert "relight" not in names("torus")


def test_scenes_without_a_ball_or_anything_virtual_have_nothing_to_mirror():
    desk = load_scene("desk")
    for changes in ({"probes": ()}, {"objects": (), "lights": ()}):
        bare = dataclasses.replace(desk, **changes)
        assert "mirror_ball" not in {knob.name for knob in relevant_knobs(bare, (640, 480))}


def random_prices(seed, knobs=4, rungs=4):
    rng = np.random.default_rng(seed)
    return [
        Price(f"knob{k}", f"rung{r}", float(rng.integers(1, 20)), float(rng.integers(0, 9)))
        for k in range(knobs)
        for r in range(rungs)
    ]


@pytest.mark.parametrize("seed", range(8))
def test_choice_is_the_best_of_all(seed):
    prices = random_prices(seed)
    groups = [list(own) for _, own in itertools.groupby(prices, lambda price: price.knob)]
    every = [(sum(p.milliseconds for p in pick), sum(p.error for p in pick)) for pick in itertools.product(*groups)]
    front = frontier(prices)
    for budget in (5.0, 12.0, 25.0, 40.0, 1e9):
        choice = choose(front, budget)
        fitting = [error for cost, error in every if cost <= budget]
        if fitting:
            assert choice.milliseconds <= budget
            assert choice.error == pytest.approx(min(fitting), abs=EXACT)
        else:
            assert choice.milliseconds == pytest.approx(min(cost for cost, _ in every), abs=EXACT)
    for error in (0.0, 4.0, 11.0):
        choice = choose_for_error(front, error)
        fitting = [cost for cost, own in every if own <= error]
        if fitting:
            assert choice.milliseconds == pytest.approx(min(fitting), abs=EXACT)


@pytest.mark.parametrize("seed", range(8))
def test_choice_is_the_best_of_all_where_knobs_multiply(seed):
    """A knob that others share makes each of them dearer by a factor of its own, the more the dearer it is itself."""
    prices = random_prices(seed)
    shared = {price.rung: price.milliseconds for price in prices if price.knob == "knob0"}
    factors = {"knob1": 0.5, "knob2": 0.1}
    scales = {
        "knob0": {rung: {knob: 1.0 + factor * ms for knob, factor in factors.items()} for rung, ms in shared.items()}
    }
    groups = [list(own) for _, own in itertools.groupby(prices, lambda price: price.knob)]
    every = [
        (
            sum(p.milliseconds * scales["knob0"][pick[0].rung].get(p.knob, 1.0) for p in pick),
            sum(p.error for p in pick),
        )
        for pick in itertools.product(*groups)
    ]
    front = frontier(prices, scales)
    assert front != frontier(prices)
    for budget in (12.0, 25.0, 60.0, 200.0, 1e9):
        choice = choose(front, budget)
        fitting = [error for cost, error in every if cost <= budget]
        if fitting:
            assert choice.milliseconds <= budget
            assert choice.error == pytest.approx(min(fitting), abs=EXACT)
        else:
            assert choice.milliseconds == pytest.approx(min(cost for cost, _ in every), abs=EXACT)


def test_choice_adds_up_and_covers_every_knob():
    prices = random_prices(3)
    by_name = {(price.knob, price.rung): price for price in prices}
    for choice in frontier(prices):
        assert [knob for knob, _ in choice.settings] == ["knob0", "knob1", "knob2", "knob3"]
        own = [by_name[pair] for pair in choice.settings]
        assert choice.milliseconds == pytest.approx(sum(price.milliseconds for price in own), abs=EXACT)
        assert choice.error == pytest.approx(sum(price.error for price in own), abs=EXACT)


def test_dominated_rungs_are_dropped():
    a, b, c, d = (Price("k", n, ms, e) for n, ms, e in (("a", 1, 9), ("b", 2, 9), ("c", 3, 4), ("d", 5, 4.5)))
    assert undominated([d, c, b, a]) == [a, c]


def test_price_list_is_checked():
    with pytest.raises(UsageError, match="table 'errors'"):
        read_errors({})
    with pytest.raises(UsageError, match=r"errors\.diffuse\.sh2 is -1"):
        read_errors({"errors": {"diffuse": {"sh2": -1}}})
    errors = read_errors({"errors": {"diffuse": {"top_mip": 0.5, "sh4": 0.1}}})
    assert errors["diffuse"] == {"top_mip": 0.5, "sh2": 0.5, "sh4": 0.1, "clusters": 0.1, "brute_force": 0.1}
