"""Twin of ``marker_edge_fit.py``: a pose fitted to a marker's printed edges, in NumPy and OpenCV."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from warp_ar.kernels.color import decode_table
from warp_ar.kernels.picture.marker_edge_fit import CORRELATED, DONE, MIN_CELLS, MIN_EDGES, MIN_REACH, NOISE_FLOOR, TAPS
from warp_ar.scene import Camera, Pose
from warp_ar.tracking.markers import Pattern

PLACES = np.linspace(-1.0, 1.0, TAPS)
WEIGHTS = np.full(TAPS, 2.0 / (TAPS - 1))
WEIGHTS[[0, -1]] /= 2
PRIOR = np.diag([0.0] * 6 + [1.0] * 3)


@dataclasses.dataclass(frozen=True)
class Fit:
    """As a record of ``EdgeFit`` that is fitted, with the information."""

    pose: Pose
    information: np.ndarray
    error: float
    support: float
    cost: float
    pattern: float


def fit_edges(gray: np.ndarray, pattern: Pattern, camera: Camera, pose: Pose, reaches: Sequence[float]) -> Fit | None:
    """The pose that fits, from one to begin with; None where none does.

    Args:
        gray: The whole picture, uint8 (height, width).
        pattern: What is printed.
        camera: Of the picture.
        pose: ``camera_from_world``.
        reaches: Half width of the window in pixels, per step.
    """
    linear = cv2.LUT(gray, decode_table(camera.transfer).mean(1)).astype(np.float32)
    for reach in reaches:
        points = pose.apply(pattern.points)
        if points[:, 2].min() <= 1e-6:
            return None
        pixels, jacobian = project(camera, points)
        along = np.einsum("nij,nj->ni", jacobian, pattern.tangents @ pose.rotation.T)
        across = np.einsum("nij,nj->ni", jacobian, pattern.normals @ pose.rotation.T)
        normal = np.stack([-along[:, 1], along[:, 0]], -1) / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
        width = (normal * across).sum(1)
        normal *= np.sign(width)[:, None]
        half = np.minimum(0.45 * np.abs(width) * pattern.clearances, reach)
        seen, offset = edge_offsets(linear, pixels, normal, half)
        if seen is None:
            return None
        arm = points[seen] - pose.translation
        pull = np.einsum("ni,nij->nj", normal[seen], jacobian[seen])
        rows = np.hstack([np.cross(arm, pull), pull])
        solved = solve(rows, offset, normal[seen])
        if solved is None:
            return None
        step, residual, keep, information = solved
        pose = Pose(cv2.Rodrigues(step[:3])[0] @ pose.rotation, pose.translation + step[3:])
        if reach == reaches[-1] or (reach <= reaches[1] and np.abs(rows @ step).max() < DONE):
            break
    if pose.apply(pattern.outline)[:, 2].min() <= 0 or pose.rotation[:, 2] @ pose.translation >= 0:
        return None
    error = float(np.sqrt((keep * residual**2).sum() / keep.sum()))
    support, cost = float(keep.sum() / len(pattern.points)), float(np.minimum(residual**2, 1.0).mean())
    return Fit(pose, information, error, support, cost, correlate(linear, pattern, camera, pose))


def project(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) of camera points, and their derivatives (n, 2, 3) by the points."""
    zero = np.zeros(3)
    pixels, jacobian = cv2.projectPoints(points, zero, zero, camera.matrix(), np.array(camera.distortion, float))
    # With no rotation and no translation, the derivative by translation is the one by the point.
    return pixels.reshape(-1, 2), np.asarray(jacobian)[:, 3:6].reshape(-1, 2, 3)


def bilinear(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Values between pixels, all inside."""
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    right, below = np.minimum(left + 1, picture.shape[1] - 1), np.minimum(top + 1, picture.shape[0] - 1)
    a, b, values = x - left, y - top, picture.astype(float)
    upper = values[top, left] * (1 - a) + values[top, right] * a
    return upper * (1 - b) + (values[below, left] * (1 - a) + values[below, right] * a) * b


def edge_offsets(linear: np.ndarray, at: np.ndarray, normal: np.ndarray, half: np.ndarray) -> tuple[Any, Any]:
    """Which edges are seen, (n,), and how far those lie along their normals; None where too few are."""
    h, w = linear.shape
    places = at[:, None] + (half[:, None] * PLACES)[..., None] * normal[:, None]
    inside = ((places >= 0) & (places <= (w - 1, h - 1))).all(axis=(1, 2)) & (half >= MIN_REACH)
    if inside.sum() < MIN_EDGES:
        return None, None
    places = np.clip(places, 0, (w - 1, h - 1))
    values = bilinear(linear, places[..., 0], places[..., 1])
    black, white = values[:, :2].mean(1), values[:, -2:].mean(1)
    seen = inside & (white - black > max(0.3 * np.median((white - black)[inside]), 1e-4))
    if seen.sum() < MIN_EDGES:
        return None, None
    area = (2 * white - values @ WEIGHTS)[seen] / (white - black)[seen]
    return seen, np.clip(half[seen] * (area - 1.0), -half[seen], half[seen])


def solve(rows: np.ndarray, offset: np.ndarray, normals: np.ndarray) -> Any:
    """Pose step (6,), residuals, weights and information (6, 6); None where singular."""
    x, y = normals.T
    design = np.column_stack([rows, np.ones(len(rows)), x * x - y * y, 2 * x * y])
    weights = np.ones(len(rows))
    for _ in range(3):
        try:
            solution = np.linalg.solve((design * weights[:, None]).T @ design + PRIOR, design.T @ (weights * offset))
        except np.linalg.LinAlgError:
            return None
        residual = offset - design @ solution
        spread = max(1.4826 * float(np.sort(np.abs(residual))[len(residual) // 2]), NOISE_FLOOR)
        weights = np.maximum(1 - (residual / (4.7 * spread)) ** 2, 0.0) ** 2
    normal = (design * weights[:, None]).T @ design + PRIOR
    shared = normal[:6, 6:] @ np.linalg.solve(normal[6:, 6:], normal[6:, :6])
    information = (normal[:6, :6] - shared) / (CORRELATED * spread**2)
    return (solution[:6], residual, weights, information) if np.isfinite(solution).all() else None


def correlate(linear: np.ndarray, pattern: Pattern, camera: Camera, pose: Pose) -> float:
    """Correlation of the brightness at cell centres with the print; 0 where it cannot be seen."""
    points = pose.apply(pattern.cells)
    if points[:, 2].min() <= 1e-6:
        return 0.0
    at, (h, w) = project(camera, points)[0], linear.shape
    inside = ((at >= 0) & (at <= (w - 1, h - 1))).all(1)
    if inside.sum() < MIN_CELLS:
        return 0.0
    values = bilinear(linear, at[inside, 0], at[inside, 1])
    values = np.clip(values, *np.percentile(values, (5, 95)))
    a, b = values - values.mean(), pattern.white[inside] - pattern.white[inside].mean()
    scale = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / scale) if scale > 1e-9 else 0.0
