"""Errors of light and picture for each fault of a simulated camera, alone and all together.

Frames of ``../shared/truth`` go through the camera; so does the picture with the virtual objects really there, with
which the program's is compared. What clips in the ball of those frames is, before the lens, what the ball mirrors of
the case's environment, so that a lower exposure shows as much of it as it would; elsewhere it is ``BEYOND``.
``WARP_AR_FAULT_CASES`` names the cases, all of that folder if it is not set; a case has the version with objects and
lights where that is rendered, else that with objects alone. ``WARP_AR_FAULTS`` names the faults; ``all_but_NAME`` is
all of them but one. ``WARP_AR_FAULT_SEEDS`` are those of the noise, over which figures are means: by one alone it is
partly chance what a codec leaves.

``WARP_AR_FAULT_DRAWN`` says whose pictures are compared, several after a comma: ``program`` if it is not set.

- ``truth`` is the picture with the objects really there through the same camera, but without its noise and codec, which
  nobody knows beforehand: what is left is not the program's.
- ``truth_laid`` lays the difference that the objects make in that picture over the camera's frame, which keeps noise
  and codec of what is really there.
- ``truth_again`` has noise and codec as well, but the noise of another seed: what matched noise and codec would give.
- ``faultless`` draws as ``truth`` does, but what this program makes of a faultless camera's frames: what is left to a
  program that knows all else about the camera. ``faultless_again`` draws that as ``truth_again`` does,
  ``faultless_bare`` without motion blur and sharpening, which this program does not draw; the desk has them
  neither there, so that this is at most what they cost.
- ``clipped`` is the program without recovery of light: beside its error of light, a fault must not invent any.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import os
import tempfile
from pathlib import Path
from typing import Any

import cv2
import flip_evaluator
import numpy as np

from tests.simulated_camera import ALONE, Faults, decode_srgb, expose, faults_named
from warp_ar.light.captured import latlong_directions, texel_solid_angles
from warp_ar.scene import SourceSpec, load_scene
from warp_ar.session import Session
from warp_ar.stages.quality import PRESETS, Quality

TRUTH = Path(__file__).resolve().parents[2] / "shared" / "truth"
QUALITY = "medium"
BEYOND = 4.0
"""Linear value of what clips, unless it is known."""
ANOTHER = 1000
"""From a seed of the noise to the seed of noise that is like it."""
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


@dataclasses.dataclass(frozen=True, eq=False)
class Clip:
    """A case before the camera: linear frames (height, width, 3) without the virtual objects and with them."""

    case: Path
    version: str
    names: tuple[str, ...]
    truths: frozenset[str]
    """Names of the frames that are known with the objects there."""
    clean: tuple[Any, ...]
    there: tuple[Any, ...]
    """As ``clean`` where the objects are not known."""

    @property
    def phase(self) -> Any:
        """Where in the clip each frame lies, 0 to 1."""
        return np.linspace(0.0, 1.0, len(self.names))


@functools.lru_cache(maxsize=1)
def read_clip(case: Path, version: str) -> Clip:
    names = sorted(path.name for path in (case / "camera").glob("*.png"))
    truths = frozenset(path.name for path in (case / version).glob("*.png"))
    mirrored = {name: mirrored_light(case, index) for index, name in enumerate(names)}
    clean = {name: light_of(case / "camera" / name, mirrored[name]) for name in names}
    there = [light_of(case / version / name, mirrored[name]) if name in truths else clean[name] for name in names]
    return Clip(case, version, tuple(names), truths, tuple(clean.values()), tuple(there))


def program_results(
    clip: Clip, faults: Faults, frames: list[Any], device: str, quality: str | Quality = QUALITY
) -> list[Any]:
    """What the program makes of a camera's ``frames``."""
    scene = load_scene(clip.case / f"scene_{clip.version}.toml")
    scene = dataclasses.replace(scene, source=SourceSpec(path=clip.case / "camera", metering="automatic"))
    if faults.distortion:
        # The calibration knows the lens: its focal length here is the picture's width.
        scale = (scene.camera.fx / scene.camera.width) ** 2
        known = (faults.distortion * scale, 0.0, 0.0, 0.0, 0.0)
        scene = dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, distortion=known))
    with tempfile.TemporaryDirectory() as folder:
        for name, frame in zip(clip.names, frames, strict=True):
            cv2.imwrite(str(Path(folder) / name), frame[..., ::-1])
        with Session(scene, source=folder, device=device, quality=quality, outputs=("image", "environment")) as session:
            return [result for _, (_, result) in zip(clip.names, session, strict=False)]


@functools.lru_cache(maxsize=1)
def faultless_light(clip: Clip, device: str) -> list[Any]:
    """Linear values of what the program draws of a faultless camera's frames; what clips as in the truth."""
    results = program_results(clip, Faults(), expose(clip.clean, Faults()), device)
    pictures = [np.asarray(result.image) for result in results]
    return [
        np.where(codes >= 254, there, decode_srgb(codes)) for codes, there in zip(pictures, clip.there, strict=True)
    ]


def drawn_pictures(clip: Clip, faults: Faults, frames: list[Any], drawn: str, device: str) -> list[Any]:
    """The truth or the faultless camera's result through a camera with ``faults``, as the module says."""
    light = faultless_light(clip, device) if drawn.startswith("faultless") else clip.there
    if drawn.endswith("_again"):
        return list(expose(light, dataclasses.replace(faults, seed=faults.seed + ANOTHER), phase=clip.phase))
    quiet = dataclasses.replace(faults, noise=0.0, codec="")
    if drawn.endswith("_bare"):
        quiet = dataclasses.replace(quiet, motion_blur=0.0, sharpening=0.0)
    pictures = expose(light, quiet, phase=clip.phase)
    if drawn != "truth_laid":
        return list(pictures)
    without = expose(clip.clean, quiet, phase=clip.phase)
    return [
        np.clip(frame.astype(int) + picture - empty, 0, 255).astype(np.uint8)
        for frame, picture, empty in zip(frames, pictures, without, strict=True)
    ]


def errors_of_results(clip: Clip, faults: Faults, results: list[Any]) -> dict[str, float]:
    """Errors of light and pose: means over frames."""
    light, angles, shifts = [], [], []
    poses = json.loads((clip.case / "case.json").read_text())["poses"]
    for index, (name, result) in enumerate(zip(clip.names, results, strict=False)):
        # A camera that ends at a code below 255 has that code's value where the light is 1.
        gain = decode_srgb(np.array(faults.saturation))
        gain = gain * (1.0 + faults.exposure_drift * np.sin(2 * np.pi * clip.phase[index]))
        tint = 1.0 + faults.white_balance_drift * np.array([1, 0, -1]) * clip.phase[index]
        env = clip.case / "env" / f"{Path(name).stem}.npy"
        if env.exists() and result.environment is not None:
            truth = irradiance(np.load(env) * gain * tint)
            light.append(np.linalg.norm(irradiance(result.environment) - truth) / np.linalg.norm(truth))
        if result.pose is not None:
            turn = result.pose.rotation @ np.array(poses[index]["R"]).T
            angles.append(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
            shifts.append(1e3 * np.linalg.norm(result.pose.translation - np.array(poses[index]["t"])))
    return {
        "light": float(np.mean(light)) if light else float("nan"),
        "pose_degrees": float(np.mean(angles)) if angles else float("nan"),
        "pose_mm": float(np.mean(shifts)) if shifts else float("nan"),
        "posed": len(angles) / len(clip.names),
    }


def score(clip: Clip, faults: Faults, drawn: str, device: str) -> dict[str, float]:
    """Share of the picture's error that is kept and that error itself; of the program, errors of light and pose too."""
    frames = expose(clip.clean, faults)
    # The same clip with the objects there, so that its noise, codec and drift are the same camera's.
    wanted = expose(clip.there, faults, phase=clip.phase)
    if drawn in ("program", "clipped"):
        quality = PRESETS[QUALITY].with_methods(recover="clipped") if drawn == "clipped" else QUALITY
        results = program_results(clip, faults, frames, device, quality)
        pictures, others = [result.image for result in results], errors_of_results(clip, faults, results)
    else:
        pictures, others = drawn_pictures(clip, faults, frames, drawn, device), {}
    kept, nothing = [], []
    for name, frame, truth, picture in zip(clip.names, frames, wanted, pictures, strict=True):
        if name in clip.truths:
            difference = np.abs(truth.astype(float) - frame).max(-1)
            changed = cv2.GaussianBlur(difference, (0, 0), 3) > 5
            mask = cv2.dilate(changed.astype(np.uint8), np.ones((9, 9))) > 0
            kept.append(flip(truth, picture)[mask].mean())
            nothing.append(flip(truth, frame)[mask].mean())
    return {"kept": float(np.mean(kept) / np.mean(nothing)), "flip": float(np.mean(kept)), **others}


def main(device: str) -> None:
    if not TRUTH.is_dir():
        print(f"camera_faults: no {TRUTH}; nothing to compare with")
        return
    rendered = ",".join(sorted(path.name for path in TRUTH.iterdir() if (path / "case.json").exists()))
    cases = os.environ.get("WARP_AR_FAULT_CASES", rendered).split(",")
    seeds = [int(seed) for seed in os.environ.get("WARP_AR_FAULT_SEEDS", "0").split(",")]
    chosen = os.environ.get("WARP_AR_FAULTS", ",".join([*ALONE, "all"])).split(",")
    drawn = os.environ.get("WARP_AR_FAULT_DRAWN", "program").split(",")
    for case, fault, whose in itertools.product(cases, chosen, drawn):
        faults = faults_named(fault)
        version = "both" if (TRUTH / case / "both").is_dir() else "object"
        # Noise alone has a seed; a fault without any gives the same figures with each.
        runs = [
            score(read_clip(TRUTH / case, version), dataclasses.replace(faults, seed=seed), whose, device)
            for seed in (seeds if faults.noise else seeds[:1])
        ]
        rounded = {name: round(float(np.mean([run[name] for run in runs])), 4) for name in runs[0]}
        line = {"bench": "camera_faults", "case": case, "fault": fault, "drawn": whose, **rounded}
        print(json.dumps(line), flush=True)
