"""Reports of measured cases: tables in a terminal, JSON lines and the cost table."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import os
import platform
import statistics
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import warp as wp
from rich.console import Console
from rich.table import Table

from warp_ar.accuracy.cost_table import SETTINGS
from warp_ar.accuracy.measure import BASE, CaseReport
from warp_ar.device import usable_cores
from warp_ar.signature import PROGRAM
from warp_ar.stages.quality import PRESETS

MIN_COLUMNS = 110
"""Smallest width of tables in characters if there is no terminal, so that no table is cut off."""


def make_cost_table(reports: Sequence[CaseReport], device: str) -> dict[str, Any]:
    """Return the cost table: error and cost of every method, and the methods that are dominated in every case.

    ``errors`` (FLIP per changed pixel, in excess of the best method) and ``milliseconds`` are averaged over the cases
    in which the setting matters. Errors on different devices differ by rounding only; times are those on this device.
    """
    tables: dict[str, dict[str, Any]] = {"errors": {}, "milliseconds": {}, "dominated": {}}
    for setting in SETTINGS:
        rows = [row for report in reports for row in report.rows if row.setting == setting.name]
        by_method = {method: [row for row in rows if row.method == method] for method in setting.methods}
        by_method = {method: own for method, own in by_method.items() if own}
        if not by_method:
            continue
        means = {method: statistics.fmean(row.error for row in own) for method, own in by_method.items()}
        best = min(means.values())
        tables["errors"][setting.name] = {method: round(mean - best, 5) for method, mean in means.items()}
        tables["milliseconds"][setting.name] = {
            method: round(statistics.fmean(row.milliseconds for row in own), 3) for method, own in by_method.items()
        }
        beaten = [method for method, own in by_method.items() if all(row.dominated for row in own)]
        tables["dominated"] |= {setting.name: beaten} if beaten else {}
    made = _made(reports, device) | {"base": BASE.name}
    return {"program": PROGRAM, "made": made, "presets": _presets(reports), **tables}


def make_preset_list(reports: Sequence[CaseReport], device: str) -> dict[str, Any]:
    """Return a table with error and milliseconds of whole frames at every preset, by case."""
    return {"program": PROGRAM, "made": _made(reports, device), "presets": _presets(reports)}


def _presets(reports: Sequence[CaseReport]) -> dict[str, dict[str, dict[str, float]]]:
    return {
        report.case.name: {
            whole.label: {"error": round(whole.flip, 4), "ms": round(whole.milliseconds, 2)}
            for whole in report.wholes
            if whole.label in PRESETS
        }
        for report in reports
        if report.wholes
    }


def _made(reports: Sequence[CaseReport], device: str) -> dict[str, Any]:
    """Return the conditions under which a table was made."""
    return {
        "by": f"python -m warp_ar.tradeoff {' '.join(dict.fromkeys(report.case.name for report in reports))}",
        "device": device_name(device),
        "warp": wp.__version__,
        "commit": commit(),
        "against": "truth" if all(report.case.truth for report in reports) else "the last method where no truth is",
    }


@functools.cache
def commit() -> str:
    """Return the short hash of the checkout, with a + for uncommitted changes; ``unknown`` outside a checkout.

    The environment variable ``WARP_AR_COMMIT``, if set, replaces it, for copies without history.
    """
    if "WARP_AR_COMMIT" in os.environ:
        return os.environ["WARP_AR_COMMIT"]
    command = ["git", "describe", "--always", "--dirty=+"]
    try:
        out = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return out.stdout.strip()


def device_name(alias: str) -> str:
    """Return the full name of a device; for a CPU with the number of cores that this process may use."""
    device = wp.get_device(alias)
    if not device.is_cpu:
        return str(device.name)
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        lines = info.read_text().splitlines()
        model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), model)
    return f"{model}, {usable_cores()} cores"


def print_report(report: CaseReport, console: Console) -> None:
    """Print the tables of one case."""
    against = "the truth" if report.case.truth else "the last method"
    rows = []
    for _, group in itertools.groupby(report.rows, lambda row: row.setting):
        for position, row in enumerate(group):
            numbers = f"{row.milliseconds:.3f}", f"{row.flip:.4f}", f"{row.error:.4f}"
            rows.append(("" if position else row.setting, row.method, *numbers, "dominated" if row.dominated else ""))
    if rows:
        head = ("setting", "method", "ms more", "FLIP", "error", "")
        print_table(console, f"{report.case.name}: every method, FLIP against {against}", head, rows, left=2)
    wholes = [
        (whole.label, f"{whole.milliseconds:.2f}", f"{whole.over_paper:.2f}", f"{whole.flip:.4f}")
        for whole in report.wholes
    ]
    if wholes:
        print_table(console, f"{report.case.name}: as a whole", ("quality", "ms", "over paper's", "FLIP"), wholes)


def print_table(
    console: Console, title: str, head: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1
) -> None:
    """Print a table whose first ``left`` columns are words."""
    table = Table(title=title)
    for index, column in enumerate(head):
        table.add_column(column, justify="left" if index < left else "right")
    for row in rows:
        table.add_row(*row)
    console.print(table)


def records(report: CaseReport, device: str) -> Iterator[dict[str, Any]]:
    """Yield one record per method and per whole preset, for JSON lines."""
    signed = {"program": PROGRAM}  # comes first, because files are recognised by their first key
    common = {"device": device_name(device), "warp": wp.__version__}
    for row in report.rows:
        yield {**signed, "kind": "method", **dataclasses.asdict(row), **common}
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
