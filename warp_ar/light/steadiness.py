"""Means over estimates while the light stays as it is: what noise makes of single frames does not flicker.

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

import numpy as np
from numpy.typing import NDArray

from warp_ar.light.config import CONFIG
from warp_ar.light.estimate import Estimate
from warp_ar.light.evidence import Interval
from warp_ar.light.stillness import Seen


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
