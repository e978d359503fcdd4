"""Float64 twins of ``warp_ar.kernels.safe_math``."""

import numpy as np


def smooth_ramp(low, high, x):
    t = np.clip((np.asarray(x, np.float64) - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)
