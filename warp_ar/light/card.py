"""Whether the card's white is in the picture: the one surface whose reflectance is known.

What stands where the card is expected may be a table, a stool or a hand. Print tells: ink is a tenth as bright as the
paper beside it or darker, in any light that both receive. White cells and ink cells lie next to each other all over the
print, so that the ratio of an ink cell to its nearest white ones does not depend on shadows or falling off.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from warp_ar.light.config import CONFIG, Kind

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class CardCheck:
    """What speaks for a card."""

    contrast: float
    """Median ratio of paper to the ink beside it; 0 where too little of either is seen."""
    share: float
    """Share of ink cells that are clearly darker than the paper beside them, 0 to 1."""

    @property
    def holds(self) -> bool:
        """Whether the card is in the picture."""
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
    """Which points of paper and ink something covers, (n,); none where hardly any paper would be left.

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
