"""Float64 twins of ``kernels/sampling.py``."""

from __future__ import annotations

import numpy as np

MASK = 0xFFFFFFFF


def pcg3d_hash(x, y, z):
    x, y, z = ((v * 1664525 + 1013904223) & MASK for v in (x, y, z))
    x = (x + y * z) & MASK
    y = (y + z * x) & MASK
    z = (z + x * y) & MASK
    x, y, z = x ^ (x >> 16), y ^ (y >> 16), z ^ (z >> 16)
    x = (x + y * z) & MASK
    y = (y + z * x) & MASK
    z = (z + x * y) & MASK
    return x, y, z


def radical_inverse(index):
    return int(f"{index:032b}"[::-1], 2) / 2.0**32


def ggx_distribution(cos_theta, alpha):
    """[Walter07] eq. 33 as printed."""
    tan2 = (1 - cos_theta**2) / cos_theta**2
    return alpha**2 / (np.pi * cos_theta**4 * (alpha**2 + tan2) ** 2)


def ggx_masking(cos_theta, alpha):
    """[Walter07] eq. 34."""
    tan2 = (1 - cos_theta**2) / cos_theta**2
    return 2 / (1 + np.sqrt(1 + alpha**2 * tan2))
