"""Selection of the stages that can change a pixel of the current frame, and the reasons against the others.

A plan depends on the scene, not on the frame: in a frame a light may have no power, or an object may be out of view.
Before a frame, each stage states whether its output has no effect (``Stage.idle``). Stages are examined from the
outputs backwards, because the inputs of an idle stage are not needed for it. The arrays of an idle stage must hold its
neutral output: in its first idle frame the stage runs once more to clear them, and then it rests. A stage whose output
no running stage reads rests as well. Its arrays keep their version, so it runs again in the next frame that needs it if
its inputs have changed meanwhile.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from warp_ar.stages.base import Reach, Stage


class FrameCulling:
    """Examines a plan's stages before every frame; remembers the stages whose arrays hold their neutral output."""

    def __init__(self, stages: Sequence[Stage], outputs: Collection[str]) -> None:
        """Prepare for a plan, none of whose arrays is clear yet.

        Args:
            stages: Stages of the plan, in the order in which they run.
            outputs: Resources that the caller wants in every frame.
        """
        self._stages, self._outputs = stages, outputs
        self._clear: set[str] = set()
        self._last: tuple[Reach, Mapping[str, str]] | None = None
        """Reach and result of the last frame, valid for the next with the same reach; None after clearing."""

    def forget(self) -> None:
        """Treat no stage's arrays as clear (holding their neutral output)."""
        self._clear.clear()
        self._last = None

    def look(self, reach: Reach) -> tuple[Mapping[str, str], Collection[str]]:
        """Return the stages that do not run in a frame, and those that run to write their neutral output.

        Args:
            reach: Parts of the frame that virtual objects and lights can reach.

        Returns:
            Reasons of the resting stages, by name; and names of the stages that run to clear their arrays. The mapping
            of reasons is the same object until a reason changes.
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
        # Stages that clear their arrays in this frame rest in the next.
        self._last = None if clearing else (reach, resting)
        return resting, clearing
