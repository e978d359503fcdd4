"""Float64 twins of ``kernels/materials.py``, written from the papers' formulas rather than the kernels' forms."""

from __future__ import annotations

import numpy as np


def dot(a, b):
    """Dot product over the last axis."""
    return np.sum(a * b, -1)


def phong_lobe(mirror, wi, exponent):
    """(n + 1) / (2 pi) cos^n."""
    cosine = dot(mirror, wi)
    with np.errstate(under="ignore"):
        return np.where(cosine > 0, (exponent + 1) / (2 * np.pi) * np.maximum(cosine, 1e-300) ** exponent, 0.0)


def ggx_lobe(normal, half, wi, wo, roughness, min_alpha):
    """D G2 / (4 cos_i cos_o): Walter et al. eq. 33 and height-correlated Smith with Lambda of eq. 34."""
    alpha = max(roughness**2, min_alpha)
    cos_h = dot(normal, half)
    # 1 - cos_h^2 from the cross product: also in float64 it has few digits left at the peak.
    sine2 = np.sum(np.cross(normal, half) ** 2, -1)
    distribution = alpha**2 / (np.pi * (sine2 + alpha**2 * cos_h**2) ** 2)

    def masking(w):
        tangent2 = (1 - dot(normal, w) ** 2) / dot(normal, w) ** 2
        return (np.sqrt(1 + alpha**2 * tangent2) - 1) / 2

    return distribution / (1 + masking(wi) + masking(wo)) / (4 * dot(normal, wi) * dot(normal, wo))


def texture(image, uv):
    """Bilinear, repeating; v points up."""
    height, width, _ = image.shape
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    j, i = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - j)[:, None], (y - i)[:, None]
    rows, columns = (i % height, (i + 1) % height), (j % width, (j + 1) % width)
    top = image[rows[0], columns[0]] * (1 - fx) + image[rows[0], columns[1]] * fx
    bottom = image[rows[1], columns[0]] * (1 - fx) + image[rows[1], columns[1]] * fx
    return top * (1 - fy) + bottom * fy
