"""Measurement of cases: all methods of all settings, presets, and our choices at the paper's time and at its error.

**Error of a method.** If all methods approximate the last one's result (``converges``), it is the distance from that
result: a method that is closer to the truth than the exact solution is so by chance, because another stage is
inaccurate. If methods are different models, it is the distance from the truth minus that of the best method. Distances
are FLIP, summed over the picture and divided by the number of pixels that virtual content changes, so that the errors
of all settings have one scale.

**Cost of a method** is the time of its stages in excess of the setting's cheapest method, measured as by ``--quality
auto``. Presets, and the choices of the cost table at the paper's time and error, are timed as whole frames, one frame
of each in turn. Choices are based on the committed errors, not on the errors of the measured case.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence

from warp_ar.accuracy.cases import SIZED, Case, Image, Mask
from warp_ar.accuracy.cost_table import (
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
from warp_ar.accuracy.costs import Costs, make_method_costs, measure_costs
from warp_ar.accuracy.metrics import changed_region, flip_map
from warp_ar.engine.pipeline import Pipeline
from warp_ar.stages.quality import PRESETS, Quality

Clock = Callable[[], float]
Tell = Callable[[str], object]
"""Function that receives a description of each finished step."""
BASE = PRESETS["high"]
"""Preset of all settings except the varied one."""
WARM_UP = 3
"""Frames of a run that are not timed, because modules are loaded and caches filled."""
RUNS = ("paper", "low", "medium", "high")
"""Presets to measure as a whole."""
SAME_TIME, SAME_ERROR = "ours near the paper's time", "ours near the paper's error"
"""Names of the choices of the cost table; their time and error are measured together with the presets'."""
COST_NOISE, FLIP_NOISE = 0.03, 2e-4
"""Measurement noise: relative for costs, in FLIP for pictures."""
_FAIR: Mapping[str, Mapping[str, str]] = {
    "unwrap": {"environment_height": "32"},
    "environment_height": {"environment_shadow": "none", "recover": "white_card"},
}
"""Other methods with which a setting is measured. Footprints on the ball matter only with coarse texels. For the map's
size, few random rays and the division of its energy among emitters would hide its own effect."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One method of one setting in one case."""

    case: str
    setting: str
    method: str
    milliseconds: float
    """Milliseconds per frame in excess of the setting's cheapest method."""
    flip: float
    """Mean FLIP of the picture per changed pixel."""
    against: str
    """Reference of ``flip``: ``truth`` or ``last method``."""
    error: float = 0.0
    """Error as the module's docstring defines it."""
    dominated: bool = False
    """True if another method costs no more and has no larger error."""


@dataclasses.dataclass(frozen=True)
class Whole:
    """A preset or a choice, measured as a whole."""

    label: str
    milliseconds: float
    """Median time per frame, without tracking."""
    flip: float
    settings: Mapping[str, str]
    images: Mapping[int, Image]
    over_paper: float = math.nan
    """Median ratio of its frame times to the paired ones of the preset ``paper``."""


@dataclasses.dataclass(frozen=True)
class CaseReport:
    """Measurements of a case."""

    case: Case
    reference: Mapping[int, Image]
    """Reference pictures: the truth, or the most accurate result."""
    rows: tuple[Row, ...]
    pictures: Mapping[tuple[str, str], Image]
    """Last picture of every method."""
    wholes: tuple[Whole, ...]
    region: Mask
    """Pixels of the last picture that virtual content changes."""


def settings_of(case: Case) -> tuple[Setting, ...]:
    """Return the settings that change the picture of a case, or its cost."""
    return relevant_settings(case.scene, (case.scene.camera.width, case.scene.camera.height))


def measure_case(
    case: Case,
    device: str,
    settings: Sequence[Setting],
    tell: Tell = lambda text: None,
    *,
    quick: bool = False,
    clock: Clock | None = None,
    presets: Sequence[str] = RUNS,
) -> CaseReport:
    """Measure every setting of a case, then presets and the best choices.

    Args:
        case: Frames, with their truth if it is known.
        device: ``cpu`` or ``cuda:N``.
        settings: Settings to vary.
        tell: Receives a description of each finished step.
        quick: Whether to leave out brute force.
        clock: Clock in seconds for whole frames; None: elapsed time.
        presets: Presets to measure as a whole.
    """
    rows: list[Row] = []
    pictures: dict[tuple[str, str], Image] = {}
    costs = Costs(0.0, {})
    if settings:
        size = case.scene.camera.width, case.scene.camera.height
        at = case.frames[-1].image, case.poses[-1]
        costs = measure_costs(case.scene, *at, device, size, settings, all_methods=not quick)
        tell(f"{case.name}: costs")
    for setting in settings:
        own, shown = sweep(case, setting, device, costs, methods=setting.measured if quick else setting.methods)
        rows += own
        pictures.update({(setting.name, method): image for method, image in shown.items()})
        tell(f"{case.name}: {setting.name}")
    index = case.shown[-1]
    if case.name.endswith(SIZED):
        last = pictures[settings[-1].name, rows[-1].method]
        return CaseReport(case, {index: last}, tuple(rows), pictures, (), region_of(case, index, last))
    reference = case.truth
    if not reference:
        best = turn(PRESETS["reference"], {"environment_shadow": "bounce"}) if quick else PRESETS["reference"]
        reference = run(case, best, device)
        tell(f"{case.name}: reference")
    qualities = {name: PRESETS[name] for name in presets}
    if "paper" in qualities and {setting.name for setting in settings} == {one.name for one in settings_of(case)}:
        qualities |= _equals(costs, settings)
    wholes = _run_wholes(case, qualities, reference, device, clock or time.perf_counter)
    tell(f"{case.name}: presets")
    return CaseReport(case, reference, tuple(rows), pictures, wholes, region_of(case, index, reference[index]))


def run(
    case: Case, quality: Quality, device: str, keep: Callable[[Pipeline], object] | None = None
) -> dict[int, Image]:
    """Light a case's frames and return the compared pictures; other frames use cheap methods that keep the light.

    Args:
        case: Frames, with the indices of the compared ones.
        quality: Quality of the compared pictures.
        device: ``cpu`` or ``cuda:N``.
        keep: Called with the pipeline that made the last picture.
    """
    images: dict[int, Image] = {}
    with (
        Pipeline(case.scene, device=device, quality=quality) as pipeline,
        Pipeline(case.scene, device=device, quality=light_only(quality)) as cheap,
    ):
        last: Pipeline | None = None
        for index, (frame, pose) in enumerate(zip(case.frames, case.poses, strict=True)):
            now = pipeline if index in case.shown else cheap
            if last not in (None, now):
                now.continue_from(last)
            last = now
            result = now(frame.image, time_seconds=frame.time, pose=pose)
            if index in case.shown:
                images[index] = result.image
        if keep is not None:
            keep(pipeline)
    return images


def run_in_turn(
    case: Case, qualities: Mapping[str, Quality], device: str, clock: Clock
) -> tuple[dict[str, list[float]], dict[str, dict[int, Image]]]:
    """Light frames with several qualities in turn, so that disturbances affect all alike.

    Returns:
        Milliseconds of whole frames after the first ``WARM_UP`` (until the picture is on the host, without tracking),
        and the compared pictures; by label.
    """
    times: dict[str, list[float]] = {label: [] for label in qualities}
    images: dict[str, dict[int, Image]] = {label: {} for label in qualities}
    with contextlib.ExitStack() as stack:
        pipelines = {
            label: stack.enter_context(Pipeline(case.scene, device=device, quality=quality))
            for label, quality in qualities.items()
        }
        for index, (frame, pose) in enumerate(zip(case.frames, case.poses, strict=True)):
            for label, pipeline in pipelines.items():
                begun = clock()
                image = pipeline(frame.image, time_seconds=frame.time, pose=pose).image
                if index >= min(WARM_UP, len(case.frames) - 1):
                    times[label].append((clock() - begun) * 1e3)
                if index in case.shown:
                    images[label][index] = image
    return times, images


def _run_wholes(
    case: Case, qualities: Mapping[str, Quality], reference: Mapping[int, Image], device: str, clock: Clock
) -> tuple[Whole, ...]:
    """Return cost and error of whole frames at several qualities."""
    times, images = run_in_turn(case, qualities, device, clock)
    return tuple(
        Whole(
            label,
            statistics.median(times[label]),
            picture_error(case, reference, images[label]),
            {setting.name: chosen(quality, setting) for setting in settings_of(case)},
            images[label],
            statistics.median(a / b for a, b in zip(times[label], times["paper"], strict=True))
            if "paper" in times
            else math.nan,
        )
        for label, quality in qualities.items()
    )


def _equals(costs: Costs, settings: Sequence[Setting]) -> dict[str, Quality]:
    """Return our choices at the paper's time and at its error, chosen as by ``--quality auto``."""
    errors = load_errors()
    front = pareto_front(make_method_costs(costs, errors))
    paper = {setting.name: chosen(PRESETS["paper"], setting) for setting in settings}
    most = sum(errors[name][method] for name, method in paper.items())
    same_error = next((choice for choice in front if choice.error <= most), front[-1])
    found = {SAME_TIME: choose(front, costs.excess(paper)), SAME_ERROR: same_error}
    return {label: turn(COST_BASE, dict(choice.settings)) for label, choice in found.items()}


def sweep(
    case: Case, setting: Setting, device: str, costs: Costs, *, base: Quality = BASE, methods: Sequence[str] = ()
) -> tuple[list[Row], dict[str, Image]]:
    """Measure every method of one setting; return a row and the last picture of each.

    Args:
        case: Frames, with their truth if it is known.
        setting: Setting to vary.
        device: ``cpu`` or ``cuda:N``.
        costs: Measured costs of the methods.
        base: Quality of all other settings.
        methods: Methods to measure, in the setting's order; empty means all.
    """
    qualities = {
        method: turn(base, {**_FAIR.get(setting.name, {}), setting.name: method})
        for method in methods or setting.methods
    }
    images = {method: run(case, quality, device) for method, quality in qualities.items()}
    last = list(images.values())[-1]
    reference = case.truth or last
    times = costs.methods[setting.name]
    errors = {method: picture_error(case, reference, own) for method, own in images.items()}
    counted = {method: error - min(errors.values()) for method, error in errors.items()}
    if setting.converges or not case.truth:
        counted = {method: picture_error(case, reference, own, last) for method, own in images.items()}
    against = "truth" if case.truth else "last method"
    rows = [
        Row(case.name, setting.name, method, times[method] - min(times.values()), errors[method], against, error)
        for method, error in counted.items()
    ]
    rows = [dataclasses.replace(row, dominated=is_dominated(row, rows)) for row in rows]
    return rows, {method: own[case.shown[-1]] for method, own in images.items()}


def is_dominated(row: Row, rows: Sequence[Row]) -> bool:
    """Return True if another method costs no more and has no larger error.

    Differences within the measurement noise count as equal; of equal methods the first is not dominated.
    """

    def better(a: Row, b: Row) -> bool:
        cheaper = a.milliseconds < (1.0 - COST_NOISE) * b.milliseconds
        return cheaper or a.error < b.error - FLIP_NOISE

    place = list(rows).index(row)
    return any(
        not better(row, other) and (better(other, row) or index < place)
        for index, other in enumerate(rows)
        if index != place
    )


def picture_error(
    case: Case,
    reference: Mapping[int, Image],
    images: Mapping[int, Image],
    last: Mapping[int, Image] | None = None,
) -> float:
    """Return the error of pictures: FLIP summed and divided by the number of pixels that virtual content changes.

    The result is the mean over the compared frames.

    Args:
        case: Frames with their regions.
        reference: Pictures that determine the changed pixels.
        images: Pictures to evaluate.
        last: Pictures to compare with; None: ``reference``.
    """
    errors = []
    for index, picture in reference.items():
        region = region_of(case, index, picture)
        flip = flip_map((last or reference)[index], images[index])
        errors.append(float((flip * region if case.darker else flip).sum()) / max(int(region.sum()), 1))
    return statistics.fmean(errors)


def region_of(case: Case, index: int, reference: Image) -> Mask:
    """Return the pixels of a frame that virtual content or the exposure changes."""
    return case.regions[index] if index in case.regions else changed_region(case.frames[index].image, reference)
