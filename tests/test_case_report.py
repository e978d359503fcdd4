"""What is measured of a case as a whole."""

from __future__ import annotations

import dataclasses

import pytest

from tests.accuracy_rig import case, frames, report, setting  # noqa: F401  (fixtures)
from warp_ar.accuracy import case_report
from warp_ar.accuracy.sweep import BRUTE_FORCE_UNITS

pytest.importorskip("flip_evaluator")


def test_choices_are_made_from_the_committed_list(report, monkeypatch):
    """Not from the errors of the case that they are scored on, unless there is no list yet."""
    listed = {"irradiance": {"sphere_mip": 0.7, "sh2": 0.2}}
    monkeypatch.setattr(case_report, "load_errors", lambda: listed)
    assert case_report.listed_errors(report.rows) is listed
    monkeypatch.setattr(case_report, "load_errors", lambda: {"irradiance": {"sphere_mip": 0.0, "sh2": 0.0}})
    assert case_report.listed_errors(report.rows) == {"irradiance": {"sphere_mip": 0.1, "sh2": 0.0}}


def test_all_work_is_announced(case, device, monkeypatch):
    """What is reported as done adds up to what was promised: the time left ends at zero."""
    cheap = [dataclasses.replace(setting("irradiance"), methods=("sphere_mip", "sh2", "brute_force"))]
    monkeypatch.setattr(case_report, "RUNS", ("paper", "low"))
    done = []
    truth = dataclasses.replace(case, truth={3: case.frames[3].image})
    made = case_report.measure_case(truth, device, cheap, lambda text, units: done.append(units), quick=True)
    assert sum(done) == case_report.work_units(truth, cheap, quick=True) == 4.0
    assert [whole.label for whole in made.wholes] == ["paper", "low"]
    assert case_report.work_units(case, cheap) == 2.0 + BRUTE_FORCE_UNITS + 2.0 + BRUTE_FORCE_UNITS
