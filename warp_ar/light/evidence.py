"""Evidence of the card: whether it is in the picture, how reliable its white is, and bounds on the missing light.

The reflectance of the card's paper is the only known one, but something else may be where the card is expected. The
card's print identifies it: ink is at most a tenth as bright as the adjacent paper in any light. White cells and ink
cells are adjacent all over the print, so the ratio of an ink cell to its nearest white cells does not depend on shadows
or on the falloff of light.

Paper is at most thirty times as bright as its ink. A larger ratio shows that the response is steeper than assumed, for
example S-shaped, and reduces the confidence in the card accordingly.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from warp_ar.light.config import CONFIG, Kind
from warp_ar.light.problem import Problem

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class CardCheck:
    """Result of the test whether the card is in the picture."""

    contrast: float
    """Median ratio of paper to adjacent ink; 0 if too little of either is visible."""
    share: float
    """Share of ink cells that are clearly darker than the adjacent paper, 0 to 1."""

    @property
    def holds(self) -> bool:
        """True if the card is in the picture."""
        config = CONFIG.card
        return self.contrast >= config.least_contrast and self.share >= config.least_share


NO_CARD = CardCheck(0.0, 0.0)
"""Result without any evidence of a card."""


def check_card(points: Array, kind: NDArray[np.int64], light: Array) -> CardCheck:
    """Return the comparison of ink with the adjacent paper.

    Args:
        points: Positions of the visible surface points, metres, (n, 3).
        kind: ``Kind`` of each point's surface, (n,).
        light: pi times the radiance of each point, (n, 3). Clipped points have the clipping level, so that the contrast
            of paper to ink is underestimated.
    """
    config = CONFIG.card
    paper, ink = np.flatnonzero(kind == Kind.CARD), np.flatnonzero(kind == Kind.INK)
    if min(len(paper), len(ink)) < config.least_cells:
        return NO_CARD
    value = light.mean(axis=1)
    apart = np.linalg.norm(points[ink][:, None] - points[paper], axis=2)
    beside = paper[np.argsort(apart, axis=1, kind="stable")[:, :3]]
    ratio = np.median(value[beside], axis=1) / np.maximum(value[ink], 1e-4)
    return CardCheck(float(np.median(ratio)), float((ratio > config.darker).mean()))


def covered_card(points: Array, kind: NDArray[np.int64], light: Array) -> NDArray[np.bool_]:
    """Return a mask, (n,), of the points of paper and ink that something covers; empty if hardly any paper is left.

    A hand over a part of the card covers paper and adjacent ink, and has the same brightness on both. A shadow darkens
    both, but keeps their ratio.

    Args:
        points: Positions of the visible surface points, metres, (n, 3).
        kind: ``Kind`` of each point's surface, (n,).
        light: pi times the radiance of each point, (n, 3); clipped points have the clipping level.
    """
    config = CONFIG.card
    paper, ink = np.flatnonzero(kind == Kind.CARD), np.flatnonzero(kind == Kind.INK)
    covered = np.zeros(len(kind), bool)
    value = light.mean(axis=1)
    apart = np.linalg.norm(points[ink][:, None] - points[paper], axis=2)
    of_ink = value[paper[np.argsort(apart, axis=1, kind="stable")[:, :3]]]
    covered[ink] = np.median(of_ink, axis=1) < config.darker * value[ink]
    of_paper = value[ink[np.argsort(apart.T, axis=1, kind="stable")[:, :3]]]
    covered[paper] = value[paper] < config.darker * np.median(of_paper, axis=1)
    return covered if np.count_nonzero(~covered[paper]) >= config.least_cells else np.zeros(len(kind), bool)


@dataclasses.dataclass(frozen=True)
class Interval:
    """Irradiance at the ball's place, recovered light included, for the six axis directions, with its interval."""

    normals: Array
    """Surface normals +x, -x, +y, -y, +z, -z, (6, 3)."""
    low: Array
    """Lower end of the 95 % interval, (6, 3: channels)."""
    value: Array
    """Estimate, (6, 3)."""
    high: Array
    """Upper end of the 95 % interval, (6, 3)."""


def doubt_of(contrast: float) -> float:
    """Return the standard deviation of the logarithm of the card's radiance, given its ratio of paper to ink."""
    config = CONFIG.evidence
    return float(np.hypot(config.white, config.doubt * np.log(max(contrast / config.usual_contrast, 1.0))))


def irradiance_form(problem: Problem, normals: Array) -> Array:
    """Return the matrix that maps the radiance of cells to irradiance at the ball's centre, (normals, cells)."""
    return np.asarray(np.maximum(normals @ problem.direction.T, 0.0) * problem.solid_angle)


def greyer(contrast: float, white: float) -> float:
    """Return the factor, at least 1, by which light may exceed the card's estimate if the paper is greyer than stated.

    The paper's reflectance is then the contrast of paper to ink times the usual reflectance of printed ink.

    Args:
        contrast: Ratio of unclipped paper to adjacent ink.
        white: Stated reflectance of the paper.
    """
    return max(white / (contrast * CONFIG.surfaces.reflectance[Kind.INK]), 1.0) if contrast > 0.0 else 1.0


def irradiance_interval(
    problem: Problem,
    recovered: Array,
    factor: float,
    bounds: tuple[bool, bool, bool],
    *,
    known: bool,
    contrast: float = 0.0,
) -> Interval:
    """Return the interval of the irradiance at the ball's place.

    Captured irradiance may be too high by ``capture`` and too low by ``overlooked``. Recovered light has the relative
    error ``found``; if only a part of it is applied, the upper end includes the rest and as much again. Paper may be
    greyer than stated (``greyer``). If surfaces do not determine directions, or the card gives only a lower bound, all
    clipped light may be as bright as ``clipped``.

    Args:
        problem: The equations.
        recovered: Solution of the estimate, (cells, 3).
        factor: Share of the solution that is applied, 0 to 1.
        bounds: Channels in which the solution is a lower bound.
        known: True if surfaces determine the directions of the light.
        contrast: Ratio of the card's paper to its ink; 0: no card is visible.
    """
    config = CONFIG.evidence
    normals = np.array([[s if k == axis else 0.0 for k in range(3)] for axis in range(3) for s in (1.0, -1.0)])
    form = irradiance_form(problem, normals)
    captured, found = form @ problem.radiance, form @ (recovered * problem.missing)
    most = form @ (config.clipped * problem.missing)
    low = (1.0 - config.capture) * captured + factor * (1.0 - config.found) * found
    high = (1.0 + config.overlooked) * captured + (2.0 - factor) * (1.0 + config.found) * found
    is_open = np.array(bounds) | (not known)
    high *= greyer(contrast, problem.white)
    high = np.where(is_open, np.maximum(high, (1.0 + config.overlooked) * captured + most), high)
    return Interval(normals, low, captured + factor * found, high)


def most_by_card(problem: Problem, recovered: Array, bounds: tuple[bool, bool, bool], doubt: float) -> float:
    """Return the factor on a solution, 0 to 1, with which its share of all light agrees with the share at the card.

    Light from the side or from below hardly reaches the card, and the surfaces that measure it are textured and of
    unknown reflectance. The solution's share of the light from all directions is therefore limited to ``lever`` times
    the share that is missing at the card.

    Args:
        problem: The equations.
        recovered: Missing radiance of cells, (cells, 3).
        bounds: Channels in which the card clips and is not used.
        doubt: Standard deviation of the logarithm of the card's radiance.
    """
    lacking = problem.solid_angle @ problem.missing
    told = [c for c in range(3) if lacking[c] > 0.3 * lacking.max() and not bounds[c]]
    if not told:
        return 1.0
    most = CONFIG.evidence.lever * (max(problem.card_share(c, is_bound=False) for c in told) + doubt)
    form = irradiance_form(problem, spread_directions(CONFIG.evidence.directions))
    size = float(np.linalg.norm(form @ (recovered * problem.missing)))
    if most >= 1.0 or size <= 0.0:
        return 1.0
    return min(most / (1.0 - most) * float(np.linalg.norm(form @ problem.radiance)) / size, 1.0)


def spread_directions(count: int) -> Array:
    """Return unit vectors that are spread evenly over the sphere on a Fibonacci spiral, (count, 3)."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    turn = np.pi * (1.0 + 5.0**0.5) * k
    return np.stack([np.sqrt(1.0 - z * z) * np.cos(turn), np.sqrt(1.0 - z * z) * np.sin(turn), z], -1)
