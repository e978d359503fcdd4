"""Alternating exposure times of a source, and the exposure bracket that is merged from them."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.errors import UsageError

WAVERING = 1.1
"""Largest ratio of exposures that count as equal. A step of a third of a stop is 1.26, or 1.15 and more as cameras
round it."""
ADAPTING = 1.2
"""Ratio of neighbouring exposures that separates a bracket from automatic exposure. If the median ratio of four or more
exposures is smaller, they come from automatic exposure."""
MOST_EXPOSURES = 8
"""Largest number of merged exposures; further ones in between add little."""


@dataclasses.dataclass(frozen=True)
class BracketPlan:
    """Exposures of a source to merge, and the exposure to show."""

    ratios: tuple[float, ...]
    """Exposures relative to the shown one, longest first; empty without a bracket."""
    shown: float
    """Exposure time in seconds of the frames that are lit and shown."""
    left_out: tuple[float, ...] = ()
    """Exposures of frames that are not merged, relative to the shown one."""
    notes: tuple[str, ...] = ()
    """Notes on what is merged or left out, one line each."""

    @property
    def reference(self) -> int:
        """Return the index in ``ratios`` of the shown exposure."""
        return self.ratios.index(1.0) if self.ratios else 0


def plan_bracket(exposures: Sequence[float], shown: float | None = None) -> BracketPlan:
    """Return the bracket of a source's exposures, with notes on exposures that are left out.

    Exposures within the ratio ``WAVERING`` count as equal. Exposures that drift in smaller steps over a wider range
    come from a camera's automatic exposure and make no bracket. Of more than ``MOST_EXPOSURES``, a subset in roughly
    geometric steps is merged.

    Args:
        exposures: Exposure times in seconds, of all frames or each once.
        shown: Exposure time in seconds of the frames to show; None: the longest.

    Raises:
        UsageError: ``shown`` is none of the exposures.
    """
    if not exposures:
        return BracketPlan((), 1.0)
    groups: list[list[float]] = []
    for time in sorted(set(exposures), reverse=True):
        if groups and time * WAVERING >= groups[-1][-1]:
            groups[-1].append(time)
        else:
            groups.append([time])
    wide = max(group[0] / group[-1] for group in groups)
    steps = sorted(longer[-1] / shorter[0] for longer, shorter in itertools.pairwise(groups))
    adapts = len(groups) >= 4 and steps[len(steps) // 2] < ADAPTING
    longest = max(exposures)
    if shown is not None and not any(1 / WAVERING < shown / time < WAVERING for time in exposures):
        told = ", ".join(f"{group[0]:g}" for group in groups)
        raise UsageError(f"shown = {shown:g} s: no frame has this exposure; expected one of {told}")
    if wide > WAVERING * WAVERING or adapts:
        note = f"exposures drift from {longest:g} to {min(exposures):g} s instead of alternating: no bracket"
        return BracketPlan((), shown or longest, notes=(note,))
    notes = [
        f"exposures {', '.join(f'{time:g}' for time in group)} s, {group[0] / group[-1]:.2f} times apart, are one"
        for group in groups
        if len(group) > 1
    ]
    times = [group[0] for group in groups]
    kept = times if len(times) <= MOST_EXPOSURES else _spread(times, shown or longest)
    if len(kept) < len(times):
        gone = ", ".join(f"{time:g}" for time in times if time not in kept)
        notes.append(f"exposures {gone} s are left out: {MOST_EXPOSURES} of {len(times)} are merged")
    reference = _nearest(kept, shown or longest)
    if len(kept) < 2:
        return BracketPlan((), reference, notes=tuple(notes))
    left_out = tuple(time / reference for time in times if time not in kept)
    return BracketPlan(tuple(time / reference for time in kept), reference, left_out, tuple(notes))


def _spread(times: Sequence[float], shown: float) -> list[float]:
    """Return at most ``MOST_EXPOSURES`` of the times, including the shown one, in roughly geometric steps.

    Args:
        times: Distinct exposure times in seconds, longest first.
        shown: Exposure time in seconds of the frames to show.
    """
    kept = {_nearest(times, time) for time in np.geomspace(times[0], times[-1], MOST_EXPOSURES).tolist()}
    kept -= {_nearest(kept, shown)}
    return sorted({*kept, _nearest(times, shown)}, reverse=True)


def _nearest(times: Iterable[float], wanted: float) -> float:
    """Return the one of some exposure times whose ratio to the wanted one is closest to 1."""
    return min(times, key=lambda time: abs(math.log(time / wanted)))


def find_exposure(exposure_time: float | None, plan: BracketPlan) -> int | None:
    """Return the index in a bracket of the exposure closest to a frame's, by ratio.

    A frame without a known exposure time counts as one of the shown exposure.

    Args:
        exposure_time: Exposure time of the frame in seconds, or None.
        plan: The bracket.

    Returns:
        Index into ``plan.ratios``; None for an exposure that was left out.
    """
    if exposure_time is None or not plan.ratios:
        return plan.reference
    ratio = exposure_time / plan.shown
    every = (*plan.ratios, *plan.left_out)
    index = every.index(_nearest(every, ratio))
    return index if index < len(plan.ratios) else None


def brightened(image: npt.NDArray[np.uint8], decode: npt.NDArray[Any], ratio: float) -> npt.NDArray[np.uint8]:
    """Return a picture scaled to the shown exposure, for tracking and display; its noise is scaled as well.

    Args:
        image: uint8 RGB (height, width, 3).
        decode: Linear value of each 8-bit pixel value, (256, 3), non-decreasing.
        ratio: Exposure time of the picture divided by the shown exposure time.
    """
    table = np.empty_like(decode, np.uint8)
    for channel in range(3):
        values = decode[:, channel].astype(np.float64)
        half = 0.5 * (values[1:] + values[:-1])
        table[:, channel] = np.searchsorted(half, np.minimum(values / ratio, 1.0))
    return np.asarray(cv2.LUT(image, table[None]), np.uint8)
