"""Float64 twin of ``warp_ar.kernels.picture.composite``."""

import numpy as np


def compose(radiance, virtual=None, added=None, ratio=None, mirror_ball=None):
    """Linear radiance of all layers, (H, W, 3)."""
    total = radiance.astype(np.float64)
    if ratio is not None:
        total = total * ratio
    if added is not None:
        total = total + added
    if mirror_ball is not None:
        total = np.maximum(total + mirror_ball, 0.0)
    if virtual is not None:
        total = (1.0 - virtual[..., 3:].astype(np.float64)) * total + virtual[..., :3]
    return total


def within(rect, shape):
    mask = np.zeros(shape, bool)
    mask[rect[0] : rect[1], rect[2] : rect[3]] = True
    return mask
