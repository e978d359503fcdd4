"""Methods of a setting: what is measured and what is told apart."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.accuracy_rig import case, frames, setting  # noqa: F401  (fixtures)
from warp_ar.accuracy import sweep as sweep_module
from warp_ar.accuracy.metrics import ArrayError
from warp_ar.stages.quality import PRESETS

pytest.importorskip("flip_evaluator")


def test_the_last_method_is_its_own_reference(case, device):
    rows, pictures = sweep_module.sweep(case, setting("irradiance"), device, PRESETS["low"])
    assert [row.method for row in rows] == list(setting("irradiance").methods)
    assert rows[-1].stage_error == ArrayError(0.0, 0.0, 0.0)
    assert rows[-1].flip == 0.0
    assert rows[-1].error == 0.0
    error = {row.method: row.stage_error.relative_rmse for row in rows}
    assert error["sphere_mip"] > 5.0 * error["sh2"] > 0.0
    assert all(row.milliseconds > 0.0 for row in rows)
    assert set(pictures) == set(setting("irradiance").methods)


def test_a_method_that_leaves_a_stage_out_costs_nothing_of_it(case, device):
    cheap = dataclasses.replace(setting("environment_shadow"), methods=("none", "coarse"))
    rows, _ = sweep_module.sweep(case, cheap, device, PRESETS["low"].with_methods(environment_shadow="none"))
    costs = {row.method: row.milliseconds for row in rows}
    assert costs["none"] == 0.0
    assert costs["coarse"] > 0.0


def test_what_the_ball_shows_is_compared_with_many_rays(case, device):
    """Every method leaves less of it than the one before; left out, all of it."""
    rows, _ = sweep_module.sweep(case, setting("mirror_ball"), device, PRESETS["low"])
    assert [row.method for row in rows] == ["none", "single", "smooth", "brute_force"]
    left = [row.stage_error.relative_rmse for row in rows]
    assert left[0] == pytest.approx(1.0)
    assert left[0] > left[1] > left[2] > left[3] == 0.0
    errors = [row.error for row in rows]
    assert errors[0] > max(errors[1:])
    assert errors[3] == 0.0


def test_truth_is_what_pictures_are_compared_with(case, device):
    truth = dataclasses.replace(case, truth={3: np.full_like(case.frames[3].image, 250)})
    rows, _ = sweep_module.sweep(truth, setting("expose"), device, PRESETS["low"])
    assert {row.against for row in rows} == {"truth"}
    assert all(row.flip > 0.1 for row in rows)
    assert min(row.error for row in rows) == 0.0


def test_dominated_means_in_every_respect():
    def row(method, ms, flip, rmse):
        return sweep_module.Row("c", "k", method, ms, ArrayError(rmse, 0.0, 0.0), flip, "truth", flip, flip)

    rows = [row("a", 1.0, 0.3, 0.3), row("b", 2.0, 0.4, 0.4), row("c", 3.0, 0.3, 0.1), row("d", 4.0, 0.1, 0.1)]
    assert [sweep_module._is_dominated(one, rows) for one in rows] == [False, True, False, False]
    # What cannot be told apart counts as equal, and of equals the first stays.
    equal = [row("a", 1.0, 0.3, 0.3), row("b", 1.01, 0.3001, 0.301), row("c", 1.0, 0.3, 0.3)]
    assert [sweep_module._is_dominated(one, equal) for one in equal] == [False, True, True]
