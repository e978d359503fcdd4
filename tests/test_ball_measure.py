"""Outlines that contradict each other, and a rim that the white card hides: the ball is measured all the same."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.random_desk import RandomDesk
from tests.rendered_room import look_at
from warp_ar.ball.ball import explains_better, mirrored_radius
from warp_ar.ball.ball_measure import measure_ball
from warp_ar.ball.ball_solve import APART, agreeing_outlines, find_outline, outline_misfit, solve_ball
from warp_ar.calibration.card import write_card
from warp_ar.scene import Pose, Probe, Proxy
from warp_ar.tracking.card_layout import CARD_MARKER, ball_center

pytestmark = pytest.mark.slow

TABLE = Proxy("plane", at=(0.0, 0.0, 0.0), size=(1.6, 1.2))
RADIUS = 0.4e-3
"""Metres: the mirrored receiver tells the radius so well on rendered desks."""


@pytest.fixture(scope="module")
def card(tmp_path_factory):
    path = tmp_path_factory.mktemp("card") / "card.pdf"
    write_card(CARD_MARKER, path, "a4", 600)
    return path


def views_of(desk, eyes, at):
    return [(desk.photograph(eye, at), Pose(*look_at(np.array(eye), np.array(at)))) for eye in eyes]


@pytest.fixture(scope="module")
def contradicting(card):
    """Two frames from the side: in the second, an edge that the ball mirrors is taken for its rim."""
    desk = RandomDesk(card, 17)
    turns = np.radians(-90 + 60 * np.sin(np.array([1, 6]) / 2))
    heights = 0.32 + 0.05 * np.cos([1, 6])
    eyes = [(0.45 * np.cos(t), 0.06 + 0.45 * np.sin(t), h) for t, h in zip(turns, heights, strict=True)]
    return desk, views_of(desk, eyes, (0.0, 0.06, 0.0))


@pytest.fixture(scope="module")
def from_above(card):
    """Two frames from above, where the card's mirror image ends in a stronger circle than the ball."""
    desk = RandomDesk(card, 31)
    eyes = [(0.09, 0.045, 0.36), (-0.12, 0.09, 0.44)]
    return desk, views_of(desk, eyes, (0.0, 0.06, 0.0))


def given(desk, share=1.0):
    radius = desk.radius * share
    return Probe(ball_center(radius), radius)


def test_of_outlines_that_contradict_each_other_the_ball_s_are_kept(contradicting):
    desk, views = contradicting
    probe = given(desk, 0.98)
    first = [(find_outline(view, desk.camera, probe), view[1]) for view in views]
    before = solve_ball(first, desk.camera, probe, 0.0)
    assert max(outline_misfit(pair, desk.camera, before) for pair in first) > APART, "nothing to put right"
    found = solve_ball(agreeing_outlines(views, desk.camera, probe, 0.0), desk.camera, probe, 0.0)
    assert abs(found.radius - desk.radius) < 2 * found.radius_deviation
    assert (np.abs(np.subtract(found.center, desk.center)) < 2 * np.array(found.center_deviation)).all()


def test_two_frames_from_above_give_an_interval_that_holds(from_above):
    desk, views = from_above
    found = measure_ball(views, desk.camera, given(desk, 1.03), (TABLE,))
    assert found.is_usable
    assert abs(found.radius - desk.radius) < 2 * found.radius_deviation
    assert np.abs(np.subtract(found.center, desk.center)).max() < 2 * found.deviation


def test_what_is_mirrored_tells_the_radius(from_above):
    desk, views = from_above
    found = mirrored_radius(views, desk.camera, given(desk, 0.96), (TABLE,))
    assert found is not None
    assert abs(found.radius - desk.radius) < RADIUS
    assert np.abs(np.subtract(found.center, desk.center)).max() < 2 * RADIUS


def test_only_the_right_ball_explains_what_is_mirrored(from_above):
    desk, views = from_above
    right = dataclasses.replace(given(desk), center=tuple(map(float, desk.center)))
    wrong = given(desk, 0.92)
    assert explains_better(views, desk.camera, right, wrong, (TABLE,))
    assert not explains_better(views, desk.camera, wrong, right, (TABLE,))


def test_without_a_ball_nothing_is_told(card):
    desk = RandomDesk(card, 31)
    eye, at = (0.09, 0.045, 0.36), (0.0, 0.06, 0.0)
    bare = [(desk.photograph(eye, at, ball=False), Pose(*look_at(np.array(eye), np.array(at))))]
    assert mirrored_radius(bare, desk.camera, given(desk), (TABLE,)) is None
