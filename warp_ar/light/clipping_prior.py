"""By how much light that clips is expected to exceed clipping: what the captured map says before surfaces are asked.

**By colour.** What is far brighter than clipping clips in all channels alike. What clips in one channel and not in
another is hardly brighter than clipping: its hue would be odd otherwise. So the radiance that a component is expected
to lack is in proportion to the square of the share of its clipped solid angle in which all channels clip (``alike``).

**By depth.** A sky that brightens toward the sun clips where it reaches the limit: what it lacks is nothing at that
boundary and grows inward. A window or a lamp ends at a wall: what it lacks is the same up to its boundary. Cells that
do not clip, beside those that do, tell which it is: they are nearly at clipping, or far below it. So within a component
light is shared in proportion to the angle from the nearest boundary at which it fades (``depth_profile``), up to
``PriorConfig.depth``: without such a boundary it is shared evenly.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.kernels.recovery.recover_cells import LOST
from warp_ar.light.config import CONFIG

Array = NDArray[np.float64]

WHOLE = 0.9
"""Share from which a cell clips in whole and shows the level of clipping."""


def alike(clipped: Array, solid_angle: Array, component: NDArray[np.int64], count: int) -> Array:
    """What each component is expected to lack over one in which all channels clip throughout, (count,).

    The share of its clipped solid angle in which all channels clip, squared, and at least ``least_alike``.

    Args:
        clipped: Share of cells at clipping, per channel, (m, 3).
        solid_angle: Steradians, (m,).
        component: Of each cell, -1 for none, (m,).
        count: Of components.
    """
    inside = component >= 0
    every, some = (
        np.bincount(component[inside], (solid_angle * share)[inside], minlength=count)
        for share in (clipped.min(axis=1), clipped.max(axis=1))
    )
    return np.asarray(np.maximum((every / np.maximum(some, 1e-9)) ** 2, CONFIG.priors.least_alike), np.float64)


def depth_profile(cells: NDArray[Any], component: NDArray[np.int64]) -> Array:
    """What cells lack over the mean of their component, by how deep inside it they lie, per channel, (m, 3).

    Args:
        cells: Records of ``kernels.recover_cells.Cell``, (rows, columns).
        component: Of each cell, -1 for none, (m,).
    """
    flat, profile = cells.ravel(), np.ones((cells.size, 3))
    beyond, seen = flat["modelled"] <= 0.5, flat["hidden"] <= 0.5
    for c in range(3):
        clipped = flat["clipped"][:, c] - flat["hidden"]
        inside = np.flatnonzero((clipped > LOST) & (component >= 0) & beyond)
        whole = inside[clipped[inside] > WHOLE]
        if not len(whole):
            continue
        level = np.median(flat["radiance"][whole, c])
        around = grown((clipped > LOST).reshape(cells.shape)).ravel() & (clipped <= LOST) & beyond & seen
        below, nearly = CONFIG.priors.fades
        outside = np.flatnonzero(around & (flat["radiance"][:, c] > below * level))
        if not len(outside):
            continue
        sharp = np.clip((nearly - flat["radiance"][outside, c] / level) / (nearly - below), 0.0, 1.0)
        cosine = flat["middle"][inside].astype(float) @ flat["middle"][outside].astype(float).T
        depth = np.arccos(np.clip(cosine, -1.0, 1.0)) + CONFIG.priors.depth * sharp
        deep = np.minimum(depth.min(axis=1), CONFIG.priors.depth)
        weight = (flat["missing"][inside, c] * flat["solid_angle"][inside]).astype(float)
        own, count = component[inside], int(component.max()) + 1
        total, sums = np.bincount(own, weight, count), np.bincount(own, weight * deep, count)
        known = total[own] > 0.0
        profile[inside[known], c] = deep[known] * total[own[known]] / sums[own[known]]
    return profile


def grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A latlong mask and its neighbours, across the seam."""
    wide = np.pad(mask, ((0, 0), (1, 1)), mode="wrap").astype(np.uint8)
    return np.asarray(cv2.dilate(wide, np.ones((3, 3), np.uint8))[:, 1:-1] > 0)
