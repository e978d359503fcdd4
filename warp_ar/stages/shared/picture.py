"""The picture as stages hand it to their kernels: frame, layers, evidence of clipped pixels, rows to run over."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from warp_ar.kernels.picture import composite
from warp_ar.kernels.picture.expose import ClippedEvidence, make_clipped_evidence
from warp_ar.kernels.rays.visibility import VisibleObjects, make_visible
from warp_ar.kernels.structs import Picture, make_picture
from warp_ar.stages.base import Arrays, Rows, Wiring
from warp_ar.stages.features import Features
from warp_ar.stages.request import Request


def frame_reads(features: Features) -> tuple[str, ...]:
    """Names of the frame that a stage reads as light: the codes, and the linear picture where there is one."""
    return ("frame", "linear_frame") if features.request.linear else ("frame",)


def find_picture(arrays: Arrays, *, frame: bool = True) -> Picture:
    """The frame with its decode table and rays; without the frame for a stage that does not read it.

    A stage that reads it reads all of ``frame_reads``.
    """
    if not frame:
        return make_picture(None, arrays["decode"], arrays["rays"])
    return make_picture(arrays["frame"], arrays["decode"], arrays["rays"], arrays["linear_frame"])


def find_visible(arrays: Arrays) -> VisibleObjects:
    """The objects that pixels show, of the stage ``visibility``."""
    return make_visible(arrays["hit_object"], arrays["hits"])


def layers_of(arrays: Mapping[str, Any]) -> composite.Layers:
    """The layers that there are, as kernels read them."""
    mirror_ball = "reflected" if "reflected" in arrays else "mirror_ball"
    names = ("virtual", "added_light", "shadow_ratio", mirror_ball)
    return composite.make_layers(*(arrays.get(name) for name in names))


SUMMED = "summed_area"
"""Resource: the frame's summed-area table."""
SUMMED_CUT = "summed_area_cut"
"""Resource: summed-area table of the residual below 8 bits, for deeper frames."""


def box_reads(features: Features) -> tuple[str, ...]:
    """Tables of what surrounds clipped pixels, where the method of ``expose`` looks at that."""
    if not features.boxed:
        return ()
    return (SUMMED, SUMMED_CUT) if features.request.linear else (SUMMED,)


def clipped_evidence(request: Request, wiring: Wiring, arrays: Arrays) -> ClippedEvidence:
    """All of it that a stage with this wiring reads."""
    known = [arrays[name] if name in wiring.reads else None for name in (SUMMED, "declipped", SUMMED_CUT)]
    return make_clipped_evidence(request.size[1], *known, levels=arrays["linear_clip"] if request.linear else None)


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
