"""Whether the intervals that calibrations state hold the truth: ``python -m bench intervals``.

A hundred random set-ups each: cameras (focal length, axis, lens, noise, hand that holds the card) and responses (gamma,
S, printer, light). An interval of two standard deviations must hold the truth in 95 of 100.
"""

from __future__ import annotations

import json
import os

import numpy as np

from bench.common import commit
from tests.printed_card import PrintedCard, linear_of, poses, smooth_curve
from tests.rendered_room import look_at
from warp_ar.input.camera_calibration import CameraReport, calibrate_camera
from warp_ar.input.grey_response import measure_grey_response
from warp_ar.scene import Camera, Pose

SETUPS = 100
HELD = 0.95
"""Share that must be held."""
VIEWS = 14


def srgb(linear: np.ndarray) -> np.ndarray:
    """Encoded light, 0 to 1."""
    value = np.clip(linear, 0.0, 1.0)
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)


def random_camera(rng: np.random.Generator) -> Camera:
    """A webcam's or a phone's, at 640x480."""
    focal = rng.uniform(480, 800)
    center = np.array([319.5, 239.5]) + rng.normal(0, 6, 2)
    return Camera(640, 480, focal, focal, *center, (rng.uniform(-0.15, 0.03), rng.uniform(-0.03, 0.05), 0.0, 0.0, 0.0))


def hand_poses(rng: np.random.Generator, focal: float) -> list[Pose]:
    """The card held before the camera, tilted another way each time, over all of the picture."""
    found = []
    for k in range(VIEWS):
        tilt, turn = np.radians((12, 30, 45)[k % 3] + rng.uniform(-6, 6)), 2.4 * k + rng.uniform(-0.4, 0.4)
        far = focal / 640 * rng.uniform(0.28, 0.4)
        shift = rng.uniform(-0.3, 0.3, 2) * far
        eye = np.array([*shift, 0.0]) + far * np.array(
            [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)]
        )
        found.append(Pose(*look_at(eye, np.array([*shift, 0.0]), rng.uniform(0, 360))))
    return found


def calibrated(seed: int) -> tuple[Camera, CameraReport]:
    """A random camera, and what calibrating it says."""
    rng = np.random.default_rng(seed)
    camera, card = random_camera(rng), PrintedCard(rng)
    noise = rng.uniform(0.5, 3.0)
    return camera, calibrate_camera(
        card.photograph(camera, pose, 0.7, srgb, noise) for pose in hand_poses(rng, camera.fx)
    )


def is_curve_held(seed: int) -> bool:
    """Whether a random camera's response lies in its interval, at 95 of 100 codes."""
    rng = np.random.default_rng(seed)
    card, encode = PrintedCard(rng), smooth_curve(rng)
    camera = Camera(640, 480, 620.0, 620.0, 319.5, 239.5)
    lights = rng.uniform(0.25, 0.95, 5)
    found = measure_grey_response(
        card.photograph(camera, pose, light, encode) for pose, light in zip(poses(rng, 5), lights, strict=True)
    )
    codes = np.arange(40, int(found.span[1]), 4)
    error = np.abs(np.log(found.curve[codes, 1] / linear_of(encode)[codes]))
    return bool((error < 2 * found.deviation[codes, 1]).mean() > 0.95)


def main(device: str) -> None:
    """Print how many intervals hold; ``WARP_AR_BENCH_SETUPS`` says of how many. Nothing runs on the device."""
    count = int(os.environ.get("WARP_AR_BENCH_SETUPS", SETUPS))
    ratios, errors = [], []
    for seed in range(count):
        truth, found = calibrated(seed)
        errors.append(abs(found.camera.fx / truth.fx - 1.0))
        ratios.append(abs(found.camera.fx - truth.fx) / found.focal_deviation)
    told = {"held": round(float((np.array(ratios) < 2).mean()), 3), "median_error": round(float(np.median(errors)), 5)}
    told |= {"largest_error": round(max(errors), 5), "ratio_95": round(float(np.percentile(ratios, 95)), 2)}
    _tell("camera", count, **told)
    held = [is_curve_held(seed) for seed in range(count)]
    _tell("response", count, held=round(float(np.mean(held)), 3))


def _tell(of: str, count: int, **figures: float) -> None:
    print(json.dumps({"case": f"interval of the {of}", "setups": count, **figures, "commit": commit()}), flush=True)
