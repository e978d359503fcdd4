"""Errors of light and picture for each fault of a simulated camera, alone and all together.

Frames of ``../shared/truth`` go through the camera; so does the picture with the virtual objects really there, with
which the program's is compared. What clips in the ball of those frames is, before the lens, what the ball mirrors of
the case's environment, so that a lower exposure shows as much of it as it would; elsewhere it is ``BEYOND``.
``WARP_AR_FAULT_CASES`` names the cases, ``WARP_AR_FAULTS`` the faults, ``WARP_AR_FAULT_SEEDS`` those of the noise, over
which figures are means: by one alone it is partly chance what a codec leaves.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import tempfile
from pathlib import Path
from typing import Any

import cv2
import flip_evaluator
import numpy as np

from tests.simulated_camera import ALL, ALONE, Faults, decode_srgb, expose
from warp_ar.light.captured import latlong_directions, texel_solid_angles
from warp_ar.scene import SourceSpec, load_scene
from warp_ar.session import Session

TRUTH = Path(__file__).resolve().parents[2] / "shared" / "truth"
QUALITY = "medium"
BEYOND = 4.0
"""Linear value of what clips, unless it is known."""
WITHIN = (np.arange(4) + 0.5) / 4 - 0.5
"""Places within a pixel, along either side, at which it is looked up what the ball mirrors."""


def read(path: Path) -> Any:
    return cv2.imread(str(path))[..., ::-1]


def light_of(path: Path, mirrored: Any = None) -> Any:
    """Linear values of a frame before the camera, what clips by ``mirrored`` where that is a number."""
    codes = read(path)
    beyond = BEYOND if mirrored is None else np.where(np.isnan(mirrored), BEYOND, np.maximum(mirrored, 1.0))
    return np.where(codes >= 254, beyond, decode_srgb(codes))


def mirrored_light(case: Path, frame: int) -> Any:
    """What the ball mirrors of the environment, linear; NaN beside the ball.

    Where a frame of a quarter of the exposure does not clip (``dark_25``), this is within 1 % of it in the median.
    """
    about = json.loads((case / "case.json").read_text())
    known = [int(path.stem) for path in (case / "env").glob("*.npy")]
    environment = np.load(case / "env" / f"{min(known, key=lambda number: abs(number - frame)):04d}.npy").astype(float)
    camera, pose, probe = about["camera"], about["poses"][frame], about["probe"]
    rotation, radius = np.array(pose["R"]), probe["radius"]
    center = rotation @ np.array(probe["center"]) + np.array(pose["t"])
    total = np.zeros((camera["height"], camera["width"], 3))
    count = np.zeros((camera["height"], camera["width"], 1))
    for down, right in itertools.product(WITHIN, WITHIN):
        y, x = np.mgrid[: camera["height"], : camera["width"]]
        slopes = (x + right - camera["cx"]) / camera["fx"], (y + down - camera["cy"]) / camera["fy"], np.ones(x.shape)
        ray = np.stack(slopes, -1)
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        along = ray @ center
        inside = along**2 - center @ center + radius**2
        normal = (ray * (along - np.sqrt(np.maximum(inside, 0.0)))[..., None] - center) / radius
        away = (ray - 2.0 * (ray * normal).sum(-1, keepdims=True) * normal) @ rotation
        rows = len(environment)
        row = (np.arccos(np.clip(away[..., 2], -1.0, 1.0)) / np.pi * rows).astype(int)
        column = ((np.arctan2(away[..., 1], away[..., 0]) / np.pi + 1.0) * rows).astype(int)
        meets = (inside > 0.0)[..., None]
        total += np.where(meets, environment[np.minimum(row, rows - 1), column % (2 * rows)], 0.0)
        count += meets
    return np.where(count > 0, total / np.maximum(count, 1) * np.array(probe["reflectance"]), np.nan)


def irradiance(radiance: Any) -> Any:
    small = cv2.resize(np.asarray(radiance, np.float32), (64, 32), interpolation=cv2.INTER_AREA).reshape(-1, 3)
    d = latlong_directions(32).reshape(-1, 3)
    area = np.broadcast_to(texel_solid_angles(32), (32, 64)).reshape(-1, 1)
    return np.maximum(latlong_directions(16).reshape(-1, 3) @ d.T, 0.0) @ (area * small)


def flip(truth: Any, picture: Any) -> Any:
    pair = [np.ascontiguousarray(image, np.float32) / 255 for image in (truth, picture)]
    return flip_evaluator.evaluate(*pair, "LDR", applyMagma=False)[0].squeeze()


def score(case: Path, version: str, faults: Faults, device: str) -> dict[str, float]:
    """Share of the picture's error that is kept, and errors of light and pose."""
    names = sorted(path.name for path in (case / "camera").glob("*.png"))
    phase = np.linspace(0.0, 1.0, len(names))
    truths = sorted(path.name for path in (case / version).glob("*.png"))
    mirrored = {name: mirrored_light(case, index) for index, name in enumerate(names)}
    clean = {name: light_of(case / "camera" / name, mirrored[name]) for name in names}
    frames = expose([clean[name] for name in names], faults)
    # The same clip with the objects there, so that its noise, codec and drift are the same camera's.
    there = [light_of(case / version / name, mirrored[name]) if name in truths else clean[name] for name in names]
    wanted = dict(zip(names, expose(there, faults, phase=phase), strict=True))
    scene = load_scene(case / f"scene_{version}.toml")
    scene = dataclasses.replace(scene, source=SourceSpec(path=case / "camera", metering="automatic"))
    known = (faults.distortion, 0.0, 0.0, 0.0, 0.0)
    if faults.distortion:
        # The calibration knows the lens: its focal length here is the picture's width.
        scale = (scene.camera.fx / scene.camera.width) ** 2
        known = (faults.distortion * scale, 0.0, 0.0, 0.0, 0.0)
        scene = dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, distortion=known))
    kept, nothing, light, angles, shifts = [], [], [], [], []
    poses = json.loads((case / "case.json").read_text())["poses"]
    with tempfile.TemporaryDirectory() as folder:
        for name, frame in zip(names, frames, strict=True):
            cv2.imwrite(str(Path(folder) / name), frame[..., ::-1])
        with Session(scene, source=folder, device=device, quality=QUALITY, outputs=("image", "environment")) as session:
            for index, (name, (_, result)) in enumerate(zip(names, session, strict=False)):
                # A camera that ends at a code below 255 has that code's value where the light is 1.
                gain = decode_srgb(np.array(faults.saturation))
                gain = gain * (1.0 + faults.exposure_drift * np.sin(2 * np.pi * phase[index]))
                tint = 1.0 + faults.white_balance_drift * np.array([1, 0, -1]) * phase[index]
                env = case / "env" / f"{Path(name).stem}.npy"
                if env.exists() and result.environment is not None:
                    truth = irradiance(np.load(env) * gain * tint)
                    light.append(np.linalg.norm(irradiance(result.environment) - truth) / np.linalg.norm(truth))
                if result.pose is not None:
                    turn = result.pose.rotation @ np.array(poses[index]["R"]).T
                    angles.append(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
                    shifts.append(1e3 * np.linalg.norm(result.pose.translation - np.array(poses[index]["t"])))
                if name in truths:
                    difference = np.abs(wanted[name].astype(float) - frames[index]).max(-1)
                    changed = cv2.GaussianBlur(difference, (0, 0), 3) > 5
                    mask = cv2.dilate(changed.astype(np.uint8), np.ones((9, 9))) > 0
                    kept.append(flip(wanted[name], result.image)[mask].mean())
                    nothing.append(flip(wanted[name], frames[index])[mask].mean())
    return {
        "kept": float(np.mean(kept) / np.mean(nothing)),
        "light": float(np.mean(light)) if light else float("nan"),
        "pose_degrees": float(np.mean(angles)) if angles else float("nan"),
        "pose_mm": float(np.mean(shifts)) if shifts else float("nan"),
        "posed": len(angles) / len(names),
    }


def main(device: str) -> None:
    if not TRUTH.is_dir():
        print(f"camera_faults: no {TRUTH}; nothing to compare with")
        return
    cases = os.environ.get("WARP_AR_FAULT_CASES", "plastic_bunny_sunset,gold_torus_interior").split(",")
    seeds = [int(seed) for seed in os.environ.get("WARP_AR_FAULT_SEEDS", "0").split(",")]
    chosen = os.environ.get("WARP_AR_FAULTS", ",".join([*ALONE, "all"])).split(",")
    for case in cases:
        for fault in chosen:
            faults = ALL if fault == "all" else ALONE[fault]
            # Noise alone has a seed; a fault without any gives the same figures with each.
            runs = [
                score(TRUTH / case, "both", dataclasses.replace(faults, seed=seed), device)
                for seed in (seeds if faults.noise else seeds[:1])
            ]
            rounded = {name: round(float(np.mean([run[name] for run in runs])), 4) for name in runs[0]}
            print(json.dumps({"bench": "camera_faults", "case": case, "fault": fault, **rounded}), flush=True)
