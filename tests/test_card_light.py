"""Light by the card and other surfaces, where no ball is."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from warp_ar.errors import UsageError
from warp_ar.light.card_light import light_by_card
from warp_ar.scene import Camera, Marker, Pose, Proxy, Scene
from warp_ar.scene.pixel_rays import project

CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
BOX = Proxy("box", at=(0.0, 0.12, 0.03), size=(0.08, 0.06, 0.06), rotate=(0.0, 0.0, 45.0))
SCENE = Scene(CAMERA, marker=Marker(size=0.08, white=0.8), proxies=(Proxy("plane", size=(1.6, 1.2)), BOX))
DOWN = np.array([[1.0, 0.0, 0.0], [0.0, -0.6, -0.8], [0.0, 0.8, -0.6]])
POSE = Pose(DOWN, np.array([0.0, 0.05, 0.5]))
"""Looks down on the desk from the front, so that two upright faces of the box are seen."""
UP = np.array([[0.0, 0.0, 1.0]])


def picture(table: float, left: float, right: float) -> np.ndarray:
    """Codes of a desk: the card's white has 0.4, the box's upright faces what is given."""
    linear = np.full((CAMERA.height, CAMERA.width), table)

    def fill(corners: np.ndarray, value: float) -> None:
        cv2.fillPoly(linear, [project(CAMERA, POSE.apply(corners)).round().astype(np.int32)], value)

    fill(0.06 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), 0.4)
    turn = np.array([[1.0, -1, 0], [1, 1, 0], [0, 0, np.sqrt(2)]]) / np.sqrt(2)
    x, y, z = 0.5 * np.array(BOX.size)
    for corners, value in (
        ([[-x, -y, -z], [x, -y, -z], [x, -y, z], [-x, -y, z]], right),  # faces +x, -y of the world
        ([[-x, -y, -z], [-x, y, -z], [-x, y, z], [-x, -y, z]], left),  # faces -x, -y
        ([[-x, -y, z], [x, -y, z], [x, y, z], [-x, y, z]], 0.4),
    ):
        fill(np.array(corners) @ turn.T + np.array(BOX.at), value)
    codes = np.round(255.0 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055))
    return np.repeat(codes.astype(np.uint8)[..., None], 3, axis=2)


def test_the_card_tells_how_much_falls_from_above() -> None:
    found = light_by_card(picture(0.2, 0.2, 0.2), SCENE, POSE)
    (value,), (half,) = found.irradiance(UP)
    np.testing.assert_allclose(value, np.pi * 0.4 / 0.8, rtol=0.1)  # the box hides a part of it from the card
    assert (half > 0.05 * value).all(), "an interval is said"
    (below,), (wide,) = found.irradiance(-UP)
    np.testing.assert_allclose(below, np.pi * 0.2, rtol=0.3)
    assert (wide / below > half / value).all()
    assert (found.radiance >= 0.0).all()


def test_faces_of_a_box_tell_the_side() -> None:
    left, even, right = (
        light_by_card(picture(0.2, *faces), SCENE, POSE) for faces in ((0.3, 0.1), (0.2, 0.2), (0.1, 0.3))
    )
    assert left.main_direction[0] < even.main_direction[0] - 0.1
    assert right.main_direction[0] > even.main_direction[0] + 0.1
    sides = np.array([[-0.7, -0.7, 0.0], [0.7, -0.7, 0.0]])
    first, second = left.irradiance(sides)[0].mean(axis=1)
    assert first > 1.3 * second


def test_a_card_that_clips_is_a_lower_bound() -> None:
    bright = np.full((CAMERA.height, CAMERA.width, 3), 255, np.uint8)
    assert (light_by_card(bright, SCENE, POSE).irradiance(UP)[0] > 1.1 * np.pi / 0.8).all()


def test_a_frame_without_the_card_is_refused() -> None:
    away = Pose(DOWN, np.array([5.0, 0.0, 0.5]))
    with pytest.raises(UsageError, match="does not show its white paper"):
        light_by_card(picture(0.2, 0.2, 0.2), SCENE, away)
