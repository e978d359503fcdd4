"""Priors on clipped light from the captured map alone: its regions, and how far they exceed clipping.

A component is a connected set of clipped cells of the map. Its missing radiance is the part above the clipping level.

**By colour.** Light far brighter than clipping clips in all channels. Light that clips in one channel only is hardly
brighter than clipping, because its hue would be implausible otherwise. The expected missing radiance of a component is
therefore proportional to the square of the share of its clipped solid angle in which all channels clip (``alike``).

**By depth.** A sky that brightens toward the sun clips where it reaches the limit: its missing radiance is zero at that
boundary and grows inward. A window or a lamp ends at a wall: its missing radiance is constant up to the boundary.
Unclipped cells next to clipped ones distinguish the two: at a fading boundary they are just below clipping, at a sharp
one far below it. Within a component, missing light is distributed in proportion to the angle from the nearest fading
boundary, up to ``PriorConfig.depth`` (``depth_profile``). Without such a boundary it is distributed evenly.

**At least** (``least_missing``). If no surface measures clipped light, it is raised by an amount that makes nearly no
scene worse. Let X be the irradiance that is added and D the missing irradiance. The result is no worse than the
captured map if X is at most 2 D. Twice the radiance that is missing in nearly every scene may therefore be added
without further knowledge. This radiance depends on the map:

- **Clipped solid angle.** The larger the clipped solid angle W in steradians, the longer the exposure, and the more
  clipped light exceeds clipping: as W^(1/4), up to a steradian. A wholly clipped sky may be hardly above clipping.
- **Clipped channels** (``alike``). Light that clips in one channel only is hardly brighter than clipping.
- **Boundary.** Surroundings of a lamp or a window are far darker. If cells next to clipped ones are nearly clipped, the
  clipped ones may be hardly brighter (``PriorConfig.fades``).

The radiance added to a clipped component, in units of the clipping level, is

    x = least * alike * sharp * W^(1/4).

``bench clipping_prior`` counts the exposures of a folder of environments that become worse by it.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.kernels.recovery.recover_cells import LOST
from warp_ar.light.config import CONFIG

Array = NDArray[np.float64]


def connected_regions(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the index of the connected component of each cell of a latlong mask, (rows, columns); -1 for none.

    Cells are also connected across the seam and the poles.
    """
    height = len(mask)
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    roots = np.arange(count)
    for row in range(height):
        for other in range(max(row - 1, 0), min(row + 2, height)):
            if labels[row, -1] and labels[other, 0]:
                roots[roots == roots[labels[row, -1]]] = roots[labels[other, 0]]
    for row in (0, height - 1):
        at_pole = np.unique(labels[row][labels[row] > 0])
        for label in at_pole[1:]:
            roots[roots == roots[label]] = roots[at_pole[0]]
    number = np.full(count, -1)
    number[np.unique(roots[1:])] = np.arange(len(np.unique(roots[1:])))
    return np.asarray(number[roots][labels], np.int64)


def split_regions(
    labels: NDArray[np.int64], directions: Array, solid_angles: Array, size: float = CONFIG.priors.region
) -> tuple[NDArray[np.int64], int]:
    """Split regions larger than ``size`` steradians into compact parts of about that size.

    Args:
        labels: Region of each cell, -1 for none, (m,).
        directions: Unit directions of cells, (m, 3).
        solid_angles: Solid angles of cells, steradians, (m,).
        size: Largest solid angle, steradians.

    Returns:
        Part of each cell, -1 for none, and the number of parts.
    """
    parts = np.full(len(labels), -1)
    count = 0
    for region in range(int(labels.max(initial=-1)) + 1):
        index = np.flatnonzero(labels == region)
        d, weights = directions[index], solid_angles[index]
        pieces = max(1, int(np.ceil(weights.sum() / size)))
        centres = [d[np.argmax(d @ d.mean(axis=0))]]
        while len(centres) < pieces:
            centres.append(d[np.argmin((d @ np.array(centres).T).max(axis=1))])
        middle = np.array(centres)
        nearest = np.zeros(len(d), np.int64)
        for _ in range(8 if pieces > 1 else 1):
            nearest = np.argmax(d @ middle.T, axis=1)
            sums = np.stack([np.bincount(nearest, weights * d[:, axis], minlength=pieces) for axis in range(3)], -1)
            lengths = np.linalg.norm(sums, axis=1, keepdims=True)
            middle = np.where(lengths > 0, sums / np.maximum(lengths, 1e-12), middle)
        for piece in np.unique(nearest):
            parts[index[nearest == piece]] = count
            count += 1
    return parts, count


WHOLE = 0.9
"""Clipped share of a cell above which its radiance is the clipping level."""


def alike(clipped: Array, solid_angle: Array, component: NDArray[np.int64], count: int) -> Array:
    """Return the expected missing radiance of components, relative to one that clips in all channels, (count,).

    It is the square of the share of the clipped solid angle in which all channels clip, but at least ``least_alike``.

    Args:
        clipped: Clipped share of cells, per channel, (m, 3).
        solid_angle: Solid angles of cells, steradians, (m,).
        component: Component of each cell, -1 for none, (m,).
        count: Number of components.
    """
    inside = component >= 0
    every, some = (
        np.bincount(component[inside], (solid_angle * share)[inside], minlength=count)
        for share in (clipped.min(axis=1), clipped.max(axis=1))
    )
    return np.asarray(np.maximum((every / np.maximum(some, 1e-9)) ** 2, CONFIG.priors.least_alike), np.float64)


def depth_profile(cells: NDArray[Any], component: NDArray[np.int64]) -> Array:
    """Return the missing radiance of cells relative to their component's mean, (m, 3), by their depth in it.

    Args:
        cells: Records of ``kernels.recover_cells.Cell``, (rows, columns).
        component: Component of each cell, -1 for none, (m,).
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
    """Return a latlong mask with adjacent cells added, also across the seam."""
    wide = np.pad(mask, ((0, 0), (1, 1)), mode="wrap").astype(np.uint8)
    return np.asarray(cv2.dilate(wide, np.ones((3, 3), np.uint8))[:, 1:-1] > 0)


def least_missing(
    radiance: NDArray[Any], clipped: NDArray[Any], solid_angle: NDArray[Any], is_light: NDArray[np.bool_]
) -> Array:
    """Return the radiance that is added to a wholly clipped texel of each cell if only the map is known.

    Args:
        radiance: Mean radiance of cells of the captured latlong map, (rows, columns, 3).
        clipped: Clipped share of cells, per channel, (rows, columns, 3).
        solid_angle: Solid angles of cells, steradians, (rows, columns).
        is_light: Mask, (rows, columns), of the cells that were seen and show no modelled surface. Clipped light in
            other cells is reflected by a surface, or was not seen.

    Returns:
        Added radiance, (rows, columns, 3).
    """
    own = np.where(is_light[..., None], clipped, 0.0)
    some = own.max(axis=-1)
    component = connected_regions(some > LOST)
    count = int(component.max(initial=-1)) + 1
    inside = component >= 0
    found = np.zeros(np.shape(radiance), np.float64)
    if count == 0:
        return found
    # No cell exceeds clipping, and the brightest cells of a wide clipped area are wholly clipped. They therefore show
    # the clipping level.
    level = np.asarray(radiance, np.float64)[inside].max(axis=0)
    area = np.asarray(solid_angle, np.float64)
    wide = min(float((area * some)[inside].sum()), CONFIG.least.most)
    shares = alike(own.reshape(-1, 3).astype(np.float64), area.ravel(), component.ravel(), count)
    shares *= _sharp(np.asarray(radiance, np.float64) / max(float(level.max()), 1e-9), area, component, is_light)
    found[inside] = CONFIG.least.least * wide**CONFIG.least.exponent * shares[component[inside], None] * level
    return found


def _sharp(radiance: Array, area: Array, component: NDArray[np.int64], is_light: NDArray[np.bool_]) -> Array:
    """Return the sharpness of components' boundaries, 0 to 1, (components,); 0.5 if no adjacent cell was seen.

    Args:
        radiance: Radiance of cells relative to the clipping level, (rows, columns, 3).
        area: Solid angles of cells, steradians, (rows, columns).
        component: Component of each cell, -1 for none, (rows, columns).
        is_light: Mask, (rows, columns), of the cells that were seen and show no modelled surface.
    """
    below, nearly = CONFIG.priors.fades
    brightness = np.clip(radiance, 0.0, 1.0).mean(axis=-1)
    beside = (component < 0) & is_light
    sharp = np.full(int(component.max()) + 1, 0.5)
    for one in range(len(sharp)):
        around = grown(component == one) & beside
        if around.any():
            rim = float((area * brightness)[around].sum() / area[around].sum())
            sharp[one] = np.clip((nearly - rim) / (nearly - below), 0.0, 1.0)
    return sharp
