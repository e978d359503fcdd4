"""Float64 twins of ``kernels/sampling.py``."""

from __future__ import annotations

import numpy as np


def ggx_distribution(cos_theta, alpha):
    """[Walter07] eq. 33 as printed."""
    tan2 = (1 - cos_theta**2) / cos_theta**2
    return alpha**2 / (np.pi * cos_theta**4 * (alpha**2 + tan2) ** 2)


def ggx_masking(cos_theta, alpha):
    """[Walter07] eq. 34."""
    tan2 = (1 - cos_theta**2) / cos_theta**2
    return 2 / (1 + np.sqrt(1 + alpha**2 * tan2))
