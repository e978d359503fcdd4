"""Where a camera's pixels look."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.scene.description import Camera


def pixel_rays(camera: Camera) -> npt.NDArray[np.float32]:
    """Normalised coordinates (x / z, y / z) of every pixel centre, lens distortion undone, (height, width, 2)."""
    columns, rows = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    pixels = np.stack([columns, rows], -1).reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-9)
    distortion = np.asarray(camera.distortion, np.float64)
    points = cv2.undistortPoints(pixels, camera.matrix(), distortion, criteria=stop)
    return np.asarray(points, np.float32).reshape(camera.height, camera.width, 2)
