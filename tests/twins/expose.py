"""Float64 twins of ``warp_ar.kernels.picture.expose``."""

import numpy as np

from tests.twins import summed_area

KNEE = 250.0


def surrounding_mean(values, i, j, scale, max_box):
    """Between the two odd boxes next to the size that is asked for."""
    reach = 0.5 * (1.0 - scale) * (max_box - 1)
    inner = int(reach)
    near, far = (summed_area.box_mean(values, i, j, 2 * k + 1) for k in (inner, inner + 1))
    return near + (reach - inner) * (far - near)


def paper_factor(mean, scale):
    """[DH04] section 4.3 without a bound; from a scale of 1e-3 on."""
    w = np.clip(2.0 * mean / 255.0 - 1.0, 0.0, 1.0)
    return scale + (1.0 - scale) * w


def paper_mean_factor(mean, scale):
    """The same with the mean itself for w."""
    return scale + (1.0 - scale) * mean / 255.0


FACTORS = {"paper": paper_factor, "paper_mean": paper_mean_factor}


def gains(frame, scale, max_box, method="paper"):
    """Factor / scale of every pixel."""
    factor = FACTORS[method]
    values = summed_area.intensity(frame)
    clipped = np.clip((frame.min(-1) - KNEE) / (255.0 - KNEE), 0.0, 1.0)
    out = np.ones(frame.shape[:2])
    if scale < 1.0:
        for i, j in np.argwhere(clipped > 0.0):
            guess = factor(surrounding_mean(values, i, j, scale, max_box), scale) / scale if scale > 0.0 else 1.0
            out[i, j] = 1.0 + clipped[i, j] * (guess - 1.0)
    return out
