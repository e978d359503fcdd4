"""Flicker of a virtual object while the camera and everything in its view stand still.

The first frame of each case of ``../shared/truth`` passes 30 times through a simulated camera, with noise alone and
with noise and H.264. The cases are those without virtual lights, because the desk under a light has the camera's noise.
Pixels of the object are averaged over 9 by 9 pixels. A step is the change of these means between successive frames, in
8-bit codes of the channel that changes most. Printed are, from frame 10 on: the object's mean step, as the median over
frames and of the worst frame; the desk's mean step of the worst frame; and the largest relative step of irradiance.
``WARP_AR_FAULT_CASES`` names the cases, separated by commas.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bench.bench_camera_faults import QUALITY, TRUTH, irradiance, light_of
from bench.simulated_camera import Faults, expose
from warp_ar import Pipeline
from warp_ar.scene import load_scene

FRAMES, SETTLED = 30, 10
"""Number of frames, and number of first frames that are not measured."""
CAMERAS = {"noise": Faults(noise=0.02), "noise, h264": Faults(noise=0.02, codec="h264")}
DRAWN = 25
"""Difference in codes between picture and frame above which a pixel counts as the object's."""
CASES = "plastic_bunny_sunset,gold_torus_interior,night_desk_lamp,mirror_and_chalk_studio,overexposed_desk"


def steps(pictures: Any) -> Any:
    """Return the change between successive frames of means over 9 by 9 pixels, codes, (frames - 1, height, width)."""
    means = np.array([cv2.blur(picture, (9, 9)) for picture in pictures])
    return np.abs(np.diff(means, axis=0)).max(axis=-1)


def measure(case: Path, camera: Faults, device: str) -> dict[str, float]:
    frames = expose([light_of(case / "camera" / "0000.png")] * FRAMES, camera)
    pictures, lights = [], []
    outputs = ("image", "environment")
    with Pipeline(load_scene(case / "scene_object.toml"), device=device, quality=QUALITY, outputs=outputs) as pipeline:
        for index, frame in enumerate(frames):
            result = pipeline(frame, time_seconds=index / 30.0)
            pictures.append(np.array(result.image, float))
            lights.append(irradiance(result.environment).sum())
    before = np.array(frames[SETTLED:], float)
    shown, light = np.array(pictures[SETTLED:]), np.array(lights[SETTLED:])
    off = np.abs(shown - before).max(axis=-1)
    is_object, is_desk = np.median(off, axis=0) > DRAWN, off.max(axis=0) == 0.0
    own, desk = (cv2.erode(mask.astype(np.uint8), np.ones((11, 11))).astype(bool) for mask in (is_object, is_desk))
    of_object, of_desk = steps(shown)[:, own].mean(axis=1), steps(before)[:, desk].mean(axis=1)
    return {
        "pixels": float(own.sum()),
        "object_median": float(np.median(of_object)),
        "object_worst": float(of_object.max()),
        "desk_worst": float(of_desk.max()),
        "irradiance_worst": float(np.abs(np.diff(light)).max() / light.mean()),
    }


def main(device: str) -> None:
    if not TRUTH.is_dir():
        print(f"flicker: no {TRUTH}; nothing to look at")
        return
    for case in os.environ.get("WARP_AR_FAULT_CASES", CASES).split(","):
        for name, camera in CAMERAS.items():
            figures = {key: round(value, 4) for key, value in measure(TRUTH / case, camera, device).items()}
            print(json.dumps({"bench": "flicker", "case": case, "camera": name, **figures}), flush=True)
