"""Evidence of the card: that it is in the picture, how far its white is believed, how much light it leaves open.

The card's white is the one reflectance that is known. A table, a stool or a hand may stand where the card is expected.
Print tells: ink is a tenth as bright as the paper beside it or darker, in any light that both receive. White cells and
ink cells lie next to each other all over the print, so that the ratio of an ink cell to its nearest white ones does not
depend on shadows or falling off.

Paper is at most some thirty times as bright as the ink on it. Where it looks brighter still, the response is steeper
than it is taken to be, as an S-shaped tone curve makes it, and the card is doubted by as much.
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
    """Evidence of a card."""

    contrast: float
    """Median ratio of paper to the ink beside it; 0 where too little of either is seen."""
    share: float
    """Share of ink cells that are clearly darker than the paper beside them, 0 to 1."""

    @property
    def holds(self) -> bool:
        """True where the card is in the picture."""
        config = CONFIG.card
        return self.contrast >= config.least_contrast and self.share >= config.least_share


NO_CARD = CardCheck(0.0, 0.0)
"""Nothing speaks for one."""


def check_card(points: Array, kind: NDArray[np.int64], light: Array) -> CardCheck:
    """Compare ink with the paper beside it.

    Args:
        points: Places of the surface points that are seen, metres, (n, 3).
        kind: ``Kind`` of the surface that each lies on, (n,).
        light: pi times the radiance that each shows, (n, 3); where it clips, the level of clipping: ink is then darker
            still beside the paper than it looks.
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
    """Return the points of paper and ink that something covers, (n,); none where hardly any paper would be left.

    A hand over a part of the card covers paper and the ink beside it, and is as bright where one is as where the other
    is. A shadow darkens both, and their ratio stays.

    Args:
        points: As for ``check_card``.
        kind: As for ``check_card``.
        light: As for ``check_card``.
    """
    config = CONFIG.card
    paper, ink = np.flatnonzero(kind == Kind.CARD), np.flatnonzero(kind == Kind.INK)
    covered = np.zeros(len(kind), bool)
    if min(len(paper), len(ink)) < config.least_cells:
        return covered
    value = light.mean(axis=1)
    apart = np.linalg.norm(points[ink][:, None] - points[paper], axis=2)
    of_ink = value[paper[np.argsort(apart, axis=1, kind="stable")[:, :3]]]
    covered[ink] = np.median(of_ink, axis=1) < config.darker * value[ink]
    of_paper = value[ink[np.argsort(apart.T, axis=1, kind="stable")[:, :3]]]
    covered[paper] = value[paper] < config.darker * np.median(of_paper, axis=1)
    return covered if np.count_nonzero(~covered[paper]) >= config.least_cells else np.zeros(len(kind), bool)


@dataclasses.dataclass(frozen=True)
class Interval:
    """Irradiance of surfaces that face along the axes, at the ball's place, with the map's light put right."""

    normals: Array
    """+x, -x, +y, -y, +z, -z, (6, 3)."""
    low: Array
    """Lower end of the 95 % interval, (6, 3: channels)."""
    value: Array
    """Estimate, (6, 3)."""
    high: Array
    """Upper end of the 95 % interval, (6, 3)."""


def doubt_of(contrast: float) -> float:
    """Standard deviation of the card's logarithm, by the ratio of its paper to its ink."""
    config = CONFIG.evidence
    return float(np.hypot(config.white, config.doubt * np.log(max(contrast / config.usual_contrast, 1.0))))


def irradiance_form(problem: Problem, normals: Array) -> Array:
    """Return the matrix from radiance of cells to irradiance at the ball's place, (normals, cells)."""
    return np.asarray(np.maximum(normals @ problem.direction.T, 0.0) * problem.solid_angle)


def greyer(contrast: float, white: float) -> float:
    """Return the factor by which light may exceed what the card says, for paper that is greyer than stated: at least 1.

    Paper over ink is their contrast; print is usually of so much reflectance.

    Args:
        contrast: Of paper that does not clip to the ink beside it.
        white: Reflectance that the paper is said to have.
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
    """Between which bounds the irradiance at the ball's place lies.

    What the ball shows errs by ``capture`` to one side and ``overlooked`` to the other. What an estimate found scatters
    as its draws do, and where part of it was held back the whole of it, and as much again, may be there. Paper may be
    greyer than it is said to be (``greyer``). Where no draws were made, or the card only bounds what is missing, all
    that clips may be as bright as ``clipped``.

    Args:
        problem: The equations.
        recovered: An estimate's solution, (cells, 3).
        factor: Share of it that is taken, 0 to 1.
        bounds: Channels in which it is a lower bound.
        known: Whether surfaces tell where the light comes from.
        contrast: Of the card's print; 0: no card is seen.
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
    """Return the factor on a solution, 0 to 1, by which its share of all light is in keeping with the card's.

    Light from the side, or from below, hardly lights the card; surfaces that say it is there are textured and of
    unknown reflectance. Where the card shows little missing, it is little elsewhere, within ``lever``.

    Args:
        problem: The equations.
        recovered: Radiance that cells lack, (cells, 3).
        bounds: Channels in which the card clips, and says nothing.
        doubt: Standard deviation of the card's logarithm.
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
    """Return unit vectors spread evenly over the sphere, (count, 3): a Fibonacci spiral."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    turn = np.pi * (1.0 + 5.0**0.5) * k
    return np.stack([np.sqrt(1.0 - z * z) * np.cos(turn), np.sqrt(1.0 - z * z) * np.sin(turn), z], -1)
