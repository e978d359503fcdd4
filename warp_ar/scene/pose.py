"""Rigid motions between the world, which is the marker's frame, and a camera."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from warp_ar.declared import show
from warp_ar.errors import UsageError

Array = NDArray[np.float64]

_NOT_A_ROTATION = 1e-3
"""Largest difference of R^T R from 1 of a rotation in a few digits."""


@dataclasses.dataclass(frozen=True, eq=False)
class Pose:
    """A rigid motion; as a tracked pose, ``camera_from_world``: X to R X + t."""

    rotation: Array
    """Rotation matrix R, float64 (3, 3)."""
    translation: Array
    """Translation t, float64 (3,), metres."""

    def __post_init__(self) -> None:
        """Check the shapes and numbers.

        Raises:
            UsageError: The rotation is not (3, 3) or no rotation, the translation not (3,), or a number is not finite.
        """
        for name, value, shape in (("rotation", self.rotation, (3, 3)), ("translation", self.translation, (3,))):
            array = np.asarray(value)
            if array.shape != shape or array.dtype.kind not in "fiu":
                given = f"has the shape {np.shape(value)}" if hasattr(value, "shape") else f"is {type(value).__name__}"
                right = f"expected an array {shape}, such as M[:3, :3] and M[:3, 3] of a 4x4 matrix M"
                raise UsageError(f"Pose: {name} {given}; {right}")
            if not np.isfinite(array).all():
                raise UsageError(f"Pose: {name} {show(array.tolist())}: expected finite numbers")
            object.__setattr__(self, name, array.astype(np.float64))
        turned = self.rotation
        off = np.abs(turned.T @ turned - np.eye(3)).max()
        if off > _NOT_A_ROTATION or np.linalg.det(turned) < 0.0:
            right = "expected a rotation matrix: orthonormal rows, no scale, no mirror image"
            raise UsageError(f"Pose: rotation {np.round(turned, 4).tolist()}: {right}")

    def __eq__(self, other: object) -> bool:
        """Return whether both are the same to the last bit."""
        return isinstance(other, Pose) and hash(self) == hash(other)

    def __hash__(self) -> int:
        """Return the hash of all numbers."""
        return hash((self.rotation.tobytes(), self.translation.tobytes()))

    def inverse(self) -> Pose:
        """The motion back: from ``camera_from_world`` to ``world_from_camera``."""
        return Pose(self.rotation.T.copy(), -self.rotation.T @ self.translation)

    def after(self, first: Pose) -> Pose:
        """The motion that does ``first`` and then this one."""
        return Pose(self.rotation @ first.rotation, self.rotation @ first.translation + self.translation)

    def apply(self, points: Array) -> Array:
        """Points (..., 3) mapped by the motion."""
        return points @ self.rotation.T + self.translation
