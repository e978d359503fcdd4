"""Objects placed by a 4x4 matrix."""

from __future__ import annotations

import numpy as np
import pytest

from warp_ar.errors import SceneError
from warp_ar.scene import Object, object_at

BALL = Object("sphere", radius=0.03)


def placed(item: Object) -> np.ndarray:
    """Return the matrix by which the renderer places an object."""
    matrix = np.eye(4)
    rotation, matrix[:3, 3] = item.pose_at(0.0)
    matrix[:3, :3] = item.scale * rotation
    return matrix


def test_similarities_come_back() -> None:
    rng = np.random.default_rng(43)
    upright = [np.array([[0.0, 0.6, 0.8], [0.0, 0.8, -0.6], [-1.0, 0.0, 0.0]]), np.eye(3)]
    upright.append(upright[0] @ np.diag([-1.0, 1.0, -1.0]))
    for index in range(200):
        rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        rotation = upright[index] if index < len(upright) else rotation
        matrix = np.eye(4)
        matrix[:3, :3] = np.exp(rng.uniform(-3.0, 3.0)) * rotation * np.sign(np.linalg.det(rotation))
        matrix[:3, 3] = rng.normal(size=3)
        np.testing.assert_allclose(placed(object_at(BALL, matrix)), matrix, atol=1e-6)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(3), "expected a 4x4"),
        ("lamp", "expected a 4x4"),
        (np.full((4, 4), np.nan), "finite"),
        (np.eye(4) + np.eye(4, k=-3), "last column"),
        (np.diag([1.0, 1.0, 2.0, 1.0]), "one positive scale"),
        (np.diag([0.0, 0.0, 0.0, 1.0]), "one positive scale"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "mirrors"),
        (np.array([[1.0, 0.6, 0, 0], [0, 0.8, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]), "shears"),
    ],
)
def test_what_is_no_similarity_is_refused(matrix: object, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        object_at(BALL, matrix)
