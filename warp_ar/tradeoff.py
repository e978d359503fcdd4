"""``python -m warp_ar.tradeoff [SCENE ...]`` shows what accuracy costs: errors and milliseconds of every method.

Every setting of a scene is turned through its methods, all others staying on ``high``; then presets run as a whole,
with our choices for the paper's time and for the paper's error. ``warp_ar.accuracy`` says how each is measured.

``--processor-time`` runs frames on one thread and counts what it works instead of the time by the clock: other programs
that are busy at the same time then hardly matter.
"""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.tradeoff")

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from warp_ar.accuracy import tradeoff_page
from warp_ar.accuracy.case_report import RUNS, CaseReport, measure_case, settings_of, work_units
from warp_ar.accuracy.cases import SIZED, VERSIONS, Case, open_cases
from warp_ar.accuracy.charts import require_plots
from warp_ar.accuracy.cost_table import SETTINGS, Setting
from warp_ar.accuracy.costs import WORK
from warp_ar.accuracy.progress import Advance, WorkProgress
from warp_ar.accuracy.report import MIN_COLUMNS, make_cost_table, make_preset_list, print_report, records
from warp_ar.accuracy.runs import Clock
from warp_ar.command_line import EXIT_DONE, Parser, run_command
from warp_ar.device import resolve_device
from warp_ar.errors import SceneError, SinkError, SourceError, UsageError
from warp_ar.output.own_files import OwnFiles
from warp_ar.stages.quality import PRESETS

DEFAULT_FRAMES = 12


def make_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = Parser(
        prog="python -m warp_ar.tradeoff", description="What accuracy costs: errors and milliseconds of every method."
    )
    add = parser.add_argument
    add(
        "scenes",
        nargs="*",
        metavar="SCENE",
        help="scene files or bundled scenes' names, or all for every bundled one (default: desk, or --truth)",
    )
    add("--stage", metavar="NAME", help=f"turn only this: {', '.join(setting.name for setting in SETTINGS)}")
    add("--presets", action="store_true", help="turn nothing: run whole presets only, and write presets.json")
    add(
        "--only",
        type=lambda text: text.split(","),
        metavar="A,B",
        help=f"with --presets: these instead of {','.join(RUNS)}",
    )
    add("--truth", type=Path, metavar="DIR", help="a case with pictures of the truth, or a folder of cases")
    add(
        "--versions",
        type=lambda text: text.split(","),
        default=list(VERSIONS),
        metavar="A,B",
        help=f"versions of the cases (default: {','.join(VERSIONS)})",
    )
    add("--frames", type=int, default=DEFAULT_FRAMES, metavar="N", help=f"frames per run (default: {DEFAULT_FRAMES})")
    add("--shrink", type=int, default=1, metavar="N", help="frames at an Nth of their width and height (default: 1)")
    add("--device", default="auto", metavar="auto|cpu|cuda:0", help="where the kernels run (default: auto)")
    add(
        "--quick",
        action="store_true",
        help="leave out brute force, and methods between two others: minutes instead of hours on CPU",
    )
    add("--processor-time", action="store_true", help="on CPU count the work of one thread, not the time by the clock")
    add(
        "--out",
        type=Path,
        metavar="DIR",
        help="write tradeoff.jsonl, cost_table.json and tradeoff.html here (or presets.json)",
    )
    add("--overwrite", action="store_true", help="also replace files that this program did not write")
    return parser


def check(options: argparse.Namespace) -> None:
    """Refuse options that make no sense, before anything is measured.

    Raises:
        UsageError: One makes no sense, or does not fit another.
    """
    if options.frames < 1:
        raise UsageError(f"--frames {options.frames}: expected 1 or more")
    if options.presets and options.stage is not None:
        raise UsageError(f"--presets --stage {options.stage}: expected one of both")
    if options.only is not None and not options.presets:
        raise UsageError(f"--only {','.join(options.only)}: expected --presets beside it")
    for name in options.only or ():
        if name not in PRESETS:
            raise UsageError(f"--only {name}: expected presets of {', '.join(PRESETS)}, separated by commas")
    if options.shrink < 1:
        raise UsageError(f"--shrink {options.shrink}: expected 1 or more")
    if options.stage is not None and options.stage not in {setting.name for setting in SETTINGS}:
        known = ", ".join(setting.name for setting in SETTINGS)
        raise UsageError(f"--stage {options.stage}: expected one of {known}")
    if options.out is not None and not options.presets:
        require_plots()


def chosen_settings(case: Case, options: argparse.Namespace) -> tuple[Setting, ...]:
    """Settings of a case that the options ask for."""
    if options.presets:
        return ()
    # A copy of a case whose virtual lights have a size is there for the shadows of those alone.
    name = "light_shadow" if case.name.endswith(SIZED) else options.stage
    if options.stage not in (None, name):
        return ()
    return tuple(setting for setting in settings_of(case) if name in (None, setting.name))


Asked = Sequence[tuple[Case, tuple[Setting, ...]]]
"""Cases, and what is turned in each."""


def asked_cases(options: argparse.Namespace, console: Console) -> Asked:
    """Every case that the options ask for.

    Raises:
        UsageError: There is nothing to turn in any.
    """
    asked: list[tuple[Case, tuple[Setting, ...]]] = []
    for case in open_cases(options.scenes, options.truth, options.frames, options.shrink, options.versions):
        settings = chosen_settings(case, options)
        if settings or (options.presets and not case.name.endswith(SIZED)):
            asked.append((case, settings))
        else:
            console.print(f"{case.name}: nothing to turn", highlight=False)
    if not asked:
        raise UsageError("nothing to turn in any scene that was named")
    return asked


def units_of(options: argparse.Namespace, asked: Asked) -> float:
    """Units of all work: of measuring, and of figures and the page where they are written."""
    units = sum(work_units(case, settings, quick=options.quick, presets=options.only) for case, settings in asked)
    if options.out is None or options.presets:
        return units
    return units + tradeoff_page.page_units(len(settings) for _, settings in asked)


def measure(
    options: argparse.Namespace, asked: Asked, device: str, clock: Clock, console: Console, advance: Advance
) -> list[CaseReport]:
    """Measure every case, and print its tables."""
    reports = []
    for case, settings in asked:
        report = measure_case(case, device, settings, advance, quick=options.quick, clock=clock, presets=options.only)
        reports.append(report)
        print_report(reports[-1], console)
    return reports


def open_out(options: argparse.Namespace) -> OwnFiles:
    """The folder that is written to, looked at before anything is measured."""
    names = ("tradeoff.jsonl", *(("presets.json",) if options.presets else ("cost_table.json", "tradeoff.html")))
    return OwnFiles(options.out, names, overwrite=options.overwrite)


def write(
    options: argparse.Namespace,
    out: OwnFiles,
    device: str,
    reports: Sequence[CaseReport],
    advance: Advance,
) -> None:
    """Write what was measured: JSON lines, the cost table and the page, or the list of presets."""
    lines = (json.dumps(record) for report in reports for record in records(report, device))
    out.write("tradeoff.jsonl", "\n".join(lines) + "\n")
    if options.presets:
        out.write("presets.json", json.dumps(make_preset_list(reports, device), indent=1) + "\n")
        return
    table = make_cost_table(reports, device)
    out.write("cost_table.json", json.dumps(table, indent=1) + "\n")
    made = table["made"] | {"clock": "processor time" if options.processor_time else "time"}
    out.write("tradeoff.html", tradeoff_page.render(reports, made, advance))


def tradeoff(options: argparse.Namespace) -> int:
    """Measure, print and write.

    Raises:
        UsageError: Options make no sense, or the device is not there.
    """
    check(options)
    device = resolve_device(options.device)
    if options.processor_time and not device.is_cpu:
        raise UsageError(f"--processor-time counts a processor's work; it says nothing of {device}")
    clock: Clock = WORK if options.processor_time else time.perf_counter
    console = Console()
    console.width = max(console.width, MIN_COLUMNS)
    out = None if options.out is None else open_out(options)
    asked = asked_cases(options, console)
    with WorkProgress(console, units_of(options, asked)) as progress:
        reports = measure(options, asked, str(device), clock, console, progress.advance)
        for setting, methods in make_cost_table(reports, str(device))["dominated"].items():
            console.print(f"dominated in every case: {setting} {', '.join(methods)}", highlight=False)
        if out is not None:
            write(options, out, str(device), reports, progress.advance)
            console.print(f"written to {options.out}", highlight=False)
    return EXIT_DONE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code: 0 done, 1 failed while running, 2 bad usage or scene."""
    failures = (SceneError, SourceError, SinkError)
    return run_command(lambda: tradeoff(make_parser().parse_args(arguments)), failures)
