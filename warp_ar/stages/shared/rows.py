"""Rows of the frame over which passes run."""

from __future__ import annotations

from collections.abc import Callable

from warp_ar.stages.base import Rows


class GrowingRows:
    """Rows of this frame and of the one before: what moved away must be cleared from where it was."""

    def __init__(self, current: Callable[[], Rows]) -> None:
        self._current = current
        self._previous: Rows = (0, 0)

    def __call__(self) -> Rows:
        """Rows to run over; asked once per frame."""
        rows, previous = self._current(), self._previous
        self._previous = rows
        if previous[0] >= previous[1]:
            return rows
        if rows[0] >= rows[1]:
            return previous
        return min(rows[0], previous[0]), max(rows[1], previous[1])
