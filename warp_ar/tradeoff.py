"""``python -m warp_ar.tradeoff [SCENE ...]``: measures error and time in milliseconds of every method.

Each setting of a scene is varied through its methods while all others stay at ``high``. Then whole presets are
measured, and our choices for the paper's time and for the paper's error. See ``warp_ar.accuracy.measure``.
"""

from __future__ import annotations

if __name__ == "__main__":
    from warp_ar.begin import begin

    begin("warp_ar.tradeoff")

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import Progress, TimeElapsedColumn

from warp_ar.accuracy import tradeoff_page
from warp_ar.accuracy.cases import SIZED, VERSIONS, Case, open_cases, smaller
from warp_ar.accuracy.charts import require_plots
from warp_ar.accuracy.cost_table import SETTINGS, Setting
from warp_ar.accuracy.measure import RUNS, CaseReport, Tell, measure_methods, measure_presets, settings_of
from warp_ar.accuracy.report import MIN_COLUMNS, make_cost_table, make_preset_list, print_report, records
from warp_ar.command_line import EXIT_DONE, Parser, count, run_command
from warp_ar.device import resolve_device
from warp_ar.errors import SceneError, SinkError, SourceError, UsageError
from warp_ar.files import store
from warp_ar.output.places import claim_places
from warp_ar.stages.quality import PRESETS

DEFAULT_FRAMES = 999
SETTLED = 24
"""Frames within which the light settles; shorter runs measure the errors at a recording's start."""
METHODS_SHRINK = 2
"""Factor by which frames are reduced where methods are measured, among them exact ones that take minutes a frame."""


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command's options."""
    parser = Parser(
        prog="python -m warp_ar.tradeoff",
        description="Measure accuracy and cost: errors and milliseconds of every method.",
    )
    add = parser.add_argument
    text = "scenes; all: all bundled ones (default: desk, or --truth's)"
    add("scenes", nargs="*", metavar="SCENE", help=text)
    add("--stage", metavar="NAME", help="change only this setting, such as recover")
    add("--presets", action="store_true", help="run whole presets only, into presets.json")
    add("--only", type=_words, metavar="A,B", help=f"with --presets: presets to run (default: {','.join(RUNS)})")
    add("--truth", type=Path, metavar="DIR", help="a case with true pictures, or a folder of cases")
    text = f"versions of the cases (default: {','.join(VERSIONS)})"
    add("--versions", type=_words, default=list(VERSIONS), metavar="A,B", help=text)
    add(
        "--frames",
        type=count,
        default=DEFAULT_FRAMES,
        metavar="N",
        help=f"most frames of a clip (default: {DEFAULT_FRAMES})",
    )
    parser.add_common("--shrink", "--device")
    add("--quick", action="store_true", help="without brute force, in less time")
    add("--processor-time", action="store_true", help="on CPU measure all threads' processor time, not clock time")
    text = "folder of tradeoff.jsonl, cost_table.json, tradeoff.html (or presets.json)"
    add("--out", type=Path, metavar="DIR", help=text)
    parser.add_common("--overwrite")
    return parser


def _words(text: str) -> list[str]:
    return text.split(",")


def check(options: argparse.Namespace) -> None:
    """Check the options before anything is measured.

    Raises:
        UsageError: An option has an impossible value, or does not fit another.
    """
    if options.presets and options.stage is not None:
        raise UsageError(f"--presets --stage {options.stage}: expected one of both")
    if options.only is not None and not options.presets:
        raise UsageError(f"--only {','.join(options.only)}: needs --presets")
    for name in options.only or ():
        if name not in PRESETS:
            raise UsageError(f"--only {name}: expected presets of {', '.join(PRESETS)}, separated by commas")
    if options.stage is not None and options.stage not in {setting.name for setting in SETTINGS}:
        known = ", ".join(setting.name for setting in SETTINGS)
        raise UsageError(f"--stage {options.stage}: expected one of {known}")
    if options.out is not None and not options.presets:
        require_plots()


def chosen_settings(case: Case, options: argparse.Namespace) -> tuple[Setting, ...]:
    """Return the settings of a case that the options select."""
    if options.presets:
        return ()
    # The copy of a case with area lights serves to measure their shadows only.
    name = "light_shadow" if case.name.endswith(SIZED) else options.stage
    if options.stage not in (None, name):
        return ()
    return tuple(setting for setting in settings_of(case) if name in (None, setting.name))


def asked_cases(options: argparse.Namespace, console: Console) -> list[tuple[Case, tuple[Setting, ...]]]:
    """Return each case that the options select, with the settings to vary in it.

    Raises:
        UsageError: No case has a setting to vary.
    """
    asked: list[tuple[Case, tuple[Setting, ...]]] = []
    for case in open_cases(options.scenes, options.truth, options.frames, options.shrink, options.versions):
        settings = chosen_settings(case, options)
        if settings or (options.presets and not case.name.endswith(SIZED)):
            asked.append((case, settings))
        else:
            console.print(f"{case.name}: no setting to vary", highlight=False)
    if not asked:
        raise UsageError("no scene has a setting to vary")
    return asked


def measure(
    case: Case, settings: Sequence[Setting], device: str, tell: Tell, options: argparse.Namespace
) -> Iterator[CaseReport]:
    """Yield the report of a case's methods, if any are asked for, then that of its presets."""
    qualities = {name: PRESETS[name] for name in options.only or RUNS}
    if settings:
        reduced = smaller(case, METHODS_SHRINK)
        report, choices = measure_methods(reduced, device, settings, tell, quick=options.quick)
        qualities |= choices
        yield report
    if not case.name.endswith(SIZED):
        clock = time.process_time if options.processor_time else time.perf_counter
        yield measure_presets(case, device, qualities, tell, quick=options.quick, clock=clock)


def tradeoff(options: argparse.Namespace) -> int:
    """Measure, print and write the results.

    Raises:
        UsageError: An option has an impossible value, or the device does not exist.
    """
    check(options)
    device = resolve_device(options.device)
    if options.processor_time and not device.is_cpu:
        raise UsageError(f"--processor-time measures the CPU's time; it does not apply to {device}")
    console = Console()
    console.width = max(console.width, MIN_COLUMNS)
    names = ("tradeoff.jsonl", *(("presets.json",) if options.presets else ("cost_table.json", "tradeoff.html")))
    out: Path | None = options.out
    if out is not None:
        claim_places({}, {f"--out, {name}": out / name for name in names}, overwrite=options.overwrite)
    asked = asked_cases(options, console)
    if options.frames < SETTLED:
        console.print(
            f"after {options.frames} frames the light has not settled: better give --frames {SETTLED} or more"
        )
    reports = []
    with Progress(*Progress.get_default_columns(), TimeElapsedColumn(), console=console) as progress:
        task = progress.add_task("", total=len(asked))

        def tell(text: str) -> None:
            progress.update(task, description=text)
            if not console.is_terminal:
                console.print(text, highlight=False)

        for case, settings in asked:
            for report in measure(case, settings, str(device), tell, options):
                reports.append(report)
                print_report(report, console)
            progress.advance(task)
    table = make_cost_table(reports, str(device))
    for setting, methods in table["dominated"].items():
        console.print(f"dominated in every case: {setting} {', '.join(methods)}", highlight=False)
    if out is None:
        return EXIT_DONE
    lines = (json.dumps(record) for report in reports for record in records(report, str(device)))
    store(out / "tradeoff.jsonl", ("\n".join(lines) + "\n").encode())
    if options.presets:
        store(out / "presets.json", (json.dumps(make_preset_list(reports, str(device)), indent=1) + "\n").encode())
    else:
        store(out / "cost_table.json", (json.dumps(table, indent=1) + "\n").encode())
        made = table["made"] | {"clock": "processor time" if options.processor_time else "time"}
        store(out / "tradeoff.html", tradeoff_page.render(reports, made).encode())
    console.print(f"written to {out}", highlight=False)
    return EXIT_DONE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code: 0 done, 1 failed while running, 2 bad usage or scene."""
    failures = (SceneError, SourceError, SinkError)
    return run_command(lambda: tradeoff(make_parser().parse_args(arguments)), failures)
