"""Tables, JSON lines and the cost table."""

from __future__ import annotations

import json

import pytest
from rich.console import Console

from tests.accuracy_rig import case, frames, report  # noqa: F401  (fixtures)
from warp_ar.accuracy import report as report_module
from warp_ar.accuracy.cost_table import read_errors


def test_records_and_tables_hold_every_method(report):
    lines = [json.loads(json.dumps(record)) for record in report_module.records(report, "cpu")]
    assert [line["kind"] for line in lines] == ["method", "method", "whole", "whole"]
    assert lines[0]["relative_rmse"] == 0.3
    console = Console(width=120, record=True, quiet=False, file=open("/dev/null", "w"))  # noqa: SIM115
    with console.file:
        report_module.print_report(report, console)
    text = console.export_text()
    assert all(word in text for word in ("sphere_mip", "sh2", "30.00%", "ours near the"))


def test_cost_table_is_what_choices_read(report):
    made = report_module.make_cost_table([report, report], "cpu")
    errors = read_errors(json.loads(json.dumps(made)))
    assert errors["irradiance"]["sphere_mip"] == pytest.approx(0.1)
    assert errors["irradiance"]["sh2"] == 0.0
    assert made["stage_errors"]["irradiance"] == {"sphere_mip": 0.3}
