"""Float64 twin of ``warp_ar.kernels.environment.accumulate``, as plain as it can be."""

import numpy as np

from tests.twins import latlong
from tests.twins.safe_math import smooth_ramp


class Accumulator:
    """Environment over time."""

    def __init__(self, height, width, cell=8, follow=0.15, haste=6.0, forget=20.0):
        self.environment = np.zeros((height, width, 3))
        self.clipped = np.zeros((height, width, 3))
        self.confidence = np.zeros((height, width))
        self.rows, self.columns = max(1, height // cell), max(1, width // cell)
        self.change = np.zeros((2, self.rows, self.columns))
        self.follow, self.haste, self.forget = follow, haste, forget

    def step(self, radiance, confidence, clipped, time_step):
        height, width = confidence.shape
        area = latlong.solid_angles(height, width)
        weight = area * np.minimum(confidence, self.confidence)
        excess = (self.environment - radiance) / np.maximum(radiance, 0.01)
        beyond = smooth_ramp(0.02, 0.1, excess) * smooth_ramp(0.9, 1.0, clipped)
        radiance = radiance + beyond * (self.environment - radiance)
        clipped = clipped + beyond * (self.clipped - clipped)
        new, old = radiance.mean(-1), self.environment.mean(-1)
        current = np.zeros((self.rows, self.columns))
        for i in range(self.rows):
            for j in range(self.columns):
                part = np.s_[
                    i * height // self.rows : (i + 1) * height // self.rows,
                    j * width // self.columns : (j + 1) * width // self.columns,
                ]
                level = (weight[part] * (np.maximum(new, old)[part] + 0.01)).sum()
                current[i, j] = (weight[part] * (new - old)[part]).sum() / level if level > 0 else 0.0
        self.change = np.stack([current, self.change[0]])
        lasting = np.where(self.change[0] * self.change[1] > 0, np.abs(self.change).min(0), 0.0)
        y = (np.arange(height) + 0.5) * self.rows / height - 0.5
        x = (np.arange(width) + 0.5) * self.columns / width - 0.5
        i, j = np.floor(y).astype(int), np.floor(x).astype(int)
        fy, fx = (y - i)[:, None], (x - j)[None, :]

        def at(r, c):
            return lasting[np.clip(r, 0, self.rows - 1)[:, None], (c % self.columns)[None, :]]

        blend = (at(i, j) * (1 - fx) + at(i, j + 1) * fx) * (1 - fy) + (
            at(i + 1, j) * (1 - fx) + at(i + 1, j + 1) * fx
        ) * fy
        rate = 1 - np.exp(-time_step / self.follow * (1 + (self.haste - 1) * smooth_ramp(0.03, 0.15, blend)))
        k = self.confidence
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.where(k > 0, rate * confidence / (rate * confidence + (1 - rate) * k), 1.0)
        a = np.where(confidence > 0, share, 0.0)
        self.environment += a[..., None] * (radiance - self.environment)
        self.clipped += a[..., None] * (clipped - self.clipped)
        k = k * np.exp(-time_step / self.forget)
        self.confidence = k + a * (confidence - k)
