"""Exposure times between which the frames of a source alternate."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.errors import UsageError

WAVERING = 1.1
"""Ratio within which exposures are one; steps of a third of a stop are 1.26, as rounded by cameras 1.15 and more."""
ADAPTING = 1.2
"""Steps that are smaller than this in the middle, of four exposures or more, are a camera that adapts to the light."""
MOST_EXPOSURES = 8
"""Exposures that are merged at most: what lies between others adds little."""


@dataclasses.dataclass(frozen=True)
class BracketPlan:
    """Exposures of a source that are merged, and the one that is shown."""

    ratios: tuple[float, ...]
    """Exposures over the shown one, longest first; empty if there is no bracket."""
    shown: float
    """Exposure in seconds of the frames that are lit and shown."""
    left_out: tuple[float, ...] = ()
    """Exposures over the shown one that frames have and that are not merged."""
    notes: tuple[str, ...] = ()
    """Notes of what was merged or left out, a line each."""

    @property
    def reference(self) -> int:
        """Return which of ``ratios`` the shown frames have."""
        return self.ratios.index(1.0) if self.ratios else 0


def plan_bracket(exposures: Sequence[float], shown: float | None = None) -> BracketPlan:
    """Exposures of a source as a bracket, said what is left out.

    Exposures within ``WAVERING`` of each other count as one. A camera that adapts to the light gives many, one beside
    the other over a wide range: no bracket. Of more than ``MOST_EXPOSURES`` the most evenly spread are merged.

    Args:
        exposures: Seconds, of all frames or each once.
        shown: Seconds of the frames to show; the longest if None.

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
        f"exposures {', '.join(f'{time:g}' for time in group)} s, {group[0] / group[-1]:.2f} times apart, count as one"
        for group in groups
        if len(group) > 1
    ]
    times = [group[0] for group in groups]
    kept = times if len(times) <= MOST_EXPOSURES else _spread(times, shown or longest)
    if len(kept) < len(times):
        gone = ", ".join(f"{time:g}" for time in times if time not in kept)
        notes.append(f"exposures {gone} s are left out: {MOST_EXPOSURES} of {len(times)} are merged")
    reference = min(kept, key=lambda time: abs(math.log(time / (shown or longest))))
    if len(kept) < 2:
        return BracketPlan((), reference, notes=tuple(notes))
    left_out = tuple(time / reference for time in times if time not in kept)
    return BracketPlan(tuple(time / reference for time in kept), reference, left_out, tuple(notes))


def _spread(times: Sequence[float], shown: float) -> list[float]:
    """The ``MOST_EXPOSURES`` times nearest to even steps from the longest to the shortest, the shown one among them."""
    logs = [math.log(time) for time in times]
    chosen = {min(range(len(times)), key=lambda k: abs(logs[k] - math.log(shown)))}
    for step in range(MOST_EXPOSURES):
        wanted = logs[0] + (logs[-1] - logs[0]) * step / (MOST_EXPOSURES - 1)
        if len(chosen) < MOST_EXPOSURES or step == MOST_EXPOSURES - 1:
            chosen.add(min(range(len(times)), key=lambda k: abs(logs[k] - wanted)))
    return [times[k] for k in sorted(chosen)][:MOST_EXPOSURES]


def find_exposure(exposure_time: float | None, plan: BracketPlan) -> int | None:
    """Return which of a bracket's exposures a frame has: the nearest by ratio; the shown one if it does not tell.

    Args:
        exposure_time: Seconds.
        plan: The bracket.

    Returns:
        Index into ``plan.ratios``; None for an exposure that was left out.
    """
    if exposure_time is None or not plan.ratios:
        return plan.reference
    ratio = exposure_time / plan.shown
    every = (*plan.ratios, *plan.left_out)
    index = min(range(len(every)), key=lambda k: abs(math.log(every[k] / ratio)))
    return index if index < len(plan.ratios) else None


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
    return np.asarray(cv2.LUT(image, table[None]), np.uint8)
