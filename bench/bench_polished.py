"""What a told polish is worth: pictures with ``[proxy.material]`` by the frames, by the truth, and without one.

Tables of ``tests/polished_table.py``: a box is drawn that really stands in one more picture of each, with which the
program's is compared over the pixels that it changes. Where frames do not tell that a table mirrors nothing is written,
so those pictures are the ones without. ``WARP_AR_POLISHED_SEEDS`` names first and last seed of the tables,
``WARP_AR_POLISHED_QUALITY`` the quality.
"""

from __future__ import annotations

import dataclasses
import json
import os
from typing import Any

import cv2
import flip_evaluator
import numpy as np

from bench.random_tables import load_environment
from bench.table_world import Block
from tests.polished_table import MIDDLE, Film, film
from warp_ar import Pipeline
from warp_ar.checks.check_pictures import Look
from warp_ar.doctor import TablePolish, look_for_polish
from warp_ar.kernels.color import decode_table
from warp_ar.scene import LambertMaterial, Object, ProxyMaterial, Scene

SEEDS = (300, 311)
COATS = ((0.08, 0.05), (0.15, 0.04), (0.2, 0.06), (0.3, 0.04), (0.0, 0.0), (0.12, 0.05))
"""Roughness and reflectance, in turn; a reflectance of 0 is a matt table."""
SIZE = np.array([0.05, 0.05, 0.08])
AWAY = 0.15
"""Metres from the card's middle, on the other side than the ball."""
TURN = 30.0
COLOR = np.array([0.6, 0.25, 0.15])
CHANGED = 5.0
"""Codes by which a blurred picture differs where it counts."""


def standing(ball: Any) -> Block:
    """The box that is there in truth and drawn by the program."""
    at = -AWAY * np.asarray(ball[:2]) / np.linalg.norm(ball[:2])
    return Block(np.array([*at, SIZE[2] / 2]), SIZE, TURN, COLOR, False)


def with_box(scene: Scene, ball: Any) -> Scene:
    """The scene with the box as a virtual object."""
    at = tuple(float(value) for value in standing(ball).at)
    size = tuple(float(value) for value in SIZE)
    color = tuple(float(value) for value in COLOR)
    box = Object("box", at=at, size=size, rotate=(0.0, 0.0, TURN), material=LambertMaterial(color))
    return dataclasses.replace(scene, objects=(box,))


def picture(made: Film, scene: Scene, quality: str, device: str) -> Any:
    """The view in the middle as the program draws it, once light from all views is gathered."""
    height, width = made.views[0][0].shape[:2]
    with Pipeline(scene, device=device, quality=quality, size=(width, height)) as pipeline:
        for number, (image, pose) in enumerate([*made.views, made.views[MIDDLE]]):
            result = pipeline(image, time_seconds=0.5 * number, pose=pose)
        return np.array(result.image)


def flip(truth: Any, image: Any) -> Any:
    pair = [np.ascontiguousarray(one, np.float32) / 255 for one in (truth, image)]
    return flip_evaluator.evaluate(*pair, "LDR", applyMagma=False)[0].squeeze()


def tell(made: Film) -> TablePolish | None:
    """What ``doctor`` would write."""
    images, camera = tuple(image for image, _ in made.views), made.scene.camera
    look = Look(camera, images, tuple(made.views), (0.0,) * len(images), decode_table(camera.transfer))
    return look_for_polish(made.scene, look)


def main(device: str) -> None:
    first, last = (int(part) for part in os.environ.get("WARP_AR_POLISHED_SEEDS", "{},{}".format(*SEEDS)).split(","))
    quality = os.environ.get("WARP_AR_POLISHED_QUALITY", "medium")
    for seed in range(first, last + 1):
        roughness, reflectance = COATS[seed % len(COATS)]
        name, environment = load_environment(np.random.default_rng(seed))
        made = film(seed, roughness, reflectance, environment=environment, standing=standing)
        scene, before = with_box(made.scene, made.scene.probes[0].center), made.views[MIDDLE][0]
        difference = cv2.GaussianBlur(np.abs(made.there.astype(float) - before).max(-1), (0, 0), 3)
        mask = cv2.dilate((difference > CHANGED).astype(np.uint8), np.ones((9, 9))) > 0
        nothing = flip(made.there, before)[mask].mean()

        def kept(material: ProxyMaterial | None, scene=scene, made=made, mask=mask, nothing=nothing) -> float:
            (plane,) = scene.proxies
            told = dataclasses.replace(scene, proxies=(dataclasses.replace(plane, material=material),))
            image = picture(made, told, quality, device)
            return round(float(flip(made.there, image)[mask].mean() / nothing), 4)

        found = tell(made)
        material = None
        if found is not None:
            material = ProxyMaterial(found.values["roughness"], (found.values["reflectance"],) * 3)
        true = ProxyMaterial(roughness, (reflectance,) * 3) if reflectance else None
        row = {"bench": "polished", "seed": seed, "environment": name, "about": made.about, "quality": quality}
        row |= {"coat": [roughness, reflectance], "told": None if found is None else found.values}
        row["without"] = kept(None)
        row["with"] = row["without"] if material is None else kept(material)
        row["true"] = row["without"] if true is None else kept(true)
        print(json.dumps(row), flush=True)
