"""What recovery finds of the light that clipping took."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from warp_ar.light.card import NO_CARD, CardCheck
from warp_ar.light.evidence import Interval


@dataclasses.dataclass(frozen=True)
class FoundEmitter:
    """A source of light that was found by what it does."""

    origin: NDArray[np.float64]
    """Where on the ball the camera sees it mirrored, metres, (3,)."""
    direction: NDArray[np.float64]
    """Unit, from there, (3,)."""
    distance: float
    """Metres from there; infinite where none was found."""
    power: NDArray[np.float64]
    """Radiance times solid angle as seen from the ball, per channel, beyond what the map shows, (3,)."""
    cell: int = -1
    """Number of the cell that it stands in, where it was found in one."""


@dataclasses.dataclass(frozen=True)
class Estimate:
    """What clipping took, as far as one frame tells."""

    recovered: NDArray[np.float32]
    """Radiance that a wholly clipped texel lacks, (rows, columns, 3) of cells."""
    lower_bound: tuple[bool, bool, bool]
    """Channels in which the card clips or is not seen: there the total is a lower bound, or rests on priors."""
    emitters: tuple[FoundEmitter, ...] = ()
    """By falling power."""
    method: str = "clipped"
    """What the estimate rests on: that which was asked for, or what evidence was left for. ``least``: no card is seen,
    and what clips is raised by what nearly every place lacks."""
    factor: float = 0.0
    """Share of the method's own solution that evidence allows, 0 to 1; ``recovered`` and ``emitters`` hold it."""
    card: CardCheck = NO_CARD
    """What speaks for the card being in the picture."""
    card_share: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of the card's light that the map as captured does not show, by channel; 0 where the card does not tell."""
    irradiance: Interval | None = None
    """Of light from all directions."""
