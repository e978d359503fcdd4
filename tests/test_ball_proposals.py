"""Circles that a picture may show, and the ball that is found among them without a hint."""

import contextlib

import cv2
import numpy as np
import pytest

from tests.photo_room import exposed, photograph, sphere
from warp_ar.ball.ball_finder import MISFIT, find_ball, lifted, silhouette
from warp_ar.ball.ball_proposals import propose_circles
from warp_ar.errors import UsageError

pytestmark = pytest.mark.slow

NEAR = 0.2
"""Share of the radius within which a proposal must be: a search begins there, which bears 0.22."""
FOUND = 0.06
"""The same of what is found."""


def off(circle, true):
    """Largest difference over the radius."""
    return max(np.hypot(circle[0] - true[0], circle[1] - true[1]), abs(circle[2] - true[2])) / true[2]


def ball():
    points, _ = silhouette(photograph()[1], sphere())
    return (*points.mean(0), float(np.linalg.norm(points - points.mean(0), axis=1).mean()))


def room(denominator=60):
    return cv2.GaussianBlur(exposed(denominator), (0, 0), 0.5).astype(np.uint8)


def disc(size, circle, seed=0):
    """A round patch of noise on other noise."""
    random = np.random.default_rng(seed)
    ground, patch = (cv2.GaussianBlur(random.normal(level, 25.0, (*size, 3)), (0, 0), 2.0) for level in (110.0, 150.0))
    rows, columns = np.mgrid[: size[0], : size[1]]
    inside = np.hypot(columns - circle[0], rows - circle[1]) < circle[2]
    return np.clip(np.where(inside[..., None], patch, ground), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    "circle", [(70.0, 200.0, 12.0), (300.0, 140.0, 40.0), (210.0, 160.0, 150.0), (15.0, 150.0, 40.0)]
)
def test_a_disc_of_any_size_is_proposed(circle):
    proposed = propose_circles(disc((320, 420), circle))
    assert min(off(found, circle) for found in proposed) < NEAR
    assert len(proposed) <= 25


def test_straight_edges_are_no_circle():
    """A chequered cloth has more edges than a disc, and none of its corners is round."""
    rows, columns = np.mgrid[:320, :420]
    cloth = np.where((rows // 24 + columns // 24) % 2 == 1, 90, 160)[..., None].repeat(3, 2).astype(np.uint8)
    rim = np.hypot(columns - 300, rows - 200) < 30
    cloth[rim] = 230
    proposed = propose_circles(cloth)
    assert min(off(found, (300.0, 200.0, 30.0)) for found in proposed) < NEAR


def test_a_small_ball_in_a_large_picture():
    """A photograph of a table: the ball is a twentieth of it, and walls and frames have the stronger edges."""
    true, picture = ball(), room()
    scene = cv2.resize(picture[:60, :80], (1600, 1200), interpolation=cv2.INTER_CUBIC)
    scene[700:1150, 900:1500] = picture
    for radius in (330, 350):
        cv2.rectangle(scene, (420 - radius, 500 - radius), (420 + radius, 500 + radius), (60, 80, 90), 3)
    found = find_ball(scene)
    assert off((found.center[0] - 900, found.center[1] - 700, found.radius), true) < FOUND


def test_a_soft_photograph_is_measured_in_a_smaller_one():
    """A telephone's picture of many megapixels is sharp in none of them."""
    x, y, radius = ball()
    grow = 8
    soft = cv2.resize(room(), None, fx=grow, fy=grow, interpolation=cv2.INTER_CUBIC)
    found = find_ball(cv2.GaussianBlur(soft, (0, 0), 8.0))
    assert found.support > 0.3
    true = ((x + 0.5) * grow - 0.5, (y + 0.5) * grow - 0.5, grow * radius)
    assert off((*found.center, found.radius), true) < FOUND


@pytest.mark.parametrize("denominator", [15, 1000, 4000])
def test_exposures_of_a_bracket(denominator):
    found = find_ball(room(denominator), photograph()[1])
    assert off((*found.center, found.radius), ball()) < FOUND


def test_lifted_darks_are_as_steep_as_brights():
    """The same edge, two codes high in the dark, is as high as one of eighty beside white."""
    codes = lifted(np.array([[[2, 2, 2], [6, 6, 6], [80, 80, 80], [121, 121, 121]]], np.uint8)).astype(int)[0, :, 0]
    assert np.all(np.diff(codes) > 0)
    assert codes[1] - codes[0] > 0.9 * (codes[3] - codes[2])


@pytest.mark.parametrize("seed", range(3))
def test_what_may_be_no_ball_is_doubtful(seed):
    """A desk full of boxes: some of their corners lie on a circle."""
    random = np.random.default_rng(seed)
    picture = np.full((300, 400, 3), 120, np.uint8)
    for _ in range(60):
        corners = cv2.boxPoints((random.uniform((0, 0), (400, 300)), random.uniform(10, 80, 2), random.uniform(0, 90)))
        cv2.fillPoly(picture, [corners.astype(np.int32)], random.integers(40, 220, 3).tolist())
    picture = cv2.GaussianBlur(picture, (0, 0), 0.7)
    with contextlib.suppress(UsageError):
        assert find_ball(picture).doubts


def test_a_wheel_is_no_ball():
    """Its rim is as sharp and as round as a ball's; its spokes run along the radius."""
    picture = disc((320, 420), (210.0, 160.0, 100.0))
    for angle in np.arange(12) * np.pi / 6:
        end = (round(210 + 90 * np.cos(angle)), round(160 + 90 * np.sin(angle)))
        cv2.line(picture, (210, 160), end, (20, 20, 20), 5, cv2.LINE_AA)
    cv2.circle(picture, (210, 160), 97, (30, 30, 30), 7, cv2.LINE_AA)
    found = find_ball(cv2.GaussianBlur(picture, (0, 0), 0.7), rough=(210.0, 160.0, 100.0))
    assert found.misfit > MISFIT


def test_an_ellipse_under_an_unknown_perspective_is_doubtful():
    """No circle is within a fortieth of the radius of it; of the ball itself, one is."""
    large = cv2.resize(room(), None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC)
    wide = cv2.resize(large, None, fx=1.12, fy=1.0, interpolation=cv2.INTER_CUBIC)
    round_one, oval = find_ball(large), find_ball(wide)
    assert round_one.stray < 0.5 * oval.stray
    assert round_one.misfit < MISFIT
    assert any("edges lie" in doubt for doubt in oval.doubts)


def test_a_rough_circle_in_the_dark():
    x, y, radius = ball()
    found = find_ball(room(4000), photograph()[1], (x + 3, y - 2, 1.08 * radius))
    assert off((*found.center, found.radius), (x, y, radius)) < FOUND
