"""Stages that can change a pixel of this frame, and the reasons why the others cannot.

A plan knows the scene, not the frame: a light may have no power, an object be out of view. Before a frame a stage is
asked whether what it writes is as if it did nothing (``Stage.idle``), from the outputs back: what such a stage reads is
not needed for its sake. Its arrays must say so too: in the first idle frame it runs once more, to clear what it wrote
before, and rests from then on. A stage that no running stage reads rests as well; what it wrote keeps its version, so
that it runs again in the frame that needs it if anything that it reads has changed meanwhile.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from warp_ar.stages.base import Reach, Stage


class Demand:
    """Walks a plan's stages before every frame; remembers whose arrays are clear."""

    def __init__(self, stages: Sequence[Stage], outputs: Collection[str]) -> None:
        """Prepare.

        Args:
            stages: In the order in which they run.
            outputs: Resources that the caller wants in every frame.
        """
        self._stages, self._outputs = stages, outputs
        self._clear: set[str] = set()
        self._last: tuple[Reach, Mapping[str, str]] | None = None
        """Result of the last frame, which holds for the next one of the same reach."""

    def forget(self) -> None:
        """Take it that no stage's arrays are clear."""
        self._clear.clear()
        self._last = None

    def look(self, reach: Reach) -> tuple[Mapping[str, str], Collection[str]]:
        """Look at one frame.

        Args:
            reach: What of the frame virtual objects and lights can reach.

        Returns:
            Reasons of the stages that rest, by name, and names of those that run to clear their arrays. The reasons are
            the same object for as long as they are the same.
        """
        if self._last is not None and self._last[0] == reach:
            return self._last[1], frozenset()
        wanted = set(self._outputs)
        resting: dict[str, str] = {}
        clearing: set[str] = set()
        for stage in reversed(self._stages):
            name, reason = stage.name, stage.idle(reach)
            if not stage.follows and wanted.isdisjoint(stage.wiring.writes):
                resting[name] = reason or f"nothing reads its {' or '.join(stage.wiring.writes)} in this frame"
                continue
            if reason is None:
                self._clear.discard(name)
            elif name in self._clear:
                resting[name] = reason
                continue
            else:
                self._clear.add(name)
                clearing.add(name)
            wanted |= set(stage.reads_for(reach))
        # What is cleared in this frame rests in the next.
        self._last = None if clearing else (reach, resting)
        return resting, clearing
