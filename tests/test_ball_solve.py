"""Centre and radius from outlines: exact without noise, within their intervals with it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.rendered_room import look_at
from warp_ar.ball.ball_finder import BallOutline
from warp_ar.ball.ball_solve import ground_below, solve_ball
from warp_ar.errors import UsageError
from warp_ar.scene import Camera, Pose, Probe, Proxy, load_scene

CAMERA = Camera(640, 480, 640.0, 640.0, 319.5, 239.5)
SETUPS = 100
INSIDE = 95
"""Of ``SETUPS``, within two standard deviations."""


def seen(center, radius, eye, pixels=(0.0, 0.0, 0.0), deviation=0.3):
    """The outline of a ball, off by so many pixels, and the frame's pose."""
    pose = Pose(*look_at(np.array(eye), np.zeros(3)))
    c = pose.apply(np.array(center))
    distance = float(np.linalg.norm(c)) / radius
    size = CAMERA.fx / distance + pixels[2]
    way = np.array([c[0] / c[2] + pixels[0] / CAMERA.fx, c[1] / c[2] + pixels[1] / CAMERA.fx, 1.0])
    sphere = way / np.linalg.norm(way) * CAMERA.fx / size
    return BallOutline((0.0, 0.0), (size, size), 0.0, (deviation,) * 3, 1.0, tuple(map(float, sphere))), pose


def eyes(rng, count, spread):
    turns = rng.uniform(0, 2 * math.pi) + spread * np.linspace(-0.5, 0.5, count)
    return [0.7 * np.array([math.cos(t) * 0.8, math.sin(t) * 0.8, 0.6]) for t in turns]


@pytest.mark.parametrize("ground", [None, 0.0])
def test_exact_outlines_give_the_ball(ground):
    truth, radius = (-0.1, 0.05, 0.03), 0.03
    outlines = [seen(truth, radius, eye) for eye in eyes(np.random.default_rng(0), 5, 1.5)]
    found = solve_ball(outlines, CAMERA, Probe((-0.09, 0.04, 0.036), 0.036), ground)
    assert np.allclose(found.center, truth, atol=1e-6)
    assert found.radius == pytest.approx(radius, abs=1e-6)
    assert not found.radius_assumed


def test_alike_views_assume_the_radius_and_say_so():
    eye = (0.3, -0.4, 0.4)
    outlines = [seen((0.0, 0.1, 0.05), 0.03, eye)] * 4
    found = solve_ball(outlines, CAMERA, Probe((0.0, 0.1, 0.05), 0.033))
    assert found.radius_assumed
    assert found.radius == 0.033


def test_intervals_hold():
    """Each set-up's outlines share one error, as those of one clip do, and each has one of its own."""
    rng = np.random.default_rng(7)
    radius_inside = center_inside = 0
    for _ in range(SETUPS):
        radius = rng.uniform(0.02, 0.05)
        truth = np.array([*rng.uniform(-0.15, 0.15, 2), radius])
        shared = rng.normal(0, 0.25, 3)
        outlines = [
            seen(truth, radius, eye, shared + rng.normal(0, 0.15, 3)) for eye in eyes(rng, 5, rng.uniform(0.3, 2.0))
        ]
        given = Probe(tuple(truth + rng.normal(0, 0.003, 3)), radius * rng.uniform(0.9, 1.1))
        found = solve_ball(outlines, CAMERA, given, 0.0)
        radius_inside += abs(found.radius - radius) < 2 * found.radius_deviation
        center_inside += bool((np.abs(found.center - truth) < 2 * np.array(found.center_deviation)).all())
    assert radius_inside >= INSIDE
    assert center_inside >= INSIDE


def test_no_outline_is_an_error():
    with pytest.raises(UsageError, match="in no frame"):
        solve_ball([], CAMERA, Probe((0.0, 0.0, 0.03), 0.03))


def test_ground_is_the_highest_level_plane_below():
    scene = load_scene("desk")
    assert ground_below(scene.probes[0], scene.proxies) == -0.0004
    tray = Proxy("plane", at=(-0.12, 0.03, 0.01), size=(0.2, 0.2))
    assert ground_below(scene.probes[0], (*scene.proxies, tray)) == 0.01
    assert ground_below(scene.probes[0], (Proxy("plane", rotate=(90.0, 0.0, 0.0), size=(1.0, 1.0)),)) is None
