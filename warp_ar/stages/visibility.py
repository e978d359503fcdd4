"""What of the virtual objects each pixel sees."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import warp as wp

from warp_ar.kernels.visibility import Hit, trace_pixels
from warp_ar.scene.ray_scene import trace_config
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Pass, Request, Rows, Stage, Wiring
from warp_ar.stages.variants import trace_variant


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


class Visibility(Stage):
    """Traces primary rays, only where virtual objects can be on screen."""

    name = "visibility"
    methods = ("default",)
    summary = "trace which virtual object each pixel sees, hidden by proxies in front"

    @classmethod
    def wire(cls, request: Request) -> Wiring | LeftOut:
        """Left out of scenes without virtual objects."""
        if not request.scene.objects:
            return LeftOut("the scene has no virtual object")
        return Wiring(reads=("pose", "objects"), writes=("hit_object", "hit_depth", "hits"))

    def arrays(self) -> Mapping[str, ArraySpec]:
        """One hit per pixel."""
        width, height = self.request.size
        return {
            "hit_object": ArraySpec((height, width), wp.int32, -1),
            "hit_depth": ArraySpec((height, width), wp.float32, float("inf")),
            "hits": ArraySpec((height, width), Hit, Hit()),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """One pass over the rows where objects are or were."""
        config = trace_variant(trace_config(self.request.scene), device)
        inputs = [arrays[name] for name in ("params", "rays", "ray_scene")]
        outputs = [arrays[name] for name in ("hit_object", "hit_depth", "hits")]

        def launch(rows: Rows | None) -> None:
            trace_pixels(config, *inputs, *outputs, rows=rows)

        return [Pass(launch, rows=self.request.size[1], extent=GrowingRows(arrays["object_rows"]))]
