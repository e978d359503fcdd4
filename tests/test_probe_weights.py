"""How much each of several mirror balls says of the light at a point between them."""

import functools

import numpy as np
import pytest
import warp as wp

from tests.twins import probe_weights as reference
from warp_ar.kernels import structs
from warp_ar.kernels.environment import probe_weights
from warp_ar.kernels.environment.interpolated_irradiance import OtherBalls
from warp_ar.kernels.environment.lobes import lobe_texels
from warp_ar.kernels.environment.probe_weights import probe_weight
from warp_ar.kernels.objects.reflect import (
    DistantLight,
    DistantLightConfig,
    make_distant_irradiance,
    make_reflected_radiance,
)
from warp_ar.kernels.rays.trace import TraceConfig
from warp_ar.kernels.structs import LAMBERT, MIRROR

# Float32: a quotient of products of metres, and a sum of a few of them.
ROUNDING = 2e-6
LEVEL_HEIGHT = 16
TWO = ((-0.2, 0.0, 0.05, 1.0), (0.2, 0.0, 0.05, 1.0))
THREE = (*TWO, (0.0, 0.3, 0.05, 1.0))


@wp.kernel(enable_backward=False)
def weigh_kernel(places: wp.array[wp.vec4], points: wp.array[wp.vec3], out: wp.array2d[wp.float32]):
    i, ball = wp.tid()
    out[i, ball] = probe_weight(places, ball, points[i])


def weigh(places, points):
    """Normalised weights of each ball at each point."""
    out = wp.zeros((len(points), len(places)), wp.float32)
    inputs = [wp.array(np.float32(places), wp.vec4), wp.array(np.float32(points), wp.vec3)]
    wp.launch(weigh_kernel, out.shape, inputs, [out])
    found = out.numpy()
    return found / found.sum(1, keepdims=True)


def test_between_two_balls_weights_are_linear_and_beside_one_it_is_alone(device):
    points = [(x, 0.07, -0.02) for x in (-0.5, -0.2, -0.1, 0.0, 0.15, 0.2, 0.9)]
    second = [0.0, 0.0, 0.25, 0.5, 0.875, 1.0, 1.0]
    np.testing.assert_allclose(weigh(TWO, points)[:, 1], second, atol=ROUNDING)


def test_twin_over_places_and_trusts(device):
    random = np.random.default_rng(4)
    for count in (2, 3, 5):
        places = np.concatenate([random.uniform(-0.3, 0.3, (count, 3)), random.uniform(0.0, 1.0, (count, 1))], 1)
        places[0, 3], places[-1, 3] = 1.0, 0.0
        points = random.uniform(-0.6, 0.6, (40, 3))
        expected = [reference.weights(np.float32(places), np.float32(point)) for point in points]
        np.testing.assert_allclose(weigh(places, points), expected, atol=ROUNDING)


def follow(shares, centers, *, seconds=0.1):
    """Places after frames that show these shares of each ball, from the start; and those of the twin."""
    params = np.zeros(1, np.dtype(structs.FrameParams.numpy_dtype()))
    params["time_step"] = seconds
    balls = np.zeros(len(centers[0]), np.dtype(structs.Probe.numpy_dtype()))
    places, twin = wp.zeros(len(balls), wp.vec4), np.zeros((len(balls), 4))
    history = []
    for share, center in zip(shares, centers, strict=True):
        balls["center"] = center
        seen = wp.array(np.repeat(np.float32(share)[:, None], 9, 1), wp.float32)
        given = wp.array(balls, dtype=structs.Probe), wp.array(params, dtype=structs.FrameParams)
        probe_weights.update_places(seen, *given, places)
        twin = reference.update_places(twin, share, center, seconds)
        np.testing.assert_allclose(places.numpy(), twin, atol=ROUNDING)
        history.append(places.numpy().copy())
    return np.array(history)


def test_trust_follows_what_is_seen(device):
    """From the first frame on; then as an exponential of 0.4 s, down and up; and the lost keep their places."""
    here, away = [(0.1, 0, 0), (0.4, 0, 0)], [(0.1, 0, 0), (9.0, 9.0, 9.0)]
    history = follow([(0.9, 0.8), *[(0.9, 0.0)] * 30, *[(0.9, 0.9)] * 30], [here, *[away] * 30, *[here] * 30])
    np.testing.assert_allclose(history[0, :, 3], 1.0)
    down = np.exp(-0.1 / 0.4 * np.arange(31))
    expected = np.concatenate([down, 1.0 - (1.0 - down[-1]) * down[1:]])
    np.testing.assert_allclose(history[:, 1, 3], expected, rtol=ROUNDING)
    np.testing.assert_allclose(history[:, 1, :3], np.tile((0.4, 0.0, 0.0), (61, 1)), atol=1e-6)


def test_a_ball_that_was_never_seen_says_nothing(device):
    assert follow([(0.0, 0.0)], [[(0, 0, 0), (1, 0, 0)]])[0, :, 3].tolist() == [0.0, 0.0]
    assert follow([(0.0, 0.3)], [[(0, 0, 0), (1, 0, 0)]])[0, :, 3].tolist() == [0.0, 1.0]


@functools.cache
def make_environment_kernel(form, several):
    config = DistantLightConfig(TraceConfig((), ()), (LAMBERT, MIRROR), False, form, True, True, several=several)
    mirrored, irradiance = make_reflected_radiance(config), make_distant_irradiance(config)

    @wp.kernel(module="unique", enable_backward=False)
    def environment_kernel(distant: DistantLight, points: wp.array[wp.vec3], out: wp.array2d[wp.vec3]):
        i = wp.tid()
        up = wp.vec3(0.0, 0.0, 1.0)
        out[i, 0] = mirrored(distant, wp.static(MIRROR), 0.0, 0.0, points[i], up, 0.0)
        out[i, 1] = irradiance(distant, points[i], up)

    return environment_kernel


def look(radiances, points, *, form="map", places=THREE, several=True):
    """Mirrored radiance and irradiance at points, where each ball sees one radiance all around."""
    distant, first, others = DistantLight(), radiances[0], np.float32(radiances[1:])
    levels = np.full((lobe_texels(LEVEL_HEIGHT), 3), first, np.float32)
    distant.levels, distant.level_height = wp.array(levels, wp.vec3), LEVEL_HEIGHT
    balls = OtherBalls()
    balls.levels = wp.array(others[:, None, None] * np.ones_like(levels), wp.vec3)
    sh = np.zeros((9, 3), np.float32)
    sh[0] = np.pi / 0.28209479
    distant.irradiance_sh, balls.irradiance_sh = (
        wp.array(first * sh, wp.vec3),
        wp.array(others[:, None, None] * sh, wp.vec3),
    )
    flat = np.full((4, 8, 3), np.pi, np.float32)
    distant.irradiance_map = wp.array(first * flat, wp.vec3)
    balls.irradiance_map = wp.array(others[:, None, None, None] * flat, wp.vec3)
    balls.places = wp.array(np.float32(places), wp.vec4)
    distant.others = balls
    out = wp.zeros((len(points), 2), wp.vec3)
    wp.launch(
        make_environment_kernel(form, several), len(points), [distant, wp.array(np.float32(points), wp.vec3)], [out]
    )
    return out.numpy()[..., 0] / (1.0, np.pi)


@pytest.mark.parametrize("form", ["map", "sh"])
def test_light_is_the_weighted_mean_of_the_balls(device, form):
    points = np.random.default_rng(7).uniform(-0.4, 0.4, (30, 3))
    radiances = (1.0, 3.0, 0.2)
    expected = [reference.weights(THREE, point) @ radiances for point in points]
    np.testing.assert_allclose(look(radiances, points, form=form), np.stack([expected] * 2, 1), rtol=1e-5)


def test_before_any_ball_is_seen_the_first_one_holds(device):
    lost = [(*place[:3], 0.0) for place in THREE]
    np.testing.assert_allclose(look((0.5, 3.0, 2.0), [(0.2, 0.0, 0.05)], places=lost), 0.5, rtol=1e-6)


def test_share_of_a_ball_that_the_frame_shows(device):
    corners = np.zeros((5, 9, 2, 3), np.float32)
    corners[..., 2] = -1.0
    corners[:2, :, 1, 2] = 9.0
    corners[2, :3, 1, 2] = 9.0
    corners[3, :, 1, 2] = 1.0  # in the rim
    corners[4, :, 1] = 40.0, 2.0, 9.0  # beside the picture
    corners[4, :4, 1] = (-1.0, 2.0, 9.0), (3.0, 30.0, 9.0), (3.0, -0.5, 9.0), (39.0, 29.0, 9.0)
    seen = wp.zeros((2, 5), wp.float32)
    probe_weights.measure_seen(wp.array(corners, wp.vec3), (40, 30), seen)
    np.testing.assert_allclose(seen.numpy(), [[0] * 5, [1, 1, 3 / 9, 0, 1 / 9]], rtol=1e-6)
