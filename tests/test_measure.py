"""A case at one quality, every method of a setting, the whole, and the tables made of it."""

from __future__ import annotations

import dataclasses
import itertools
import json
import time

import numpy as np
import pytest

from tests.accuracy_rig import case, frames, report, setting  # noqa: F401  (fixtures)
from warp_ar.accuracy import cases, measure
from warp_ar.accuracy import report as report_module
from warp_ar.accuracy.cost_table import (
    SETTINGS,
    MethodCost,
    choose,
    chosen,
    pareto_front,
    read_errors,
    relevant_settings,
    turn,
)
from warp_ar.accuracy.costs import Costs
from warp_ar.accuracy.metrics import changed_region
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import UsageError
from warp_ar.kernels.color import decode_table
from warp_ar.scene import load_scene
from warp_ar.stages.quality import PRESETS

pytest.importorskip("flip_evaluator")


def even(name: str) -> Costs:
    return Costs(1.0, {name: {method: float(place) for place, method in enumerate(setting(name).methods)}})


@pytest.mark.slow
def test_frames_that_are_not_shown_keep_the_light(case, device):
    """They run at another quality, without a trace in the picture that counts."""
    with Pipeline(case.scene, device=device, quality="low") as pipeline:
        for frame, pose in zip(case.frames, case.poses, strict=True):
            full = pipeline(frame.image, time_seconds=frame.time, pose=pose).image
    sparse = measure.run(case, {"": PRESETS["low"]}, device)[""]
    assert list(sparse) == [3]
    assert np.abs(sparse[3].astype(int) - full).max() <= 1


@pytest.mark.slow
def test_in_turn_is_alone(case, device):
    """Qualities that run in turn do not touch each other."""
    qualities = {"a": PRESETS["low"], "b": dataclasses.replace(PRESETS["low"], environment_height=32)}
    times, images = measure.run_in_turn(case, qualities, device, time.perf_counter)
    for label, quality in qualities.items():
        _, alone = measure.run_in_turn(case, {label: quality}, device, time.perf_counter)
        np.testing.assert_array_equal(images[label][3], alone[label][3])
        assert len(times[label]) == len(case.frames) - measure.WARM_UP


@pytest.mark.slow
def test_the_last_method_is_its_own_reference(case, device):
    one = setting("mirror_ball")
    rows, pictures = measure.sweep(case, {one: one.methods}, device, even("mirror_ball"), base=PRESETS["low"])
    assert [row.method for row in rows] == ["none", "single", "smooth", "brute_force"]
    assert list(pictures) == [("mirror_ball", row.method) for row in rows]
    assert [row.milliseconds for row in rows] == [0.0, 1.0, 2.0, 3.0]
    errors = [row.error for row in rows]
    assert errors[0] > max(errors[1:])
    assert errors[3] == rows[3].flip == 0.0


@pytest.mark.slow
def test_truth_is_what_pictures_are_compared_with(case, device):
    truth = dataclasses.replace(case, truth={3: np.full_like(case.frames[3].image, 250)})
    one = setting("expose")
    rows, _ = measure.sweep(truth, {one: one.methods}, device, even("expose"), base=PRESETS["low"])
    assert {row.against for row in rows} == {"truth"}
    assert all(row.flip > 0.1 for row in rows)
    assert min(row.error for row in rows) == 0.0


def test_cost_table_is_what_choices_read(report):
    made = json.loads(json.dumps(report_module.make_cost_table([report, report], "cpu")))
    errors = read_errors(made)
    assert errors["irradiance"]["sphere_mip"] == pytest.approx(0.1)
    assert errors["irradiance"]["sh2"] == 0.0
    assert made["milliseconds"]["irradiance"] == {"sphere_mip": 0.5, "sh2": 1.0}


# --- Settings turn what they say; choices are the best there are, against trying all ----------------------------------


# Sums of a handful of float64.
EXACT = 1e-12


@pytest.mark.parametrize("setting", SETTINGS, ids=lambda setting: setting.name)
def test_what_is_turned_is_set(setting):
    for method in setting.methods:
        assert chosen(turn(PRESETS["medium"], {setting.name: method}), setting) == method


def test_bad_turns_are_refused():
    with pytest.raises(UsageError, match="irradiance has no method 'sh9'; expected sphere_mip"):
        turn(PRESETS["medium"], {"irradiance": "sh9"})
    with pytest.raises(UsageError, match="no setting 'colour'"):
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


@pytest.mark.parametrize("seed", range(3))
def test_choice_is_the_best_of_all(seed):
    method_costs = random_method_costs(seed)
    groups = [list(own) for _, own in itertools.groupby(method_costs, lambda method_cost: method_cost.setting)]
    every = [(sum(p.milliseconds for p in pick), sum(p.error for p in pick)) for pick in itertools.product(*groups)]
    front = pareto_front(method_costs)
    check_choices(front, every, (5.0, 12.0, 25.0, 40.0, 1e9))


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


# --- Cases with their truth -------------------------------------------------------------------------------------------


def test_bundled_scenes_end_with_their_truth():
    case = cases.open_scene("desk", 2, 4)
    assert len(case.frames) == 2
    assert list(case.truth) == [1]
    region = case.regions[1]
    camera, truth = case.frames[1].image, case.truth[1]
    assert 0.05 < region.mean() < 0.5
    # Nothing virtual, nothing changed.
    np.testing.assert_array_equal(truth[~region], camera[~region])
    assert np.abs(truth[region].astype(int) - camera[region]).mean() > 5.0


def test_where_nothing_clips_the_truth_of_a_shorter_exposure_is_known():
    case = cases.open_scene("darken", 1, 1)
    camera, truth, region = case.frames[0].image, case.truth[0], case.regions[0]
    decode = decode_table("srgb")[:, 0]
    scaled = 0.5 * decode[camera[~region]]
    # Rounding to a code: half of the step between codes there.
    assert np.abs(decode[truth[~region]] - scaled).max() <= 0.51 * np.diff(decode).max()
    assert region[(camera >= 255).any(-1)].mean() > 0.95


# --- FLIP at its two ends; regions of pictures that count -------------------------------------------------------------


def test_changed_region_takes_what_changed_and_no_noise():
    camera = np.random.default_rng(0).integers(100, 104, (60, 80, 3)).astype(np.uint8)
    truth = camera.copy()
    truth[20:40, 30:50] += 60
    region = changed_region(camera, truth)
    assert region[20:40, 30:50].all()
    assert not region[:5].any()
    assert not changed_region(camera, camera ^ 1).any()
