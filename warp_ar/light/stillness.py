"""Whether the light is as it was: then the last estimate holds and nothing is solved for."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from warp_ar.light.config import CONFIG

Array = NDArray[np.float64]


class Stillness:
    """Remembers what the last estimate was made from."""

    def __init__(self) -> None:
        """Remember nothing."""
        self._rested = 0
        self._seen: tuple[Array, Array, NDArray[np.bool_]] | None = None

    def holds(self, cells: NDArray[Any], observations: NDArray[Any], *, settled: bool) -> bool:
        """Whether the last estimate still holds, as far as the light tells.

        Takes note of what it is given, unless it holds.

        Args:
            cells: Records of ``kernels.recover_cells.Cell``, (rows, columns).
            observations: Records of ``Observation``, (n,).
            settled: Whether enough estimates were made for one to be left out.
        """
        environment = cells["solid_angle"][..., None] * cells["radiance"].astype(float)
        shown = observations["radiance"].mean(axis=1).astype(float)
        told = (observations["visible"] > 0.8) & (observations["clipped"].max(axis=1) < 0.01)
        told &= np.pi * shown > CONFIG.surfaces.dark
        before, self._rested = self._seen, self._rested + 1
        if before is not None and settled and (told & before[2]).any():
            both = told & before[2]
            # The sum of what changed, not of changes: which of two cells sees a window's edge varies by itself.
            moved = np.abs((environment - before[0]).sum(axis=(0, 1))).max() / max(
                environment.sum(axis=(0, 1)).max(), 1e-9
            )
            ratio = np.log(shown[both] / before[1][both])
            moved = max(moved, abs(float(np.median(ratio))), 0.5 * float(np.quantile(np.abs(ratio), 0.8)))
            solver = CONFIG.solver
            if self._rested <= (solver.rest if moved < solver.still else 1 if moved < solver.sudden else 0):
                return True
        self._seen, self._rested = (environment, shown, told), 0
        return False
