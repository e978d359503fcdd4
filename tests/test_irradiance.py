import math

import numpy as np
import pytest
import warp as wp

from tests.error_model import check_error
from tests.twins import irradiance as reference
from tests.twins import latlong
from warp_ar.kernels.environment import irradiance

# Float32 sums over a map, relative to the largest result.
ROUNDING = 1e-5
# The reference cuts texels in 8 x 8 parts, ours takes their spread: of the largest irradiance, texels of 11 degrees.
REFERENCE_SPREAD = 2e-3
SIZES = [(64, 128), (16, 32), (7, 13), (1, 9), (9, 1), (1, 1), (5, 10)]


def unit(count, seed=0):
    v = np.random.default_rng(seed).standard_normal((count, 3))
    v = v / np.linalg.norm(v, axis=1, keepdims=True)
    v[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    return v


def upload(radiance):
    return wp.array(np.ascontiguousarray(radiance, np.float32), dtype=wp.vec3)


def project(radiance, window=False):
    environment = upload(radiance)
    tables = irradiance.make_sh_tables(*environment.shape, environment.device)
    sums = wp.zeros((environment.shape[0], 5), dtype=wp.vec3)
    out = wp.zeros(9, dtype=wp.vec3)
    irradiance.project_irradiance_sh(environment, tables, sums, out)
    if window:
        irradiance.window_sh(out)
    return out


def clusters(radiance, blocks=None, size=(32, 64)):
    environment = upload(radiance)
    blocks = blocks or environment.shape
    lights = wp.zeros(math.prod(blocks), dtype=irradiance.Cluster)
    irradiance.gather_clusters(environment, blocks, lights)
    out = wp.zeros(size, dtype=wp.vec3)
    irradiance.sum_clusters(lights, out)
    return out


def sun(height, width, row, column, sky=0.0, value=1.0):
    radiance = np.full((height, width, 3), sky)
    radiance[row, column] = value
    parts, areas = reference.supersampled(height, width, 8)
    direction = (parts * areas[..., None])[row, :, column].sum(
        (0, 1)
    )  # a texel at a pole does not look where its centre lies
    direction /= np.linalg.norm(direction)
    return radiance, direction, value * latlong.solid_angles(height, width)[row, column]


# --- Closed forms -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("blocks", [None, (8, 16)])
@pytest.mark.parametrize("row", [0, 5, 32, 63])
def test_a_single_lamp_gives_the_cosine(device, row, blocks):
    # Atlas row 6: 1e6 over 1e-4.
    radiance, direction, flux = sun(64, 128, row, 71, 1e-4, 1e6)
    values = clusters(radiance, blocks).numpy().reshape(-1, 3)
    cosines = np.maximum(latlong.directions(32, 64).reshape(-1, 3) @ direction, 0)
    # Half a texel (1.4 degrees) either side of the terminator sees part of the lamp.
    np.testing.assert_allclose(values[:, 0] / flux, cosines, atol=0.5 * np.pi / 64 / 2)
    lit = cosines > 0.05
    # Elsewhere by what the texel's mean direction is shorter than 1.
    np.testing.assert_allclose(values[lit, 0] / flux, cosines[lit], atol=(np.pi / 64) ** 2 / 12 + ROUNDING)


def test_a_single_lamp_gives_the_order_2_polynomial(device):
    radiance, direction, flux = sun(256, 512, 90, 300)
    normals = unit(500)
    x = normals @ direction
    coefficients = project(radiance).numpy().astype(np.float64)
    # The lamp is a texel wide: 1 - l (l + 1) variance / 2 of 1.
    expected = flux * (0.25 + 0.5 * x + 5 / 32 * (3 * x * x - 1))
    np.testing.assert_allclose(
        reference.evaluate(coefficients, normals), expected[:, None].repeat(3, 1), atol=1e-4 * flux
    )


# --- Twins ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", SIZES)
def test_projection_is_the_twin_s(device, size):
    radiance = np.random.default_rng(7).random((*size, 3)) ** 4
    factor = min(max(4, 256 // min(size)), 64)  # parts small enough for the twin's own error
    twin = reference.project_irradiance_sh(radiance, 2, factor)
    ours = project(radiance).numpy()
    np.testing.assert_allclose(
        ours, twin, atol=1e-3 * np.abs(twin).max() if min(size) < 4 else 1e-4 * np.abs(twin).max()
    )
    check_error("irradiance", ours, twin)


@pytest.mark.parametrize("size", [(16, 32), (9, 20)])
def test_the_reference_is_the_twin_s(device, size):
    radiance = np.random.default_rng(9).random((*size, 3)) ** 8
    out = clusters(radiance, None, (6, 12)).numpy().reshape(-1, 3)
    twin = reference.irradiance(radiance, latlong.directions(6, 12).reshape(-1, 3))
    np.testing.assert_allclose(out, twin, atol=REFERENCE_SPREAD * twin.max())
    check_error("irradiance", out, twin)


# --- Positivity -------------------------------------------------------------------------------------------------------


def lamp(degrees, height=256):
    """A round lamp of a diameter, black otherwise, anti-aliased."""
    axis = np.array([0.36, -0.48, 0.8])
    angle = np.degrees(np.arccos(np.clip(latlong.directions(height, 2 * height) @ axis, -1, 1)))
    soft = np.clip((degrees / 2 - angle) / (180 / height) + 0.5, 0, 1)
    return soft[..., None] * np.array((1.0, 0.8, 0.5)) * 1e4


@pytest.mark.parametrize("degrees", [0.7, 2.7, 30.0, 90.0])
def test_a_small_lamp_gives_no_negative_light(device, degrees):
    radiance, normals = lamp(degrees), unit(20_000)
    plain = project(radiance).numpy().astype(np.float64)
    mean = plain[0] / np.sqrt(4 * np.pi)
    lowest = reference.evaluate(plain, normals).min(0)
    if degrees < 30:
        assert (lowest < -0.1 * mean).all()  # the case is a real one: filament #744
    windowed = project(radiance, window=True).numpy().astype(np.float64)
    values = reference.evaluate(windowed, normals)
    assert (values > -1e-4 * mean).all()
    np.testing.assert_array_equal(windowed[0], plain[0])  # energy kept
    if (lowest < 0).any():
        # No more than it takes: the darkest direction of some channel is black.
        assert (values.min(0) < 2e-3 * mean).any()


# --- Seam, poles, hard cases ------------------------------------------------------------------------------------------


# --- Wiring -----------------------------------------------------------------------------------------------------------
