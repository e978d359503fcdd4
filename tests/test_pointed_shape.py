"""Planes, walls and boxes from four points."""

from __future__ import annotations

import numpy as np
import pytest

from tests.rendered_room import look_at
from warp_ar.checks.pointed_shape import point_out
from warp_ar.errors import UsageError
from warp_ar.scene import Camera, Pose, Proxy
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.pixel_rays import project

CAMERA = Camera(640, 480, 620.0, 620.0, 322.0, 236.0, (-0.08, 0.02, 0.0, 0.0, 0.0))
POSE = Pose(*look_at(np.array([0.1, -0.55, 0.4]), np.array([0.0, 0.02, 0.03])))
EXACT = 1e-4
"""Metres: a shape's numbers are rounded to hundredths of a millimetre."""
HAND = 0.012
"""Metres: points that miss by 3 pixels each way, a pixel being 1.9 mm along the desk's depth; two ends add up."""

SHAPES = {
    "plane": Proxy("plane", at=(0.03, 0.02, 0.0), rotate=(0.0, 0.0, 24.0), size=(0.16, 0.11)),
    "wall": Proxy("plane", at=(0.0, 0.14, 0.09), rotate=(90.0, 0.0, -9.0), size=(0.3, 0.18)),
    "box": Proxy("box", at=(-0.02, 0.01, 0.035), rotate=(0.0, 0.0, 31.0), size=(0.12, 0.09, 0.07)),
}
ORDERS = [("plane", (0, 1, 2, 3)), ("plane", (0, 3, 2, 1)), ("wall", (0, 1, 2, 3)), ("box", (0, 1, 5, 6))]


def corners(shape):
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * shape.size[:2]
    levels = (-shape.size[2] / 2, shape.size[2] / 2) if shape.shape == "box" else (0.0,)
    flat = np.concatenate([np.column_stack([square, np.full(4, z)]) for z in levels])
    return flat @ rotation_matrix(shape.rotate).T + shape.at


def apart(one, other):
    """Return how far corners lie from the nearest of another shape's, metres: it may be named from another corner."""
    return np.linalg.norm(corners(one)[:, None] - corners(other), axis=2).min(1).max()


@pytest.mark.parametrize(("kind", "order"), ORDERS)
def test_exact_points_give_the_shape(kind, order):
    seen = project(CAMERA, POSE.apply(corners(SHAPES[kind])))[list(order)]
    found = point_out(CAMERA, POSE, kind, [tuple(pixel) for pixel in seen])
    assert apart(found, SHAPES[kind]) < EXACT


@pytest.mark.parametrize(("kind", "order"), ORDERS)
def test_points_of_a_hand_give_nearly_the_shape(kind, order):
    rng = np.random.default_rng(3)
    seen = project(CAMERA, POSE.apply(corners(SHAPES[kind])))[list(order)] + rng.uniform(-3, 3, (4, 2))
    assert apart(point_out(CAMERA, POSE, kind, [tuple(pixel) for pixel in seen]), SHAPES[kind]) < HAND


@pytest.mark.parametrize(
    ("kind", "points", "said"),
    [
        ("wall", [(200, 200), (200, 200), (300, 100), (200, 100)], "at one place"),
        ("box", [(200, 300), (300, 300), (300, 420), (200, 260)], "expected both ends of an edge"),
    ],
)
def test_points_of_nothing_are_refused(kind, points, said):
    with pytest.raises(UsageError, match=said):
        point_out(CAMERA, POSE, kind, points)


def test_points_above_the_horizon_are_refused():
    level = Pose(*look_at(np.array([0.0, -0.6, 0.1]), np.array([0.0, 0.0, 0.1])))
    with pytest.raises(UsageError, match="horizon"):
        point_out(CAMERA, level, "plane", [(100, 20), (200, 20), (200, 300), (100, 300)])
