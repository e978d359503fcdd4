"""What was edited, so that it can be undone and done again."""

from __future__ import annotations

import dataclasses
from typing import Final

from warp_ar.viewer.edits import Wanted

MOST_EDITS: Final = 100
"""Edits that can be undone."""
TOGETHER_SECONDS: Final = 1.0
"""Changes of one value that follow each other so soon are one edit: a drag, a slider."""


@dataclasses.dataclass(frozen=True)
class _Edit:
    label: str
    """What was done, in words."""
    other: Wanted
    """What is wanted on the other side of the edit."""


class History:
    """Edits in order. Not locked: whoever owns it holds a lock."""

    def __init__(self) -> None:
        self._done: list[_Edit] = []
        self._undone: list[_Edit] = []
        self._last = -TOGETHER_SECONDS

    @property
    def undo_label(self) -> str | None:
        """What would be undone; None where nothing can be."""
        return self._done[-1].label if self._done else None

    @property
    def redo_label(self) -> str | None:
        """What would be done again; None where nothing can be."""
        return self._undone[-1].label if self._undone else None

    def note(self, label: str, before: Wanted, now: float) -> None:
        """Note an edit.

        Args:
            label: What it does, in words; successive edits with the same words may become one.
            before: What was wanted before it.
            now: Seconds on a clock that does not jump.
        """
        self._undone.clear()
        same = bool(self._done) and self._done[-1].label == label and now - self._last < TOGETHER_SECONDS
        self._last = now
        if not same:
            self._done = [*self._done, _Edit(label, before)][-MOST_EDITS:]

    def undo(self, wanted: Wanted) -> Wanted | None:
        """What was wanted before the last edit; None where there is none."""
        return self._move(wanted, self._done, self._undone)

    def redo(self, wanted: Wanted) -> Wanted | None:
        """What was wanted before the last undo; None where there is none."""
        return self._move(wanted, self._undone, self._done)

    def _move(self, wanted: Wanted, source: list[_Edit], target: list[_Edit]) -> Wanted | None:
        if not source:
            return None
        edit = source.pop()
        target.append(_Edit(edit.label, wanted))
        self._last = -TOGETHER_SECONDS
        # The quality is no edit: a budget chooses it too.
        return dataclasses.replace(edit.other, quality=wanted.quality)

    def drop(self, before: Wanted) -> None:
        """Forget the last edit if ``before`` is what was wanted before it: it could not be made."""
        if self._done and dataclasses.replace(self._done[-1].other, quality=before.quality) == before:
            self._done.pop()

    def clear(self) -> None:
        """Forget all."""
        self._done.clear()
        self._undone.clear()
