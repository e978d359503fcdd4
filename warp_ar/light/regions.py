"""What clips, grouped to regions of one unknown radiance each."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.light.config import CONFIG

Array = NDArray[np.float64]


def connected_regions(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Connected part that each cell of a latlong mask belongs to, across the seam and the poles; -1 for none."""
    height = len(mask)
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    parent = list(range(count))

    def root(label: int) -> int:
        while parent[label] != label:
            label = parent[label]
        return label

    for row in range(height):
        for other in range(max(row - 1, 0), min(row + 2, height)):
            if labels[row, -1] and labels[other, 0]:
                parent[root(int(labels[row, -1]))] = root(int(labels[other, 0]))
    for row in (0, height - 1):
        at_pole = [int(label) for label in np.unique(labels[row]) if label]
        for label in at_pole[1:]:
            parent[root(label)] = root(at_pole[0])
    roots = np.array([root(label) for label in range(count)])
    number = np.full(count, -1)
    number[np.unique(roots[1:])] = np.arange(len(np.unique(roots[1:])))
    return np.asarray(number[roots][labels], np.int64)


def split_regions(
    labels: NDArray[np.int64], directions: Array, solid_angles: Array, size: float = CONFIG.priors.region
) -> tuple[NDArray[np.int64], int]:
    """Split regions that are wider than ``size`` steradians into compact parts of about that size.

    Args:
        labels: Region of each cell, -1 for none, (m,).
        directions: Unit, (m, 3).
        solid_angles: (m,).
        size: Steradians.

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
