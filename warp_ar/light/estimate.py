"""Results of the recovery, and their averaging over time.

**Stillness.** While the light is unchanged, the last estimate stays valid and nothing is solved.

**Steadiness.** While the light is unchanged, estimates are averaged, so that noise of single frames does not cause
flicker. Estimates of single frames scatter, because noise shifts surfaces, moves points across a threshold, or splits
clipped cells into other regions. The mean of n estimates of constant light scatters less by the factor n^-1/2, and a
new estimate changes it by 1 / n of the difference.

Let m be the relative change of the light, on surfaces or in the environment, since the mean; or, if it is larger, the
angle in radians between the present direction from the ball to the camera and the mean of that direction. Seen from
another direction, clipped light lies in other cells, and a mean over both views fits neither. A new estimate has the
weight

    w = max((m / still)^2, 1 / n), at most 1.

Light that has changed by ``still`` is followed at once. Noise alone looks like a change by a quarter of ``still`` and
has little weight. If the light changes by r between estimates, the mean lags by m = r / w = (r still^2)^1/3, which is
less than ``still``.

If emitters are found, lost or moved, the light has changed, and the mean starts anew.
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
    """Light source found by its effect on surfaces."""

    origin: NDArray[np.float64]
    """Point of the ball at which the camera sees the emitter's reflection, metres, (3,)."""
    direction: NDArray[np.float64]
    """Unit direction from ``origin``, (3,)."""
    distance: float
    """Distance from ``origin``, metres; infinite if none was found."""
    power: NDArray[np.float64]
    """Radiance times solid angle as seen from the ball, per channel, in addition to that in the map, (3,)."""
    cell: int = -1
    """Index of the map's cell that contains the emitter; -1: none."""


@dataclasses.dataclass(frozen=True)
class Estimate:
    """Recovered light, as far as one frame determines it."""

    recovered: NDArray[np.float32]
    """Missing radiance of a wholly clipped texel in each cell, (rows, columns, 3)."""
    lower_bound: tuple[bool, bool, bool]
    """True for channels in which the card clips or is not visible: the total is a lower bound, or due to priors."""
    emitters: tuple[FoundEmitter, ...] = ()
    """Emitters, the most powerful first."""
    method: str = "clipped"
    """Method used: the requested one or a fallback. ``least``: no card is visible, and clipped light is raised by the
    amount that is missing in nearly every scene."""
    factor: float = 0.0
    """Share of the method's solution that the evidence supports, 0 to 1. ``recovered`` and ``emitters`` are multiplied
    by it."""
    card: CardCheck = NO_CARD
    """Evidence that the card is in the picture."""
    card_share: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Share of the card's irradiance, by channel, that the captured map lacks; 0 without evidence of the card."""
    irradiance: Interval | None = None
    """Interval of the irradiance from all directions."""

    @property
    def is_finite(self) -> bool:
        """True if all values that the estimate adds to the map are finite."""
        powers = all(bool(np.isfinite(emitter.power).all()) for emitter in self.emitters)
        return powers and bool(np.isfinite(self.recovered).all())

    def report(self) -> dict[str, Any]:
        """Return the estimate and the evidence for it, as data for reports (JSON)."""
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
    """Light observed in a frame: of the environment, and on surfaces."""

    environment: Array
    """Radiance times solid angle of cells, (rows, columns, 3)."""
    shown: Array
    """Radiance of surface points, mean of channels, (n,)."""
    told: NDArray[np.bool_]
    """Visible points that are neither clipped nor dark, (n,)."""

    @classmethod
    def of(cls, cells: NDArray[Any], observations: NDArray[Any]) -> Seen:
        """Return the light observed in one frame.

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
        """Return the relative change of the light since ``before``; None if no point is usable in both."""
        both = self.told & before.told
        if not both.any():
            return None
        # The change of the sum is used, because light at the edge of a window alternates between two cells.
        total = max(self.environment.sum(axis=(0, 1)).max(), 1e-9)
        moved = np.abs((self.environment - before.environment).sum(axis=(0, 1))).max() / total
        ratio = np.log(self.shown[both] / before.shown[both])
        return float(max(moved, abs(np.median(ratio)), 0.5 * np.quantile(np.abs(ratio), 0.8)))


class Stillness:
    """Detector of light that has not changed since the last estimate.

    While the light is unchanged, the number of turns until the next estimate about doubles each time.
    """

    def __init__(self) -> None:
        """Start without a last estimate."""
        self._rested, self._patience = 0, 1
        self._seen: Seen | None = None

    def holds(self, cells: NDArray[Any], observations: NDArray[Any], *, settled: bool) -> bool:
        """Return True if the light has not changed, so that the last estimate stays valid.

        If it has changed, the given light is stored as that of the next estimate.

        Args:
            cells: Records of ``kernels.recover_cells.Cell``, (rows, columns).
            observations: Records of ``Observation``, (n,).
            settled: True if enough estimates were made for one to be left out.
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
    """Running mean of estimates, and of the observed light from which they were made."""

    def __init__(self) -> None:
        """Start without estimates."""
        self._seen: Seen | None = None
        self._view = np.zeros(3)
        self._mean: Estimate | None = None
        self._count = 0

    def follow(self, estimate: Estimate, seen: Seen, view: NDArray[np.float64]) -> Estimate:
        """Add an estimate to the mean, and return the mean.

        Args:
            estimate: Estimate from a frame.
            seen: Light that was observed in the frame.
            view: Unit direction from the ball to the camera, (3,).
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
    """Return the power of emitters by their cell and distance."""
    return {(emitter.cell, emitter.distance): emitter.power for emitter in estimate.emitters}


def _mixed_seen(before: Seen, now: Seen, weight: float) -> Seen:
    """Return the mean of observed light, with ``weight`` for ``now``; a point usable in only one has that value."""
    shown = np.where(before.told & now.told, before.shown + weight * (now.shown - before.shown), now.shown)
    shown = np.where(before.told & ~now.told, before.shown, shown)
    environment = before.environment + weight * (now.environment - before.environment)
    return Seen(environment, shown, before.told | now.told)


def _mixed(mean: Estimate, now: Estimate, weight: float) -> Estimate:
    """Return the mean of two estimates, with ``weight`` for ``now``.

    Missing radiance, powers of emitters and irradiance are averaged. Other fields are those of ``now``, and so is the
    missing radiance of a cell that misses light in only one of the two.
    """
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
