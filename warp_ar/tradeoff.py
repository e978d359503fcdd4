"""``python -m warp_ar.tradeoff [SCENE ...]`` shows what accuracy costs: errors and milliseconds of every method.

Every setting of a scene (see ``methods``) is turned through its methods, all others staying on ``BASE``. Per method it
notes

- how far what the stage writes is from what the setting's last method writes: relative RMSE, worst texel, energy drift;
- how far the picture is from the truth (a path tracer's: bundled scenes come with one frame of it), and from the
  picture at the setting's last method: FLIP, summed over the picture and divided by the pixels that anything virtual
  changes, so that errors of different settings are on one scale;
- the milliseconds per frame of the setting's own stages, and of those that run only for this method.

**A method's error.** Where the methods approximate one object that the last of them gives (``converges``), it is the
distance from the last: nearer to the truth than the exact light would be is luck, for something else is wrong then.
Where methods are models of their own, the distance from the truth, less that of the best.

Then presets, and the best choices for the paper's time and for the paper's error, are run as a whole, frame by frame in
turn. Those choices are made from the committed cost table, not from the errors of the case that they are scored on, and
a choice in the paper's time must be measured to take no more of it.

``--processor-time`` runs frames on one thread and counts what it works instead of the time by the clock: other programs
that are busy at the same time then hardly matter.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import itertools
import json
import math
import os
import platform
import statistics
import sys
import time
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

from warp_ar.accuracy import tradeoff_page
from warp_ar.accuracy.cost_table import (
    SETTINGS,
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
from warp_ar.accuracy.costs import NOW_AND_THEN, WORK, make_method_costs, measure_costs, open_profiled, worked_ms
from warp_ar.accuracy.metrics import ArrayError, array_error, changed_region, clipped_region, flip_map, latlong_weights
from warp_ar.command_line import EXIT_DONE, EXIT_FAILED, EXIT_USAGE, Parser
from warp_ar.engine.graph import make_plan
from warp_ar.engine.pipeline import TRACK, Pipeline, Result
from warp_ar.errors import UsageError, WarpArError
from warp_ar.input.sources import Frame, open_source
from warp_ar.input.tracking import Tracker
from warp_ar.kernels.color import decode_table
from warp_ar.scene import Pose, Scene, bundled_scenes, load_scene
from warp_ar.stages.base import Request
from warp_ar.stages.quality import PRESETS, Quality

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
Clock = Callable[[], float]

BASE = PRESETS["high"]
"""What the other settings stay on while one is turned."""
WARM_UP = 3
"""Frames that are not timed: modules load, caches fill."""
DEFAULT_FRAMES = 12
TIMED = 5
"""Last frames that are run at a method, the first of them not timed; those before only bring the light."""
LAMP_RADIUS = 0.02
"""Metres, of ``sized_lamp``: a light bulb."""
SIZED = ", sized lamp"
"""At the end of such a case's name."""
REPEAT_BELOW = 2000.0
"""Milliseconds: a frame that took less is run again where it was the only one, for it loaded the kernels."""
TRIES = 6
"""Runs at most to find what fits a budget or an error."""
OVER = 1.02
"""By how much more than the paper's a measured time counts as the paper's: the noise of a paired mean."""
COST_NOISE = 0.03
"""Share by which costs must differ to be told apart."""
FLIP_NOISE = 2e-4
"""FLIP by which pictures must differ to be told apart."""
RMSE_NOISE = 0.02
"""Share by which errors of arrays must differ to be told apart."""
MIN_COLUMNS = 110
"""Of the tables: where output is no terminal, narrower ones would be cut."""
RUNS = ("paper", "low", "medium", "high")
"""Presets that are run as a whole."""
NORMALS = (24, 48)
"""Orientations at which irradiance is compared, whatever form it has."""
VERSIONS = ("both", "object", "light", "dark_50", "dark_25")
"""Kinds of truth that a case may have; ``object`` and ``light`` are swept only where there is no ``both``."""

_FAIR = {
    "unwrap": {"environment_height": "32"},
    "environment_height": {"environment_shadow": "none", "recover": "white_card"},
}
"""Other methods at which a setting is turned: footprints on the ball matter where texels are coarse; what few rays of
another map happen to meet, and how its energy is shared among lamps, would hide what the map's own size does."""
_OUTPUT = {
    "unwrap": "probe_radiance",
    "recover": "environment",
    "irradiance": "irradiance",
    "prefilter": "prefilter_levels",
    "relight": "physical_added",
    "environment_shadow": "shadow_ratio",
    "shade": "virtual",
    "mirror_ball": "mirrored",
    "edge_samples": "virtual",
    "light_shadow": "physical_added",
    "expose": "image",
}
"""What a setting's stage writes; settings that are not here change the size of what is written."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A scene with frames, and pictures of how it should look."""

    name: str
    scene: Scene
    frames: tuple[Frame, ...]
    poses: tuple[Pose | None, ...]
    truth: Mapping[int, Image]
    """What the camera would have seen, by frame; empty where that is not known."""
    regions: Mapping[int, Mask] = dataclasses.field(default_factory=dict)
    """Pixels that anything virtual changes, or that clip, where the truth says so."""

    @property
    def darker(self) -> bool:
        """Whether what matters is what clips: at another exposure all else is scaled, and errs by rounding alone."""
        return is_darker(self.scene)

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
    """Median milliseconds of every stage, the marker's tracking left out."""
    output: npt.NDArray[Any] | None
    """What the setting's stage had written at the end."""

    @property
    def milliseconds(self) -> float:
        """Of all stages."""
        return sum(self.stages.values())


@dataclasses.dataclass(frozen=True)
class Row:
    """One method of one setting in one case."""

    case: str
    setting: str
    method: str
    milliseconds: float
    frame_milliseconds: float
    stage_error: ArrayError | None
    """Against the last method; None where sizes differ."""
    flip: float
    """Mean FLIP of the picture per changed pixel."""
    against: str
    """``truth`` or ``last method``."""
    apart: float = 0.0
    """The same against the picture at the last method."""
    error: float = 0.0
    """What counts: ``apart`` where the setting converges or no truth is known, else ``flip`` above the best
    method's."""
    dominated: bool = False
    """Another method costs no more and errs no more."""


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


# ---------------------------------------------------------------------------------------------------------------- cases


def read_image(path: Path) -> Image:
    """A picture as uint8 RGB, or RGBA if it says where it is transparent.

    Raises:
        UsageError: It cannot be read.
    """
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint8 or image.ndim != 3:
        raise UsageError(f"cannot read the picture {path}; expected 8-bit colour")
    order = (2, 1, 0, 3)[: image.shape[2]]
    return np.ascontiguousarray(image[..., order])


def shrink(image: Image, times: int) -> Image:
    """A picture at a whole fraction of its size."""
    if times == 1:
        return image
    size = image.shape[1] // times, image.shape[0] // times
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def load_case(
    name: str,
    scene: Scene,
    count: int,
    truth: Mapping[int, Image] | None = None,
    times: int = 1,
    first: int = 0,
) -> Case:
    """Read frames, and find the marker in each once.

    Args:
        name: For tables.
        scene: Its clip is read.
        count: Frames at most.
        truth: By number of the frame in the clip: RGB, or RGBA that is transparent where nothing changes.
        times: By how much everything is shrunk.
        first: Number of the first frame.
    """
    if scene.source is None or scene.source.path is None:
        raise UsageError(f"scene {scene.name!r} has no clip to compare methods on; expected [source] path")
    with open_source(scene.source.path, fps=scene.source.fps) as source:
        whole = tuple(itertools.islice(source, first, first + count))
        width, height = source.size
        scene = dataclasses.replace(scene, camera=scene.camera.scaled_to(width // times, height // times))
    frames = tuple(dataclasses.replace(frame, image=shrink(frame.image, times)) for frame in whole)
    poses: tuple[Pose | None, ...] = (None,) * len(frames)
    if make_plan(Request(scene, PRESETS["reference"], (scene.camera.width, scene.camera.height))).needs("pose"):
        tracker = Tracker(scene.marker, scene.camera)
        poses = tuple(tracker.track(frame.image, frame.time).pose for frame in frames)
    pictures: dict[int, Image] = {}
    regions: dict[int, Mask] = {}
    for number, picture in (truth or {}).items():
        index = number - first
        if 0 <= index < len(frames):
            complete, region = _complete(scene, whole[index].image, picture)
            pictures[index] = shrink(complete, times)
            regions[index] = shrink(region.astype(np.uint8) * 255, times) > 0
    return Case(name, scene, frames, poses, pictures, regions)


def _complete(scene: Scene, camera: Image, truth: Image) -> tuple[Image, Mask]:
    """The truth's whole picture, and the region in which it says anything that the frame does not."""
    scale = scene.exposure.scale
    if truth.shape[2] == 3:
        return truth, clipped_region(camera) if is_darker(scene) else changed_region(camera, truth)
    # Where the truth is transparent nothing changes but the exposure, and nothing clips.
    rest = camera if isinstance(scale, str) else scale_codes(camera, scale, scene.camera.transfer)
    region = truth[..., 3] > 0
    return np.where(region[..., None], truth[..., :3], rest), region


def is_darker(scene: Scene) -> bool:
    """Whether a scene asks for a shorter exposure and nothing else that the frame does not show."""
    scale = scene.exposure.scale
    return not isinstance(scale, str) and scale < 1.0 and not scene.objects and not scene.lights


def scale_codes(image: Image, scale: float, transfer: str | Path) -> Image:
    """A frame at another exposure, as far as nothing in it clips."""
    values = decode_table(transfer)
    codes = np.arange(256)
    tables = [np.interp(column * scale, column, codes) + 0.5 for column in values.T]
    return np.stack([table.astype(np.uint8)[image[..., k]] for k, table in enumerate(tables)], -1)


def read_truth(folder: Path) -> dict[int, Image]:
    """Pictures of a folder of ``NNNN.png`` by their numbers."""
    return {int(path.stem): read_image(path) for path in sorted(folder.glob("*.png"))}


def truth_of(scene_file: Path) -> Path | None:
    """Folder of pictures that a scene file of a case comes with: ``both`` beside ``scene_both.toml``."""
    folder = scene_file.parent / scene_file.stem.removeprefix("scene_")
    return folder if scene_file.stem.startswith("scene_") and folder.is_dir() else None


def open_scene(name: str, count: int, times: int = 1) -> Case:
    """A case from a scene file or a bundled scene, with the truth that it comes with.

    Bundled scenes come with one true frame, ``truth/SCENE_NNNN.png``; the frames end with it.
    """
    path = Path(name)
    if path.is_file():
        folder = truth_of(path)
        return load_case(path.stem, load_scene(name), count, read_truth(folder) if folder else None, times)
    scene = load_scene(name)
    found = sorted((bundled_scenes()[name].parent / "truth").glob(f"{name}_[0-9]*.png"))
    if not found:
        return load_case(name, scene, count, None, times)
    number = int(found[0].stem.rpartition("_")[2])
    return load_case(name, scene, count, {number: read_image(found[0])}, times, max(0, number + 1 - count))


def sized_lamp(case: Case) -> Case:
    """The case with lamps that have a size, whose shadows are soft; what they truly look like is not known."""
    lights = tuple(dataclasses.replace(light, radius=LAMP_RADIUS) for light in case.scene.lights)
    scene = dataclasses.replace(case.scene, lights=lights)
    return dataclasses.replace(case, name=case.name + SIZED, scene=scene, truth={}, regions={})


def truth_folders(truth: Path) -> list[Path]:
    """Cases under a folder, or the folder itself if it is one."""
    return [truth] if (truth / "case.json").is_file() else sorted(path for path in truth.iterdir() if path.is_dir())


def open_cases(options: argparse.Namespace) -> Iterator[Case]:
    """What the command line asks for: scenes, or cases with truth, or both."""
    names = options.scenes or ([] if options.truth is not None else ["desk"])
    for name in bundled_scenes() if names == ["all"] else names:
        yield open_scene(name, options.frames, options.shrink)
    if names == ["all"]:
        yield sized_lamp(open_scene("desk", options.frames, options.shrink))
    if options.truth is None:
        return
    found = False
    for folder in truth_folders(options.truth):
        versions = [version for version in options.versions if (folder / f"scene_{version}.toml").is_file()]
        if "both" in versions:
            versions = [version for version in versions if version not in ("object", "light")]
        for version in versions:
            found = True
            scene = load_scene(folder / f"scene_{version}.toml")
            name = f"{folder.name.replace('_', ' ')}, {version.replace('_', ' ')}"
            yield load_case(name, scene, options.frames, read_truth(folder / version), options.shrink)
    if not found:
        raise UsageError(
            f"--truth {options.truth}: expected folders with scene_*.toml, as scene_both.toml beside both/"
        )


# ------------------------------------------------------------------------------------------------------------ measuring


def run(
    case: Case,
    quality: Quality,
    device: str,
    setting: Setting | None = None,
    *,
    between: Quality | None = None,
    timed: int = TIMED,
    clock: Clock = time.perf_counter,
) -> Outcome:
    """Run a case's frames at one quality, one after another, and time every stage.

    Args:
        case: Frames, and which pictures are wanted.
        quality: What to run at.
        device: Where.
        setting: What was turned: what its stage wrote is kept.
        between: Frames that are neither wanted nor timed run at this, which keeps the light; None runs all alike.
        timed: Last frames that run at ``quality`` whatever is wanted; the first that does is not timed.
        clock: Seconds, on CPU.
    """
    images: dict[int, Image] = {}
    times: dict[str, list[float]] = {}
    count = len(case.frames)
    wanted = {*case.shown, *range(max(0, count - timed), count)} if between is not None else set(range(count))
    skip = 1 if len(wanted) > 1 else 0

    def note(result: Result) -> None:
        for name, timing in result.stages.items():
            times.setdefault(name, []).extend([] if timing.skipped else [timing.milliseconds])

    with open_profiled(case.scene, device, quality, None, clock) as pipeline, contextlib.ExitStack() as stack:
        cheap = (
            pipeline
            if between is None
            else stack.enter_context(open_profiled(case.scene, device, between, None, clock))
        )
        before = pipeline
        for index, (frame, pose) in enumerate(zip(case.frames, case.poses, strict=True)):
            now = pipeline if index in wanted else cheap
            if now is not before and index > 0:
                now.continue_from(before)
            before = now
            result = now(frame.image, time_seconds=frame.time, pose=pose)
            if index in case.shown:
                images[index] = result.image
            if now is pipeline:
                if skip > 0:
                    skip -= 1
                else:
                    note(result)
        output = None if setting is None else _read_output(pipeline, setting)
        if len(wanted) == 1 and sum(own[0] for own in times.values() if own) < REPEAT_BELOW:
            times.clear()
            pipeline.scheduler.forget()
            note(pipeline(case.frames[-1].image, time_seconds=case.frames[-1].time + 1e-3, pose=case.poses[-1]))
    times.pop(TRACK, None)
    stages = {name: statistics.median(own or [0.0]) for name, own in times.items()}
    return Outcome(quality, images, stages, output)


def run_in_turn(
    case: Case, qualities: Mapping[str, Quality], device: str, clock: Clock
) -> tuple[dict[str, list[float]], dict[str, dict[int, Image]]]:
    """Run several qualities frame by frame in turn, so that whatever else goes on disturbs all alike.

    Returns:
        Milliseconds of every frame after the first ``WARM_UP``, tracking left out, and the wanted pictures; by label.
    """
    times: dict[str, list[float]] = {label: [] for label in qualities}
    images: dict[str, dict[int, Image]] = {label: {} for label in qualities}
    with contextlib.ExitStack() as stack:
        pipelines = {
            label: stack.enter_context(open_profiled(case.scene, device, quality, None, clock))
            for label, quality in qualities.items()
        }
        for index, (frame, pose) in enumerate(zip(case.frames, case.poses, strict=True)):
            for label, pipeline in pipelines.items():
                result = pipeline(frame.image, time_seconds=frame.time, pose=pose)
                if index in case.shown:
                    images[label][index] = result.image
                if index >= min(WARM_UP, len(case.frames) - 1):
                    own = (timing for name, timing in result.stages.items() if name != TRACK)
                    times[label].append(sum(timing.milliseconds for timing in own))
    return times, images


def _read_output(pipeline: Pipeline, setting: Setting) -> npt.NDArray[Any] | None:
    """What the setting's stage has written, in a form that all its methods share."""
    name = _OUTPUT.get(setting.name)
    if name is None:
        return None
    arrays = pipeline.arrays
    if name == "virtual" and name not in arrays:
        name = "physical_added"  # no objects: what has edges is the shadows on the desk
    if name == "irradiance":
        if "irradiance_sh" in arrays:
            return irradiance_from_sh(arrays["irradiance_sh"].numpy())
        return resample(arrays["irradiance_map"].numpy(), NORMALS)
    neutral = {"shadow_ratio": 1.0, "mirrored": 0.0}
    if name in neutral and name not in arrays:
        width, height = pipeline.size
        return np.full((height, width, 3), neutral[name], np.float32)
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
    return statistics.fmean(
        _flip_per_pixel(case, picture, images[index], region_of(case, index, picture))
        for index, picture in reference.items()
    )


def _apart(case: Case, reference: Mapping[int, Image], last: Mapping[int, Image], images: Mapping[int, Image]) -> float:
    """FLIP between two methods' pictures, divided as ``picture_error`` divides."""
    return statistics.fmean(
        _flip_per_pixel(case, last[index], images[index], region_of(case, index, picture))
        for index, picture in reference.items()
    )


def _flip_per_pixel(case: Case, a: Image, b: Image, region: Mask) -> float:
    errors = flip_map(a, b)
    return float((errors * region if case.darker else errors).sum()) / max(int(region.sum()), 1)


def region_of(case: Case, index: int, reference: Image) -> Mask:
    """Pixels of a frame that anything virtual, or the exposure, changes."""
    return case.regions[index] if index in case.regions else changed_region(case.frames[index].image, reference)


def sweep(
    case: Case,
    setting: Setting,
    device: str,
    base: Quality = BASE,
    *,
    methods: Sequence[str] | None = None,
    clock: Clock = time.perf_counter,
) -> tuple[list[Row], dict[str, Image]]:
    """Every method of one setting, or those named: its row, and its last picture."""
    outcomes: dict[str, Outcome] = {}
    for method in methods or setting.methods:
        turned = turn(base, {**_FAIR.get(setting.name, {}), setting.name: method})
        timed = 1 if method == "brute_force" else TIMED
        outcomes[method] = run(case, turned, device, setting, between=light_only(turned), timed=timed, clock=clock)
    if setting.name == NOW_AND_THEN and wp.get_device(device).is_cpu:
        count_work(case, outcomes, device, clock)
    last = list(outcomes.values())[-1]
    common = set.intersection(*(set(outcome.stages) for outcome in outcomes.values())) - set(setting.stages)
    reference = case.truth or last.images
    rows = []
    for method, outcome in outcomes.items():
        own = {name: ms for name, ms in outcome.stages.items() if name not in common}
        rows.append(
            Row(
                case.name,
                setting.name,
                method,
                sum(own.values()),
                outcome.milliseconds,
                _stage_error(outcome, last),
                picture_error(case, reference, outcome.images),
                "truth" if case.truth else "last method",
                _apart(case, reference, last.images, outcome.images),
            )
        )
    best = min(row.flip for row in rows)
    own_scale = setting.converges or not case.truth
    rows = [dataclasses.replace(row, error=row.apart if own_scale else row.flip - best) for row in rows]
    rows = [dataclasses.replace(row, dominated=_is_dominated(row, rows)) for row in rows]
    return rows, {method: outcome.images[case.shown[-1]] for method, outcome in outcomes.items()}


def count_work(case: Case, outcomes: dict[str, Outcome], device: str, clock: Clock) -> None:
    """Charge methods that work on a thread of their own with what the process works more than for the cheapest.

    Frames only bring the light meanwhile, and follow each other as fast as they can: times between are the clip's.
    """
    work: dict[str, float] = {}
    for method, outcome in outcomes.items():
        with open_profiled(case.scene, device, light_only(outcome.quality), None, clock) as pipeline:
            for index, (frame, pose) in enumerate(zip(case.frames, case.poses, strict=True)):
                if index == min(WARM_UP, len(case.frames) - 1):
                    begun = time.process_time()
                pipeline(frame.image, time_seconds=frame.time, pose=pose)
        # Outside: what was begun beside the frames has ended then.
        work[method] = worked_ms((time.process_time() - begun) / max(len(case.frames) - WARM_UP, 1), clock)
    for method, outcome in outcomes.items():
        stages = {**outcome.stages, NOW_AND_THEN: work[method] - min(work.values())}
        outcomes[method] = dataclasses.replace(outcome, stages=stages)


def _is_dominated(row: Row, rows: Sequence[Row]) -> bool:
    """Whether another method costs no more and errs no more, in the picture and in what the stage writes.

    What measurements cannot tell apart counts as equal; of equals the first in the methods stays.
    """

    def better(a: Row, b: Row) -> bool:
        cheaper = a.milliseconds < (1.0 - COST_NOISE) * b.milliseconds
        nearer = a.error < b.error - FLIP_NOISE
        mine, yours = (x.stage_error.relative_rmse if x.stage_error else 0.0 for x in (a, b))
        return cheaper or nearer or mine < (1.0 - RMSE_NOISE) * yours

    place = list(rows).index(row)
    return any(
        not better(row, other) and (better(other, row) or index < place)
        for index, other in enumerate(rows)
        if index != place
    )


def _stage_error(outcome: Outcome, last: Outcome) -> ArrayError | None:
    values, reference = outcome.output, last.output
    if values is None or reference is None or values.shape != reference.shape:
        return None
    is_map = reference.ndim == 3 and reference.shape[1] == 2 * reference.shape[0]
    return array_error(values, reference, latlong_weights(*reference.shape[:2]) if is_map else None)


def measure_case(
    case: Case,
    device: str,
    settings: Sequence[Setting],
    progress: Any = None,
    *,
    quick: bool = False,
    clock: Clock = time.perf_counter,
) -> CaseReport:
    """Sweep every setting, then run presets and the best choices.

    Args:
        case: Frames, and their truth if it is known.
        device: Where.
        settings: What to turn.
        progress: Told what comes next.
        quick: Leave brute force out.
        clock: Seconds, on CPU.
    """
    rows: list[Row] = []
    pictures: dict[tuple[str, str], Image] = {}

    def advance(text: str) -> None:
        if progress is not None:
            progress(f"{case.name}: {text}")

    for setting in settings:
        advance(setting.name)
        methods = [method for method in setting.methods if not (quick and method == "brute_force")]
        own, shown = sweep(case, setting, device, methods=methods, clock=clock)
        rows += own
        pictures.update({(setting.name, method): image for method, image in shown.items()})
    if case.name.endswith(SIZED):
        last = pictures[settings[-1].name, rows[-1].method]
        region = region_of(case, case.shown[-1], last)
        return CaseReport(case, {case.shown[-1]: last}, tuple(rows), pictures, (), region)
    advance("presets")
    qualities = {name: PRESETS[name] for name in RUNS}
    best = None
    if not case.truth:
        quality = PRESETS["reference"] if not quick else turn(PRESETS["reference"], {"environment_shadow": "bounce"})
        best = run(case, quality, device, between=light_only(quality), timed=1)
    reference = case.truth or (best.images if best is not None else {})
    everything = relevant_settings(case.scene, (case.scene.camera.width, case.scene.camera.height))
    if {setting.name for setting in everything} == {setting.name for setting in settings} and "paper" in qualities:
        advance("equal time, equal error")
        # As --quality auto does: costs measured here, errors from the list.
        frame, size = case.frames[-1], (case.scene.camera.width, case.scene.camera.height)
        costs = measure_costs(case.scene, frame.image, case.poses[-1], device, size, settings, clock)
        front = pareto_front(make_method_costs(costs, listed_errors(rows)), costs.scales)
        qualities |= {
            "ours in the paper's time": _find_same_time(case, front, costs.base - costs.track, device, clock),
            "ours at the paper's error": _find_same_error(case, front, device, reference),
        }
    times, images = run_in_turn(case, qualities, device, clock)
    wholes = tuple(
        Whole(
            label,
            statistics.fmean(times[label]),
            picture_error(case, reference, images[label]),
            {setting.name: chosen(quality, setting) for setting in everything},
            images[label],
            statistics.median(a / b for a, b in zip(times[label], times["paper"], strict=True))
            if "paper" in times
            else math.nan,
        )
        for label, quality in qualities.items()
    )
    index = case.shown[-1]
    return CaseReport(case, reference, tuple(rows), pictures, wholes, region_of(case, index, reference[index]))


def listed_errors(rows: Sequence[Row]) -> Mapping[str, Mapping[str, float]]:
    """Errors by setting and method, from the committed cost table; while that is empty, as measured here."""
    listed = load_errors()
    if any(any(own.values()) for own in listed.values()):
        return listed
    return {
        setting: {row.method: row.error for row in own}
        for setting, own in itertools.groupby(rows, lambda row: row.setting)
    }


def _find_same_time(case: Case, front: Sequence[Choice], base_ms: float, device: str, clock: Clock) -> Quality:
    """Least error by the list of what is measured, in turn with the paper's preset, to take no more than that."""

    def fits(choice: Choice) -> tuple[bool, float]:
        qualities = {"paper": PRESETS["paper"], "ours": _chosen(choice)}
        times, _ = run_in_turn(case, qualities, device, clock)
        paper = statistics.fmean(times["paper"])
        return statistics.fmean(times["ours"]) <= OVER * paper, paper

    paper = fits(front[0])[1]
    predicted = choose(front, paper - base_ms)
    low, high, place = 0, len(front), front.index(predicted)
    for _ in range(TRIES):
        if fits(front[place])[0]:
            low = place
        else:
            high = place
        if high - low <= 1:
            break
        place = min(low + 2, high - 1) if high == len(front) else (low + high) // 2
    return _chosen(front[low])


def _find_same_error(case: Case, front: Sequence[Choice], device: str, reference: Mapping[int, Image]) -> Quality:
    """Cheapest by the list of what is measured to err no more than the paper's preset: only the list orders."""

    def error(quality: Quality) -> float:
        between = light_only(quality)
        return picture_error(case, reference, run(case, quality, device, between=between, timed=1).images)

    aim = error(PRESETS["paper"])
    low, high = -1, len(front) - 1
    for _ in range(TRIES):
        if high - low <= 1:
            break
        middle = (low + high) // 2
        if error(_chosen(front[middle])) <= aim:
            high = middle
        else:
            low = middle
    return _chosen(front[high])


def _chosen(choice: Choice) -> Quality:
    return turn(COST_BASE, dict(choice.settings))


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
    (
        "Figure 7",
        "darken",
        ("dark_25", "dark_50"),
        "expose",
        ("plain", "box", "ball"),
        "A shorter exposure, simulated: what clips in the frame must not just turn grey. Plain scaling; the paper's "
        "box filter, which lets clipped pixels darken less where their surroundings clip too; ours, which estimates "
        "what the clipped pixels had from the glow around them and from the mirror ball's view of the same lamps.",
    ),
    (
        "Figure 8",
        "wire_coincident",
        (),
        "relight",
        ("flat", "paper", "reflectance"),
        "A virtual spotlight from where the room's own lamp shines, over wires that no model knows. Flat light; the "
        "paper's blend, which takes the frame's brightness for relief; ours, which divides the frame by the light that "
        "falls there and lights the reflectance that remains.",
    ),
    (
        "Figure 9",
        "wire_opposing",
        ("light",),
        "relight",
        ("flat", "paper", "reflectance"),
        "The same against the environment's lamp: what the frame shows bright now lies in shadow.",
    ),
)
"""Title, bundled scene, versions of cases that show the same with its truth, setting, its plain, paper's and best
method."""


def make_figures(
    device: str, count: int, truth: Path | None, times: int = 1, clock: Clock = time.perf_counter
) -> Iterator[Figure]:
    """Figures 7, 8 and 9 of the paper: plain, the paper's way, ours, each against the truth where that is known."""
    for title, bundled, versions, setting, methods, text in _FIGURES:
        cases = [(f"{title}: {bundled.replace('_', ' ')}", open_scene(bundled, count, times))]
        for folder in truth_folders(truth) if truth is not None else ():
            version = next((name for name in versions if (folder / f"scene_{name}.toml").is_file()), None)
            if version is not None:
                scene = load_scene(folder / f"scene_{version}.toml")
                case = load_case(folder.name, scene, count, read_truth(folder / version), times)
                cases.append((f"{title} again: {folder.name.replace('_', ' ')}, {version.replace('_', ' ')}", case))
        for number, (name, case) in enumerate(cases):
            index = case.shown[-1]
            camera = case.frames[index].image
            outcomes = []
            for method in methods:
                turned = turn(BASE, {setting: method})
                outcomes.append(run(case, turned, device, between=light_only(turned), timed=1, clock=clock))
            images = [outcome.images[index] for outcome in outcomes]
            reference = case.truth.get(index)
            labels = (f"plain ({methods[0]})", f"the paper ({methods[1]})", f"ours ({methods[2]})")
            columns = (("camera", camera), *zip(labels, images, strict=True))
            if reference is not None:
                columns = (*columns, ("truth", reference))
            region = clipped_region(camera) if setting == "expose" else region_of(case, index, images[-1])
            yield Figure(name, text if number == 0 else "", columns, reference, region)


# ------------------------------------------------------------------------------------------------------------ reporting


def make_cost_table(reports: Sequence[CaseReport], device: Any) -> dict[str, Any]:
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
        "made": _made(reports, device) | {"base": BASE.name},
        "errors": errors,
        "stage_errors": stage_errors,
        "dominated": {setting: methods for setting, methods in dominated.items() if methods},
    }


def make_preset_list(reports: Sequence[CaseReport], device: Any) -> dict[str, Any]:
    """FLIP per changed pixel of every preset's whole picture, by case."""
    return {
        "made": _made(reports, device),
        "errors": {
            report.case.name: {whole.label: round(whole.flip, 4) for whole in report.wholes if whole.label in RUNS}
            for report in reports
            if report.wholes
        },
    }


def _made(reports: Sequence[CaseReport], device: Any) -> dict[str, Any]:
    """Of what a list was made."""
    return {
        "by": f"python -m warp_ar.tradeoff {' '.join(report.case.name for report in reports)}",
        "device": device_name(device),
        "warp": wp.__version__,
        "against": "truth" if all(report.case.truth for report in reports) else "the last method where no truth is",
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


def records(report: CaseReport, device: Any) -> Iterator[dict[str, Any]]:
    """One plain record per method and per whole, ready for JSON lines."""
    common = {"device": device_name(device), "warp": wp.__version__}
    for row in report.rows:
        error = {} if row.stage_error is None else dataclasses.asdict(row.stage_error)
        plain = {key: value for key, value in dataclasses.asdict(row).items() if key != "stage_error"}
        yield {"kind": "method", **plain, **error, **common}
    for whole in report.wholes:
        yield {
            "kind": "whole",
            "case": report.case.name,
            "quality": whole.label,
            "milliseconds": whole.milliseconds,
            "over_paper": whole.over_paper if math.isfinite(whole.over_paper) else None,
            "flip": whole.flip,
            "settings": dict(whole.settings),
            **common,
        }


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
    add("--quick", action="store_true", help="leave brute force out: seconds instead of minutes on CPU")
    add("--processor-time", action="store_true", help="on CPU count the work of one thread, not the time by the clock")
    add(
        "--out",
        type=Path,
        metavar="DIR",
        help="write tradeoff.jsonl, cost_table.json and tradeoff.html here (or presets.json)",
    )
    add("--extra", type=Path, metavar="FILE", help="JSON lines of python -m bench precision, for the page")
    return parser


def chosen_settings(case: Case, name: str | None) -> tuple[Setting, ...]:
    """Settings of a case that the command line asks for."""
    settings = relevant_settings(case.scene, (case.scene.camera.width, case.scene.camera.height))
    if name is None:
        return settings
    if name not in {setting.name for setting in SETTINGS}:
        raise UsageError(f"--stage {name}: expected one of {', '.join(setting.name for setting in SETTINGS)}")
    return tuple(setting for setting in settings if setting.name == name)


def tradeoff(options: argparse.Namespace) -> int:
    """Measure, print and write."""
    if options.frames < 1:
        raise UsageError(f"--frames {options.frames}: expected 1 or more")
    if options.presets and options.stage is not None:
        raise UsageError(f"--presets --stage {options.stage}: expected one of both")
    if options.shrink < 1:
        raise UsageError(f"--shrink {options.shrink}: expected 1 or more")
    from warp_ar.device import resolve_device

    device = resolve_device(options.device)
    if options.processor_time and not device.is_cpu:
        raise UsageError(f"--processor-time counts a processor's work; it says nothing of {device}")
    clock: Clock = WORK if options.processor_time else time.perf_counter
    console = Console()
    console.width = max(console.width, MIN_COLUMNS)
    reports = []
    with Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), console=console) as progress:
        for case in open_cases(options):
            settings = () if options.presets else chosen_settings(case, options.stage)
            if case.name.endswith(SIZED):
                settings = tuple(setting for setting in settings if setting.name == "light_shadow")
                if options.presets:
                    continue
            if not settings and not options.presets:
                console.print(f"{case.name}: nothing to turn", highlight=False)
                continue
            task = progress.add_task(case.name, total=len(settings) + 2)

            def advance(text: str, task: Any = task) -> None:
                progress.update(task, advance=1, description=text)

            reports.append(measure_case(case, str(device), settings, advance, quick=options.quick, clock=clock))
            progress.remove_task(task)
            print_report(reports[-1], console)
    if not reports:
        raise UsageError("nothing to turn in any scene that was named")
    cost_table = make_cost_table(reports, device)
    for setting, methods in cost_table["dominated"].items():
        if methods:
            console.print(f"dominated in every case: {setting} {', '.join(methods)}", highlight=False)
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        lines = (json.dumps(record) for report in reports for record in records(report, device))
        (options.out / "tradeoff.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
        if options.presets:
            presets = make_preset_list(reports, device)
            (options.out / "presets.json").write_text(json.dumps(presets, indent=1) + "\n", encoding="utf-8")
            console.print(f"written to {options.out}", highlight=False)
            return EXIT_DONE
        (options.out / "cost_table.json").write_text(json.dumps(cost_table, indent=1) + "\n", encoding="utf-8")
        figures = (
            list(make_figures(str(device), options.frames, options.truth, options.shrink, clock))
            if options.stage is None
            else []
        )
        extra = [json.loads(line) for line in options.extra.read_text().splitlines()] if options.extra else []
        made = cost_table["made"] | {"clock": "processor time" if options.processor_time else "time"}
        page = tradeoff_page.render(reports, figures, made, extra)
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
