"""Textures of the bundled clips, drawn here: wood, the printed card, a tin, a page, the view from a window."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from make_shapes import noise

MARKER, CARD, PAPER, INK = 0.08, 0.12, 0.85, 0.04
"""Side of the marker and of its card in metres; reflectance of paper and ink."""


def wood(light: Any, dark: Any, seed: int, boards: int = 9, shape: tuple[int, int] = (1536, 2048)) -> np.ndarray:
    """Return a picture of boards along x: growth rings, fibres, pores, and a thin dark joint between boards."""
    rng = np.random.default_rng(seed)
    rows, width = shape
    height = rows // boards
    found = []
    for _ in range(boards):
        across = np.linspace(-1, 1, height, dtype=np.float32)[:, None]
        bend = noise(rng, height, width, (1, 3), 3)
        rings = 0.5 + 0.5 * np.sin(
            2 * np.pi * (rng.uniform(1.2, 2.6) * (across + rng.uniform(-1, 1)) ** 2 * 3 + 1.1 * bend)
        )
        fibre = noise(rng, height, width, (height // 6, 8), 2)
        pores = np.clip(noise(rng, height, width, (height // 3, 30), 1) - 0.6, 0, 1)
        mix = 0.42 + 0.34 * rings**1.5 + 0.10 * fibre - 0.6 * pores + rng.uniform(-0.16, 0.16)
        board = np.clip(mix, 0, 1.15)
        board[:2] *= 0.45
        found.append(board)
    mix = np.concatenate(found)
    mix = cv2.resize(mix, (width, rows))[..., None]
    return np.array(dark, np.float32) + mix * (np.array(light, np.float32) - np.array(dark, np.float32))


def card() -> np.ndarray:
    """Return a picture of the printed card: marker 0 of DICT_4X4_50, ink on paper, sharp to the pixel."""
    pixels = 48 * 6
    marker = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 0, pixels)
    edge = round(pixels * (CARD / MARKER - 1) / 2)
    gray = np.pad(np.where(marker > 127, PAPER, INK), edge, constant_values=PAPER)
    return np.repeat(gray[..., None], 3, -1)


def tin() -> np.ndarray:
    """Return a picture of the tea tin's face: a cream band with a ring between two thin lines on sage green."""
    image = np.tile(np.array([0.16, 0.27, 0.22], np.float32), (360, 800, 1))
    cream, ink = (0.72, 0.66, 0.52), (0.12, 0.2, 0.17)
    cv2.rectangle(image, (0, 95), (800, 265), cream, -1)
    for y in (106, 254):
        cv2.line(image, (0, y), (800, y), ink, 3, cv2.LINE_AA)
    cv2.circle(image, (400, 180), 52, ink, 4, cv2.LINE_AA)
    for k in range(5):  # a leaf
        cv2.ellipse(
            image,
            (400, 190 - 4 * k),
            (30 - 4 * k, 12 + 2 * k),
            -90 + 36 * (k - 2),
            0,
            360,
            (0.22, 0.38, 0.25),
            -1,
            cv2.LINE_AA,
        )
    for x in (150, 650):
        for k in range(3):
            cv2.line(image, (x - 80, 160 + 20 * k), (x + 80, 160 + 20 * k), ink, 4 if k == 1 else 2, cv2.LINE_AA)
    cv2.line(image, (0, 38), (800, 38), (0.09, 0.16, 0.13), 3, cv2.LINE_AA)
    return image


def page() -> np.ndarray:
    """Return a picture of a ruled page with a few written lines."""
    rng = np.random.default_rng(5)
    image = np.full((640, 448, 3), 0.74, np.float32) * np.array([1.0, 0.98, 0.92], np.float32)
    for y in range(60, 630, 28):
        cv2.line(image, (0, y), (448, y), (0.5, 0.58, 0.68), 1, cv2.LINE_AA)
    for row in range(6):
        x, y = 46.0, 60 + 28 * row
        points = []
        while x < rng.uniform(280, 410):
            x += rng.uniform(3, 6)
            points.append((x, y - 6 + rng.uniform(-9, 5)))
            if rng.uniform() < 0.13 and len(points) > 2:
                cv2.polylines(image, [np.array(points, np.int32)], False, (0.12, 0.14, 0.24), 1, cv2.LINE_AA)
                points, x = [], x + 9
    return image


def view(seed: int) -> np.ndarray:
    """Return the view from the window: sky that brightens toward the horizon, far trees, a lawn; mean about 1."""
    rng = np.random.default_rng(seed)
    rows, columns = 192, 192
    v = np.linspace(1, 0, rows, dtype=np.float32)[:, None, None]
    sky = np.array([0.75, 0.95, 1.25], np.float32) * v + np.array([1.35, 1.3, 1.2], np.float32) * (1 - v)
    sky = sky * (1 + 0.18 * noise(rng, rows, columns, (4, 2), 4)[..., None])
    crown = 0.3 + 0.09 * noise(rng, 1, columns, (1, 6), 4)[0]
    trees = np.array([0.22, 0.3, 0.13], np.float32) * (1 + 0.5 * noise(rng, rows, columns, (16, 16), 3)[..., None])
    image = np.where(v < crown[None, :, None], trees, sky)
    image = np.where(v < 0.14, np.array([0.45, 0.55, 0.22], np.float32), image)
    return np.clip(image, 0.02, None)
