"""Spread of recovered light and of the picture under changes that should not matter, on cases of ``../shared/truth``.

    python -m bench stability [--draws noise,dropped,rows,pose,tables] [--count 16] [--quality high]

Each case is run ``--count`` times for each kind of change:

- ``noise``: Gaussian noise, in 8-bit codes, on its frames;
- ``dropped``: three of ten frames, drawn at random, are missing, but not the first and the last. If a case's light
  changes during its third of a second (mirror, night, overexposed), the spread also contains the lag of the estimate;
- ``rows``: an environment map of 64, 96, 128, 192 or 256 rows;
- ``pose``: the camera's principal point displaced by a pixel, in a different direction each time;
- ``tables``: ten random tables with noise, one picture each.

One JSON line per case, in percent: ``mean``, ``p10`` and ``p90`` of the relative error of the last frame's irradiance
over all directions. ``spread`` is the difference of the two percentiles; ``picture`` is that of the ratio of the last
picture's error to the error without objects; ``power`` is that of the power of all emitters, relative to its mean.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.bench_camera_faults import TRUTH, flip, irradiance
from bench.random_tables import make_setup
from bench.truth_score import read_image
from warp_ar import PRESETS, Pipeline, Pose
from warp_ar.scene import load_scene, loads_scene
from warp_ar.sources.sources import open_source

KINDS = ("noise", "dropped", "rows", "pose", "tables")
ROWS = (64, 96, 128, 192, 256)
TABLES = 10
DROPPED = 0.3
"""Share of frames that are missing."""

Measures = tuple[float, float, float]
"""Relative error of irradiance; ratio of the picture's error to that without objects; power of all emitters."""


def noisy(image: NDArray[np.uint8], rng: np.random.Generator, noise: float) -> NDArray[np.uint8]:
    """Return a picture with Gaussian noise of a standard deviation in codes."""
    return np.clip(np.round(image + rng.normal(0.0, noise, image.shape)), 0, 255).astype(np.uint8)


def light_error(environment: object, truth: object) -> float:
    """Return the relative error of the irradiance over all directions."""
    light, true = irradiance(environment), irradiance(truth)
    return float(np.linalg.norm(light - true) / np.linalg.norm(true))


def emitted(pipeline: Pipeline) -> float:
    """Return the total power of the emitters that were found."""
    return float(sum(np.mean(one["power"]) for one in pipeline.arrays["recover_status"]().get("emitters", ())))


def left_of(case: Path, name: str, picture: NDArray[np.uint8]) -> float:
    """Return the ratio of a picture's FLIP to that of the frame without the object, where the object changes it."""
    camera, truth = (read_image(case / folder / name) for folder in ("camera", "object"))
    assert camera is not None
    assert truth is not None
    differs = cv2.GaussianBlur(np.abs(truth.astype(float) - camera).max(-1), (0, 0), 3) > 5
    changed = cv2.dilate(differs.astype(np.uint8), np.ones((9, 9))) > 0
    return float(flip(truth, picture)[changed].mean() / flip(truth, camera)[changed].mean())


def measure_case(case: Path, kind: str, number: int, given: argparse.Namespace, device: str) -> Measures:
    """Run a case once and return the measures of its last frame.

    Args:
        case: Folder of the case.
        kind: Kind of change.
        number: Number of the draw.
        given: Options of the command.
        device: Device of the pipeline.
    """
    scene, rng = load_scene(case / "scene_object.toml"), np.random.default_rng(number)
    quality, camera = PRESETS[given.quality], scene.camera
    if kind == "rows":
        quality = dataclasses.replace(quality, environment_height=ROWS[number])
    if kind == "pose":
        angle = 2.0 * np.pi * number / given.count
        moved = dataclasses.replace(camera, cx=camera.cx + float(np.cos(angle)), cy=camera.cy + float(np.sin(angle)))
        scene = dataclasses.replace(scene, camera=moved)
    assert scene.source is not None
    assert scene.source.path is not None
    outputs = ("image", "environment")
    with (
        open_source(scene.source.path) as source,
        Pipeline(scene, device=device, quality=quality, outputs=outputs) as pipeline,
    ):
        frames = list(source)
        for index, frame in enumerate(frames):
            if kind == "dropped" and 0 < index < len(frames) - 1 and rng.random() < DROPPED:
                continue
            image = noisy(frame.image, rng, given.noise) if kind == "noise" else frame.image
            result = pipeline(image, time_seconds=frame.time)
        power = emitted(pipeline)
    truth = np.load(sorted((case / "env").glob("*.npy"))[-1])
    name = sorted(path.name for path in (case / "object").glob("*.png"))[-1]
    return light_error(result.environment, truth), left_of(case, name, result.image), power


def measure_table(table: int, number: int, given: argparse.Namespace, device: str) -> Measures:
    """Run a random table once and return its measures; that of the picture is NaN, because there is no true one."""
    setup = make_setup(table)
    with Pipeline(
        loads_scene(setup.scene), device=device, quality=PRESETS[given.quality], outputs=("environment",)
    ) as pipeline:
        image = noisy(setup.image, np.random.default_rng(number), given.noise)
        result = pipeline(image, time_seconds=0.0, pose=Pose(setup.rotation, setup.translation))
        return light_error(result.environment, setup.truth), np.nan, emitted(pipeline)


def spread_of(values: NDArray[np.float64]) -> float:
    """Return the difference between the 90th and the 10th percentile."""
    low, high = np.quantile(values, (0.1, 0.9))
    return float(high - low)


def summarise(draws: Sequence[Measures]) -> dict[str, float]:
    """Return the figures that the module lists, in percent, over all runs of a case; NaN figures are left out."""
    light, picture, power = 100.0 * np.array(draws).T
    low, high = np.quantile(light, (0.1, 0.9))
    figures = {"mean": light.mean(), "p10": low, "p90": high, "spread": spread_of(light), "picture": spread_of(picture)}
    figures["power"] = 100.0 * spread_of(power) / max(float(power.mean()), 1e-9)
    return {key: round(float(value), 2) for key, value in figures.items() if np.isfinite(value)}


def main(device: str, arguments: Sequence[str] = ()) -> None:
    """Run all cases; print a line for each, and for each kind of change one with mean and largest spread."""
    parser = argparse.ArgumentParser(prog="python -m bench stability")
    parser.add_argument("--draws", default=",".join(KINDS))
    parser.add_argument("--count", type=int, default=16, help="draws of each kind (default: %(default)s)")
    parser.add_argument("--quality", default="high", choices=PRESETS)
    parser.add_argument("--cases", help="names of some cases, with commas (default: all)")
    parser.add_argument("--noise", type=float, default=0.7, help="standard deviation in codes")
    given = parser.parse_args(arguments)
    every = sorted(path.parent for path in TRUTH.glob("*/case.json"))
    cases = [case for case in every if given.cases is None or case.name in given.cases.split(",")]
    for kind in given.draws.split(","):
        run: dict[str, Callable[[int], Measures]]
        if kind == "tables":
            run = {f"table {k}": functools.partial(measure_table, k, given=given, device=device) for k in range(TABLES)}
        else:
            run = {case.name: functools.partial(measure_case, case, kind, given=given, device=device) for case in cases}
        numbers, spreads = range(len(ROWS) if kind == "rows" else given.count), []
        for name, measure in run.items():
            figures = summarise([measure(number) for number in numbers])
            spreads.append(figures["spread"])
            print(json.dumps({"draws": kind, "case": name, **figures}), flush=True)
        worst = {"spread": round(float(np.mean(spreads)), 2), "largest": max(spreads)}
        print(json.dumps({"draws": kind, "case": "all", **worst, "count": len(numbers)}), flush=True)
