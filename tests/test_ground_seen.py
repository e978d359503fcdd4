"""Where a ball should stand the receiver is seen from all sides: then there is none, and nothing is searched."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from tests.printed_card import PrintedCard
from tests.rendered_room import look_at
from warp_ar.ball import ball_measure
from warp_ar.ball.ball_measure import measure_ball
from warp_ar.ball.ball_solve import BallSolution
from warp_ar.ball.ground_seen import ground_correlations, ground_is_seen
from warp_ar.checks import check_ball
from warp_ar.checks.check_ball import check_balls
from warp_ar.checks.check_pictures import take_look
from warp_ar.errors import UsageError
from warp_ar.scene import Camera, Pose, Probe, Proxy, load_scene
from warp_ar.sources.sources import open_source
from warp_ar.tracking.card_layout import ball_center

pytestmark = pytest.mark.slow

CAMERA = Camera(640, 480, 600.0, 600.0, 321.0, 238.0, (-0.08, 0.02, 0.0, 0.0, 0.0))
PROBE = Probe(ball_center(0.03), 0.03)
TABLE = Proxy("plane", at=(0.0, 0.0, 0.0), size=(1.6, 1.2))


@pytest.fixture(scope="module")
def bare():
    """The card without a ball from four sides, with the noise of a webcam."""
    card = PrintedCard(np.random.default_rng(0))
    found = []
    for turn in np.radians((-125.0, -100.0, -80.0, -50.0)):
        eye = np.array([0.45 * np.cos(turn), 0.08 + 0.45 * np.sin(turn), 0.32])
        pose = Pose(*look_at(eye, np.array([0.0, 0.07, 0.0])))
        found.append((card.photograph(CAMERA, pose, 0.7, lambda linear: np.clip(linear, 0, 1) ** (1 / 2.2)), pose))
    return found


def with_ball(views):
    """A ball of stripes that stay where the eye has them, as what a mirror shows does, painted over the cross."""
    found = []
    for k, (image, pose) in enumerate(views):
        c = pose.apply(np.array(PROBE.center))
        zero = np.zeros(3)
        x, y = cv2.projectPoints(c[None], zero, zero, CAMERA.matrix(), np.array(CAMERA.distortion))[0].ravel()
        radius = CAMERA.fx * PROBE.radius / np.linalg.norm(c)
        rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
        stripes = np.where(np.floor((columns - x) / radius * 3 + 0.4 * k) % 2, 180, 60)
        inside = (columns - x) ** 2 + (rows - y) ** 2 < radius**2
        found.append((np.where(inside[..., None], stripes[..., None], image).astype(np.uint8), pose))
    return found


def test_a_bare_card_is_told_from_a_ball(bare):
    assert min(ground_correlations(bare, CAMERA, PROBE, 0.0)) > 0.85
    assert ground_is_seen(bare, CAMERA, PROBE, 0.0)
    covered = ground_correlations(with_ball(bare), CAMERA, PROBE, 0.0)
    assert len(covered) >= 3
    assert max(covered) < 0.4
    assert not ground_is_seen(with_ball(bare), CAMERA, PROBE, 0.0)


def test_what_tells_nothing_says_nothing(bare):
    one_side = [bare[0]] * 4
    assert ground_correlations(one_side, CAMERA, PROBE, 0.0) == []
    flat = [(np.full_like(image, 180), pose) for image, pose in bare]
    assert ground_correlations(flat, CAMERA, PROBE, 0.0) == []
    outside = dataclasses.replace(PROBE, center=(3.0, 0.1, 0.03))
    assert not ground_is_seen(bare, CAMERA, outside, 0.0)


@pytest.mark.parametrize(("share", "is_kept"), [(0.6, False), (0.75, True), (1.25, True), (1.4, False)])
def test_a_ball_of_quite_another_size_is_not_believed(bare, share, is_kept, monkeypatch):
    """From one side alone the card's rings made one of 18 mm where 30 were typed."""
    solution = BallSolution(PROBE.center, share * PROBE.radius, (1e-4,) * 3, 1e-4, False, ())
    monkeypatch.setattr(ball_measure, "agreeing_outlines", lambda *arguments: [None])
    monkeypatch.setattr(ball_measure, "solve_ball", lambda *arguments: solution)
    monkeypatch.setattr(ball_measure, "mirrored_radius", lambda *arguments: None)
    monkeypatch.setattr(ball_measure, "fit_ball", lambda *arguments, **options: None)
    if is_kept:
        assert measure_ball(bare[:1], CAMERA, PROBE, (TABLE,)).radius == solution.radius
    else:
        with pytest.raises(UsageError, match=rf"has a radius of {solution.radius:.3f} m, but \[probe\] radius = 0.03"):
            measure_ball(bare[:1], CAMERA, PROBE, (TABLE,))


def test_a_balls_place_that_shows_the_desk_is_a_finding(monkeypatch):
    scene = load_scene("desk")
    with open_source(str(scene.source.path)) as source:
        look = take_look(scene, source, 96, 12)
    (probe,) = scene.probes
    aside = dataclasses.replace(scene, probes=(dataclasses.replace(probe, center=(0.0, 0.05, probe.center[2])),))

    def searched(*arguments, **options):
        raise AssertionError("an outline was looked for")

    monkeypatch.setattr(check_ball, "agreeing_outlines", searched)
    with pytest.raises(AssertionError, match="looked for"):
        check_balls(scene, look, 1)
    monkeypatch.setattr(check_ball, "ground_is_seen", lambda *arguments: True)
    assert [finding.name for finding in check_balls(aside, look, 1)] == ["ball.unfound"]
