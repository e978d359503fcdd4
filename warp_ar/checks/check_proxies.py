"""Check of modelled walls and boxes against edges in the picture.

Samples are taken along every visible edge of a shape. A sample matches if the colour of the picture changes abruptly
across the edge there. A shape with few matches is also tested at displaced positions. If many more samples match at one
of them, the shape is reported to be there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.checks.finding import Finding
from warp_ar.checks.pointed_shape import corners_of
from warp_ar.scene import Camera, Pose, Proxy, Scene
from warp_ar.scene.pixel_rays import project

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

FARTHEST: Final = 0.03
"""Largest displacement in metres, along x and y."""
STEPS: Final = (0.003, 0.001)
"""Distances in metres between tested displacements, first around the shape and then around the best displacement."""
PIXELS: Final = 5.0
"""Smallest displacement of a corner in pixels for a finding; for a box at the right place it is 0.6."""
ON: Final = 0.6
"""Share of matching samples from which a shape counts as right."""
BETTER: Final = 0.15
"""Smallest increase of the share of matching samples at a displaced position."""
FEWEST: Final = 2
"""Smallest number of views in which the shape fits only elsewhere, for a finding; all views if there are fewer."""
STEP: Final = 6.0
"""Smallest slope of the colour across an edge in 8-bit codes per pixel, above noise and wood grain. It is lower in dark
pictures."""
BRIGHT: Final = 110.0
"""Mean code of a picture from which ``STEP`` applies."""
FAINTEST: Final = 2.0
"""Smallest slope in codes per pixel in the darkest picture: four standard deviations of a camera's noise."""
_FACES: Final = ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))


def check_proxies(scene: Scene, camera: Camera, views: Sequence[tuple[Image, Pose]]) -> list[Finding]:
    """Return findings on walls and standing boxes whose edges are elsewhere in the picture."""
    found = []
    for index, proxy in enumerate(scene.proxies):
        kind, shape = _numbers(proxy)
        if kind is None:
            continue
        tried = [one for image, pose in views if (one := _elsewhere(image, camera, pose, kind, shape)) is not None]
        worse = [place for place, is_worse in tried if is_worse]
        if not worse or len(worse) < max(1, min(FEWEST, len(views))):
            continue
        off = np.median(worse, axis=0)
        x, y = np.add(proxy.at[:2], off)
        text = (
            f"[[proxy]] {index}: few edges of the picture lie on the outline of the {proxy.shape}; most lie "
            f"{1e3 * math.hypot(*off):.0f} mm away"
        )
        remedy = f"point it out again on the page, or write at = [{x:.3f}, {y:.3f}, {proxy.at[2]:g}]"
        found.append(Finding("proxy.edges", text, remedy))
    return found


def _numbers(proxy: Proxy) -> tuple[str | None, Array]:
    """Return the kind and the numbers of a wall or box that stands on the receiver, as ``corners_of`` takes them.

    The kind is None for any other shape.
    """
    turn = math.radians(proxy.rotate[2])
    x, y, z = proxy.at
    if proxy.shape == "box" and proxy.rotate[:2] == (0.0, 0.0) and abs(z - proxy.size[2] / 2) < 0.1 * proxy.size[2]:
        return "box", np.array([x, y, turn, *proxy.size])
    if proxy.shape == "plane" and proxy.rotate[:2] == (90.0, 0.0) and abs(z - proxy.size[1] / 2) < 0.1 * proxy.size[1]:
        return "wall", np.array([x, y, turn, *proxy.size])
    return None, np.zeros(0)


def _elsewhere(
    image: Image, camera: Camera, pose: Pose, kind: str, shape: Array
) -> tuple[tuple[float, float], bool] | None:
    """Return the displacement, x and y in metres, with the most matches, and True if the shape fits only there.

    The result is None if the shape is not entirely in the picture, because the rest of an outline would fit anywhere.

    Args:
        image: The picture.
        camera: Its camera.
        pose: ``camera_from_world``.
        kind: ``wall`` or ``box``.
        shape: Numbers of the shape, as ``corners_of`` takes them.
    """
    corners = corners_of(kind, shape)
    eye = -pose.rotation.T @ pose.translation
    seen = project(camera, pose.apply(corners))
    inside = (seen > 2) & (seen < (image.shape[1] - 3, image.shape[0] - 3))
    if eye[2] <= 0 or not inside.all():
        return None
    steps = _Steps(image)
    edges = _edges(kind, corners, eye)

    def met(x: float, y: float) -> float:
        pixels = project(camera, pose.apply(corners + np.array([x, y, 0.0])))
        return float(np.mean([steps.share(pixels[i], pixels[j]) for i, j in edges]))

    before, best = met(0.0, 0.0), (0.0, 0.0)
    if before >= ON:
        return best, False
    reach = FARTHEST
    for step in STEPS:
        grid = np.arange(-reach, reach + step / 2, step)
        places = [(best[0] + x, best[1] + y) for x in grid for y in grid]
        best = places[int(np.argmax([met(*place) for place in places]))]
        reach = step
    moved = project(camera, pose.apply(corners + np.array([*best, 0.0])))
    far = float(np.linalg.norm(moved - seen, axis=1).max()) > PIXELS
    return best, far and met(*best) > before + BETTER


def _edges(kind: str, corners: Array, eye: Array) -> list[tuple[int, int]]:
    """Return the edges of faces that are turned toward the camera, as pairs of indices of corners.

    Args:
        kind: ``wall`` or ``box``.
        corners: Corners of the shape in the world.
        eye: Position of the camera in the world.
    """
    faces = [(0, 1, 2, 3)]
    if kind == "box":
        middle, centers = corners.mean(0), [corners[list(face)].mean(0) for face in _FACES]
        towards = [(center - middle) @ (eye - center) > 0 for center in centers]
        faces = [face for face, is_seen in zip(_FACES, towards, strict=True) if is_seen]
    pairs = {tuple(sorted((face[k - 1], face[k]))) for face in faces for k in range(4)}
    return [(i, j) for i, j in sorted(pairs)]


class _Steps:
    """Slopes of the colour in a picture."""

    def __init__(self, image: Image) -> None:
        smooth = cv2.GaussianBlur(image, (0, 0), 0.8).astype(np.float32)
        # Scharr's kernel gives 32 for a slope of one code per pixel.
        self._slopes = [cv2.Scharr(smooth, cv2.CV_32F, *axes) / 32.0 for axes in ((1, 0), (0, 1))]
        self._least = max(STEP * min(float(image.mean()) / BRIGHT, 1.0), FAINTEST)

    def share(self, start: Array, end: Array) -> float:
        """Return the share of the samples along a line between two pixels across which the colour has a steep slope."""
        length = float(np.linalg.norm(end - start))
        if not length > 0.0:
            return 0.0
        normal = np.array([start[1] - end[1], end[0] - start[0]]) / length
        along = np.linspace(0.0, 1.0, max(int(length / 4), 3) + 2)[1:-1]
        at = start + along[:, None, None] * (end - start) + normal * np.array([-1.0, 0.0, 1.0])[:, None]
        places = np.round(at).astype(int)
        columns, rows = (np.clip(places[..., k], 0, self._slopes[0].shape[1 - k] - 1) for k in (0, 1))
        slope = normal[0] * self._slopes[0][rows, columns] + normal[1] * self._slopes[1][rows, columns]
        strength = np.sqrt((slope**2).mean(-1)).max(1)
        return float((strength > self._least).mean())
