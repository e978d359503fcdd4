"""Selection of the stages that can change a pixel of the current frame, with a reason for each of the others.

A plan depends on the scene, not on the frame: in a frame a light may have no power, or an object may be out of view.
Before a frame, each stage states whether it is idle, that is, whether its output has no effect (``Stage.idle``). Stages
are examined from the outputs backwards, because an idle stage needs no inputs. The arrays of an idle stage must hold
its neutral output. In its first idle frame the stage therefore runs once more to clear them; in the following ones it
rests, that is, it does not run. A stage whose output no running stage reads also rests. The version of its arrays does
not change. In the next frame that needs it, it runs only if its inputs have changed.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from warp_ar.stages.base import Reach, Stage


class FrameCulling:
    """Selection of a plan's stages before every frame; stores which stages' arrays are clear (hold neutral output)."""

    def __init__(self, stages: Sequence[Stage], outputs: Collection[str]) -> None:
        """Store a plan's stages; no array is clear yet.

        Args:
            stages: Stages of the plan, in the order in which they run.
            outputs: Resources that every frame must provide.
        """
        self._stages, self._outputs = stages, outputs
        self._clear: set[str] = set()
        self._last: tuple[Reach, Mapping[str, str]] | None = None
        """Reach and resting stages of the last frame, valid for the next frame if its reach is equal; None if stages
        were cleared in the last frame."""

    def forget(self) -> None:
        """Assume that no stage's arrays are clear."""
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
