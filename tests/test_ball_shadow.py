"""Whether recovered light reaches the ball: what the table shows beside the ball's shadow and across it."""

from __future__ import annotations

import types

import numpy as np
import pytest

from tests.recover_rig import DistantLight, lit_environment, scene  # noqa: F401
from warp_ar.light.ball_shadow import ELSEWHERE, Ball, reaching_factor
from warp_ar.light.config import Kind

CENTER, RADIUS = np.array([-0.12, 0.03, 0.035]), 0.035
SUN = np.array([-0.5, -0.6, 0.6]) / np.linalg.norm([-0.5, -0.6, 0.6])
STRENGTH = 2.0
"""Irradiance of the sun across its rays; the sky's is 0.6."""


def sunlight(light, direction, hidden_within):
    """Irradiance of surface points by a sun, hidden where its rays pass the ball within some radii, (n, 1)."""
    to_ball = CENTER - light.surfaces.points["position"]
    along = to_ball @ direction
    off = np.linalg.norm(to_ball - along[:, None] * direction, axis=1)
    clear = (along < 0.0) | (off > hidden_within * RADIUS)
    return (STRENGTH * np.maximum(light.surfaces.points["normal"] @ direction, 0.0) * clear)[:, None]


def estimated(device, scene, hidden_within):
    """What is estimated where the ball shows that something clips toward the sun, whether it is the sun or not."""
    light = DistantLight(device, scene, noise=0.1)
    radiance, _, _ = lit_environment((SUN, 0.985, 1.0))
    return light.estimate(radiance, extra=sunlight(light, SUN, hidden_within))[0]


def test_light_that_reaches_the_ball_is_taken(device, scene):
    estimate = estimated(device, scene, 1.0)
    assert estimate.method == "shading"
    assert estimate.factor == 1.0


def test_light_that_is_hidden_from_the_ball_is_not(device, scene):
    """Clutter shades the ball and a radius and a half around; the card lies in the sun."""
    estimate = estimated(device, scene, 2.5)
    # The table has noise of a tenth and shows three quarters less there than the sun would have it.
    assert estimate.factor < 0.2
    assert estimate.irradiance.value[4, 1] < 1.0 < estimate.irradiance.high[4, 1]


def test_a_lamp_that_is_found_close_by_stays(device, scene):
    direction = np.array([-0.45, 0.35, 0.82]) / np.linalg.norm([-0.45, 0.35, 0.82])
    radiance, _, _ = lit_environment((direction, 0.996, 1.0))
    light = DistantLight(device, scene, noise=0.1)
    lamp = np.array([[*(CENTER + 0.35 * direction), 0.03]], np.float32)
    extra = light.trace(lamp) * 0.35**2 * 2.5 * np.ones(3)
    assert light.estimate(radiance, extra=extra)[0].factor == 1.0


def plane_in_the_sun(shown_shadow, level=1.0, texture=0.1, both_sides=True):
    """Equations of a plane around a ball of five centimetres. The estimate has two thirds of the light come from +x.

    Args:
        shown_shadow: Where rays toward this direction meet the ball the plane is dark.
        level: What is added, beside the ball and elsewhere where its rays pass within 2.5 radii, over what is said.
        texture: Standard deviation of the logarithm of its reflectance.
        both_sides: Of the ball's shadow, or of one alone.
    """
    rng = np.random.default_rng(7)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (1500, 2)), np.zeros(1500)])
    ball, sun = Ball(np.array([0.0, 0.0, 0.05]), 0.05), np.array([0.8, 0.0, 0.6])

    def passes(direction, radii):
        to_ball = ball.center - points
        along = to_ball @ direction
        return (along > 0.0) & (((to_ball**2).sum(axis=1) - along**2) < (radii * ball.radius) ** 2)

    problem = types.SimpleNamespace(
        points=points,
        normals=np.broadcast_to([0.0, 0.0, 1.0], points.shape),
        kind=np.full(1500, Kind.PLANE),
        surface=np.zeros(1500, int),
        exact=np.ones((1500, 3), bool),
        shared=np.full(1500, 4.0),
        captured=np.ones((1500, 3)),
        direction=sun[None],
        missing=np.ones((1, 3)),
        solid_angle=np.ones(1),
    )
    added = 2.0 * ~passes(sun, 1.0)[:, None] * np.ones(3)
    problem.added_irradiance = lambda unknowns: added * unknowns.mean()
    problem.distant_radiance = lambda unknowns: unknowns
    problem.near_emitters = lambda unknowns: []
    hidden = passes(sun, 2.5) & (points[:, 1] > (-1.0 if both_sides else 0.0))
    true = 2.0 * np.where(hidden, level, 1.0) * ~passes(shown_shadow, 1.0)
    problem.light = 0.3 * (1.0 + true[:, None]) * np.exp(texture * rng.standard_normal((1500, 1))) * np.ones(3)
    return problem, ball


@pytest.mark.parametrize(
    ("shown_shadow", "level", "least", "most"),
    [
        ((0.8, 0.0, 0.6), 1.0, 1.0, 1.0),
        # No shadow but one on the other side: some of the light may still come from there.
        ((-0.8, 0.0, 0.6), 1.0, ELSEWHERE, ELSEWHERE + 0.1),
        # A shadow of clutter beside the ball: no light; half of it: half, or less as far as texture leaves it open.
        ((0.8, 0.0, 0.6), 0.0, 0.0, 0.05),
        ((0.8, 0.0, 0.6), 0.5, 0.4, 0.5),
    ],
)
def test_planes_tell_what_reaches_the_ball(shown_shadow, level, least, most):
    problem, ball = plane_in_the_sun(np.array(shown_shadow), level)
    assert least <= reaching_factor(problem, np.ones((1, 3)), ball) <= most
    # Nothing is asked of an estimate that adds nothing, nor of points that clip.
    assert reaching_factor(problem, np.zeros((1, 3)), ball) == 1.0
    problem.exact[:] = False
    assert reaching_factor(problem, np.ones((1, 3)), ball) == 1.0


def test_a_shadow_whose_edge_passes_by_the_ball_says_nothing():
    problem, ball = plane_in_the_sun(np.array([0.8, 0.0, 0.6]), 0.0, both_sides=False)
    assert reaching_factor(problem, np.ones((1, 3)), ball) == 1.0


def test_texture_hides_what_a_shadow_would_tell():
    """Texture as strong as the shadow: nothing is said, and nothing taken away."""
    problem, ball = plane_in_the_sun(np.array([-0.8, 0.0, 0.6]), texture=1.2)
    assert reaching_factor(problem, np.ones((1, 3)), ball) == 1.0
