"""Spherical harmonics: closed forms, and another way to the same sums."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from warp_ar.output.environment_axes import AXES, world_from_marker
from warp_ar.output.environment_harmonics import basis, encode_harmonics, project_radiance

ROUNDING = 1e-6  # float32 of the map; sums are in double precision
# 200,000 directions of a bilinear sample: five standard errors of a mean of values about 0.3.
MONTE_CARLO = 5 * 0.5 * 4 * math.pi / math.sqrt(200_000)


def noise() -> np.ndarray:
    return np.random.default_rng(3).random((8, 16, 3)).astype(np.float32)


def test_a_constant_has_the_first_coefficient_alone() -> None:
    coefficients = project_radiance(np.full((5, 10, 3), 0.5, np.float32))
    expected = np.zeros((9, 3))
    expected[0] = 0.5 * math.sqrt(4 * math.pi)
    np.testing.assert_allclose(coefficients, expected, atol=ROUNDING)
    content = json.loads(encode_harmonics(np.full((5, 10, 3), 0.5, np.float32), "z-up", 1.0))
    received = basis(np.array([[0.6, 0.0, 0.8]])) @ np.array(content["irradiance"])
    np.testing.assert_allclose(received, math.pi * 0.5, rtol=ROUNDING)  # white furnace


def test_half_a_sky_lights_what_faces_it() -> None:
    """L = 1 above: E(up) of order 2 is pi/2 + 2 pi/3 . 3/4 (the exact pi less orders above 2, which are odd)."""
    sky = np.zeros((16, 32, 3), np.float32)
    sky[:8] = 1.0
    content = json.loads(encode_harmonics(sky, "y-up", 1.0))
    up = np.array([[0.0, 1.0, 0.0]])
    np.testing.assert_allclose(basis(up) @ np.array(content["irradiance"]), math.pi, rtol=ROUNDING)
    np.testing.assert_allclose(basis(-up) @ np.array(content["irradiance"]), 0.0, atol=ROUNDING * 10)


@pytest.mark.parametrize("axes", AXES)
def test_sums_are_those_of_monte_carlo_in_the_files_world(axes: str) -> None:
    directions = np.random.default_rng(4).normal(size=(200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rows = np.minimum((np.arccos(directions[:, 2]) / math.pi * 8).astype(int), 7)
    columns = ((np.arctan2(directions[:, 1], directions[:, 0]) / math.pi + 1) * 8).astype(int) % 16
    light = noise()[rows, columns]
    told = basis(directions @ world_from_marker(axes).T)
    expected = 4 * math.pi * np.einsum("ni,nc->ic", told, light) / len(directions)
    np.testing.assert_allclose(project_radiance(noise(), axes), expected, atol=MONTE_CARLO)


def test_the_frames_own_harmonics_agree(device: str) -> None:
    """The kernel that frames are lit by has the same basis, order and lobe."""
    import warp as wp

    from warp_ar.kernels.environment.irradiance import make_sh_tables, project_irradiance_sh

    radiance = wp.array(noise(), dtype=wp.vec3, device=device)
    tables = make_sh_tables(8, 16, device)
    out = wp.zeros(9, dtype=wp.vec3, device=device)
    rows = wp.zeros((8, 5), dtype=wp.vec3, device=device)
    project_irradiance_sh(radiance, tables, rows, out)
    content = json.loads(encode_harmonics(noise(), "z-up", 1.0))
    np.testing.assert_allclose(out.numpy(), content["irradiance"], atol=1e-4)


def test_a_turned_ramp_points_the_same_way() -> None:
    """l = 1 is a vector: it turns with the world."""
    z_up = project_radiance(noise())[[3, 1, 2]]
    for axes in AXES:
        np.testing.assert_allclose(
            project_radiance(noise(), axes)[[3, 1, 2]], world_from_marker(axes) @ z_up, atol=ROUNDING
        )
