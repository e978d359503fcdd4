"""Measurements of cases, as tables in a terminal, JSON lines and the cost table."""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
import platform
import statistics
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import warp as wp
from rich.console import Console
from rich.table import Table

from warp_ar.accuracy.case_report import CaseReport
from warp_ar.accuracy.cost_table import SETTINGS
from warp_ar.accuracy.runs import BASE
from warp_ar.signature import PROGRAM
from warp_ar.stages.quality import PRESETS

MIN_COLUMNS = 110
"""Of the tables: where output is no terminal, narrower ones would be cut."""


def make_cost_table(reports: Sequence[CaseReport], device: str) -> dict[str, Any]:
    """Errors of every method, and the methods that another beats in every case.

    ``errors`` is FLIP per changed pixel as a method's error counts (see above), mean over the cases in which the
    setting matters. ``stage_errors`` is the relative RMSE of what the stage writes against its last method, mean
    likewise. Both depend on the device only by rounding; costs do not, so they are not kept here.
    """
    errors: dict[str, dict[str, float]] = {}
    stage_errors: dict[str, dict[str, float]] = {}
    dominated: dict[str, list[str]] = {}
    for setting in SETTINGS:
        rows = [row for report in reports for row in report.rows if row.setting == setting.name]
        if not rows:
            continue
        measured = {row.method for row in rows}
        by_method = {
            method: [row for row in rows if row.method == method] for method in setting.methods if method in measured
        }
        means = {method: statistics.fmean(row.error for row in own) for method, own in by_method.items()}
        best = min(means.values())
        errors[setting.name] = {method: round(mean - best, 5) for method, mean in means.items()}
        arrays = {
            method: [row.stage_error.relative_rmse for row in own if row.stage_error is not None]
            for method, own in by_method.items()
        }
        stage_errors[setting.name] = {method: round(statistics.fmean(own), 5) for method, own in arrays.items() if own}
        kept = {row.method for row in rows if not row.dominated}
        dominated[setting.name] = [method for method in by_method if method not in kept]
    return {
        "program": PROGRAM,
        "made": _made(reports, device) | {"base": BASE.name},
        "errors": errors,
        "stage_errors": stage_errors,
        "dominated": {setting: methods for setting, methods in dominated.items() if methods},
    }


def make_preset_list(reports: Sequence[CaseReport], device: str) -> dict[str, Any]:
    """FLIP per changed pixel of every preset's whole picture, by case."""
    return {
        "program": PROGRAM,
        "made": _made(reports, device),
        "errors": {
            report.case.name: {whole.label: round(whole.flip, 4) for whole in report.wholes if whole.label in PRESETS}
            for report in reports
            if report.wholes
        },
    }


def _made(reports: Sequence[CaseReport], device: str) -> dict[str, Any]:
    """Of what a list was made."""
    return {
        "by": f"python -m warp_ar.tradeoff {' '.join(report.case.name for report in reports)}",
        "device": device_name(device),
        "warp": wp.__version__,
        "against": "truth" if all(report.case.truth for report in reports) else "the last method where no truth is",
    }


def device_name(alias: str) -> str:
    """The device as a person would name it; for a CPU with the cores that this process may use."""
    device = wp.get_device(alias)
    if not device.is_cpu:
        return str(device.name)
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [
            line.partition(":")[2].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        model = names[0] if names else model
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return f"{model}, {cores} cores"


def print_report(report: CaseReport, console: Console) -> None:
    """The tables of one case."""
    against = "the truth" if report.case.truth else "the last method"
    table = Table(title=f"{report.case.name}: every method, FLIP against {against}")
    for column in ("setting", "method"):
        table.add_column(column)
    for column in ("ms", "rel. RMSE", "worst", "drift", "FLIP", "error"):
        table.add_column(column, justify="right")
    table.add_column("")
    for _, group in itertools.groupby(report.rows, lambda row: row.setting):
        for position, row in enumerate(group):
            error = row.stage_error
            numbers = (
                ("", "", "")
                if error is None
                else (f"{error.relative_rmse:.2%}", f"{error.worst:.2f}", f"{error.energy_drift:+.2%}")
            )
            table.add_row(
                row.setting if position == 0 else "",
                row.method,
                f"{row.milliseconds:.3f}",
                *numbers,
                f"{row.flip:.4f}",
                f"{row.error:.4f}",
                "dominated" if row.dominated else "",
                style="dim" if row.dominated else "",
            )
        table.add_section()
    if report.rows:
        console.print(table)
    table = Table(title=f"{report.case.name}: as a whole")
    table.add_column("quality")
    for column in ("ms", "over paper's", "FLIP"):
        table.add_column(column, justify="right")
    for whole in report.wholes:
        table.add_row(whole.label, f"{whole.milliseconds:.2f}", f"{whole.over_paper:.2f}", f"{whole.flip:.4f}")
    console.print(table)


def records(report: CaseReport, device: str) -> Iterator[dict[str, Any]]:
    """One plain record per method and per whole, ready for JSON lines."""
    signed = {"program": PROGRAM}  # first, as a file is known by its first key
    common = {"device": device_name(device), "warp": wp.__version__}
    for row in report.rows:
        error = {} if row.stage_error is None else dataclasses.asdict(row.stage_error)
        plain = {key: value for key, value in dataclasses.asdict(row).items() if key != "stage_error"}
        yield {**signed, "kind": "method", **plain, **error, **common}
    for whole in report.wholes:
        yield {
            **signed,
            "kind": "whole",
            "case": report.case.name,
            "quality": whole.label,
            "milliseconds": whole.milliseconds,
            "over_paper": whole.over_paper if math.isfinite(whole.over_paper) else None,
            "flip": whole.flip,
            "settings": dict(whole.settings),
            **common,
        }
