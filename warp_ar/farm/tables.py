"""Tables of a job file: what those of a scene have, and values that are drawn."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ar.errors import UsageError
from warp_ar.scene.table import Table


class JobsError(UsageError):
    """A job file cannot be used."""


@dataclasses.dataclass(frozen=True)
class Span:
    """Numbers from which a value is drawn, each evenly: a list of lows and one of highs."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    def draw(self, random: np.random.Generator) -> tuple[float, ...]:
        """One value; its numbers are drawn in their order, also where low and high are one."""
        share = random.random(len(self.low))
        return tuple(a + float(t) * (b - a) for a, b, t in zip(self.low, self.high, share, strict=True))

    def draw_one(self, random: np.random.Generator) -> float:
        """One number."""
        return self.draw(random)[0]


class JobTable(Table):
    """One table of a job file."""

    error = JobsError

    def path(self, key: str) -> Path | None:
        """A file or folder, relative to the job file; whether it is there is not asked."""
        if key not in self.data:
            return None
        value = self.text(key)
        if "\0" in value:
            self.fail(key, "expected a path; this cannot be one")
        return Path(self.folder / value).absolute()

    def pair(self, key: str, default: tuple[int, int], *, low: int) -> tuple[int, int]:
        """Two whole numbers, the first no more than the second."""
        value = self.data.get(key, list(default))
        whole = isinstance(value, list) and all(isinstance(n, int) and not isinstance(n, bool) for n in value)
        if not whole or len(value) != 2 or not low <= value[0] <= value[1]:
            self.fail(key, f"expected two whole numbers [least, most], {low} or more")
        return value[0], value[1]

    def span(self, key: str, default: Span | None, size: int = 1, *, low: float, high: float) -> Span:
        """A value that is drawn: a fixed one, or ``[lowest, highest]``.

        Args:
            key: The key.
            default: Where it is left out; None: it may not be.
            size: Numbers of the value.
            low: Least that a number may be.
            high: Most.
        """
        right = (
            f"expected {'a number' if size == 1 else f'{size} numbers'} from {low:g} to {high:g}, or [lowest, highest]"
        )
        value = self.data.get(key)
        if value is None:
            if default is None:
                self.fail(key, right)
            return default
        ends = value if size == 1 or (isinstance(value, list) and value and isinstance(value[0], list)) else [value]
        if size == 1:
            ends = [[end] for end in (ends if isinstance(ends, list) else [ends])]
        if len(ends) not in (1, 2) or any(not isinstance(end, list) or len(end) != size for end in ends):
            self.fail(key, right)
        numbers: npt.NDArray[Any] = np.array(ends, object)
        if not all(_is_number(n) and low <= n <= high for n in numbers.flat):
            self.fail(key, right)
        if any(a > b for a, b in zip(ends[0], ends[-1], strict=True)):
            self.fail(key, f"{right}, the lowest first")
        return Span(tuple(map(float, ends[0])), tuple(map(float, ends[-1])))


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
