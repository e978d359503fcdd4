"""Where a mirror ball stands, by its outline alone: what holds where it mirrors nothing that is known."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.errors import UsageError
from warp_ar.scene import Camera, Pose

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_SEARCH = 10
"""Millimetres around the rough centre in which the ball is looked for."""
_BLUR = 0.9
"""Pixels: standard deviation of the blur under which the ball's rim is looked for."""
_RIM_POINTS = 96
"""Points on the ball's outline at which the picture is compared."""


@dataclasses.dataclass(frozen=True)
class BallReport:
    """Where a mirror ball stands."""

    center: tuple[float, float, float]
    """Centre in the marker's frame, metres."""
    contrast: float
    """Contrast across its outline against that just outside: 0 nothing there, 1 all."""
    views: int
    """Frames that were used."""


def outline_ball(camera: Camera, pose: Pose, center: Array, radius: float) -> tuple[Array, Array, NDArray[np.bool_]]:
    """The silhouette of a ball.

    Rays that touch the ball touch it on a circle: with d the distance of the centre c from the eye and n the direction
    to it, the circle's centre is c - n r^2 / d and its radius r sqrt(1 - r^2 / d^2).

    Returns:
        Pixels (n, 2) on the outline, outward unit normals (n, 2) in the image, and which points (n,) lie above the
        ball's middle in the world; empty if the ball is not wholly before the camera.
    """
    c = pose.apply(center)
    d = float(np.linalg.norm(c))
    if d <= radius or c[2] <= radius:
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, bool)
    n = c / d
    u = np.cross(n, [0.0, 1.0, 0.0] if abs(n[1]) < 0.9 else [1.0, 0.0, 0.0])
    u /= np.linalg.norm(u)
    v = np.cross(n, u)
    angle = 2 * np.pi * np.arange(_RIM_POINTS) / _RIM_POINTS
    spokes = np.outer(np.cos(angle), u) + np.outer(np.sin(angle), v)
    rim = c - n * radius**2 / d + radius * math.sqrt(1 - (radius / d) ** 2) * spokes
    pixels = cv2.projectPoints(rim, np.zeros(3), np.zeros(3), camera.matrix(), np.array(camera.distortion))[0].reshape(
        -1, 2
    )
    tangent = np.roll(pixels, -1, 0) - np.roll(pixels, 1, 0)
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], -1) / np.maximum(np.linalg.norm(tangent, axis=1), 1e-9)[:, None]
    outward = np.sign(((pixels - pixels.mean(0)) * normal).sum(1))
    above = (rim - c) @ pose.rotation[:, 2] > 0
    return pixels, normal * outward[:, None], above


def outline_search(
    views: Sequence[tuple[Image, Pose]], camera: Camera, center: Sequence[float], radius: float
) -> BallReport:
    """Centre of a mirror ball of known radius and height, from its outline in frames with known poses.

    The height stays as given: a ball stands on something, and from nearby viewpoints height and distance are hard to
    tell apart. Over the other two the mean contrast across the outline is largest where the ball is, less that just
    outside: reflections crowd inside the rim and would pull the outline in. Only the upper half counts, where the rim
    reflects what lies behind the receiver; below, it reflects that before it. No edge is picked by threshold.

    On path-traced desks this comes within 1 mm where the rim stands out, and within 9 mm where a bright band lies just
    inside it: look at the result, and measure such a ball with a ruler.

    Args:
        views: RGB frames with ``camera_from_world``.
        camera: the camera.
        center: rough centre in the marker's frame, metres, within 10 mm, and at the right height.
        radius: metres.

    Raises:
        UsageError: if the ball is in too few frames to see its outline.
    """
    h, w = views[0][0].shape[:2]
    gradients = [_gradients(image) for image, _ in views]

    def score(c: Array) -> float:
        total, count = 0.0, 0
        for (dx, dy), (_, pose) in zip(gradients, views, strict=True):
            pixels, normals, above = outline_ball(camera, pose, c, radius)
            rings = pixels + np.array([0.0, 3.5, 5.5])[:, None, None] * _BLUR * normals
            within = above & ((rings >= 1) & (rings <= (w - 2, h - 2))).all((0, 2))
            if not within.any():
                continue
            x, y = np.moveaxis(rings[:, within].astype(np.float32), 2, 0)
            slope = cv2.remap(dx, x, y, cv2.INTER_LINEAR) * normals[within, 0]
            slope = np.abs(slope + cv2.remap(dy, x, y, cv2.INTER_LINEAR) * normals[within, 1])
            # A lamp's edge must not outweigh the whole rim: strong is strong enough.
            strength = slope / (slope + 0.02)
            total += float((strength[0] - 0.5 * (strength[1] + strength[2])).sum())
            count += int(within.sum())
        return total / count if count >= _RIM_POINTS // 4 else -math.inf

    best, count = np.array(center, float), _SEARCH
    # Everywhere at 1 mm first: reflections make maxima of their own.
    for step in (1e-3, 4e-4, 2e-4, 1e-4, 5e-5):
        places = [
            best + step * np.array([x, y, 0.0]) for x in range(-count, count + 1) for y in range(-count, count + 1)
        ]
        scores = [score(place) for place in places]
        best, count = places[int(np.argmax(scores))], 2
    if not math.isfinite(max(scores)):
        raise UsageError(f"ball at {[round(x, 4) for x in center]}: its upper half is in no frame")
    x, y, z = (float(v) for v in best)
    return BallReport((x, y, z), max(scores), len(views))


def _gradients(image: Image) -> list[Any]:
    """Derivatives of blurred encoded brightness (0 to 1) along x and y, times the blur's width."""
    gray = cv2.medianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), 3).astype(np.float32) / 255
    smooth = cv2.GaussianBlur(gray, (0, 0), _BLUR)
    return [cv2.Sobel(smooth, cv2.CV_32F, x, y, ksize=3, scale=_BLUR / 8) for x, y in ((1, 0), (0, 1))]
