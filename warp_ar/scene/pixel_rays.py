"""Projection of points to pixels and of pixels to rays, with lens distortion."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.scene.description import Camera

Float = npt.NDArray[np.float64]

_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 300, 1e-9)
"""Termination of the iterative undistortion: OpenCV's default of 5 steps leaves errors up to 30 pixels for strong
distortion."""


def project(camera: Camera, points: Float) -> Float:
    """Return the pixels, (n, 2), of points in the camera's frame, (n, 3); NaN for points behind the camera.

    Args:
        camera: The camera.
        points: x right, y down, z forward, metres.
    """
    if not len(points):
        return np.zeros((0, 2))
    ahead = points[:, 2] > 1e-6
    zero = np.zeros(3)
    safe = np.where(ahead[:, None], points, (0.0, 0.0, 1.0))
    pixels = cv2.projectPoints(safe, zero, zero, camera.matrix(), np.array(camera.distortion))[0].reshape(-1, 2)
    return np.where(ahead[:, None], pixels, np.nan)


def undistorted(camera: Camera, pixels: npt.ArrayLike) -> Float:
    """Return the undistorted normalised coordinates (x / z, y / z), (n, 2), of pixels (n, 2)."""
    flat = np.asarray(pixels, np.float64).reshape(-1, 1, 2)
    if not len(flat):
        return np.zeros((0, 2))
    points = cv2.undistortPoints(flat, camera.matrix(), np.array(camera.distortion), criteria=_STOP)
    return np.asarray(points, np.float64).reshape(-1, 2)


def pixel_rays(camera: Camera) -> npt.NDArray[np.float32]:
    """Return the normalised coordinates (x / z, y / z) of every pixel centre, (height, width, 2)."""
    columns, rows = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    points = undistorted(camera, np.stack([columns, rows], -1))
    return points.astype(np.float32).reshape(camera.height, camera.width, 2)
