"""Rigid motions between the world frame, which is the marker's frame, and a camera frame."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from warp_ar.declared import show
from warp_ar.errors import UsageError

Array = NDArray[np.float64]

_NOT_A_ROTATION = 1e-3
"""Largest deviation of R^T R from the identity, allowing for a rotation rounded to a few digits."""


@dataclasses.dataclass(frozen=True, eq=False)
class Pose:
    """Rigid motion that maps a point X to R X + t; a tracked pose is ``camera_from_world``."""

    rotation: Array
    """Rotation matrix R, float64 (3, 3)."""
    translation: Array
    """Translation t, float64 (3,), metres."""

    def __post_init__(self) -> None:
        """Check the shapes and numbers.

        Raises:
            UsageError: The rotation is not a (3, 3) rotation matrix, the translation is not (3,), or a number is not
                finite.
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
        """Return True if all numbers of both poses are equal."""
        return isinstance(other, Pose) and hash(self) == hash(other)

    def __hash__(self) -> int:
        """Return a hash of rotation and translation."""
        return hash((self.rotation.tobytes(), self.translation.tobytes()))

    def inverse(self) -> Pose:
        """Return the inverse motion, for example ``world_from_camera`` of ``camera_from_world``."""
        return Pose(self.rotation.T.copy(), -self.rotation.T @ self.translation)

    def after(self, first: Pose) -> Pose:
        """Return the motion that applies ``first`` and then this motion."""
        return Pose(self.rotation @ first.rotation, self.rotation @ first.translation + self.translation)

    def apply(self, points: Array) -> Array:
        """Return points (..., 3) transformed by this motion."""
        return points @ self.rotation.T + self.translation
