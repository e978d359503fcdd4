"""Shadows of virtual objects in the environment, and light that they reflect onto the desk."""

import numpy as np
import pytest

from tests.environment_shadow_rig import (
    MEAN_ERROR,
    ONE_BALL,
    RIM,
    SET_ERROR,
    STRATIFIED,
    SUM_ERROR,
    draw,
    lamp_at,
    list_texels,
    run,
    sky,
    sphere,
    with_sun,
)
from tests.error_model import check_error
from tests.kernel_rig import shape
from tests.relight_rig import CAMERA, DESK, POINTS, H, W
from tests.twins import environment_shadow as reference
from warp_ar.kernels.environment import environment_samples
from warp_ar.kernels.structs import BOX

# --- Ratio ------------------------------------------------------------------------------------------------------------


def test_nothing_virtual_changes_nothing_to_the_bit(device):
    drawn = draw(with_sun(6, 20, 500.0))
    far = sphere((0, 0, -3), 0.05)  # below the desk
    assert (run(drawn, [far], probes=[{"center": (0.1, 0, 0.03), "radius": 0.03}]) == 1).all()


def test_sphere_under_an_even_sky(device):
    center, radius = (0.02, -0.03, 0.09), 0.05
    expected = 1 - reference.sphere_form_factor(POINTS, center, radius)
    got = run(draw(sky(0.3)), [sphere(center, radius)])[..., 0]
    assert np.abs(got - expected).max() < SET_ERROR
    assert abs((got - expected).mean()) < MEAN_ERROR
    # A pixel's window holds every set once, but not at one point: what is left is the curvature of the shadow.
    inner = (got - expected)[8:-8, 8:-8]
    assert np.sqrt((inner**2).mean()) < STRATIFIED


def test_reference_method_matches_the_twin(device):
    environment = np.random.default_rng(1).random((32, 64, 3)).astype(np.float32)
    environment[8, 40] = 300.0
    drawn = list_texels(environment)
    spheres, balls = [((0.05, 0.02, 0.06), 0.05), ((-0.1, 0.0, 0.04), 0.04)], [((-0.05, 0.1, 0.035), 0.035)]
    got = run(
        drawn,
        [sphere(*item) for item in spheres],
        probes=[{"center": c, "radius": r} for c, r in balls],
        count=2048,
        side=1,
        filtered=False,
    )[0]
    wi, flux = drawn[0].numpy().astype(np.float64), drawn[1].numpy().astype(np.float64)
    bright = wi[8 * 64 + 40]
    checked = 0
    for row, column in np.random.default_rng(0).integers(0, (H, W), (40, 2)):
        point = POINTS[row, column]
        to_ball = point - CAMERA
        if reference.meets_sphere(CAMERA, (to_ball / np.linalg.norm(to_ball))[None], *balls[0])[0]:
            continue
        shadowing = [*spheres, *balls]
        if min(reference.clearance(point, bright[None], *item)[0] for item in shadowing) < RIM:
            continue
        expected = reference.ratio_on_plane(point[None], wi, flux, spheres, balls)[0]
        # A ray at a rim may fall on either side: one of 2048, none bright but the sun, which is clear of them.
        check_error("environment_shadow", got[row, column], expected)
        checked += 1
    assert checked > 20


def test_estimated_bounce_is_the_sum_of_its_series(device):
    """A grey sphere high above the desk: its lower half sees the desk, its upper half the sky."""
    center, radius, albedo = (0.0, 0.0, 0.2), 0.03, 0.6
    drawn = list_texels(sky(1.0))
    got = run(drawn, [sphere(center, radius)], albedo=albedo, count=2048, side=1)[..., 0]
    at = np.unravel_index(np.linalg.norm(POINTS, axis=-1).argmin(), (H, W))
    point = POINTS[at]
    # Directions of the texels that meet the sphere, and its normals there.
    wi, flux = drawn[0].numpy().astype(np.float64), drawn[1].numpy()[:, 0].astype(np.float64)
    weight = np.maximum(wi[:, 2], 0) * flux
    met = reference.meets_sphere(point, wi, center, radius)
    to_center = np.asarray(center) - point
    along = wi[met] @ to_center
    t = along - np.sqrt(radius**2 - (to_center @ to_center - along**2))
    up = ((point + t[:, None] * wi[met] - center) / radius)[:, 2]
    hidden, desk = weight[met].sum() / weight.sum(), albedo * (weight[met] @ (0.5 - 0.5 * up)) / weight.sum()
    surroundings = albedo * hidden - desk
    assert hidden > 0.01
    assert 0.005 < desk < albedo * hidden
    assert got[at] == pytest.approx((1 - hidden + surroundings) / (1 - desk), abs=SUM_ERROR)


@pytest.mark.slow
@pytest.mark.parametrize("bounce", ["estimated", "traced"])
def test_the_physical_among_samples_matches_the_reference(device, bounce):
    """Sets of 64 samples beside every texel, with a box and a ball that differ from the environment behind them."""
    environment = sky(0.3)
    environment[8:14, 10:30] = 4.0
    probes = [{"center": (0.1, 0.02, 0.03), "radius": 0.03, "reflectance": (0.8, 0.8, 0.8)}]
    wall = shape(BOX, (-0.1, 0.0, 0.04), (0.03, 0.1, 0.04))
    scene = {"proxies": (DESK, wall), "probes": probes, "albedo": 0.6, "bounce": bounce}
    item = [sphere((0.0, -0.02, 0.06), 0.04)]
    got = run(draw(environment), item, **scene)
    expected = run(list_texels(environment), item, **scene, count=2048, side=1)
    assert expected.min() < 0.8
    assert abs((got - expected).mean()) < MEAN_ERROR
    assert np.abs(got - expected).max() < SET_ERROR


def test_what_the_ball_hides_is_not_there(device):
    """Seen from the desk in front of the ball, an object behind it neither takes light nor sends any."""
    ball = np.array([0.0, 0.0, 0.035])
    probes = [{"center": ball, "radius": 0.035, "reflectance": (0.5, 0.5, 0.5)}]
    point = POINTS[H // 2, W // 4]
    toward = (ball - point) / np.linalg.norm(ball - point)
    item = [sphere(point + 0.4 * toward, 0.07)]
    scene = {"bounce": "estimated", "albedo": 0.9, "count": 2048, "side": 1, "filtered": False}
    drawn = list_texels(sky(1.0))
    assert run(drawn, item, **scene)[0][H // 2, W // 4].max() < 0.995
    assert (run(drawn, item, probes=probes, **scene)[0][H // 2, W // 4] == 1).all()


def test_near_lamps_cast_their_own_shadow(device):
    # A lamp 0.4 m above the ball: straight up as the environment has it, aslant from elsewhere.
    environment = sky(1e-3, (64, 128))
    environment[:1] = 5000.0
    lamp = np.array([0, 0, 0.435])
    directions, flux, samples = draw(environment)
    item = [sphere((0.1, 0, 0.1), 0.03)]
    distant = run((directions, flux, samples), item)[..., 0]
    environment_samples.place_emitters(lamp_at(lamp), ONE_BALL, samples)
    near = run((directions, flux, samples), item, emitters=True)[..., 0]
    # Centre of the shadow: where the line through lamp and object meets the desk.
    expected = lamp + (np.array([0.1, 0, 0.1]) - lamp) * lamp[2] / (lamp[2] - 0.1)
    for got, center in ((distant, (0.1, 0.0)), (near, expected[:2])):
        weight = (got < 0.5).astype(float)
        assert weight.sum() > 10
        found = (POINTS[..., :2] * weight[..., None]).sum((0, 1)) / weight.sum()
        assert np.abs(found - center).max() < 0.012  # a pixel is 10 mm


# --- Stage ------------------------------------------------------------------------------------------------------------


def test_estimated_bounce_keeps_the_energy_of_a_white_environment(device):
    """To and fro between white objects and the desk nothing is lost, however close they are."""
    for item in (sphere((0, 0, 0.08), 0.05), sphere((0.03, 0.02, 0.06), 0.05), shape(BOX, (0, 0, 0.07), (0.05,) * 3)):
        got = run(draw(sky(1.0)), [item], albedo=1.0)
        np.testing.assert_allclose(got, 1.0, atol=10 * SUM_ERROR)
