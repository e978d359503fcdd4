"""Circles that a picture may show: where edges of all directions point to one place.

Every edge votes for the two places at a radius from it along its gradient (the fast radial symmetry of [LZ03]). Votes
are counted by eighths of the turn, and none of them counts for more than a rim in it can give: a straight edge or a
thicket fills one or two eighths, a rim most of them. Radii are looked for an octave at a time, each in a picture that
is reduced until they are some 20 pixels, so that a ball of a thirtieth of the picture is seen as well as one that fills
it. Gradients are those of the logarithm of the codes: in the short exposures of a bracket a rim is a few codes high,
beside lamps of two hundred.

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
"""Radii over the picture's shorter side that are looked for; a ball may leave the picture by half its radius."""
LEAST_RADIUS = 5.0
"""Pixels of the smallest ball."""
REDUCED = 14.0
"""Pixels of an octave's smallest radius in the picture in which it is looked for."""
STEPS = (1.0, 1.19, 1.41, 1.68)
"""Radii of an octave over its smallest."""
SLACK = 0.1
"""Standard deviation of a vote's place over the radius: the steps between radii, a lens's ellipse, noise."""
SECTORS = 8
"""Parts of the turn that count on their own."""
FAINT = 0.012
"""Derivative of the logarithm of codes, per pixel, below which nothing is an edge."""
DARK = 5.0
"""Codes that are added before the logarithm: noise of the darks."""
LEAST_VOTE = 0.08
"""Share of a whole rim below which no circle is proposed."""
APART = 0.2
"""Difference over the radius from which on two circles are two."""


def _edges(image: Image) -> tuple[Array, Array]:
    """Places (n, 2) of edges, one pixel wide, and unit gradients there (n, 2)."""
    light = cv2.GaussianBlur(np.log(image.astype(np.float32) + DARK), (0, 0), 0.7)
    gx, gy = (cv2.Sobel(light, cv2.CV_32F, *way, scale=1 / 8) for way in ((1, 0), (0, 1)))
    # The channel that changes most: a coloured ball may be as bright as what is behind it.
    most = np.argmax(gx**2 + gy**2, axis=-1)[..., None]
    gx, gy = (np.take_along_axis(g, most, -1)[..., 0] for g in (gx, gy))
    size = np.hypot(gx, gy)
    before, after = (np.where(np.abs(gx) >= np.abs(gy), np.roll(size, by, 1), np.roll(size, by, 0)) for by in (1, -1))
    edge = (size >= before) & (size > after) & (size > FAINT)
    rows, columns = np.nonzero(edge)
    return np.column_stack([columns, rows]).astype(float), np.column_stack([gx[edge], gy[edge]]) / size[edge][:, None]


def _vote(places: Array, ways: Array, radius: float, size: tuple[int, int]) -> tuple[Array, float, float]:
    """Share of a rim of ``radius`` that edges show about each place: a grid, its cell in pixels, and its margin.

    ``size``: height and width of the picture. Of an eighth of the turn at most all of its rim is counted.
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
    """Circles (x, y, radius) in pixels that a picture may show, of each octave of radii the ``most`` likely.

    Args:
        image: uint8 RGB (height, width, 3).
        most: Circles of each octave.
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
    """The likeliest circles, none of them another one once more."""
    chosen: list[Circle] = []
    for _, (x, y, radius) in sorted(found, reverse=True):
        if all(max(math.hypot(x - a, y - b), abs(radius - r)) > APART * max(radius, r) for a, b, r in chosen):
            chosen.append((x, y, radius))
            if len(chosen) == most:
                break
    return chosen
