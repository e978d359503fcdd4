"""The focal length of an unknown camera, from the marker that it looks at.

A square seen at a slant tells it: its vanishing points fix the focal length of a camera with square pixels, a central
principal point and no distortion. Corners are too noisy for that closed form when the view is nearly straight on, so
the focal length is the one under which the marker's corners, posed anew for each candidate, are reprojected best over
many views at once.

A first guess good enough to start with; ``python -m warp_ar.calibrate camera`` measures the lens as well.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.scene import Camera, Marker
from warp_ar.tracking.markers import MarkerDetector

DEFAULT_FIELD_OF_VIEW: Final = 60.0
"""Horizontal, degrees: between a phone's main camera (65 to 70) and a laptop's (50 to 60)."""

_FIELDS: Final = (30.0, 100.0)
_CANDIDATES: Final = 33
_VIEWS: Final = 2
_MOST_VIEWS: Final = 32
_NOISE: Final = 0.3
"""Standard error of a corner in pixels, with which the spread of the estimate is judged."""
_GOOD_ENOUGH: Final = 0.08
_NEW_VIEW: Final = 0.01
"""A view counts as another one when its corners have moved by this share of the picture's width."""


@dataclasses.dataclass(frozen=True)
class FocalEstimate:
    """A focal length and how sure it is."""

    focal: float
    """Pixels."""
    spread: float
    """Relative standard error."""
    views: int
    """How many views it rests on."""


def guessed_camera(width: int, height: int, transfer: Any = "srgb", focal: float | None = None) -> Camera:
    """A camera with square pixels, a central principal point, no distortion, and the default field of view."""
    focal = focal or 0.5 * width / math.tan(0.5 * math.radians(DEFAULT_FIELD_OF_VIEW))
    return Camera(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1), transfer=transfer)


class FocalEstimator:
    """Collects views of a single marker until they tell the focal length."""

    def __init__(self, marker: Marker, width: int, height: int) -> None:
        self._marker, self._size = marker, (width, height)
        self._detector = MarkerDetector(marker.dictionary)
        half = 0.5 * marker.size
        self._square = np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])
        self._views: list[npt.NDArray[np.float64]] = []

    @property
    def ripe(self) -> bool:
        """Whether twice as many views have come as at the last time that was worth an estimate."""
        return len(self._views) >= _VIEWS and len(self._views).bit_count() == 1

    @property
    def full(self) -> bool:
        """Whether more views would hardly tell more."""
        return len(self._views) >= _MOST_VIEWS

    def look(self, image: npt.NDArray[np.uint8]) -> bool:
        """Take a frame, uint8 RGB; True if it showed the marker from a new side."""
        found = [d for d in self._detector.detect(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)) if d.id == self._marker.id]
        return len(found) == 1 and self.add(np.asarray(found[0].corners, np.float64))

    def add(self, corners: npt.NDArray[np.float64]) -> bool:
        """Take the marker's corners (4, 2) in pixels, clockwise from its top left; True if they show a new side."""
        if self.full:
            return False
        least = _NEW_VIEW * self._size[0]
        if any(np.abs(corners - view).max() < least for view in self._views):
            return False
        self._views.append(corners)
        return True

    def _error(self, focal: float) -> float:
        """Sum over all views of the squared reprojection error in pixels."""
        matrix = guessed_camera(*self._size, focal=focal).matrix()
        total = 0.0
        for corners in self._views:
            _, turns, shifts, _ = cv2.solvePnPGeneric(
                self._square, corners, matrix, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
            )
            errors = []
            for turn, shift in zip(turns, shifts, strict=True):
                turn, shift = cv2.solvePnPRefineLM(self._square, corners, matrix, None, turn, shift)
                points, _ = cv2.projectPoints(self._square, turn, shift, matrix, None)
                errors.append(float(((points[:, 0] - corners) ** 2).sum()))
            total += min(errors, default=0.0)
        return total

    def estimate(self) -> FocalEstimate | None:
        """The focal length, or None while the views do not tell it within 8 %."""
        if len(self._views) < _VIEWS:
            return None
        fields = np.radians(np.linspace(*_FIELDS, _CANDIDATES))
        logs = np.sort(np.log(0.5 * self._size[0] / np.tan(0.5 * fields)))
        errors = np.array([self._error(float(np.exp(log))) for log in logs])
        best = int(errors.argmin())
        if not 0 < best < len(logs) - 1:
            return None
        a, b, _ = np.polyfit(logs[best - 1 : best + 2] - logs[best], errors[best - 1 : best + 2], 2)
        if a <= 0.0:
            return None
        # Least squares: the error's curvature over the corners' variance is the information on log f.
        residual = errors[best] / max(8 * len(self._views) - 6 * len(self._views) - 1, 1)
        spread = math.sqrt(max(residual, _NOISE**2) / a)
        if spread > _GOOD_ENOUGH:
            return None
        return FocalEstimate(float(np.exp(logs[best] - b / (2.0 * a))), spread, len(self._views))
