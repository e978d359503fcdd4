"""Planes, walls and boxes from four points that a user selects in one picture, without detection of edges."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from warp_ar.errors import UsageError
from warp_ar.scene import Camera, Pose, Proxy
from warp_ar.scene.pixel_rays import project, undistorted

Array = NDArray[np.float64]

SMALLEST: Final = 0.004
"""Shortest side of a shape, metres."""
LARGEST: Final = 3.0
"""Longest side of a shape and its largest distance from the marker, metres."""
SQUARE: Final = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
"""Corners of a unit square around the origin."""
_ORDER: Final = {
    "plane": "its four corners, around it",
    "wall": "the left and right end of its foot, then its top right and top left corner",
    "box": "both ends of an edge of its base, the corner of its top above the second, and the next one behind it",
}


def point_out(camera: Camera, pose: Pose, kind: str, points: Sequence[tuple[float, float]]) -> Proxy:
    """Return the plane, wall or box whose projected corners are nearest to four points of a picture.

    Args:
        camera: Camera of the picture.
        pose: ``camera_from_world``.
        kind: ``plane``, ``wall`` or ``box``.
        points: Four pixels. For a plane: the corners of a rectangle on the receiver, in order. For a wall: the left and
            the right end of its foot, then its top right and top left corner. For a box: both ends of an edge of its
            base, then the corner of its top above the second end, then the next corner of its top, which is further
            back.

    Raises:
        UsageError: The points outline no such shape.
    """
    pixels = np.asarray(points, float)
    eye, rays = -pose.rotation.T @ pose.translation, undistorted(camera, pixels)
    rays = np.column_stack([rays, np.ones(len(rays))]) @ pose.rotation
    shape = _start(kind, eye, rays)
    if not _is_sound(shape):
        sizes = " x ".join(f"{1e3 * side:.0f}" for side in shape[3:])
        raise UsageError(f"the points make a {kind} of {sizes} mm; expected {_ORDER[kind]}")

    def seen(numbers: Array) -> Array:
        return project(camera, pose.apply(corners_of(kind, numbers)))

    # A box's corners are numbered from either end of the selected edge.
    chosen = [int(np.linalg.norm(seen(shape) - pixel, axis=1).argmin()) for pixel in pixels]
    for _ in range(6):  # Gauss-Newton with equal weights for all four points
        now = seen(shape)[chosen]
        steps = 1e-4 * np.eye(len(shape))
        jacobian = np.stack([(seen(shape + step)[chosen] - now).ravel() / 1e-4 for step in steps], 1)
        if not np.isfinite(jacobian).all():
            break
        moved = shape + np.linalg.lstsq(jacobian, (pixels - now).ravel(), rcond=None)[0]
        if not _is_sound(moved):
            break
        shape = moved
    return _proxy(kind, shape)


def corners_of(kind: str, shape: Array) -> Array:
    """Return a shape's corners in the world, (4, 3) metres; of a box those of its base, then those of its top, (8, 3).

    Args:
        kind: ``plane``, ``wall`` or ``box``.
        shape: x and y of the middle in metres, angle about the vertical in radians, and two or three sides in metres.
    """
    x, y, angle, width, second = shape[:5]
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    if kind == "wall":
        foot = np.array([[-width / 2, 0.0], [width / 2, 0.0]]) @ turn.T + (x, y)
        return np.array([[*foot[0], 0.0], [*foot[1], 0.0], [*foot[1], second], [*foot[0], second]])
    base = np.column_stack([(SQUARE * (width, second)) @ turn.T + (x, y), np.zeros(4)])
    return base if kind == "plane" else np.concatenate([base, base + np.array([0.0, 0.0, shape[5]])])


def _at_height(eye: Array, rays: Array, height: float = 0.0) -> Array:
    """Return the intersections of rays with a horizontal plane, (n, 2) metres.

    Args:
        eye: Common origin of the rays in the world.
        rays: Directions of the rays, (n, 3).
        height: Height of the plane above the receiver, metres.

    Raises:
        UsageError: A ray does not reach the plane.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (height - eye[2]) / rays[:, 2]
    if not (np.isfinite(far) & (far > 0)).all():
        raise UsageError("a point lies above the desk's horizon; point out corners that stand on the desk")
    return np.asarray((eye + far[:, None] * rays)[:, :2], float)


def _start(kind: str, eye: Array, rays: Array) -> Array:
    """Return initial numbers of a shape, as ``corners_of`` takes them, from the rays through the selected points.

    The first two points are the ends of an edge on the receiver. The others are above or behind it.
    """
    a, b = _at_height(eye, rays if kind == "plane" else rays[:2])[:2]
    along, middle = b - a, (a + b) / 2
    width, height = float(np.linalg.norm(along)), 0.0
    if width < SMALLEST:
        raise UsageError(f"two of the points are at one place; expected {_ORDER[kind]}")
    start = [math.atan2(along[1], along[0]), width]
    if kind != "plane":
        # Height at which the ray through the third point is closest to the vertical line through the second point.
        above = rays[2]
        far = float(above[:2] @ (b - eye[:2])) / max(float(above[:2] @ above[:2]), 1e-12)
        height = float(eye[2] + far * above[2])
    if kind == "wall":
        return np.array([*middle, *start, height])
    sideways = np.array([-along[1], along[0]]) / width
    depth = float((_at_height(eye, rays[3:], height)[0] - b) @ sideways)
    return np.array([*(middle + sideways * depth / 2), *start, abs(depth), height])[: 5 if kind == "plane" else 6]


def _is_sound(shape: Array) -> bool:
    sides = shape[3:]
    return bool(
        np.isfinite(shape).all()
        and ((sides >= SMALLEST) & (sides <= LARGEST)).all()
        and np.abs(shape[:2]).max() <= LARGEST
    )


def _proxy(kind: str, shape: Array) -> Proxy:
    x, y = (round(float(value), 5) for value in shape[:2])
    turn = round((math.degrees(float(shape[2])) + 180) % 360 - 180, 3)
    sides = tuple(round(float(value), 5) for value in shape[3:])
    if kind == "plane":
        return Proxy("plane", at=(x, y, 0.0), rotate=(0.0, 0.0, turn), size=sides)
    if kind == "wall":
        # A plane faces +z of its own frame; rotated upright about x, it faces -y.
        return Proxy("plane", at=(x, y, round(sides[1] / 2, 5)), rotate=(90.0, 0.0, turn), size=sides)
    return Proxy("box", at=(x, y, round(sides[2] / 2, 5)), rotate=(0.0, 0.0, turn), size=sides)
