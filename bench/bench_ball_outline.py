"""Errors of a ball's outline in rendered photographs: column, row and radius in pixels, against the stated ones."""

from __future__ import annotations

import json

import cv2
import numpy as np

from tests.photo_files import encode_srgb
from tests.rendered_room import Room, look_at, render
from warp_ar.ball.ball_finder import find_ball, silhouette
from warp_ar.errors import UsageError
from warp_ar.scene import Camera

PICTURES = 16
SIZE = (640, 480)


def photograph(seed: int) -> tuple[np.ndarray, Camera, np.ndarray]:
    """A JPEG of a random room, its camera, and the ball's centre over its radius."""
    random = np.random.default_rng(100 + seed)
    lift, reflectance, lamp = (0.0, 0.03)[seed % 2], random.uniform(0.55, 0.9), random.uniform(20, 100)
    room = Room(seed=seed, lift=lift, reflectance=reflectance, lamp=lamp)
    focal, distance = random.uniform(700, 1500), random.uniform(0.35, 0.9)
    up, around = np.radians(random.uniform(10, 50)), np.radians(random.uniform(-180, 180))
    eye = np.array([np.sin(around) * np.cos(up), -np.cos(around) * np.cos(up), np.sin(up)])
    eye = room.center + distance * eye
    target = room.center + random.uniform(-0.1, 0.1, 3) * distance
    rotation, translation = look_at(eye, target, random.uniform(-8, 8))
    camera = Camera(*SIZE, focal, focal, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
    light = render(room, camera.matrix(), (rotation, translation), SIZE)
    light = cv2.GaussianBlur(light, (0, 0), 0.5) * random.uniform(0.5, 1.5)
    light = light + random.normal(size=light.shape) * np.sqrt(1e-6 + 8e-5 * np.clip(light, 0, None))
    _, data = cv2.imencode(".jpg", encode_srgb(light)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    image = np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])
    return image, camera, (rotation @ room.center + translation) / room.radius


def main(device: str) -> None:
    errors, stated = [], []
    for seed in range(PICTURES):
        image, camera, sphere = photograph(seed)
        points, _ = silhouette(camera, sphere)
        (x, y), (a, b), _ = cv2.fitEllipseDirect(points.astype(np.float32)[:, None])
        radius, random = 0.5 * np.sqrt(a * b), np.random.default_rng(seed)
        dx, dy, grow = random.uniform(-0.1, 0.1, 3)
        found = find_ball(image, camera, (x + dx * radius, y + dy * radius, (1 + grow) * radius))
        errors.append([found.center[0] - x, found.center[1] - y, found.radius - radius])
        stated.append(found.deviation)
        try:
            alone = find_ball(image, camera)
            off = float(np.hypot(alone.center[0] - x, alone.center[1] - y))
        except UsageError:
            off = float("nan")
        row = {"radius": round(radius, 1), "error": np.round(errors[-1], 3).tolist(), "found_alone_off": round(off, 2)}
        print(json.dumps({"bench": "ball_outline", "picture": seed, **row}), flush=True)
    ratio = np.array(errors) / np.array(stated)
    figures = {"median": np.median(np.abs(errors), 0), "over_stated": np.sqrt((ratio**2).mean(0))}
    print(json.dumps({"bench": "ball_outline", **{name: np.round(v, 2).tolist() for name, v in figures.items()}}))
