"""Poses fitted to the edges of a print: sharp, blurred, half hidden and small ones."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.test_tracking import CAMERA, look, make_camera, render
from warp_ar.scene import Camera, GridBoard, Marker, Pose
from warp_ar.tracking.edge_fit import EdgeFitter
from warp_ar.tracking.markers import pattern_of

PIXELS = {"blurred": 2.0, "half hidden": 0.2, "board": 0.2}
"""Of the outline's corners, where not 0.1: a blur that is not symmetric is none of a camera's; half of an outline is
extrapolated; inner edges of a board's markers are near the least size. Measured at most 1.5, 0.11, 0.09 and 0.05."""
DEVIATIONS = 2.0
"""Root mean square error over what the information says, of six numbers over all cases that have edges of a camera."""
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
def test_a_fit_is_near_the_truth(case):
    """Within a part of a pixel, and as sure of itself as it is near."""
    marker, camera, truth, seen_as = CASES[case]
    pattern = pattern_of(marker)
    fitter, squares = EdgeFitter(pattern, camera), []
    expected = fitter.project(truth.apply(pattern.outline))[0]
    for seed in range(6):
        image = seen_as(render((marker, truth), camera=camera, noise=2.0, seed=seed))
        np.testing.assert_array_equal(fitter.show(image, whole(camera)), cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        fit = fitter.fit(nudged(truth, seed), REACHES)
        assert fit is not None
        found = fitter.project(fit.pose.apply(pattern.outline))[0]
        assert np.abs(found - expected).max() < PIXELS.get(case, 0.1)
        assert fit.pattern > 0.8
        assert fit.error < 0.1
        turn = cv2.Rodrigues(truth.rotation @ fit.pose.rotation.T)[0].ravel()
        off = np.concatenate([turn, truth.translation - fit.pose.translation])
        squares.append(float(off @ fit.information @ off) / 6)
    assert case in ("blurred", "board") or np.mean(squares) < DEVIATIONS**2


def test_a_fit_counts_the_edges_that_it_sees():
    """All of a whole marker but for chance, half of a hidden one."""
    support = {}
    for case in ("sharp", "half hidden"):
        marker, camera, truth, seen_as = CASES[case]
        fitter = EdgeFitter(pattern_of(marker), camera)
        fitter.show(seen_as(render((marker, truth), camera=camera)), whole(camera))
        support[case] = fitter.fit(truth, REACHES).support
    assert support["sharp"] > 0.85
    assert 0.35 < support["half hidden"] < 0.65


@pytest.mark.parametrize("pose", [look(30, 10, -0.5), Pose(look(30).rotation, np.array([0.0, 0.0, 0.01])), look(200)])
def test_no_pose_where_none_can_be_seen(pose):
    """Behind the camera, through it, or from behind the page."""
    marker = Marker()
    fitter = EdgeFitter(pattern_of(marker), CAMERA)
    fitter.show(render((marker, look(30, 10))), whole(CAMERA))
    assert fitter.fit(pose, REACHES) is None


@pytest.mark.parametrize("level", [0, 128, 255])
def test_nothing_is_fitted_to_an_even_picture(level):
    fitter = EdgeFitter(pattern_of(Marker()), CAMERA)
    fitter.show(np.full((CAMERA.height, CAMERA.width), level, np.uint8), whole(CAMERA))
    assert fitter.fit(look(30, 10), REACHES) is None
    assert fitter.correlate(look(30, 10)) == 0.0
