"""Rigid motions between the world, which is the marker's frame, and a camera."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Pose:
    """A rigid motion; as a tracked pose, ``camera_from_world``: X to R X + t."""

    rotation: Array
    """Rotation matrix R, float64 (3, 3)."""
    translation: Array
    """Translation t, float64 (3,), metres."""

    def inverse(self) -> Pose:
        """The motion back: from ``camera_from_world`` to ``world_from_camera``."""
        return Pose(self.rotation.T.copy(), -self.rotation.T @ self.translation)

    def after(self, first: Pose) -> Pose:
        """The motion that does ``first`` and then this one."""
        return Pose(self.rotation @ first.rotation, self.rotation @ first.translation + self.translation)

    def apply(self, points: Array) -> Array:
        """Points (..., 3) mapped by the motion."""
        return points @ self.rotation.T + self.translation
