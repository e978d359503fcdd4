"""Error of the irradiance estimated from card, planes and boxes, on rendered desks without the mirror ball.

The ball is painted over with the median of the desk around it. For comparison, there is the error of constant light
with the card's brightness, and that of the preset ``medium`` with the ball. Errors are relative to the true irradiance
at the ball's place, over all directions.
"""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.engine.pipeline import Pipeline
from warp_ar.kernels.color import decode_table
from warp_ar.light.card_light import light_by_card
from warp_ar.light.config import Kind
from warp_ar.light.surfaces import find_surfaces
from warp_ar.scene import Pose, Scene, load_scene
from warp_ar.scene.pixel_rays import project

FRAMES = (0, 5, 11)
"""Indices of the measured frames."""


def painted(image: npt.NDArray[np.uint8], scene: Scene, pose: Pose) -> npt.NDArray[np.uint8]:
    """Return a frame in which the first ball is painted over."""
    ball, camera = scene.probes[0], scene.camera
    center = pose.apply(np.array(ball.center))
    u, v = project(camera, center[None])[0]
    radius = 1.06 * camera.fx * ball.radius / float(np.sqrt(center[2] ** 2 - ball.radius**2)) + 2.0
    mask = np.zeros(image.shape[:2], np.uint8)
    cv2.circle(mask, (round(u), round(v)), int(np.ceil(radius)), 255, -1)
    ring = (cv2.dilate(mask, np.ones((15, 15), np.uint8)) > 0) & (mask == 0)
    out = image.copy()
    out[mask > 0] = np.median(image[ring], axis=0)
    return out


def card_irradiance(image: npt.NDArray[np.uint8], scene: Scene, pose: Pose) -> npt.NDArray[np.float64]:
    """Return the irradiance by the median of the card's paper alone, RGB."""
    surfaces = find_surfaces(scene)
    points = surfaces.points["position"][surfaces.kinds[surfaces.surface] == Kind.CARD].astype(np.float64)
    columns, rows = project(scene.camera, pose.apply(points)).round().astype(int).T
    codes, decode = np.median(image[rows, columns], axis=0).astype(int), decode_table(scene.camera.transfer)
    return np.pi / scene.marker.white * decode[codes, range(3)]


def main(device: str) -> None:
    """Print the three mean errors of each desk, and the largest ratio of the card's error to that of constant light."""
    theta, phi = (np.arange(64) + 0.5) / 64 * np.pi, ((np.arange(128) + 0.5) / 64 - 1.0) * np.pi
    rows, columns = np.meshgrid(theta, phi, indexing="ij")
    sine = np.sin(rows)
    directions = np.stack([sine * np.cos(columns), sine * np.sin(columns), np.cos(rows)], -1).reshape(-1, 3)
    normals = directions[::7]
    weights = np.maximum(normals @ directions.T, 0.0) * (sine.ravel() * (np.pi / 64) ** 2)
    for case in sorted(path.parent for path in Path(os.environ["WARP_AR_SHARED"], "truth").glob("*/case.json")):
        scene, told = load_scene(case / "scene_object.toml"), json.loads((case / "case.json").read_text())
        errors = []
        with Pipeline(scene, device=device, outputs=("environment",), estimates="synchronous") as pipeline:
            for frame in range(FRAMES[-1] + 1):
                pose = Pose(*(np.array(told["poses"][frame][key]) for key in ("R", "t")))
                image = np.ascontiguousarray(cv2.imread(str(case / "camera" / f"{frame:04d}.png"))[..., ::-1])
                ball = pipeline(image, pose=pose).environment
                if frame not in FRAMES or not (file := case / "env" / f"{frame:04d}.npy").exists():
                    continue
                light = light_by_card(painted(image, scene, pose), dataclasses.replace(scene, probes=()), pose)
                found, half = light.irradiance(normals)
                maps = (np.load(file).astype(np.float32), ball)
                small = (cv2.resize(env, (128, 64), interpolation=cv2.INTER_AREA).reshape(-1, 3) for env in maps)
                true, by_ball = (weights @ env for env in small)
                guesses = found, np.broadcast_to(card_irradiance(image, scene, pose), true.shape), by_ball
                misses = [float(np.linalg.norm(guess - true) / np.linalg.norm(true)) for guess in guesses]
                errors.append([*misses, misses[0] / misses[1], (np.abs(found - true) <= half).mean()])
        ours, constant, by_ball, _, within = np.mean(errors, axis=0)
        worst = max(ratio for *_, ratio, _ in errors)
        told_of = f"card {ours:.1%}  constant {constant:.1%}  ball {by_ball:.1%}  worst frame {worst:.2f} of constant"
        print(f"{case.name:26s} {told_of}  within the interval {within:.0%}")
