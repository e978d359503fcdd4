"""The focal length of a camera that nobody calibrated, from the marker in its frames."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

import cv2
import numpy as np
import pytest

from tests.viewer_rig import rendered_cards
from warp_ar.calibration.card import draw_card
from warp_ar.checks.check_pictures import FocalFit, look_at, measure_focal
from warp_ar.scene import Camera, Marker, load_scene
from warp_ar.sources.sources import open_source
from warp_ar.viewer.controls import guessed_camera
from warp_ar.viewer.setup import FOCAL_SPREAD

pytestmark = pytest.mark.slow

MARKER = Marker(size=0.08)
# On rendered frames, of eight views. A pinhole: noise alone, measured 0.4 %. Lens and off-centre axis are left to
# calibration, and bend the estimate: measured 0.7 % for a phone's lens, 1.2 % for a webcam's barrel, 2.6 % for an axis
# 15 pixels off.
LENSES = {
    "pinhole": ((0.0, 0.0, 0.0, 0.0), (0.0, 0.0), 0.01),
    "phone": ((-0.05, 0.02, 0.0, 0.0), (3.0, -2.0), 0.02),
    "barrel": ((-0.25, 0.08, 0.0, 0.0), (0.0, 0.0), 0.05),
    "off centre": ((0.0, 0.0, 0.0, 0.0), (12.0, -9.0), 0.05),
}
# Of the bundled clip, which hardly moves: measured 1.4 %.
CLIP_ERROR = 0.03


def fit_of(images: Iterable[np.ndarray], camera: Camera, marker: Marker = MARKER) -> FocalFit | None:
    frames = [(image, 0.4 * index) for index, image in enumerate(images)]
    return measure_focal(marker, look_at(marker, camera, frames))


@pytest.mark.parametrize(("lens", "field"), list(zip(LENSES, (45.0, 75.0, 75.0, 45.0), strict=True)))
def test_focal_length_from_stills(field: float, lens: str) -> None:
    """The guess is off by a third; stills that jump around the marker tell better than 5 %, whatever the lens."""
    focal = 320.0 / math.tan(math.radians(field / 2))
    distortion, (right, down), bound = LENSES[lens]
    camera = Camera(640, 480, focal, focal, 319.5 + right, 239.5 + down, distortion)
    guess = guessed_camera(640, 480)
    fit = fit_of(rendered_cards(camera, 8, seed=3), guess)
    assert fit is not None
    assert fit.deviation < FOCAL_SPREAD
    assert abs(fit.ratio * guess.fx / focal - 1) < bound


def test_focal_length_from_a_clip_that_hardly_moves() -> None:
    scene = load_scene("desk")
    camera = scene.camera
    guess = guessed_camera(camera.width, camera.height)
    with open_source(scene.source.path) as source:  # type: ignore[union-attr, arg-type]
        images = [frame.image for frame in source if frame.index % 12 == 0]
    fit = fit_of(images, dataclasses.replace(guess, transfer=camera.transfer), scene.marker)
    assert fit is not None
    assert abs(fit.ratio * guess.fx / camera.fx - 1) < CLIP_ERROR


def test_a_camera_straight_above_does_not_tell_its_focal_length() -> None:
    rng = np.random.default_rng(2)
    images = []
    for _ in range(8):
        image = np.full((480, 640), 200, np.uint8)
        card = cv2.resize(draw_card(MARKER, 4000.0), None, fx=(scale := rng.uniform(0.3, 0.5)), fy=scale)
        top, left = rng.integers(0, 480 - card.shape[0]), rng.integers(0, 640 - card.shape[1])
        image[top : top + card.shape[0], left : left + card.shape[1]] = card
        noisy = np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
        images.append(cv2.cvtColor(cv2.GaussianBlur(noisy, (0, 0), 0.7), cv2.COLOR_GRAY2RGB))
    fit = fit_of(images, guessed_camera(640, 480))
    assert fit is None or fit.deviation > FOCAL_SPREAD
