"""Edges of a print: the native fit against its NumPy twin, on sharp, blurred, half hidden and small ones."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.reference import marker_edge_fit as reference
from tests.test_tracking import CAMERA, look, make_camera, render
from warp_ar.scene import Camera, GridBoard, Marker, Pose
from warp_ar.tracking.edge_fit import EdgeFitter
from warp_ar.tracking.markers import make_pattern

PIXELS = 2e-4
"""Between two fits of one picture: samples are interpolated in float32. Measured at most 3e-5."""
RELATIVE = 1e-3
"""Of errors, supports, costs and information, which fall with the square of residuals of 0.01 pixel."""
REACHES = (4.0, 3.0, 2.5, 2.5)
BENT = make_camera(distortion=(-0.12, 0.05, 0.001, -0.002, 0.01, 0.02, -0.01, 0.003))
BOARD = Marker("DICT_4X4_50", board=GridBoard(3, 2, 0.04, 0.01))


def whole(camera: Camera) -> tuple[slice, slice]:
    return slice(0, camera.height), slice(0, camera.width)


def nudged(pose: Pose, seed: int) -> Pose:
    """A pose as detected corners have it: some pixels off."""
    random = np.random.default_rng(seed)
    turn = cv2.Rodrigues(np.radians(random.normal(0, 0.4, 3)))[0]
    return Pose(turn @ pose.rotation, pose.translation + random.normal(0, 8e-4, 3))


def outline(pattern, camera: Camera, pose: Pose) -> np.ndarray:
    return reference.project(camera, pose.apply(pattern.outline))[0]


def hidden(image: np.ndarray) -> np.ndarray:
    """Without the left of where the marker is."""
    image = image.copy()
    image[:, : image.shape[1] // 2] = 90
    return image


CASES = {
    "sharp": (Marker(), CAMERA, look(30, 10), lambda image: image),
    "tilted": (Marker(), CAMERA, look(65, 40, 0.5), lambda image: image),
    "lens": (Marker(), BENT, look(20, -15, 0.5, (0.12, 0.08)), lambda image: image),
    "blurred": (Marker(), CAMERA, look(35, 20, 0.5), lambda image: cv2.blur(image, (9, 3))),
    "half hidden": (Marker(), CAMERA, look(25, 5, 0.35), hidden),
    "cut off": (Marker(), CAMERA, look(25, 5, 0.4, (0.17, 0.0)), lambda image: image),
    "small": (Marker(), CAMERA, look(40, 10, 1.5), lambda image: image),
    "board": (BOARD, CAMERA, look(30, 10, 0.5), lambda image: image),
}


@pytest.mark.parametrize("case", CASES)
def test_fit_is_its_twins(case):
    marker, camera, truth, seen_as = CASES[case]
    pattern = make_pattern(marker.dictionary, marker.id, marker.size, marker.board)
    fitter, fitted = EdgeFitter(pattern, camera), 0
    for seed in range(6):
        image = seen_as(render((marker, truth), camera=camera, noise=2.0, seed=seed))
        begun = [nudged(truth, seed), nudged(truth, 100 + seed)]
        gray = fitter.show(image, whole(camera)).copy()
        np.testing.assert_array_equal(gray, cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        found = [fit.copy() for fit in fitter.fit(begun, REACHES)]
        for index, (pose, fit) in enumerate(zip(begun, found, strict=True)):
            expected = reference.fit_edges(gray, pattern, camera, pose, REACHES)
            assert bool(fit["fitted"]) == (expected is not None)
            if expected is None:
                continue
            fitted += 1
            pose = Pose(fit["rotation"], fit["translation"])
            off = np.abs(outline(pattern, camera, pose) - outline(pattern, camera, expected.pose)).max()
            assert off < PIXELS
            for name in ("error", "support", "cost", "pattern"):
                assert fit[name] == pytest.approx(getattr(expected, name), rel=RELATIVE)
            information = fitter.information(index)
            np.testing.assert_allclose(
                information, expected.information, atol=RELATIVE * np.abs(expected.information).max()
            )
    assert fitted >= 8


@pytest.mark.parametrize("pose", [look(30, 10, -0.5), Pose(look(30).rotation, np.array([0.0, 0.0, 0.01])), look(200)])
def test_no_pose_where_none_can_be_seen(pose):
    """Behind the camera, through it, or from behind the page."""
    marker = Marker()
    pattern = make_pattern(marker.dictionary, marker.id, marker.size, None)
    fitter = EdgeFitter(pattern, CAMERA)
    gray = fitter.show(render((marker, look(30, 10))), whole(CAMERA))
    assert not fitter.fit([pose], REACHES)[0]["fitted"]
    assert reference.fit_edges(gray.copy(), pattern, CAMERA, pose, REACHES) is None


@pytest.mark.parametrize("level", [0, 128, 255])
def test_nothing_is_fitted_to_an_even_picture(level):
    pattern = make_pattern("DICT_4X4_50", 0, 0.08, None)
    fitter = EdgeFitter(pattern, CAMERA)
    fitter.show(np.full((CAMERA.height, CAMERA.width), level, np.uint8), whole(CAMERA))
    fit = fitter.fit([look(30, 10)], REACHES)[0]
    assert not fit["fitted"]
    assert fitter.fit([look(30, 10)], ())[0]["pattern"] == 0.0
