"""Frames of several exposures tell of lamps that the longest one clips."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import warp as wp

from warp_ar.kernels import bracket as kernels
from warp_ar.kernels.launch import copy
from warp_ar.stages.base import Arrays, ArraySpec, LeftOut, Pass, Request, Rows, Stage, Wiring
from warp_ar.stages.recover import recovers
from warp_ar.stages.unwrap import NO_PROBE

UNWRAPPED = ("radiance", "confidence", "clipped")
"""What unwrapping a frame gives; arrays are named ``probe_*``, those of all exposures ``bracket_*``."""


class Bracket(Stage):
    """The latest frame of every exposure, merged; frames of shorter exposures come in through ``ShortFrames``."""

    name: ClassVar[str] = "bracket"
    methods: ClassVar[tuple[str, ...]] = ("default",)
    summary: ClassVar[str] = "merges alternating exposures: what clips in the long one comes from the short one"
    remembers: ClassVar[tuple[str, ...]] = tuple(f"bracket_{part}" for part in UNWRAPPED)

    @classmethod
    def wire(cls, request: Request) -> Wiring | LeftOut:
        """Needs a mirror ball, and a source whose frames alternate between exposures."""
        if not request.scene.probes:
            return LeftOut(NO_PROBE)
        if len(request.exposures) < 2:
            return LeftOut("the source tells of no alternating exposures")
        if not recovers(request):
            return LeftOut("the quality takes the light as the camera clipped it")
        return Wiring(
            (*(f"probe_{part}" for part in UNWRAPPED), "short_frames"), tuple(f"merged_{part}" for part in UNWRAPPED)
        )

    def arrays(self) -> Mapping[str, ArraySpec]:
        """The maps of all exposures, what clips nearby, and the merged map."""
        height = self.request.quality.environment_height
        count = len(self.request.exposures)
        types = dict(zip(UNWRAPPED, (wp.vec3, wp.float32, wp.vec3), strict=True))
        return {
            **{f"merged_{part}": ArraySpec((height, 2 * height), kind) for part, kind in types.items()},
            **{f"bracket_{part}": ArraySpec((count, height, 2 * height), kind) for part, kind in types.items()},
            "bracket_spread": ArraySpec((count, height, 2 * height), wp.vec3),
            "bracket_exposures": ArraySpec((count,), kernels.BracketExposure),
        }

    def build(self, arrays: Arrays, device: Any) -> list[Pass]:
        """The reference joins the others; what clips nearby; their mean."""
        height = self.request.quality.environment_height
        own = [(arrays[f"bracket_{part}"][0], arrays[f"probe_{part}"]) for part in UNWRAPPED]

        def store(rows: Rows | None) -> None:
            for target, source in own:
                copy(target, source)

        def spread(rows: Rows | None) -> None:
            kernels.spread_clipping(
                arrays["bracket_confidence"], arrays["bracket_clipped"], arrays["bracket_spread"], rows=rows
            )

        def merge(rows: Rows | None) -> None:
            kernels.merge_exposures(
                arrays["bracket_exposures"],
                arrays["bracket_radiance"],
                arrays["bracket_confidence"],
                arrays["bracket_clipped"],
                arrays["bracket_spread"],
                arrays["merged_radiance"],
                arrays["merged_confidence"],
                arrays["merged_clipped"],
                rows=rows,
            )

        return [Pass(store), Pass(spread, rows=height), Pass(merge, rows=height)]


def merges(request: Request) -> bool:
    """Whether exposures are merged for ``request``."""
    return isinstance(Bracket.wire(request), Wiring)
