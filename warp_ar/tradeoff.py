"""``python -m warp_ar.tradeoff [SCENE]`` shows what accuracy costs: errors and milliseconds of every rung.

Every knob of a scene (see ``ladder``) is turned through its rungs, all others staying on ``BASE``. Per rung it notes

- how far what the stage writes is from what the knob's last rung writes: relative RMSE, worst texel, energy drift;
- how far the picture is from the truth (a path tracer's, where there is one) or else from the picture at the knob's
  last rung: FLIP, summed over the picture and divided by the pixels that anything virtual changes, so that errors of
  different knobs are on one scale;
- the median milliseconds per frame of the knob's own stages, and of those that run only for this rung.

Then presets, and the best choices for the paper's time and for the paper's error, are run as a whole.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import itertools
import json
import os
import platform
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import warp as wp
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table

from warp_ar import tradeoff_page
from warp_ar.errors import UsageError, WarpArError
from warp_ar.graph import make_plan
from warp_ar.ladder import (
    KNOBS,
    Choice,
    Knob,
    Price,
    frontier,
    relevant_knobs,
    setting,
    turn,
)
from warp_ar.live import EXIT_DONE, EXIT_FAILED, EXIT_USAGE, Parser
from warp_ar.metrics import ArrayError, array_error, changed_region, clipped_region, flip_map, latlong_weights
from warp_ar.pipeline import TRACK, Pipeline
from warp_ar.quality import PRESETS, Quality
from warp_ar.scene import Scene, load_scene
from warp_ar.sources import Frame, open_source
from warp_ar.stages.base import Request
from warp_ar.tracking import Pose, Tracker

Image = npt.NDArray[np.uint8]

BASE = PRESETS["high"]
"""What the other knobs stay on while one is turned."""
WARM_UP = 3
"""Frames that are not timed: modules load, caches fill."""
DEFAULT_FRAMES = 12
TRIES = 7
"""Runs at most to find what fits a budget."""
MIN_COLUMNS = 110
"""Of the tables: where output is no terminal, narrower ones would be cut."""
RUNS = ("paper", "low", "medium", "high")
"""Presets that are run as a whole."""
NORMALS = (24, 48)
"""Orientations at which irradiance is compared, whatever form it has."""
VERSIONS = ("both", "object", "light", "dark_50", "dark_25")
"""Kinds of truth that a case may have; ``object`` and ``light`` are swept only where there is no ``both``."""

_WITHOUT_BRUTE_FORCE = PRESETS["reference"].with_rungs(diffuse="clusters", specular="energy_mip", room_shadow="none")
"""The reference's light without what it takes to show it."""

_OUTPUT = {
    "unwrap": "probe_radiance",
    "recover": "environment",
    "diffuse": "irradiance",
    "specular": "specular_levels",
    "relight": "physical_added",
    "room_shadow": "physical_ratio",
    "shade": "virtual",
    "edge_samples": "virtual",
    "light_shadow": "physical_added",
    "expose": "image",
}
"""What a knob's stage writes; knobs that are not here change the size of what is written."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A scene with frames, and pictures of how it should look."""

    name: str
    scene: Scene
    frames: tuple[Frame, ...]
    poses: tuple[Pose | None, ...]
    truth: Mapping[int, Image]
    """What the camera would have seen, by frame; empty where that is not known."""

    @property
    def shown(self) -> tuple[int, ...]:
        """Frames whose pictures are compared."""
        return tuple(self.truth) or (len(self.frames) - 1,)


@dataclasses.dataclass(frozen=True)
class Outcome:
    """One quality, run over a case's frames."""

    quality: Quality
    images: Mapping[int, Image]
    stages: Mapping[str, float]
    """Median milliseconds of every stage over the frames in which it ran, the marker's tracking left out."""
    output: npt.NDArray[Any] | None
    """What the knob's stage had written at the end."""

    @property
    def milliseconds(self) -> float:
        """Of all stages."""
        return sum(self.stages.values())


@dataclasses.dataclass(frozen=True)
class Row:
    """One rung of one knob in one case."""

    case: str
    knob: str
    rung: str
    milliseconds: float
    frame_milliseconds: float
    stage_error: ArrayError | None
    """Against the last rung; None where sizes differ."""
    flip: float
    """Mean FLIP of the picture per changed pixel."""
    against: str
    """``truth`` or ``last rung``."""
    excess: float = 0.0
    """``flip`` above that of the knob's best rung."""
    dominated: bool = False
    """Another rung costs no more and errs no more."""


@dataclasses.dataclass(frozen=True)
class Whole:
    """A preset or a choice, run as a whole."""

    label: str
    milliseconds: float
    flip: float
    settings: Mapping[str, str]
    images: Mapping[int, Image]


@dataclasses.dataclass(frozen=True)
class CaseReport:
    """All that is known of a case."""

    case: Case
    reference: Mapping[int, Image]
    """Pictures that others are compared with: the truth, or the best there is."""
    rows: tuple[Row, ...]
    pictures: Mapping[tuple[str, str], Image]
    """The last picture of every rung."""
    wholes: tuple[Whole, ...]
    region: npt.NDArray[np.bool_]
    """Pixels of the last picture that anything virtual changes."""


# ---------------------------------------------------------------------------------------------------------------- cases


def read_image(path: Path) -> Image:
    """A picture as uint8 RGB.

    Raises:
        UsageError: It cannot be read.
    """
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise UsageError(f"cannot read the picture {path}")
    return np.ascontiguousarray(image[..., ::-1], dtype=np.uint8)


def shrink(image: Image, times: int) -> Image:
    """A picture at a whole fraction of its size."""
    if times == 1:
        return image
    size = image.shape[1] // times, image.shape[0] // times
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def load_case(name: str, scene: Scene, count: int, truth: Path | None = None, times: int = 1) -> Case:
    """Read frames, find the marker in each once, and read the truth's pictures of those frames.

    Args:
        name: For tables.
        scene: Its clip is read.
        count: Frames at most.
        truth: Folder of ``NNNN.png``: what the camera would have seen.
        times: By how much everything is shrunk.
    """
    if scene.source is None or scene.source.path is None:
        raise UsageError(f"scene {scene.name!r} has no clip to compare rungs on; expected [source] path")
    with open_source(scene.source.path, fps=scene.source.fps) as source:
        frames = tuple(
            dataclasses.replace(frame, image=shrink(frame.image, times)) for frame in itertools.islice(source, count)
        )
        width, height = source.size
        scene = dataclasses.replace(scene, camera=scene.camera.scaled_to(width // times, height // times))
    poses: tuple[Pose | None, ...] = (None,) * len(frames)
    if make_plan(Request(scene, PRESETS["reference"], (scene.camera.width, scene.camera.height))).needs("pose"):
        tracker = Tracker(scene.marker, scene.camera)
        poses = tuple(tracker.track(frame.image, frame.time).pose for frame in frames)
    pictures = sorted(truth.glob("*.png")) if truth is not None else []
    wanted = {int(path.stem): shrink(read_image(path), times) for path in pictures if int(path.stem) < len(frames)}
    return Case(name, scene, frames, poses, wanted)


def truth_of(scene_file: Path) -> Path | None:
    """Folder of pictures that a scene file of a case comes with: ``both`` beside ``scene_both.toml``."""
    folder = scene_file.parent / scene_file.stem.removeprefix("scene_")
    return folder if scene_file.stem.startswith("scene_") and folder.is_dir() else None


def open_cases(options: argparse.Namespace) -> Iterator[Case]:
    """What the command line asks for: a scene, or cases with truth, or both."""
    if options.scene is not None or options.truth is None:
        name = options.scene or "desk"
        path = Path(name)
        truth = truth_of(path) if path.is_file() else None
        yield load_case(path.stem, load_scene(name), options.frames, truth, options.shrink)
    if options.truth is None:
        return
    folders = [options.truth] if (options.truth / "case.json").is_file() else sorted(options.truth.iterdir())
    found = False
    for folder in folders:
        versions = [version for version in options.versions if (folder / f"scene_{version}.toml").is_file()]
        if "both" in versions:
            versions = [version for version in versions if version not in ("object", "light")]
        for version in versions:
            found = True
            scene = load_scene(folder / f"scene_{version}.toml")
            yield load_case(f"{folder.name} {version}", scene, options.frames, folder / version, options.shrink)
    if not found:
        raise UsageError(
            f"--truth {options.truth}: expected folders with scene_*.toml, as scene_both.toml beside both/"
        )


# ------------------------------------------------------------------------------------------------------------ measuring


def run(
    case: Case, quality: Quality, device: str, knob: Knob | None = None, *, between: Quality | None = None
) -> Outcome:
    """Run a case's frames at one quality, one after another, and time every stage.

    Args:
        case: Frames, and which pictures are wanted.
        quality: What to run at.
        device: Where.
        knob: What was turned: what its stage wrote is kept.
        between: Only wanted pictures are worth its time: the frames between them run at this, which keeps the light.
    """
    images: dict[int, Image] = {}
    times: dict[str, list[float]] = {}
    timed = case.shown if between is not None else range(min(WARM_UP, len(case.frames) - 1), len(case.frames))

    def open_pipeline(at: Quality) -> Pipeline:
        return Pipeline(case.scene, device=device, quality=at, outputs=("image",), profile=True)

    with open_pipeline(quality) as pipeline, contextlib.ExitStack() as stack:
        cheap = pipeline if between is None else stack.enter_context(open_pipeline(between))
        before = pipeline
        for index, (frame, pose) in enumerate(zip(case.frames, case.poses, strict=True)):
            now = pipeline if index in case.shown else cheap
            if now is not before and index > 0:
                now.continue_from(before)
            before = now
            result = now(frame.image, time_seconds=frame.time, pose=pose)
            if index in case.shown:
                images[index] = result.image
            if index in timed:
                for name, timing in result.stages.items():
                    times.setdefault(name, []).extend([] if timing.skipped else [timing.milliseconds])
        output = None if knob is None else _read_output(pipeline, knob)
    times.pop(TRACK, None)
    return Outcome(quality, images, {name: statistics.median(own or [0.0]) for name, own in times.items()}, output)


def _read_output(pipeline: Pipeline, knob: Knob) -> npt.NDArray[Any] | None:
    """What the knob's stage has written, in a form that all its rungs share."""
    name = _OUTPUT.get(knob.name)
    if name is None:
        return None
    arrays = pipeline.arrays
    if name == "irradiance":
        if "irradiance_sh" in arrays:
            return irradiance_from_sh(arrays["irradiance_sh"].numpy())
        return resample(arrays["irradiance_map"].numpy(), NORMALS)
    if name == "physical_ratio" and name not in arrays:
        width, height = pipeline.size
        return np.ones((height, width, 3), np.float32)
    return np.array(arrays[name].numpy()) if name in arrays else None


def _directions(rows: int, columns: int) -> npt.NDArray[np.float64]:
    theta, phi = np.meshgrid(
        (np.arange(rows) + 0.5) * np.pi / rows,
        ((np.arange(columns) + 0.5) / columns * 2.0 - 1.0) * np.pi,
        indexing="ij",
    )
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)


def irradiance_from_sh(coefficients: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Irradiance over ``NORMALS`` from nine coefficients, (9, 3), of the real orthonormal basis."""
    x, y, z = np.moveaxis(_directions(*NORMALS), -1, 0)
    basis = np.stack(
        [
            np.full(NORMALS, 0.28209479),
            *(0.48860251 * axis for axis in (y, z, x)),
            *(1.09254843 * pair for pair in (x * y, y * z)),
            0.31539157 * (3.0 * z * z - 1.0),
            1.09254843 * x * z,
            0.54627422 * (x * x - y * y),
        ],
        -1,
    )
    return np.asarray(np.maximum(basis @ coefficients.astype(np.float64), 0.0), np.float64)


def resample(latlong: npt.NDArray[Any], shape: tuple[int, int]) -> npt.NDArray[np.float64]:
    """Bilinear samples of a latlong map at the texel centres of another size, across the seam and the poles."""
    rows, columns = latlong.shape[:2]
    padded = np.concatenate([latlong[:1, (np.arange(columns) + columns // 2) % columns], latlong], 0)
    padded = np.concatenate([padded, latlong[-1:, (np.arange(columns) + columns // 2) % columns]], 0)
    padded = np.concatenate([padded[:, -1:], padded, padded[:, :1]], 1).astype(np.float32)
    y = (np.arange(shape[0]) + 0.5) * rows / shape[0] + 0.5
    x = (np.arange(shape[1]) + 0.5) * columns / shape[1] + 0.5
    at_x, at_y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    return np.asarray(cv2.remap(padded, at_x, at_y, cv2.INTER_LINEAR), np.float64)


def picture_error(case: Case, reference: Mapping[int, Image], images: Mapping[int, Image]) -> float:
    """Sum of FLIP over the picture divided by the pixels that anything virtual changes, mean over compared frames."""
    errors = []
    for index, picture in reference.items():
        region = changed_region(case.frames[index].image, picture)
        errors.append(float(flip_map(picture, images[index]).sum()) / max(int(region.sum()), 1))
    return statistics.fmean(errors)


def sweep(case: Case, knob: Knob, device: str, base: Quality = BASE) -> tuple[list[Row], dict[str, Image]]:
    """Every rung of one knob: its row, and its last picture."""
    outcomes = {
        rung: run(case, turn(base, {knob.name: rung}), device, knob, between=base if rung == "brute_force" else None)
        for rung in knob.rungs
    }
    last = outcomes[knob.rungs[-1]]
    common = set.intersection(*(set(outcome.stages) for outcome in outcomes.values())) - set(knob.stages)
    reference = case.truth or last.images
    rows = []
    for rung, outcome in outcomes.items():
        own = {name: ms for name, ms in outcome.stages.items() if name not in common}
        rows.append(
            Row(
                case.name,
                knob.name,
                rung,
                sum(own.values()),
                outcome.milliseconds,
                _stage_error(outcome, last),
                picture_error(case, reference, outcome.images),
                "truth" if case.truth else "last rung",
            )
        )
    best = min(row.flip for row in rows)
    rows = [dataclasses.replace(row, excess=row.flip - best, dominated=_is_dominated(row, rows)) for row in rows]
    return rows, {rung: outcome.images[case.shown[-1]] for rung, outcome in outcomes.items()}


def _is_dominated(row: Row, rows: Sequence[Row]) -> bool:
    """Whether another rung costs no more and errs no more, in the picture and in what the stage writes."""

    def beats(other: Row) -> bool:
        mine = row.milliseconds, row.flip, row.stage_error.relative_rmse if row.stage_error else 0.0
        yours = other.milliseconds, other.flip, other.stage_error.relative_rmse if other.stage_error else 0.0
        return all(y <= m for y, m in zip(yours, mine, strict=True)) and yours != mine

    return any(beats(other) for other in rows)


def _stage_error(outcome: Outcome, last: Outcome) -> ArrayError | None:
    values, reference = outcome.output, last.output
    if values is None or reference is None or values.shape != reference.shape:
        return None
    is_map = reference.ndim == 3 and reference.shape[1] == 2 * reference.shape[0]
    return array_error(values, reference, latlong_weights(*reference.shape[:2]) if is_map else None)


def measure_case(case: Case, device: str, knobs: Sequence[Knob], progress: Any = None) -> CaseReport:
    """Sweep every knob, then run presets and the best choices."""
    rows: list[Row] = []
    pictures: dict[tuple[str, str], Image] = {}

    def advance(text: str) -> None:
        if progress is not None:
            progress(f"{case.name}: {text}")

    for knob in knobs:
        advance(knob.name)
        own, shown = sweep(case, knob, device)
        rows += own
        pictures.update({(knob.name, rung): image for rung, image in shown.items()})
    advance("presets")
    outcomes = {name: run(case, PRESETS[name], device) for name in RUNS}
    best = None if case.truth else run(case, PRESETS["reference"], device, between=_WITHOUT_BRUTE_FORCE)
    reference = case.truth or (best.images if best is not None else {})
    labelled = list(outcomes.items())
    everything = relevant_knobs(case.scene, (case.scene.camera.width, case.scene.camera.height))
    if {knob.name for knob in everything} == {knob.name for knob in knobs}:
        # Knobs share stages, so their times overlap: costs are relative to the base's, and only order the choices.
        front = frontier(_relative_prices(rows, knobs, BASE))
        paper = outcomes["paper"]
        aim = picture_error(case, reference, paper.images)
        advance("equal time, equal error")
        same_time = _bisect(case, front, device, lambda outcome: outcome.milliseconds <= paper.milliseconds)
        # From the other end: the cheapest that errs no more than the paper is next to the dearest that errs more.
        dearest_worse = _bisect(
            case, front, device, lambda outcome: picture_error(case, reference, outcome.images) > aim
        )
        place = next(index for index, choice in enumerate(front) if _chosen(choice) == dearest_worse.quality)
        errs_more = picture_error(case, reference, dearest_worse.images) > aim
        same_error = run(case, _chosen(front[min(place + errs_more, len(front) - 1)]), device)
        labelled += [("ours in the paper's time", same_time), ("ours at the paper's error", same_error)]
    wholes = tuple(
        Whole(
            label,
            outcome.milliseconds,
            picture_error(case, reference, outcome.images),
            {knob.name: setting(outcome.quality, knob) for knob in everything},
            outcome.images,
        )
        for label, outcome in labelled
    )
    index = case.shown[-1]
    region = changed_region(case.frames[index].image, reference[index])
    return CaseReport(case, reference, tuple(rows), pictures, wholes, region)


def _bisect(case: Case, front: Sequence[Choice], device: str, fits: Callable[[Outcome], bool]) -> Outcome:
    """Run the dearest choice that fits, or the cheapest if none does: prices give the order, measuring the place."""
    low, high = 0, len(front)
    best = run(case, _chosen(front[low]), device)
    for _ in range(TRIES):
        if high - low <= 1:
            break
        middle = (low + high) // 2
        outcome = run(case, _chosen(front[middle]), device)
        if fits(outcome):
            low, best = middle, outcome
        else:
            high = middle
    return best


def _chosen(choice: Choice) -> Quality:
    return turn(BASE, dict(choice.settings))


def _relative_prices(rows: Sequence[Row], knobs: Sequence[Knob], base: Quality) -> list[Price]:
    """Prices by what turning a knob away from the base saves or adds."""
    cost = {(row.knob, row.rung): row.milliseconds for row in rows}
    own = {knob.name: cost[knob.name, setting(base, knob)] for knob in knobs}
    return [Price(row.knob, row.rung, row.milliseconds - own[row.knob], row.excess) for row in rows]


@dataclasses.dataclass(frozen=True)
class Figure:
    """One of the paper's figures, redone."""

    title: str
    text: str
    columns: tuple[tuple[str, Image], ...]
    reference: Image | None
    """What the columns are compared with, where it is known."""
    region: npt.NDArray[np.bool_] | None
    """What to look at."""


_FIGURES = (
    ("Figure 7", "darken", "dark_25", "expose", ("plain", "box", "ball"), "A shorter exposure, simulated"),
    (
        "Figure 8",
        "wire_coincident",
        "",
        "relight",
        ("flat", "paper", "reflectance"),
        "Light from where the room's comes",
    ),
    ("Figure 9", "wire_opposing", "light", "relight", ("flat", "paper", "reflectance"), "Light against the room's"),
)
"""Title, bundled scene, version of cases that show the same with its truth, knob, its plain, paper's and best rung."""


def make_figures(device: str, count: int, truth: Path | None, times: int = 1) -> Iterator[Figure]:
    """Figures 7, 8 and 9 of the paper: plain, the paper's way, ours; in cases with a truth against that."""
    for title, bundled, version, knob, rungs, text in _FIGURES:
        cases = [(f"{title}: {bundled}", load_case(bundled, load_scene(bundled), count, None, times))]
        if truth is not None and version:
            folders = [truth] if (truth / "case.json").is_file() else sorted(truth.iterdir())
            for folder in folders:
                file = folder / f"scene_{version}.toml"
                if file.is_file():
                    case = load_case(folder.name, load_scene(file), count, folder / version, times)
                    cases.append((f"{title} against the truth: {folder.name.replace('_', ' ')}", case))
        for name, case in cases:
            index = case.shown[-1]
            camera = case.frames[index].image
            images = [run(case, turn(BASE, {knob: rung}), device).images[index] for rung in rungs]
            reference = case.truth.get(index)
            labels = (f"plain ({rungs[0]})", f"the paper ({rungs[1]})", f"ours ({rungs[2]})")
            columns = (("camera", camera), *zip(labels, images, strict=True))
            if reference is not None:
                columns = (*columns, ("truth", reference))
            region = clipped_region(camera) if knob == "expose" else changed_region(camera, images[0])
            yield Figure(name, f"{text}; all else on the preset {BASE.name}.", columns, reference, region)


# ------------------------------------------------------------------------------------------------------------ reporting


def make_price_list(reports: Sequence[CaseReport], device: Any) -> dict[str, Any]:
    """Errors and costs per rung, mean over the cases in which a knob matters; errors never rise along the ladder.

    Against the truth, noise and luck can favour a cheaper rung in one case; over all, a rung that errs more than a
    cheaper one is marked as dominated.
    """
    errors: dict[str, dict[str, float]] = {}
    costs: dict[str, dict[str, float]] = {}
    dominated: dict[str, list[str]] = {}
    for knob in KNOBS:
        rows = [row for report in reports for row in report.rows if row.knob == knob.name]
        if not rows:
            continue
        measured = {row.rung for row in rows}
        by_rung = {rung: [row for row in rows if row.rung == rung] for rung in knob.rungs if rung in measured}
        flips = {rung: statistics.fmean(row.flip for row in own) for rung, own in by_rung.items()}
        best = min(flips.values())
        errors[knob.name] = {rung: round(flip - best, 6) for rung, flip in flips.items()}
        costs[knob.name] = {
            rung: round(statistics.fmean(row.milliseconds for row in own), 4) for rung, own in by_rung.items()
        }
        kept = set().union(
            *(
                {row.rung for row in rows if row.case == case and not row.dominated}
                for case in {row.case for row in rows}
            )
        )
        dominated[knob.name] = [rung for rung in knob.rungs if rung not in kept]
    return {
        "made": {
            "device": device_name(device),
            "warp": wp.__version__,
            "cases": [report.case.name for report in reports],
        },
        "errors": errors,
        "milliseconds": costs,
        "dominated": dominated,
    }


def device_name(device: Any) -> str:
    """The device as a person would name it; for a CPU with the cores that this process may use."""
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
    against = "the truth" if report.case.truth else "the last rung"
    table = Table(title=f"{report.case.name}: every rung, FLIP against {against}")
    for column in ("knob", "rung"):
        table.add_column(column)
    for column in ("ms", "rel. RMSE", "worst", "drift", "FLIP", "above best"):
        table.add_column(column, justify="right")
    table.add_column("")
    for _, group in itertools.groupby(report.rows, lambda row: row.knob):
        for position, row in enumerate(group):
            error = row.stage_error
            numbers = (
                ("", "", "")
                if error is None
                else (f"{error.relative_rmse:.2%}", f"{error.worst:.2f}", f"{error.energy_drift:+.2%}")
            )
            table.add_row(
                row.knob if position == 0 else "",
                row.rung,
                f"{row.milliseconds:.3f}",
                *numbers,
                f"{row.flip:.4f}",
                f"{row.excess:.4f}",
                "dominated" if row.dominated else "",
                style="dim" if row.dominated else "",
            )
        table.add_section()
    console.print(table)
    table = Table(title=f"{report.case.name}: as a whole")
    table.add_column("quality")
    table.add_column("ms", justify="right")
    table.add_column("FLIP", justify="right")
    for whole in report.wholes:
        table.add_row(whole.label, f"{whole.milliseconds:.2f}", f"{whole.flip:.4f}")
    console.print(table)


def records(report: CaseReport, device: Any) -> Iterator[dict[str, Any]]:
    """One plain record per rung and per whole, ready for JSON lines."""
    common = {"device": device_name(device), "warp": wp.__version__}
    for row in report.rows:
        error = {} if row.stage_error is None else dataclasses.asdict(row.stage_error)
        plain = {key: value for key, value in dataclasses.asdict(row).items() if key != "stage_error"}
        yield {"kind": "rung", **plain, **error, **common}
    for whole in report.wholes:
        yield {
            "kind": "whole",
            "case": report.case.name,
            "quality": whole.label,
            "milliseconds": whole.milliseconds,
            "flip": whole.flip,
            "settings": dict(whole.settings),
            **common,
        }


def make_parser() -> argparse.ArgumentParser:
    """The command's options."""
    parser = Parser(
        prog="python -m warp_ar.tradeoff", description="What accuracy costs: errors and milliseconds of every rung."
    )
    add = parser.add_argument
    add("scene", nargs="?", metavar="SCENE", help="a scene file or a bundled scene's name (default: desk, or --truth)")
    add("--stage", metavar="NAME", help=f"turn only this: {', '.join(knob.name for knob in KNOBS)}")
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
    add("--out", type=Path, metavar="DIR", help="write tradeoff.jsonl, price_list.json and tradeoff.html here")
    return parser


def chosen_knobs(case: Case, name: str | None) -> tuple[Knob, ...]:
    """Knobs of a case that the command line asks for."""
    knobs = relevant_knobs(case.scene, (case.scene.camera.width, case.scene.camera.height))
    if name is None:
        return knobs
    if name not in {knob.name for knob in KNOBS}:
        raise UsageError(f"--stage {name}: expected one of {', '.join(knob.name for knob in KNOBS)}")
    return tuple(knob for knob in knobs if knob.name == name)


def tradeoff(options: argparse.Namespace) -> int:
    """Measure, print and write."""
    if options.frames < 1:
        raise UsageError(f"--frames {options.frames}: expected 1 or more")
    if options.shrink < 1:
        raise UsageError(f"--shrink {options.shrink}: expected 1 or more")
    from warp_ar.device import resolve_device

    device = resolve_device(options.device)
    console = Console()
    console.width = max(console.width, MIN_COLUMNS)
    reports = []
    with Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), console=console) as progress:
        for case in open_cases(options):
            knobs = chosen_knobs(case, options.stage)
            if not knobs:
                console.print(f"{case.name}: nothing to turn", highlight=False)
                continue
            task = progress.add_task(case.name, total=len(knobs) + 2)

            def advance(text: str, task: Any = task) -> None:
                progress.update(task, advance=1, description=text)

            reports.append(measure_case(case, str(device), knobs, advance))
            progress.remove_task(task)
            print_report(reports[-1], console)
    if not reports:
        raise UsageError("nothing to turn in any scene that was named")
    price_list = make_price_list(reports, device)
    for knob, rungs in price_list["dominated"].items():
        if rungs:
            console.print(f"dominated in every case: {knob} {', '.join(rungs)}", highlight=False)
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        lines = (json.dumps(record) for report in reports for record in records(report, device))
        (options.out / "tradeoff.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
        (options.out / "price_list.json").write_text(json.dumps(price_list, indent=1) + "\n", encoding="utf-8")
        figures = (
            list(make_figures(str(device), options.frames, options.truth, options.shrink))
            if options.stage is None
            else []
        )
        page = tradeoff_page.render(reports, figures, price_list["made"])
        (options.out / "tradeoff.html").write_text(page, encoding="utf-8")
        console.print(f"written to {options.out}", highlight=False)
    return EXIT_DONE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code: 0 done, 1 failed while running, 2 bad usage or scene."""
    try:
        options = make_parser().parse_args(arguments)
        return tradeoff(options)
    except UsageError as error:
        print(f"warp_ar: {error}", file=sys.stderr)
        return EXIT_USAGE
    except WarpArError as error:
        print(f"warp_ar: {error}", file=sys.stderr)
        return EXIT_FAILED


if __name__ == "__main__":
    sys.exit(main())
