"""Whether the light is as it was: then the last estimate holds and nothing is solved for."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warp_ar.light.config import CONFIG

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Seen:
    """The light that a frame shows: of the environment, and on surfaces."""

    environment: Array
    """Radiance times solid angle of cells, (rows, columns, 3)."""
    shown: Array
    """Radiance of surface points, mean of channels, (n,)."""
    told: NDArray[np.bool_]
    """Which of those are seen and neither clip nor are dark, (n,)."""

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
    """Remembers what the last estimate was made from."""

    def __init__(self) -> None:
        """Remember nothing."""
        self._rested = 0
        self._seen: Seen | None = None

    def holds(self, cells: NDArray[Any], observations: NDArray[Any], *, settled: bool) -> bool:
        """Whether the last estimate still holds, as far as the light tells.

        Takes note of what it is given, unless it holds.

        Args:
            cells: Records of ``kernels.recover_cells.Cell``, (rows, columns).
            observations: Records of ``Observation``, (n,).
            settled: Whether enough estimates were made for one to be left out.
        """
        now = Seen.of(cells, observations)
        before, self._rested = self._seen, self._rested + 1
        moved = now.change(before) if before is not None and settled else None
        if moved is not None:
            solver = CONFIG.solver
            if self._rested <= (solver.rest if moved < solver.still else 1 if moved < solver.sudden else 0):
                return True
        self._seen, self._rested = now, 0
        return False
