"""Exposure times between which the frames of a source alternate."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

LEAST_STEP = 1.4
"""Least ratio of neighbouring exposures: less than that brings little."""
WAVERING = 1.1
"""Ratio within which exposures are one."""
MOST_EXPOSURES = 8
"""More than this is a camera that adapts to the light, not one that alternates."""


def bracket_ratios(exposures: Sequence[float]) -> tuple[float, ...]:
    """Exposure times of a source as ratios to the longest: 1 first, then ever shorter ones; empty if no bracket.

    A camera that adapts to the light gives many times, near one another: no bracket either.
    """
    times: list[float] = []
    for time in sorted(exposures, reverse=True):
        if not times or time * WAVERING < times[-1]:
            times.append(time)
    apart = all(longer >= LEAST_STEP * shorter for longer, shorter in itertools.pairwise(times))
    if not 2 <= len(times) <= MOST_EXPOSURES or not apart:
        return ()
    return tuple(time / times[0] for time in times)


def find_exposure(exposure_time: float | None, longest: float, ratios: Sequence[float]) -> int:
    """Which of the exposures a frame has: the nearest by ratio; the reference, 0, if it does not tell.

    Args:
        exposure_time: Seconds.
        longest: The reference's, seconds.
        ratios: From ``bracket_ratios``.
    """
    if exposure_time is None or not ratios:
        return 0
    ratio = exposure_time / longest
    return min(range(len(ratios)), key=lambda index: abs(math.log(ratios[index] / ratio)))


def brightened(image: npt.NDArray[np.uint8], decode: npt.NDArray[Any], ratio: float) -> npt.NDArray[np.uint8]:
    """The picture as the reference's exposure would show it, but for its noise: for tracking, and to look at.

    Args:
        image: uint8 RGB (height, width, 3).
        decode: Linear value of each code, (256, 3), not falling.
        ratio: Its exposure time over the reference's.
    """
    table = np.empty_like(decode, np.uint8)
    for channel in range(3):
        values = decode[:, channel].astype(np.float64)
        half = 0.5 * (values[1:] + values[:-1])
        table[:, channel] = np.searchsorted(half, np.minimum(values / ratio, 1.0))
    result = np.empty_like(image)
    for channel in range(3):
        result[..., channel] = table[image[..., channel], channel]
    return result
