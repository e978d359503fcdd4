"""Measurement of cases: all methods of all settings, presets, and our choices at the paper's time and at its error.

**Error of a method.** Distances between pictures are FLIP, summed over the picture and divided by the number of pixels
that virtual content changes, so that the errors of all settings have one scale. If all methods of a setting approximate
the last one's result (``converges``), the error is the distance from that result. A method that is closer to the truth
than the exact solution is so by chance, because another stage is inaccurate. If methods are different models, the error
is the distance from the truth minus that of the best method.

**Cost of a method.** It is the time of its stages in excess of the setting's cheapest method, measured by
``measure_costs``. The command measures methods at half the size of the frames, because exact ones take minutes a frame.

**Whole frames.** Presets are timed as whole frames, one frame of each in turn. So are two choices of the cost table:
the best at the time of the paper's methods, and the cheapest at their error. These choices are based on the errors in
the package's cost table, not on those of the measured case.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import TypeVar

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
Label = TypeVar("Label", bound=Hashable)
Tell = Callable[[str], object]
"""Function to which a description of each step is passed."""
BASE = PRESETS["high"]
"""Preset of all settings except the varied one."""
WARM_UP = 3
"""Number of first frames of a run that are not timed, because they load modules and fill caches."""
RUNS = ("paper", "low", "medium", "high")
"""Presets to measure as a whole."""
SAME_TIME, SAME_ERROR = "ours near the paper's time", "ours near the paper's error"
"""Names of the two choices of the cost table, which are measured together with the presets."""
COST_NOISE, FLIP_NOISE = 0.03, 2e-4
"""Measurement noise: of costs (relative) and of errors (FLIP)."""
_FAIR: Mapping[str, Mapping[str, str]] = {
    "unwrap": {"environment_height": "32"},
    "environment_height": {"environment_shadow": "none", "recover": "white_card"},
}
"""Methods of other settings with which a setting is measured, in place of ``BASE``. The methods of ``unwrap`` differ
only with coarse texels. The effect of ``environment_height`` would be hidden by the noise of few random rays, and by
the division of the map's energy among emitters."""


@dataclasses.dataclass(frozen=True)
class Row:
    """Measurement of one method of one setting in one case."""

    case: str
    setting: str
    method: str
    milliseconds: float
    """Milliseconds per frame in excess of the setting's cheapest method."""
    flip: float
    """Mean FLIP of the picture per changed pixel."""
    against: str
    """Picture with which ``flip`` compares: ``truth`` or ``last method``."""
    error: float = 0.0
    """Error of the method, which the module's docstring defines."""
    dominated: bool = False
    """True if another method costs no more and has no larger error."""


@dataclasses.dataclass(frozen=True)
class Whole:
    """Measurement of whole frames at one quality: a preset or a choice of the cost table."""

    label: str
    """Name of the quality."""
    milliseconds: float
    """Median time per frame, without tracking."""
    flip: float
    """Mean FLIP of the pictures per changed pixel."""
    settings: Mapping[str, str]
    """Method of each setting."""
    images: Mapping[int, Image]
    """Compared pictures, by frame."""
    over_paper: float = math.nan
    """Median over the frames of the ratio of their time to that with the preset ``paper``."""


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


def measure_methods(
    case: Case, device: str, settings: Sequence[Setting], tell: Tell = lambda text: None, *, quick: bool = False
) -> tuple[CaseReport, dict[str, Quality]]:
    """Measure every method of some settings of a case.

    Args:
        case: Frames, with their truth if it is known.
        device: ``cpu`` or ``cuda:N``.
        settings: Settings to vary.
        tell: Function to which a description of each step is passed.
        quick: True to leave out brute force.

    Returns:
        The report, without whole frames; and, if all settings were varied, the choices of the cost table at the paper's
        time and at its error.
    """
    size = case.scene.camera.width, case.scene.camera.height
    shown = case.frames[-1].image, case.poses[-1]

    def tell_share(share: float) -> None:
        tell(f"{case.name}: costs, {share:.0%}")

    costs = measure_costs(case.scene, *shown, device, size, settings, all_methods=not quick, tell=tell_share)
    methods = {setting: setting.measured if quick else setting.methods for setting in settings}
    rows, pictures = sweep(case, methods, device, costs, tell)
    index = case.shown[-1]
    reference = case.truth or {index: pictures[rows[-1].setting, rows[-1].method]}
    report = CaseReport(case, reference, rows, pictures, (), region_of(case, index, reference[index]))
    everything = not case.name.endswith(SIZED) and list(settings) == list(settings_of(case))
    return report, _equals(costs, settings) if everything else {}


def measure_presets(
    case: Case,
    device: str,
    qualities: Mapping[str, Quality],
    tell: Tell = lambda text: None,
    *,
    quick: bool = False,
    clock: Clock = time.perf_counter,
) -> CaseReport:
    """Measure whole frames of a case at several qualities.

    Args:
        case: Frames, with their truth if it is known.
        device: ``cpu`` or ``cuda:N``.
        qualities: Qualities by name.
        tell: Function to which a description of each step is passed.
        quick: True to leave out brute force in the reference, if the truth is unknown.
        clock: Clock in seconds.
    """
    reference = case.truth
    if not reference:
        tell(f"{case.name}: reference")
        best = turn(PRESETS["reference"], {"environment_shadow": "bounce"}) if quick else PRESETS["reference"]
        reference = run(case, {"": best}, device)[""]
    tell(f"{case.name}: presets")
    index = case.shown[-1]
    wholes = _run_wholes(case, qualities, reference, device, clock)
    return CaseReport(case, reference, (), {}, wholes, region_of(case, index, reference[index]))


def run(
    case: Case,
    qualities: Mapping[Label, Quality],
    device: str,
    tell: Tell = lambda text: None,
    keep: Callable[[Pipeline], object] | None = None,
) -> dict[Label, dict[int, Image]]:
    """Light a case's frames at several qualities and return the compared pictures of each.

    Frames before a compared one only serve to capture light. They are lit with cheap methods for the rest of the
    picture, once for all qualities that capture light equally.

    Args:
        case: Frames, with the indices of the compared ones.
        qualities: Qualities of the compared pictures.
        device: ``cpu`` or ``cuda:N``.
        tell: Function to which a description of each step is passed.
        keep: Function that is called with each pipeline after it has made a compared picture.
    """
    images: dict[Quality, dict[int, Image]] = {quality: {} for quality in qualities.values()}
    for light in dict.fromkeys(map(light_only, images)):
        own = [quality for quality in images if light_only(quality) == light]
        tell(f"{case.name}: light of {case.shown[-1]} frames for {len(own)} qualities")
        with Pipeline(case.scene, device=device, quality=light) as cheap:
            for index, (frame, pose) in enumerate(zip(case.frames, case.poses, strict=True)):
                for quality in own if index in case.shown else ():
                    with Pipeline(case.scene, device=device, quality=quality) as pipeline:
                        pipeline.continue_from(cheap)
                        images[quality][index] = pipeline(frame.image, time_seconds=frame.time, pose=pose).image
                        if keep is not None:
                            keep(pipeline)
                if index < case.shown[-1]:
                    cheap(frame.image, time_seconds=frame.time, pose=pose)
    return {label: images[quality] for label, quality in qualities.items()}


def run_in_turn(
    case: Case, qualities: Mapping[str, Quality], device: str, clock: Clock
) -> tuple[dict[str, list[float]], dict[str, dict[int, Image]]]:
    """Light frames with several qualities in turn, so that disturbances by other programs affect all equally.

    Returns:
        Milliseconds of each frame after the first ``WARM_UP``, until the picture is on the host and without tracking;
        and the compared pictures. Both are by label.
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
    """Return the choices of the cost table at the paper's time and at its error, by their names."""
    errors = load_errors()
    front = pareto_front(make_method_costs(costs, errors))
    paper = {setting.name: chosen(PRESETS["paper"], setting) for setting in settings}
    most = sum(errors[name][method] for name, method in paper.items())
    same_error = next((choice for choice in front if choice.error <= most), front[-1])
    found = {SAME_TIME: choose(front, costs.excess(paper)), SAME_ERROR: same_error}
    return {label: turn(COST_BASE, dict(choice.settings)) for label, choice in found.items()}


def sweep(
    case: Case,
    methods: Mapping[Setting, Sequence[str]],
    device: str,
    costs: Costs,
    tell: Tell = lambda text: None,
    *,
    base: Quality = BASE,
) -> tuple[tuple[Row, ...], dict[tuple[str, str], Image]]:
    """Return a row and the last picture of each method of some settings.

    Args:
        case: Frames, with their truth if it is known.
        methods: Methods of each setting, in the setting's order.
        device: ``cpu`` or ``cuda:N``.
        costs: Measured costs of the methods.
        tell: Function to which a description of each step is passed.
        base: Quality of all settings but the varied one.
    """
    qualities = {
        (setting.name, method): turn(base, {**_FAIR.get(setting.name, {}), setting.name: method})
        for setting, names in methods.items()
        for method in names
    }
    images = run(case, qualities, device, tell)
    rows: list[Row] = []
    for setting, names in methods.items():
        own = {method: images[setting.name, method] for method in names}
        rows += _rows_of(case, setting, own, costs.methods[setting.name])
    return tuple(rows), {label: pictures[case.shown[-1]] for label, pictures in images.items()}


def _rows_of(
    case: Case, setting: Setting, images: Mapping[str, Mapping[int, Image]], times: Mapping[str, float]
) -> list[Row]:
    """Return a row for each method of a setting.

    Args:
        case: Frames, with their truth if it is known.
        setting: The setting.
        images: Compared pictures of each method, by frame.
        times: Cost of each method, milliseconds.
    """
    last = list(images.values())[-1]
    reference = case.truth or last
    errors = {method: picture_error(case, reference, own) for method, own in images.items()}
    counted = {method: error - min(errors.values()) for method, error in errors.items()}
    if setting.converges or not case.truth:
        counted = {method: picture_error(case, reference, own, last) for method, own in images.items()}
    against = "truth" if case.truth else "last method"
    rows = [
        Row(case.name, setting.name, method, times[method] - min(times.values()), errors[method], against, error)
        for method, error in counted.items()
    ]
    return [dataclasses.replace(row, dominated=is_dominated(row, rows)) for row in rows]


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
    """Return the sum of FLIP over a picture, divided by the number of changed pixels, as the mean over frames.

    Args:
        case: Frames with their regions.
        reference: Pictures that determine the changed pixels.
        images: Pictures to evaluate.
        last: Pictures with which they are compared; None: ``reference``.
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
