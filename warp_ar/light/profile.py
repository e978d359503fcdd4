"""PROTOTYPE"""
from __future__ import annotations
import os
import numpy as np
from numpy.typing import NDArray
from typing import Any
from warp_ar.kernels.recover_cells import LOST
Array = NDArray[np.float64]
P, LOW, HIGH, T0 = (float(x) for x in os.environ.get("LOOK_P", "1,.5,.8,0").split(","))

def neighbours(mask):
    out = np.zeros_like(mask)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            m = np.roll(mask, dx, axis=1)
            if dy == -1: out[:-1] |= m[1:]
            elif dy == 1: out[1:] |= m[:-1]
            else: out |= m
    return out

def excess_profile(cells: NDArray[Any], components: NDArray[np.int64]) -> Array:
    shape = cells.shape
    profile = np.ones((cells.size, 3))
    if P == 0: return profile
    direction = cells["middle"].reshape(-1, 3).astype(float)
    area = cells["solid_angle"].ravel().astype(float)
    seen = (cells["hidden"].ravel() < 0.5)
    own = ~(cells["modelled"].ravel() > 0.5)
    missing = cells["missing"].reshape(-1, 3).astype(float)
    for c in range(3):
        share = cells["clipped"][..., c].ravel() - cells["hidden"].ravel()
        inside = (share > LOST) & own
        if not inside.any(): continue
        outside = neighbours(inside.reshape(shape)).ravel() & ~inside & seen & own
        rad = cells["radiance"].reshape(-1, 3)[:, c]
        smooth = np.clip((rad - LOW) / (HIGH - LOW), 0, 1)
        j = np.flatnonzero(outside & (smooth > 0)); i = np.flatnonzero(inside)
        if not len(j): continue
        theta = np.arccos(np.clip(direction[i] @ direction[j].T, -1, 1))
        e = (theta + (1 - smooth[j]) * np.pi).min(axis=1)
        e = np.minimum(e, float(os.environ.get("LOOK_CAP", "1")))
        for k in np.unique(components[i]):
            if k < 0: continue
            m = components[i] == k
            w = (missing[i[m], c] * area[i[m]])
            if w.sum() <= 0: continue
            q = (e[m] + T0) ** P
            profile[i[m], c] = np.clip(q / ((w * q).sum() / w.sum()), 0.02, 20)
    return profile
