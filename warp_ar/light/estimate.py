"""Results of recovery, and their course over time.

**Stillness.** While the light is as it was, the last estimate holds and nothing is solved for.

**Steadiness.** While the light stays as it is, estimates are averaged, so that noise of single frames does not flicker.
An estimate of one frame scatters as noise moves surfaces, decides over points at a threshold, or splits what clips to
other regions. Over n estimates of the same light the mean scatters by n^-1/2 of that, and a new one moves it by 1 / n.

Let m be the relative change, of surfaces or of the environment, between the light that the mean was made from, its own
mean, and that which is seen now; or the angle, in radians, between the directions from which the ball is seen, if that
is more: from elsewhere what clips lies in other cells, and the mean over them is neither. A new estimate has the weight

    w = max((m / still)^2, 1 / n), at most 1.

Light that has changed by ``still`` is followed at once. What a mean errs by for its lag is m^2, as a variance; and
noise alone looks like a change by a quarter of ``still``, which so counts for little. Light that changes by r from one
estimate to the next runs ahead of its mean by m = r / w = (r still^2)^1/3, which is less than ``still``.

Emitters that were found, lost or moved are other light: then the mean begins anew.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warp_ar.light.config import CONFIG
from warp_ar.light.evidence import NO_CARD, CardCheck, Interval


@dataclasses.dataclass(frozen=True)
class FoundEmitter:
    """A source of light that was found by what it does."""

    origin: NDArray[np.float64]
    """Point of the ball in which the camera sees it mirrored, metres, (3,)."""
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
    """Light that clipping took, as far as one frame tells."""

    recovered: NDArray[np.float32]
    """Radiance that a wholly clipped texel lacks, (rows, columns, 3) of cells."""
    lower_bound: tuple[bool, bool, bool]
    """Channels in which the card clips or is not seen: there the total is a lower bound, or rests on priors."""
    emitters: tuple[FoundEmitter, ...] = ()
    """Emitters, the most powerful first."""
    method: str = "clipped"
    """Method: the one that was asked for, or the one that is left. ``least``: no card is seen,
    and what clips is raised by what nearly every place lacks."""
    factor: float = 0.0
    """Share of the method's own solution that evidence allows, 0 to 1; ``recovered`` and ``emitters`` hold it."""
    card: CardCheck = NO_CARD
    """Evidence that the card is in the picture."""
    card_share: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Share of the card's light, by channel, that the captured map lacks; 0 without evidence of the card."""
    irradiance: Interval | None = None
    """Interval of the irradiance from all directions."""

    @property
    def is_finite(self) -> bool:
        """True where all that it puts into the map is finite."""
        powers = all(bool(np.isfinite(emitter.power).all()) for emitter in self.emitters)
        return powers and bool(np.isfinite(self.recovered).all())

    def report(self) -> dict[str, Any]:
        """Return what it rests on, as reports list it."""
        emitters = [
            {
                "direction": [round(float(x), 4) for x in emitter.direction],
                "distance": round(emitter.distance, 3) if np.isfinite(emitter.distance) else None,
                "power": [round(float(x), 4) for x in emitter.power],
            }
            for emitter in self.emitters
        ]
        report: dict[str, Any] = {
            "method": self.method,
            "factor": round(self.factor, 3),
            "card_contrast": round(self.card.contrast, 2),
            "lower_bound": list(self.lower_bound),
            "emitters": emitters,
        }
        if self.irradiance is not None:
            for name in ("low", "value", "high"):
                axes = getattr(self.irradiance, name)
                report[f"irradiance_{name}"] = [[round(float(x), 4) for x in axis] for axis in axes]
        return report


Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Seen:
    """The light that a frame shows: of the environment, and on surfaces."""

    environment: Array
    """Radiance times solid angle of cells, (rows, columns, 3)."""
    shown: Array
    """Radiance of surface points, mean of channels, (n,)."""
    told: NDArray[np.bool_]
    """Points that are seen and neither clip nor are dark, (n,)."""

    @classmethod
    def of(cls, cells: NDArray[Any], observations: NDArray[Any]) -> Seen:
        """From one frame.

        Args:
            cells: Records of ``kernels.recover_cells.Cell``, (rows, columns).
            observations: Records of ``Observation``, (n,).
        """
        environment = cells["solid_angle"][..., None] * cells["radiance"].astype(float)
        shown = observations["radiance"].mean(axis=1).astype(float)
        told = (observations["visible"] > 0.8) & (observations["clipped"].max(axis=1) < 0.01)
        told &= np.pi * shown > CONFIG.surfaces.dark
        return cls(environment, shown, told)

    def change(self, before: Seen) -> float | None:
        """Relative change since then; None where no surface tells."""
        both = self.told & before.told
        if not both.any():
            return None
        # The sum of what changed, not of changes: which of two cells sees a window's edge varies by itself.
        total = max(self.environment.sum(axis=(0, 1)).max(), 1e-9)
        moved = np.abs((self.environment - before.environment).sum(axis=(0, 1))).max() / total
        ratio = np.log(self.shown[both] / before.shown[both])
        return float(max(moved, abs(np.median(ratio)), 0.5 * np.quantile(np.abs(ratio), 0.8)))


class Stillness:
    """Tells whether the light is that of the last estimate.

    While it is, each estimate lets twice as many turns pass as the one before.
    """

    def __init__(self) -> None:
        """Remember nothing."""
        self._rested, self._patience = 0, 1
        self._seen: Seen | None = None

    def holds(self, cells: NDArray[Any], observations: NDArray[Any], *, settled: bool) -> bool:
        """Return whether the last estimate still holds, as far as the light tells.

        Takes note of what it is given, unless it holds.

        Args:
            cells: Records of ``kernels.recover_cells.Cell``, (rows, columns).
            observations: Records of ``Observation``, (n,).
            settled: Whether enough estimates were made for one to be left out.
        """
        now, before = Seen.of(cells, observations), self._seen
        self._rested += 1
        moved = now.change(before) if before is not None and settled else None
        if moved is not None and moved < CONFIG.solver.still:
            if self._rested <= self._patience:
                return True
            self._patience = 2 * self._patience + 1
        else:
            self._patience = 1
            if moved is not None and moved < CONFIG.solver.sudden and self._rested <= 1:
                return True
        self._seen, self._rested = now, 0
        return False


class Steadiness:
    """The mean of estimates, and what they were made from."""

    def __init__(self) -> None:
        """Remember nothing."""
        self._seen: Seen | None = None
        self._view = np.zeros(3)
        self._mean: Estimate | None = None
        self._count = 0

    def follow(self, estimate: Estimate, seen: Seen, view: NDArray[np.float64]) -> Estimate:
        """The mean with one estimate more.

        Args:
            estimate: Of the frame.
            seen: What it was made from.
            view: Direction from the ball to the camera, unit, (3,).
        """
        weight = self._weight(estimate, seen, view)
        if weight >= 1.0 or self._mean is None or self._seen is None:
            self._seen, self._mean, self._view, self._count = seen, estimate, view, 1
            return estimate
        self._view = self._view + weight * (view - self._view)
        self._count = min(self._count + 1, CONFIG.solver.remembered)
        self._seen, self._mean = _mixed_seen(self._seen, seen, weight), _mixed(self._mean, estimate, weight)
        return self._mean

    def _weight(self, estimate: Estimate, seen: Seen, view: NDArray[np.float64]) -> float:
        mean, before = self._mean, self._seen
        if mean is None or before is None or _powers(mean).keys() != _powers(estimate).keys():
            return 1.0
        change = seen.change(before)
        if change is None:
            return 1.0
        change = max(change, float(np.linalg.norm(view - self._view)))
        return max((change / CONFIG.solver.still) ** 2, 1.0 / (self._count + 1))


def _powers(estimate: Estimate) -> dict[tuple[int, float], NDArray[np.float64]]:
    """Power of emitters by where they stand."""
    return {(emitter.cell, emitter.distance): emitter.power for emitter in estimate.emitters}


def _mixed_seen(before: Seen, now: Seen, weight: float) -> Seen:
    """A mean of what was seen; points that come into view begin as they are."""
    shown = np.where(before.told & now.told, before.shown + weight * (now.shown - before.shown), now.shown)
    shown = np.where(before.told & ~now.told, before.shown, shown)
    environment = before.environment + weight * (now.environment - before.environment)
    return Seen(environment, shown, before.told | now.told)


def _mixed(mean: Estimate, now: Estimate, weight: float) -> Estimate:
    """A mean of light and powers; all else is of the newer, so are cells that begin to lack light or cease to."""
    both = (mean.recovered > 0.0) & (now.recovered > 0.0)
    recovered = np.where(both, mean.recovered + weight * (now.recovered - mean.recovered), now.recovered)
    powers, emitters = _powers(mean), []
    for emitter in now.emitters:
        before = powers[emitter.cell, emitter.distance]
        emitters.append(dataclasses.replace(emitter, power=before + weight * (emitter.power - before)))
    emitters.sort(key=lambda emitter: -float(emitter.power.sum()))
    irradiance = now.irradiance
    if irradiance is not None and mean.irradiance is not None:
        old, new = mean.irradiance, irradiance
        low, value, high = (
            getattr(old, name) + weight * (getattr(new, name) - getattr(old, name)) for name in ("low", "value", "high")
        )
        irradiance = Interval(new.normals, low, value, high)
    return dataclasses.replace(
        now, recovered=recovered.astype(np.float32), emitters=tuple(emitters), irradiance=irradiance
    )
