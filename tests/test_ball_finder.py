"""The ball's outline in a photograph."""

import cv2
import numpy as np
import pytest

from tests.photo_files import encode_srgb
from tests.photo_room import exposed, photograph, sphere
from tests.rendered_room import Room, look_at, render
from warp_ar.ball.ball_finder import find_ball, silhouette
from warp_ar.errors import UsageError
from warp_ar.scene import Camera

pytestmark = pytest.mark.slow

CLOSE = 0.5
"""Pixels: a fifth is the median over many pictures; of one, the worst of three unknowns is this."""


def ellipse(camera, center):
    points, _ = silhouette(camera, center)
    (x, y), (a, b), _ = cv2.fitEllipseDirect(points.astype(np.float32)[:, None])
    return x, y, 0.5 * np.sqrt(a * b)


@pytest.fixture(scope="module")
def picture():
    return cv2.GaussianBlur(exposed(60), (0, 0), 0.5).astype(np.uint8)


@pytest.mark.parametrize("off", [(0.0, 0.0, 1.0), (0.12, -0.1, 0.9), (-0.1, 0.1, 1.1)])
def test_outline_from_a_rough_circle(picture, off):
    camera = photograph()[1]
    x, y, r = ellipse(camera, sphere())
    found = find_ball(picture, camera, (x + off[0] * r, y + off[1] * r, r * off[2]))
    error = np.array([found.center[0] - x, found.center[1] - y, found.radius - r])
    assert np.abs(error).max() < CLOSE
    assert (np.abs(error) < 4.0 * np.array(found.deviation)).all()
    assert max(found.deviation) < 1.0
    toward = np.array(found.sphere) / np.linalg.norm(found.sphere)
    assert np.allclose(toward, sphere() / np.linalg.norm(sphere()), atol=2e-3)


@pytest.mark.parametrize("blur", [0.8, 1.1])
def test_a_soft_picture_s_outline_says_how_far_it_may_be_off(blur):
    linear = cv2.GaussianBlur(0.5 * photograph()[0], (0, 0), blur)
    camera = photograph()[1]
    x, y, r = ellipse(camera, sphere())
    found = find_ball(encode_srgb(linear).astype(np.uint8), camera, (x, y, r))
    error = np.array([found.center[0] - x, found.center[1] - y, found.radius - r])
    assert (np.abs(error) < 2.0 * np.array(found.deviation)).all()


def test_outline_from_nothing(picture):
    camera = photograph()[1]
    x, y, r = ellipse(camera, sphere())
    found = find_ball(picture, camera)
    assert np.abs([found.center[0] - x, found.center[1] - y, found.radius - r]).max() < 2 * CLOSE


def test_a_stand_and_a_wide_lens():
    room = Room(seed=1, lift=0.03, reflectance=0.7, lamp=30.0)
    camera = Camera(480, 360, 330.0, 330.0, 239.5, 179.5)
    eye = room.center + np.array([0.05, -0.25, 0.1])
    rotation, translation = look_at(eye, room.center + np.array([0.07, 0.0, 0.02]))
    codes = render(room, camera.matrix(), (rotation, translation), (480, 360), samples=3)
    image = np.round(255 * np.clip(codes, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    true = (rotation @ room.center + translation) / room.radius
    x, y, r = ellipse(camera, true)
    found = find_ball(image, camera, (x + 3, y - 3, 1.05 * r))
    assert np.abs([found.center[0] - x, found.center[1] - y, found.radius - r]).max() < CLOSE
    # Off the axis the silhouette is an ellipse: two half axes that a circle would mix up.
    assert found.axes[0] / found.axes[1] > 1.02


def test_bad_circles_and_pictures_without_a_ball():
    noise = np.random.default_rng(0).integers(100, 110, (200, 300, 3)).astype(np.uint8)
    with pytest.raises(UsageError, match="no ball"):
        find_ball(noise)
    with pytest.raises(UsageError, match="column, row and radius"):
        find_ball(noise, rough=(10.0, 10.0, 1.0))
