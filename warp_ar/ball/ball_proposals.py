"""Candidate circles in a picture: places toward which edges of all directions point.

Every edge votes for the two places at distance r along its gradient (fast radial symmetry [LZ03]). Votes are counted in
eighths of the full angle, each limited to the share that a rim can give: a straight edge or a thicket fills one or two
eighths, a rim most of them. Each octave of radii is searched in a picture reduced so that they are about 20 pixels; a
ball of a thirtieth of the picture is found as well as one that fills it. Gradients are those of the logarithm of the
codes: in the short exposures of a bracket, a rim has a contrast of a few codes, next to lamps of two hundred.

References:
    [LZ03] G. Loy and A. Zelinsky. Fast radial symmetry for detecting points of interest. PAMI 25(8), 2003.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Array = NDArray[np.float64]
Circle = tuple[float, float, float]

SMALLEST, LARGEST = 1.0 / 45.0, 0.62
"""Smallest and largest radius, relative to the picture's shorter side; a ball may leave the picture by half its
radius."""
LEAST_RADIUS = 5.0
"""Smallest radius of a ball in pixels."""
REDUCED = 14.0
"""Radius in pixels of an octave's smallest circle in its reduced picture."""
STEPS = (1.0, 1.19, 1.41, 1.68)
"""Radii of an octave, relative to its smallest."""
SLACK = 0.1
"""Standard deviation of a vote's position relative to the radius, for the steps of radii, a lens's ellipse, and
noise."""
SECTORS = 8
"""Number of sectors that are counted separately."""
FAINT = 0.012
"""Smallest gradient of an edge, as the derivative of the logarithm of codes per pixel."""
DARK = 5.0
"""Code added before the logarithm, to suppress noise in dark regions."""
LEAST_VOTE = 0.08
"""Smallest share of a whole rim for which a circle is proposed."""
APART = 0.2
"""Difference, relative to the radius, from which two circles are distinct."""


def _edges(image: Image) -> tuple[Array, Array]:
    """Return positions (n, 2) of edges, one pixel wide, and unit gradients there (n, 2)."""
    light = cv2.GaussianBlur(np.log(image.astype(np.float32) + DARK), (0, 0), 0.7)
    gx, gy = (cv2.Sobel(light, cv2.CV_32F, *way, scale=1 / 8) for way in ((1, 0), (0, 1)))
    # The channel with the largest gradient: a coloured ball may have the brightness of its background.
    most = np.argmax(gx**2 + gy**2, axis=-1)[..., None]
    gx, gy = (np.take_along_axis(g, most, -1)[..., 0] for g in (gx, gy))
    size = np.hypot(gx, gy)
    before, after = (np.where(np.abs(gx) >= np.abs(gy), np.roll(size, by, 1), np.roll(size, by, 0)) for by in (1, -1))
    edge = (size >= before) & (size > after) & (size > FAINT)
    rows, columns = np.nonzero(edge)
    return np.column_stack([columns, rows]).astype(float), np.column_stack([gx[edge], gy[edge]]) / size[edge][:, None]


def _vote(places: Array, ways: Array, radius: float, size: tuple[int, int]) -> tuple[Array, float, float]:
    """Return a grid of the share of a rim of ``radius`` around each position, its cell size in pixels, and its margin.

    ``size`` is the picture's (height, width). Votes of each eighth are limited to that eighth of a rim.
    """
    spread, margin = SLACK * radius, 0.5 * radius
    cell = max(1.0, spread / 1.5)
    height, width = (int((side + 2 * margin) / cell) + 1 for side in size)
    counts = np.zeros((SECTORS, height * width), np.float32)
    for sign in (1.0, -1.0):
        at = ((places + sign * radius * ways + margin) / cell).astype(int)
        inside = ((at >= 0) & (at < (width, height))).all(1)
        turn = np.arctan2(sign * ways[inside, 1], sign * ways[inside, 0]) / (2.0 * math.pi) + 0.5
        sector = (turn * SECTORS).astype(int) % SECTORS
        flat = at[inside, 1] * width + at[inside, 0]
        counts += np.bincount(sector * height * width + flat, minlength=counts.size).reshape(counts.shape)
    whole, blur = 2.0 * math.pi * radius / SECTORS, spread / cell
    total = np.zeros((height, width))
    for part in counts:
        near = cv2.GaussianBlur(part.reshape(height, width), (0, 0), blur, borderType=cv2.BORDER_CONSTANT)
        total += np.minimum(near * (2.0 * math.pi * blur * blur / whole), 1.0)
    return total / SECTORS, cell, margin


def propose_circles(image: Image, most: int = 5) -> list[Circle]:
    """Return candidate circles (x, y, radius) in pixels; for each octave of radii, the ``most`` likely.

    Args:
        image: uint8 RGB (height, width, 3).
        most: Number of circles per octave.
    """
    height, width = image.shape[:2]
    side = min(height, width)
    radius, proposed = max(SMALLEST * side, LEAST_RADIUS), []
    while radius < LARGEST * side:
        share = min(1.0, REDUCED / radius)
        size = max(round(height * share), 8), max(round(width * share), 8)
        small = image if share == 1.0 else cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA)
        places, ways = _edges(np.asarray(small))
        found: list[tuple[float, Circle]] = []
        for step in STEPS:
            votes, cell, margin = _vote(places, ways, step * radius * share, size)
            best = (votes >= cv2.dilate(votes, np.ones((5, 5), np.uint8))) & (votes > LEAST_VOTE)
            for row, column in zip(*np.nonzero(best), strict=True):
                x, y = (((k + 0.5) * cell - margin + 0.5) / share - 0.5 for k in (column, row))
                found.append((float(votes[row, column]), (float(x), float(y), step * radius)))
        proposed += _distinct(found, most)
        radius *= 2.0
    return proposed


def _distinct(found: list[tuple[float, Circle]], most: int) -> list[Circle]:
    """Return the likeliest circles, without near duplicates."""
    chosen: list[Circle] = []
    for _, (x, y, radius) in sorted(found, reverse=True):
        if all(max(math.hypot(x - a, y - b), abs(radius - r)) > APART * max(radius, r) for a, b, r in chosen):
            chosen.append((x, y, radius))
            if len(chosen) == most:
                break
    return chosen
