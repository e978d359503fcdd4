"""More workers while a run goes on, for as long as cores stand idle and those that came last brought more frames.

What a worker takes beside others is not what it takes alone. So a run begins with as many as one alone lets expect, and
then looks at what all of them do. It is never left with fewer frames a second than it began with: where those that came
last brought fewer, they get no more jobs.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from warp_ar.device import usable_cores

SECONDS = 15.0
"""That workers are looked at: they tell of their frames each half second, and a segment's end takes some tenths."""
WARM = 24
"""Frames that a worker has lit before it counts: with the first it loads kernels and allocates."""
IDLE = 0.1
"""Share of the cores that may stand idle: the rest of a machine takes some, and threads wait for each other."""
GAIN = 1.03
"""Frames a second over those before, for which more workers are worth their memory."""


class Growth:
    """Decides how many workers come, by numbers alone."""

    def __init__(
        self,
        devices: Sequence[str],
        most: int,
        add: Callable[[Sequence[str]], None],
        say: Callable[[str], None],
        *,
        cores: int | None = None,
        idle: Callable[[], float | None] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin to look.

        Args:
            devices: GPUs; as many workers come to each.
            most: Workers, all told.
            add: Starts workers on the devices that it is given.
            say: Called with a line for people.
            cores: That workers may use; None: those of this process.
            idle: Gives seconds for which these have stood idle; None: as the system counts them.
            clock: Seconds.
        """
        self._devices, self._most, self._add, self._say, self._clock = list(devices), most, add, say, clock
        self._cores, self._idle = cores or usable_cores(), idle or idle_seconds
        self._over = False
        self._begun: tuple[float, int, float] | None = None
        self._before: tuple[int, float] | None = None
        """Workers that there were before the last ones came, and their frames a second."""

    def look(self, frames: Sequence[int] | None) -> int:
        """Have workers started, if it is time for more.

        Args:
            frames: That each worker has lit since it was started; None where one of them loads or surveys.

        Returns:
            How many; below zero: so many of the last ones should get no more jobs.
        """
        idle = None if self._over else self._idle()
        if idle is None or frames is None or min(frames, default=0) < WARM:
            self._begun = None
            return 0
        now = self._clock(), sum(frames), idle
        if self._begun is None:
            self._begun = now
        seconds, lit, idled = (b - a for a, b in zip(self._begun, now, strict=True))
        if seconds < SECONDS:
            return 0
        self._begun = None
        return self._decide(len(frames), lit / seconds, idled / seconds)

    def _decide(self, workers: int, rate: float, idle: float) -> int:
        """By frames a second, and cores that stood idle."""
        before, self._before = self._before, (workers, rate)
        if before is not None and rate < GAIN * before[1]:
            self._over = True
            if rate >= before[1]:
                return 0
            self._say(f"{rate:.0f} frames/s with {workers} workers, {before[1]:.0f} with {before[0]}: those go on")
            return before[0] - workers
        group = len(self._devices)
        busy = max(self._cores - idle, 0.1)
        wanted = min(math.floor(workers * self._cores / busy), 2 * workers)
        more = min(max((wanted - workers) // group, 1), (self._most - workers) // group) * group
        if idle <= IDLE * self._cores or more <= 0:
            self._over = True
            return 0
        self._say(
            f"{idle:.1f} of {self._cores} cores stand idle at {rate:.0f} frames/s by {workers} workers: {more} more"
        )
        self._add(self._devices * (more // group))
        return more


def idle_seconds() -> float | None:
    """For how long the cores that this process may use have stood idle since the system began, all told.

    None where the system does not say.
    """
    try:
        lines = Path("/proc/stat").read_text(encoding="ascii").splitlines()
        own = {f"cpu{core}" for core in os.sched_getaffinity(0)}
        each = [line.split() for line in lines]
        ticks = [int(fields[4]) + int(fields[5]) for fields in each if fields and fields[0] in own]
        return sum(ticks) / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError, ValueError, IndexError):
        return None
