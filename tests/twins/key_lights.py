"""Float64 twin of parts of ``warp_ar.kernels.environment.key_lights``."""

import numpy as np

from tests.twins import latlong


def flow(environment):
    """Vector irradiance and scalar irradiance of the luminance."""
    height, width = environment.shape[:2]
    weight = latlong.solid_angles(height, width) * (np.asarray(environment, np.float64) @ [0.2126, 0.7152, 0.0722])
    return np.einsum("hw,hwc->c", weight, latlong.directions(height, width)), weight.sum()
