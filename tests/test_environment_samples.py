"""Samples of the environment, by which shadows and near light are estimated."""

import numpy as np
import pytest
import warp as wp

from tests.environment_shadow_rig import (
    ONE_BALL,
    ORIGIN,
    STRATIFIED,
    SUM_ERROR,
    draw,
    lamp_at,
    list_texels,
    sky,
    with_sun,
)
from tests.error_model import check_error
from tests.twins import environment_shadow as reference
from warp_ar.kernels.environment import environment_samples

# --- Samples ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("row", [0, 3, 14])
def test_irradiance_of_a_one_texel_sun_over_a_dark_sky(device, row):
    environment = with_sun(row, 5, 1e6, sky(1e-4))
    directions, flux, _ = draw(environment)
    wi, solid_angle = reference.texel_directions(32, 64)
    expected = (np.maximum(wi[..., 2], 0) * solid_angle)[..., None] * environment
    up = np.maximum(directions.numpy()[:, 2], 0) @ flux.numpy()
    np.testing.assert_allclose(up, expected.sum((0, 1)), rtol=STRATIFIED)


@pytest.mark.parametrize("size", [(16, 32), (256, 512), (5, 9)])
def test_cumulative_sums_match_their_twin(device, size):
    """Along rows and over rows, over eight decades of radiance."""
    environment = np.float32(10.0 ** np.random.default_rng(6).uniform(-4, 4, (*size, 3)))
    cumulative, sums = wp.zeros(size, wp.float32), wp.zeros(size[0], wp.vec2)
    environment_samples.sum_environment(wp.array(environment, dtype=wp.vec3), cumulative, sums)
    along, over = reference.cumulative_sums(environment.astype(np.float64), float(environment_samples.SIDE_WEIGHT))
    check_error("environment_samples", cumulative.numpy(), along)
    for channel in range(2):
        check_error("environment_samples", sums.numpy()[:, channel], over[:, channel])


@pytest.mark.parametrize("size", [(16, 32), (5, 9), (1, 4)])
def test_every_sample_lies_in_the_texel_that_it_shows(device, size):
    height, width = size
    ramp = np.arange(height * width, dtype=np.float32).reshape(size)
    _, _, samples = draw(np.repeat(ramp[..., None], 3, -1))
    found = samples.numpy()
    wi = found["direction"]
    np.testing.assert_allclose(np.linalg.norm(wi, axis=1), 1, atol=1e-6)
    row = np.arccos(np.clip(wi[:, 2], -1, 1)) / np.pi * height
    column = (np.arctan2(wi[:, 1], wi[:, 0]) / np.pi + 1) / 2 * width
    texel = found["radiance"][:, 0].astype(int)
    # Half a texel from its middle, and what float32 directions lose.
    assert np.abs(row - (texel // width + 0.5)).max() < 0.5 + 1e-3
    off = np.abs(column - (texel % width + 0.5))
    assert np.minimum(off, width - off).max() < 0.5 + 1e-3
    assert len(np.unique(texel)) > min(height * width, 1024) // 3


def test_sobol_matches_its_twin(device):
    out = wp.zeros(1024, wp.float32)
    wp.launch(_sobol_kernel, dim=1024, outputs=[out])
    np.testing.assert_allclose(out.numpy(), [reference.sobol_second(i) for i in range(1024)], atol=2**-24)


@wp.kernel(enable_backward=False)
def _sobol_kernel(out: wp.array[wp.float32]):
    i = wp.tid()
    out[i] = environment_samples.sobol_second(wp.uint32(i))


def test_texels_list_the_map(device):
    environment = np.random.default_rng(3).random((8, 16, 3)).astype(np.float32)
    directions, flux, samples = list_texels(environment)
    wi, solid_angle = reference.texel_directions(8, 16)
    np.testing.assert_allclose(directions.numpy().reshape(8, 16, 3), wi, atol=1e-6)
    np.testing.assert_allclose(flux.numpy().reshape(8, 16, 3), solid_angle[..., None] * environment, rtol=1e-5)
    np.testing.assert_allclose(samples.numpy()["measure"].sum(), 4 * np.pi, rtol=SUM_ERROR)


def test_lamps_are_placed_from_where_the_ball_mirrors_them(device):
    at, mirrors = np.array([0.3, -0.1, 0.2]), np.array([0.01, 0.02, 0.06])
    direction = (at - mirrors) / np.linalg.norm(at - mirrors)
    environment = sky(0.5, (256, 512))
    environment[reference.texel_directions(256, 512)[0] @ direction > np.cos(0.1)] = 40.0
    _, _, samples = list_texels(environment)
    environment_samples.place_emitters(lamp_at(at, origin=mirrors), ONE_BALL, samples)
    found = samples.numpy()
    near = found["distance"] < 1e29
    places = found["origin"][near] + found["distance"][near, None] * found["direction"][near]
    weights = found["measure"][near, None]
    # The mean over a disc of 0.1 rad lies its sagitta short of its middle.
    np.testing.assert_allclose((weights * places).sum(0) / weights.sum(), at, atol=0.002)
    np.testing.assert_allclose(found["origin"][~near], np.broadcast_to(ORIGIN, (int((~near).sum()), 3)), rtol=1e-6)
