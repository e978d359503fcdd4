"""Progress of a long measurement, with the time that is left: a bar in a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

Advance = Callable[[str, float], None]
"""Told what was done, for people, and how many units of work that was."""


def ignore(text: str, units: float) -> None:
    """Report no progress."""


class TimeLeft(ProgressColumn):
    """Time left: what the units took so far, on average, for each that remains."""

    def render(self, task: Task) -> Text:
        """``12:34 left``, or a word while nothing is known."""
        return Text(time_left(task.elapsed or 0.0, task.completed, task.total or 0.0), style="progress.remaining")


def time_left(elapsed: float, done: float, total: float) -> str:
    """Time left in words, from seconds elapsed and units of work done and in all."""
    if done <= 0.0:
        return "time left: not known yet"
    minutes, seconds = divmod(round(elapsed / done * max(total - done, 0.0)), 60)
    return f"{minutes}:{seconds:02d} left"


class WorkProgress:
    """Shows what share of a number of units is done."""

    def __init__(self, console: Console, units: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._console, self._units, self._clock = console, units, clock
        columns = TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"), TimeLeft()
        self._bar = Progress(*columns, console=console, disable=not console.is_terminal)
        self._task = self._bar.add_task("", total=units)
        self._begun, self._done = clock(), 0.0

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._bar.stop()

    def advance(self, text: str, units: float) -> None:
        """Show that ``units`` of work are done, the last of them ``text``."""
        self._done += units
        if self._console.is_terminal:
            self._bar.update(self._task, advance=units, description=text)
            return
        left = time_left(self._clock() - self._begun, self._done, self._units)
        self._console.print(f"{min(self._done / self._units, 1.0):4.0%}  {left:>12}  {text}", highlight=False)
