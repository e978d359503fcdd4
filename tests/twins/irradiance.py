"""Float64 twins of ``kernels/environment/irradiance.py``."""

from __future__ import annotations

import numpy as np
from scipy.special import sph_harm_y

from tests.twins import latlong

COSINE_LOBE = (np.pi, 2 * np.pi / 3, np.pi / 4, 0.0, -np.pi / 24)


def supersampled(height, width, factor):
    """Directions (H, f, W, f, 3) and solid angles (H, f, 1, 1) of the parts of every texel."""
    directions = latlong.directions(height * factor, width * factor).reshape(height, factor, width, factor, 3)
    areas = latlong.solid_angles(height * factor, width * factor)[:, 0].reshape(height, factor, 1, 1)
    return directions, areas


def irradiance(radiance, normals, factor=8):
    """Irradiance (N, 3) on ``normals`` (N, 3), by summing over parts of texels."""
    directions, areas = supersampled(*radiance.shape[:2], factor)
    cosines = np.maximum(np.einsum("hawbc,nc->nhawb", directions, normals), 0.0) * areas
    return np.einsum("nhawb,hwk->nk", cosines, radiance)


def real_basis(l, m, directions):
    """Real orthonormal spherical harmonic without the Condon-Shortley sign."""
    theta = np.arccos(np.clip(directions[..., 2], -1, 1))
    phi = np.arctan2(directions[..., 1], directions[..., 0])
    value = sph_harm_y(l, abs(m), theta, phi) * (-1) ** m
    if m == 0:
        return value.real
    return np.sqrt(2) * (value.imag if m < 0 else value.real)


def pairs(order):
    """(l, m) in the order of the coefficients."""
    return [(l, m) for l in range(order + 1) for m in range(-l, l + 1)]


def project_irradiance_sh(radiance, order, factor=16):
    """Irradiance coefficients, by summing over parts of texels."""
    directions, areas = supersampled(*radiance.shape[:2], factor)
    return np.stack(
        [
            COSINE_LOBE[l] * np.einsum("hawb,hwk->k", real_basis(l, m, directions) * areas, radiance)
            for l, m in pairs(order)
        ]
    )


def evaluate(coefficients, directions):
    """Irradiance of directions (N, 3) from coefficients, not clamped."""
    order = int(np.sqrt(len(coefficients))) - 1
    basis = np.stack([real_basis(l, m, directions) for l, m in pairs(order)], -1)
    return basis @ coefficients
