"""Float64 twins of ``kernels/environment/prefilter.py``, ``lobes.py`` and ``split_sum.py``."""

from __future__ import annotations

import numpy as np

from tests.twins import latlong


def lobe(cosine, alpha, kind):
    """Lobes as papers print them, not normalised: D of the half vector times cos, or cos^n."""
    cosine = np.maximum(cosine, 0.0)
    if kind == "phong":
        return cosine ** (1 / alpha**2)
    half_cosine2 = (1 + cosine) / 2
    return cosine * alpha**2 / (np.pi * (half_cosine2 * (alpha**2 - 1) + 1) ** 2)


def integrate_lobe(radiance, directions, alpha, kind):
    """Radiance (N, 3) averaged with a lobe about ``directions`` (N, 3), by summing over texels."""
    texels = latlong.directions(*radiance.shape[:2]).reshape(-1, 3)
    weight = lobe(directions @ texels.T, alpha, kind) * latlong.solid_angles(*radiance.shape[:2]).ravel()
    return weight @ radiance.reshape(-1, 3) / weight.sum(1, keepdims=True)


def dfg(n_dot_v, roughness, nodes=400):
    """Scale and bias of F0 by quadrature over wi, GGX with height-correlated Smith masking."""
    alpha = roughness**2
    wo = np.array([np.sqrt(1 - n_dot_v**2), 0.0, n_dot_v])
    # Half vectors, tan theta = alpha t / (1 - t) gathers nodes at the peak; phi from 0 to pi by symmetry.
    x, w = np.polynomial.legendre.leggauss(nodes)
    t, dt = (x + 1) / 2, w / 2
    theta = np.arctan(alpha * t / (1 - t))
    dtheta = dt * alpha / ((1 - t) ** 2 + (alpha * t) ** 2)
    phi, dphi = (x + 1) / 2 * np.pi, w / 2 * np.pi * 2
    theta, phi = theta[:, None], phi[None, :]
    wh = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi], -1)
    cosine = wh @ wo
    wi_z = 2 * cosine * wh[..., 2] - wo[2]
    tan2 = np.tan(theta) ** 2
    distribution = alpha**2 / (np.pi * np.cos(theta) ** 4 * (alpha**2 + tan2) ** 2)

    def masking(z):
        return (np.sqrt(1 + alpha**2 * (1 / np.maximum(z, 1e-12) ** 2 - 1)) - 1) / 2

    visibility = 1 / (1 + masking(wo[2]) + masking(wi_z))
    # brdf cos_i dwi with dwi = 4 cos_h dwh:  D G F / (4 z_o z_i) z_i 4 cos_h.
    value = distribution * visibility * cosine / wo[2] * np.where((wi_z > 0) & (cosine > 0), 1.0, 0.0)
    measure = (np.sin(theta) * dtheta[:, None]) * dphi[None, :]
    fresnel = (1 - np.clip(cosine, 0, 1)) ** 5
    return float((value * (1 - fresnel) * measure).sum()), float((value * fresnel * measure).sum())


def energy_compensation(once, f0):
    """Factor on what is reflected once: of what is left a share sqrt(once) leaves at each further scattering."""
    later = np.sqrt(once)
    return 1 + f0 * (1 / once - 1) * later / (1 - f0 * (1 - later))
