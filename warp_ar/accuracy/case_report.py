"""All that is measured of a case: every setting's methods, whole presets, equal time and equal error.

Presets, and the best choices for the paper's time and for the paper's error, run frame by frame in turn. Those choices
are made from the committed cost table, not from the errors of the case that they are scored on, and a choice in the
paper's time must be measured to take no more of it.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import statistics
import time
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from warp_ar.accuracy.cases import SIZED, Case, Image
from warp_ar.accuracy.cost_table import (
    Choice,
    Setting,
    choose,
    chosen,
    light_only,
    load_errors,
    pareto_front,
    relevant_settings,
    turn,
)
from warp_ar.accuracy.costs import BASE as COST_BASE
from warp_ar.accuracy.costs import MEASURED_FRAMES, finish_steps, make_method_costs, measure_steps
from warp_ar.accuracy.progress import Advance, ignore
from warp_ar.accuracy.runs import TIMED, Clock, LightBefore, run, run_in_turn
from warp_ar.accuracy.sweep import BRUTE_FORCE_UNITS, Row, picture_error, region_of, run_units, sweep
from warp_ar.stages.quality import PRESETS, Quality

TRIES, QUICK_TRIES = 6, 4
"""Runs at most to find what fits a budget or an error; where time matters."""
QUICK_TIMED, QUICK_COST_FRAMES = 3, 3
"""Frames run at a method, the first of them not timed, and frames that tell a method's cost, where time matters."""
FITS = 0.0
"""By how much more than the paper's a measured time may be, as a share: nothing, so what runs in its time does."""
COST_UNITS = 20.0
"""Units of work of measuring costs."""
SAME_TIME, SAME_ERROR = "ours near the paper's time", "ours near the paper's error"
"""Labels of choices that are looked for; what they are found to take and to err is measured with the presets."""
RUNS = ("paper", "low", "medium", "high")
"""Presets that are run as a whole."""


@dataclasses.dataclass(frozen=True)
class Whole:
    """A preset or a choice, run as a whole."""

    label: str
    milliseconds: float
    """Mean per frame, tracking left out."""
    flip: float
    settings: Mapping[str, str]
    images: Mapping[int, Image]
    over_paper: float = math.nan
    """Median ratio of its frames' times to the paper preset's, paired."""


@dataclasses.dataclass(frozen=True)
class CaseReport:
    """All that is known of a case."""

    case: Case
    reference: Mapping[int, Image]
    """Pictures that others are compared with: the truth, or the best there is."""
    rows: tuple[Row, ...]
    pictures: Mapping[tuple[str, str], Image]
    """The last picture of every method."""
    wholes: tuple[Whole, ...]
    region: npt.NDArray[np.bool_]
    """Pixels of the last picture that anything virtual changes."""


def is_complete(case: Case, settings: Sequence[Setting]) -> bool:
    """Return whether everything that a case can turn is turned: only then are equal time and equal error looked for."""
    return {setting.name for setting in settings_of(case)} == {setting.name for setting in settings}


def settings_of(case: Case) -> tuple[Setting, ...]:
    """Settings that change what a case shows or costs."""
    return relevant_settings(case.scene, (case.scene.camera.width, case.scene.camera.height))


def work_units(
    case: Case, settings: Sequence[Setting], *, quick: bool = False, presets: Sequence[str] | None = None
) -> float:
    """Units of work that ``measure_case`` will report as done: runs of the case's frames, at most."""
    methods = [setting.measured if quick else setting.methods for setting in settings]
    units = sum(run_units(method) for own in methods for method in own)
    if case.name.endswith(SIZED):
        return units
    units += len(presets or RUNS) + (0.0 if case.truth else BRUTE_FORCE_UNITS)
    tries = QUICK_TRIES if quick else TRIES
    return units + (COST_UNITS + 3.0 * (tries + 1) if is_complete(case, settings) else 0.0)


def measure_case(
    case: Case,
    device: str,
    settings: Sequence[Setting],
    advance: Advance = ignore,
    *,
    quick: bool = False,
    clock: Clock = time.perf_counter,
    presets: Sequence[str] | None = None,
) -> CaseReport:
    """Sweep every setting, then run presets and the best choices.

    Args:
        case: Frames, and their truth if it is known.
        device: Where.
        settings: What to turn.
        advance: Told of what is done, ``work_units`` in all.
        quick: Leave brute force out, and what lies between two other methods; time fewer frames, and search less.
        clock: Seconds, on CPU.
        presets: Those to run as a whole; None means ``RUNS``.
    """
    rows: list[Row] = []
    pictures: dict[tuple[str, str], Image] = {}
    with LightBefore() as before:
        for setting in settings:
            own, shown = sweep(
                case,
                setting,
                device,
                methods=setting.measured if quick else setting.methods,
                timed=QUICK_TIMED if quick else TIMED,
                clock=clock,
                advance=advance,
                before=before,
            )
            rows += own
            pictures.update({(setting.name, method): image for method, image in shown.items()})
    if case.name.endswith(SIZED):
        last = pictures[settings[-1].name, rows[-1].method]
        region = region_of(case, case.shown[-1], last)
        return CaseReport(case, {case.shown[-1]: last}, tuple(rows), pictures, (), region)
    reference = case.truth or _best_images(case, device, advance, quick=quick)
    qualities = {name: PRESETS[name] for name in presets or RUNS}
    if is_complete(case, settings) and "paper" in qualities:
        qualities |= _find_equals(case, device, settings, rows, reference, clock, advance, quick=quick)
    wholes = _run_wholes(case, qualities, reference, device, clock)
    advance(f"{case.name}: presets", len(presets or RUNS))
    index = case.shown[-1]
    return CaseReport(case, reference, tuple(rows), pictures, wholes, region_of(case, index, reference[index]))


def _run_wholes(
    case: Case, qualities: Mapping[str, Quality], reference: Mapping[int, Image], device: str, clock: Clock
) -> tuple[Whole, ...]:
    """Cost and error of whole pictures by several qualities, whose frames are run in turn."""
    times, images = run_in_turn(case, qualities, device, clock)
    return tuple(
        Whole(
            label,
            statistics.fmean(times[label]),
            picture_error(case, reference, images[label]),
            {setting.name: chosen(quality, setting) for setting in settings_of(case)},
            images[label],
            statistics.median(a / b for a, b in zip(times[label], times["paper"], strict=True))
            if "paper" in times
            else math.nan,
        )
        for label, quality in qualities.items()
    )


def _best_images(case: Case, device: str, advance: Advance, *, quick: bool) -> Mapping[int, Image]:
    """Pictures of a case without truth at the preset ``reference``, less what takes longest where time matters."""
    quality = PRESETS["reference"] if not quick else turn(PRESETS["reference"], {"environment_shadow": "bounce"})
    images = run(case, quality, device, between=light_only(quality), timed=1).images
    advance(f"{case.name}: reference", BRUTE_FORCE_UNITS)
    return images


def _find_equals(
    case: Case,
    device: str,
    settings: Sequence[Setting],
    rows: Sequence[Row],
    reference: Mapping[int, Image],
    clock: Clock,
    advance: Advance,
    *,
    quick: bool,
) -> dict[str, Quality]:
    """Our choices in the paper's time and at its error, as ``--quality auto`` chooses: costs measured, errors known."""
    frame, size = case.frames[-1], (case.scene.camera.width, case.scene.camera.height)
    count, tries = (QUICK_COST_FRAMES, QUICK_TRIES) if quick else (MEASURED_FRAMES, TRIES)
    steps = measure_steps(case.scene, frame.image, case.poses[-1], device, size, settings, clock, frames=count)
    costs = finish_steps(steps, lambda share: advance(f"{case.name}: costs", share * COST_UNITS))
    front = pareto_front(make_method_costs(costs, listed_errors(rows)), costs.scales)
    same_time = _find_same_time(case, front, costs.base - costs.track, device, clock, advance, tries)
    same_error = _find_same_error(case, front, device, reference, advance, tries)
    return {SAME_TIME: same_time, SAME_ERROR: same_error}


def listed_errors(rows: Sequence[Row]) -> Mapping[str, Mapping[str, float]]:
    """Errors by setting and method, from the committed cost table; while that is empty, as measured here."""
    listed = load_errors()
    if any(any(own.values()) for own in listed.values()):
        return listed
    return {
        setting: {row.method: row.error for row in own}
        for setting, own in itertools.groupby(rows, lambda row: row.setting)
    }


def _find_same_time(
    case: Case, front: Sequence[Choice], base_ms: float, device: str, clock: Clock, advance: Advance, tries: int
) -> Quality:
    """Least error by the list of what is measured, in turn with the paper's preset, to take no more than that.

    A choice fits if its median time over the paper's, frame by frame, is at most ``1 + FITS``: the same ratio is
    measured again when all presets run in turn, and is what the report states.
    """
    units = 0

    def fits(choice: Choice) -> tuple[bool, float]:
        nonlocal units
        qualities = {"paper": PRESETS["paper"], "ours": _chosen(choice)}
        times, _ = run_in_turn(case, qualities, device, clock)
        advance(f"{case.name}: equal time", 2.0)
        units += 2
        ratio = statistics.median(a / b for a, b in zip(times["ours"], times["paper"], strict=True))
        return ratio <= 1.0 + FITS, statistics.fmean(times["paper"])

    paper = fits(front[0])[1]
    place = front.index(choose(front, paper - base_ms))
    low, high = 0, len(front)
    for _ in range(tries):
        if fits(front[place])[0]:
            low = place
        else:
            high = place
        if high - low <= 1:
            break
        place = min(low + 2, high - 1) if high == len(front) else (low + high) // 2
    advance(f"{case.name}: equal time", 2.0 * (tries + 1) - units)
    return _chosen(front[low])


def _find_same_error(
    case: Case, front: Sequence[Choice], device: str, reference: Mapping[int, Image], advance: Advance, tries: int
) -> Quality:
    """Cheapest by the list of what is measured to err no more than the paper's preset: only the list orders."""
    units = 0

    def error(quality: Quality, before: LightBefore) -> float:
        nonlocal units
        images = run(case, quality, device, between=light_only(quality), timed=1, before=before).images
        advance(f"{case.name}: equal error", 1.0)
        units += 1
        return picture_error(case, reference, images)

    low, high = -1, len(front) - 1
    with LightBefore() as before:
        aim = error(PRESETS["paper"], before)
        for _ in range(tries):
            if high - low <= 1:
                break
            middle = (low + high) // 2
            if error(_chosen(front[middle]), before) <= aim:
                high = middle
            else:
                low = middle
    advance(f"{case.name}: equal error", tries + 1.0 - units)
    return _chosen(front[high])


def _chosen(choice: Choice) -> Quality:
    return turn(COST_BASE, dict(choice.settings))
