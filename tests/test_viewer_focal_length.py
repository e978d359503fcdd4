"""The focal length of a camera that nobody calibrated, from the marker in its frames."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.viewer_rig import rendered_cards
from warp_ar.scene import Camera, Marker, load_scene
from warp_ar.sources.sources import open_source
from warp_ar.viewer.camera import FocalEstimator, guessed_camera

# A corner's noise of 0.2 pixels over a dozen views tells the focal length to about 1 %.
FOCAL_ERROR = 0.03
# On rendered frames. A pinhole: noise alone, measured 0.1 % over 16 views. Lens and off-centre axis are left to
# calibration, and bend the estimate: measured 0.5 % for a phone's lens, 2 to 6 % for a webcam's barrel, 1.5 to 3 % for
# an axis 15 pixels off.
RENDERED_ERROR = {"pinhole": 0.01, "phone": 0.02, "barrel": 0.08, "off centre": 0.05}
# From the first two views, whatever the lens: good enough to start.
FIRST_ERROR = 0.05


@pytest.mark.parametrize("field", [45.0, 60.0, 75.0])
def test_focal_length_from_the_marker(field: float) -> None:
    rng = np.random.default_rng(1)
    focal = 320.0 / math.tan(math.radians(field / 2))
    camera = guessed_camera(640, 480, focal=focal)
    estimator = FocalEstimator(Marker(size=0.08), 640, 480)
    assert estimator.estimate() is None
    half = 0.04
    square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    for index in range(40):
        slant, around = math.radians(rng.uniform(25, 60)), 2 * math.pi * index / 13
        eye = 0.3 * np.array([math.sin(slant) * math.cos(around), math.sin(slant) * math.sin(around), math.cos(slant)])
        forward = -eye / np.linalg.norm(eye)
        right = np.cross(forward, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(forward, [0.0, 0.0, 1.0]))
        rotation = np.stack([right, np.cross(forward, right), forward])
        points = square @ rotation.T - rotation @ eye
        pixels = points[:, :2] / points[:, 2:] * focal + (camera.cx, camera.cy)
        estimator.add(pixels + rng.normal(0, 0.2, pixels.shape))
    found = estimator.estimate()
    assert found is not None
    assert abs(found.focal / focal - 1) < FOCAL_ERROR
    assert 0.0 < found.spread < 0.08


LENSES = {
    "pinhole": ((0.0, 0.0, 0.0, 0.0), (0.0, 0.0)),
    "phone": ((-0.05, 0.02, 0.0, 0.0), (3.0, -2.0)),
    "barrel": ((-0.25, 0.08, 0.0, 0.0), (0.0, 0.0)),
    "off centre": ((0.0, 0.0, 0.0, 0.0), (12.0, -9.0)),
}


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("field", [45.0, 75.0])
def test_focal_length_from_rendered_frames(field: float, lens: str) -> None:
    focal = 320.0 / math.tan(math.radians(field / 2))
    distortion, (right, down) = LENSES[lens]
    camera = Camera(640, 480, focal, focal, 319.5 + right, 239.5 + down, distortion)
    estimator = FocalEstimator(Marker(size=0.08), 640, 480)
    errors = []
    for image in rendered_cards(camera, 17, seed=3):
        if estimator.look(image) and estimator.ripe:
            found = estimator.estimate()
            errors.append(None if found is None else found.focal / focal - 1)
    known = [error for error in errors if error is not None]
    assert len(known) >= 3
    assert abs(known[0]) < FIRST_ERROR
    assert abs(known[-1]) < RENDERED_ERROR[lens]


def test_focal_length_from_a_clip_that_hardly_moves() -> None:
    scene = load_scene("desk")
    estimator = FocalEstimator(scene.marker, scene.camera.width, scene.camera.height)
    with open_source(scene.source.path) as source:  # type: ignore[union-attr, arg-type]
        for frame in source:
            if estimator.look(frame.image) and estimator.ripe and (found := estimator.estimate()) is not None:
                assert abs(found.focal / scene.camera.fx - 1) < FOCAL_ERROR
                return
    pytest.fail("no estimate")


def test_a_camera_straight_above_does_not_tell_its_focal_length() -> None:
    rng = np.random.default_rng(2)
    estimator = FocalEstimator(Marker(size=0.08), 640, 480)
    for _ in range(40):
        size = rng.uniform(60, 160)
        corner = rng.uniform(100, 300, 2)
        square = corner + size * np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
        estimator.add(square + rng.normal(0, 0.2, (4, 2)))
    found = estimator.estimate()
    assert found is None or found.spread > 0.03
