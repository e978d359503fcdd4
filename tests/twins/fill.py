"""Float64 twin of ``warp_ar.kernels.environment.fill``, as plain as it can be."""

import numpy as np

from tests.twins import latlong
from tests.twins.safe_math import smooth_ramp


def _overlap(fine, coarse):
    """Share of fine cell f within coarse cell c, (coarse, fine), with the interval's ends."""
    edges = np.arange(coarse + 1) * fine / coarse
    start = np.maximum(edges[:-1, None], np.arange(fine)[None, :])
    stop = np.minimum(edges[1:, None], np.arange(1, fine + 1)[None, :])
    return start, np.maximum(stop, start)


def fill(radiance, confidence):
    """Complete a map by push and pull."""
    trust = smooth_ramp(0.0, 0.5, confidence)
    value = np.where(trust[..., None] > 0, np.maximum(radiance, 0), 0)
    levels = [(value, trust)]
    while levels[-1][1].shape != (1, 1):
        value, trust = levels[-1]
        height, width = trust.shape
        rows, columns = (height + 1) // 2, (width + 1) // 2
        start, stop = _overlap(height, rows)
        bands = np.cos(np.pi * start / height) - np.cos(np.pi * stop / height)
        start, stop = _overlap(width, columns)
        spans = stop - start
        area = bands.sum(1)[:, None] * spans.sum(1)[None, :]
        weight = bands @ trust @ spans.T
        total = np.einsum("rh,hw,hwc,kw->rkc", bands, trust, value, spans)
        mean = np.where(weight[..., None] > 0, total / np.maximum(weight, 1e-300)[..., None], 0)
        levels.append((mean, np.minimum(1, 4 * weight / area)))
    complete = levels[-1][0]
    for value, trust in reversed(levels[:-1]):
        height, width = trust.shape
        rows, columns = complete.shape[:2]
        y, x = np.meshgrid(
            (np.arange(height) + 0.5) * rows / height - 0.5,
            (np.arange(width) + 0.5) * columns / width - 0.5,
            indexing="ij",
        )
        coarse = latlong.sample_at(complete, y, x)
        complete = value + (1 - trust)[..., None] * (coarse - value)
    return complete
