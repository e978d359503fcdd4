"""Errors of light and picture for each fault of a simulated camera, alone and all together.

The camera takes the frames of the rendered cases in ``../shared/truth``, and also the true pictures, in which the
objects are real. The program's pictures of the frames are compared with the true ones. Where the ball clips in the
rendered frames, the light before the camera is computed from the case's environment, so that shorter exposures show it
correctly; other clipped light has the value ``BEYOND``.

Environment variables, with values separated by commas:

- ``WARP_AR_FAULT_CASES``: names of cases; all by default. A case is used in its version with virtual objects and
  lights if there is one, else in that with objects alone.
- ``WARP_AR_FAULTS``: names of faults; ``all_but_NAME`` stands for all except one.
- ``WARP_AR_FAULT_SEEDS``: seeds of the noise. Figures are means over them, because the effect of a codec on one noise
  is partly chance.
- ``WARP_AR_FAULT_DRAWN``: pictures to compare with the true ones; ``program`` by default.

Besides ``program``, these pictures give bounds:

- ``truth``: the true picture without the camera's noise and codec, which no program can predict.
- ``truth_laid``: the camera's frame plus the difference that the objects make in ``truth``. It keeps the frame's noise
  and codec.
- ``truth_again``: the true picture with noise of another seed and the codec, as from perfectly matched noise.
- ``faultless``: the program's result for a faultless camera, through the camera without noise and codec. A program that
  knows the camera perfectly would have this error. ``faultless_again`` has noise of another seed and the codec.
  ``faultless_bare`` lacks motion blur and sharpening, which the program does not simulate. They are missing on the desk
  as well, so the difference is an upper bound on their effect.
- ``clipped``: the program without recovery of light. A fault must not make recovered light worse than this.
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

from bench.simulated_camera import ALONE, Faults, decode_srgb, expose, faults_named
from warp_ar.light.captured import latlong_directions, texel_solid_angles
from warp_ar.scene import SourceSpec, load_scene
from warp_ar.session import Session
from warp_ar.stages.quality import PRESETS, Quality

TRUTH = Path(__file__).resolve().parents[2] / "shared" / "truth"
QUALITY = "medium"
BEYOND = 4.0
"""Linear value of clipped light, where it is unknown."""
ANOTHER = 1000
"""Difference of seeds between the camera's noise and other noise of the same kind."""
WITHIN = (np.arange(4) + 0.5) / 4 - 0.5
"""Offsets within a pixel, in each direction, of the rays by which the ball's reflection is computed."""


def read(path: Path) -> Any:
    return cv2.imread(str(path))[..., ::-1]


def light_of(path: Path, mirrored: Any = None) -> Any:
    """Return the linear values of a rendered frame, with clipped light from ``mirrored`` where that is not NaN."""
    codes = read(path)
    beyond = BEYOND if mirrored is None else np.where(np.isnan(mirrored), BEYOND, np.maximum(mirrored, 1.0))
    return np.where(codes >= 254, beyond, decode_srgb(codes))


def mirrored_light(case: Path, frame: int) -> Any:
    """Return the linear light of the environment that the ball reflects, (height, width, 3); NaN outside the ball.

    Where a frame with a quarter of the exposure (``dark_25``) does not clip, its median difference to this is 1 %.
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
    """Case before the camera: linear frames, (height, width, 3), without and with the objects."""

    case: Path
    """Folder of the case."""
    version: str
    """Version of the case: ``both`` or ``object``."""
    names: tuple[str, ...]
    """File names of the frames."""
    truths: frozenset[str]
    """Names of the frames that have a true picture."""
    clean: tuple[Any, ...]
    """Frames without the objects."""
    there: tuple[Any, ...]
    """Frames with the objects, or without them where there is no true picture."""

    @property
    def phase(self) -> Any:
        """Position of each frame in the clip, 0 to 1."""
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
    """Return the program's results for the frames of a camera."""
    scene = load_scene(clip.case / f"scene_{clip.version}.toml")
    scene = dataclasses.replace(scene, source=SourceSpec(path=clip.case / "camera", metering="automatic"))
    if faults.distortion:
        # The scene knows the lens. The camera's distortion refers to a focal length of the picture's width.
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
    """Return the linear values of the program's pictures for a faultless camera; clipped light is that of the truth."""
    results = program_results(clip, Faults(), expose(clip.clean, Faults()), device)
    pictures = [np.asarray(result.image) for result in results]
    return [
        np.where(codes >= 254, there, decode_srgb(codes)) for codes, there in zip(pictures, clip.there, strict=True)
    ]


def drawn_pictures(clip: Clip, faults: Faults, frames: list[Any], drawn: str, device: str) -> list[Any]:
    """Return the pictures ``drawn``, other than the program's, for a camera with faults (see the module)."""
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
    """Return the mean errors of light and pose over frames.

    ``light`` is relative; ``posed`` is the share of frames with a pose.
    """
    light, angles, shifts = [], [], []
    poses = json.loads((clip.case / "case.json").read_text())["poses"]
    for index, (name, result) in enumerate(zip(clip.names, results, strict=False)):
        # A camera whose highest code is below 255 shows light of 1 as that code.
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
    """Return the picture's error, FLIP, and its ratio to that without objects; for the program also light and pose."""
    frames = expose(clip.clean, faults)
    # The true pictures pass through an equal camera, with its noise, codec and drift.
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
        # Only noise depends on the seed; other faults give equal figures with each.
        runs = [
            score(read_clip(TRUTH / case, version), dataclasses.replace(faults, seed=seed), whose, device)
            for seed in (seeds if faults.noise else seeds[:1])
        ]
        rounded = {name: round(float(np.mean([run[name] for run in runs])), 4) for name in runs[0]}
        line = {"bench": "camera_faults", "case": case, "fault": fault, "drawn": whose, **rounded}
        print(json.dumps(line), flush=True)
