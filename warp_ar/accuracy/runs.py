"""A case run at one quality: its pictures, the time of every stage, and what a setting's stage wrote."""

from __future__ import annotations

import contextlib
import dataclasses
import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any, Self

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.accuracy.cases import Case, Image
from warp_ar.accuracy.cost_table import Setting
from warp_ar.accuracy.costs import open_profiled
from warp_ar.engine.pipeline import TRACK, Pipeline, Result
from warp_ar.stages.quality import PRESETS, Quality

Clock = Callable[[], float]
BASE = PRESETS["high"]
"""Preset of all settings but the one that is turned."""
WARM_UP = 3
"""Frames that are not timed: modules load, caches fill."""
TIMED = 5
"""Last frames that are run at a method, the first of them not timed; those before only bring the light."""
REPEAT_BELOW = 2000.0
"""Milliseconds: a frame that took less is run again where it was the only one, for it loaded the kernels."""
NORMALS = (24, 48)
"""Orientations at which irradiance is compared, whatever form it has."""
_OUTPUT = {
    "unwrap": "probe_radiance",
    "recover": "environment",
    "irradiance": "irradiance",
    "prefilter": "prefilter_levels",
    "relight": "added_light",
    "environment_shadow": "shadow_ratio",
    "shade": "virtual",
    "mirror_ball": "mirror_ball",
    "edge_samples": "virtual",
    "light_shadow": "added_light",
    "area_light": "added_light",
    "expose": "image",
}
"""Output of a setting's stage; settings that are not here change the size of what is written."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """One quality, run over a case's frames."""

    quality: Quality
    images: Mapping[int, Image]
    stages: Mapping[str, float]
    """Median milliseconds of every stage, the marker's tracking left out."""
    output: npt.NDArray[Any] | None
    """Output of the setting's stage at the end."""

    @property
    def milliseconds(self) -> float:
        """Of all stages."""
        return sum(self.stages.values())


class LightBefore:
    """A pipeline that has lit the frames before those that count, kept for further qualities with the same light.

    Of a case's frames most only bring the light. Qualities whose light is found in the same way go on from one pipeline
    that has lit them once. Close it, or use it in a ``with`` statement.
    """

    def __init__(self) -> None:
        """Nothing is lit yet."""
        self._key: tuple[object, ...] | None = None
        self._stack = contextlib.ExitStack()
        self._pipeline: Pipeline | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Let the pipeline go."""
        self._stack.close()
        self._key = self._pipeline = None

    def light(self, case: Case, count: int, quality: Quality, device: str, clock: Clock) -> Pipeline:
        """A pipeline that has lit the first ``count`` frames of a case; it is to be gone on from, not to be called."""
        key = (id(case), count, dataclasses.replace(quality, name=""), device, clock)
        if self._pipeline is None or self._key != key:
            self.close()
            self._pipeline = self._stack.enter_context(open_profiled(case.scene, device, quality, None, clock))
            for frame, pose in zip(case.frames[:count], case.poses[:count], strict=True):
                self._pipeline(frame.image, time_seconds=frame.time, pose=pose)
            self._key = key
        return self._pipeline


def run(
    case: Case,
    quality: Quality,
    device: str,
    setting: Setting | None = None,
    *,
    between: Quality | None = None,
    timed: int = TIMED,
    clock: Clock = time.perf_counter,
    before: LightBefore | None = None,
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
        before: Keeps what has lit the frames before those, for the next quality with the same ``between``.
    """
    images: dict[int, Image] = {}
    times: dict[str, list[float]] = {}
    count = len(case.frames)
    wanted = {*case.shown, *range(max(0, count - timed), count)} if between is not None else set(range(count))
    skip = 1 if len(wanted) > 1 else 0
    first = min(wanted)
    shared = before is not None and first > 0 and wanted == set(range(first, count))
    with open_profiled(case.scene, device, quality, None, clock) as pipeline, contextlib.ExitStack() as stack:
        cheap = pipeline
        if before is not None and between is not None and shared:
            cheap = before.light(case, first, between, device, clock)
        elif between is not None:
            cheap = stack.enter_context(open_profiled(case.scene, device, between, None, clock))
        last = cheap if shared else pipeline
        for index in range(first if shared else 0, count):
            frame, pose = case.frames[index], case.poses[index]
            now = pipeline if index in wanted else cheap
            if now is not last and index > 0:
                now.continue_from(last)
            last = now
            result = now(frame.image, time_seconds=frame.time, pose=pose)
            if index in case.shown:
                images[index] = result.image
            if now is pipeline:
                if skip <= 0:
                    _note(times, result)
                skip -= 1
        output = None if setting is None else _read_output(pipeline, setting)
        if len(wanted) == 1 and sum(own[0] for own in times.values() if own) < REPEAT_BELOW:
            times.clear()
            pipeline.scheduler.forget()
            again = case.frames[-1].time + 1e-3
            _note(times, pipeline(case.frames[-1].image, time_seconds=again, pose=case.poses[-1]))
    times.pop(TRACK, None)
    stages = {name: statistics.median(own or [0.0]) for name, own in times.items()}
    return Outcome(quality, images, stages, output)


def _note(times: dict[str, list[float]], result: Result) -> None:
    for name, timing in result.stages.items():
        times.setdefault(name, []).extend([] if timing.skipped else [timing.milliseconds])


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
    """Return the output of the setting's stage, in a form that all its methods share."""
    name = _OUTPUT.get(setting.name)
    if name is None:
        return None
    arrays = pipeline.arrays
    if name == "virtual" and name not in arrays:
        name = "added_light"  # no objects: what has edges is the shadows on the desk
    if name == "irradiance":
        if "irradiance_sh" in arrays:
            return irradiance_from_sh(arrays["irradiance_sh"].numpy())
        return resample(arrays["irradiance_map"].numpy(), NORMALS)
    neutral = {"shadow_ratio": 1.0, "mirror_ball": 0.0}
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
