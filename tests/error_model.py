"""Checks kernels against the error model: where a twin in float64 exists, a stage's ``Numerics`` must hold.

Twin tests call ``check_error`` with what the kernel and what the twin found; ``tests.hard_cases.measure_errors`` reads
the worst errors from ``worst``.
"""

from __future__ import annotations

import collections

import numpy as np
import numpy.typing as npt

from warp_ar.stages import STAGES

worst: dict[str, float] = collections.defaultdict(float)
"""Largest error of every stage that was compared in this process."""


def check_error(stage: str, found: npt.ArrayLike, expected: npt.ArrayLike) -> None:
    """The largest difference, over the largest value or in codes, is within what the model states for ``stage``."""
    one, other = np.asarray(found, np.float64), np.asarray(expected, np.float64)
    assert one.size, f"{stage}: nothing is compared"
    assert np.isfinite(other).all(), f"{stage}: the twin is not finite"
    numerics = next(kind.numerics for kind in STAGES if kind.name == stage)
    scale = 1.0 if numerics.codes else np.abs(other).max() or 1.0
    error = float(np.abs(one - other).max() / scale)
    worst[stage] = max(worst[stage], error)
    assert error <= numerics.bound, f"{stage}: {error:.2g}, expected at most {numerics.bound:g}"
