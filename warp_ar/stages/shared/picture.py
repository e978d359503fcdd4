"""The picture as kernels read it: frame, layers, evidence about clipped pixels, and rows to process."""

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
    """Return the frame's resources for a stage that reads radiance: the codes, and the linear frame if there is one."""
    return ("frame", "linear_frame") if features.request.linear else ("frame",)


def find_picture(arrays: Arrays, *, frame: bool = True) -> Picture:
    """Return the frame with its decode table and rays; ``frame=False`` for a stage that does not read the frame.

    A stage that reads the frame must read all resources of ``frame_reads``.
    """
    if not frame:
        return make_picture(None, arrays["decode"], arrays["rays"])
    return make_picture(arrays["frame"], arrays["decode"], arrays["rays"], arrays["linear_frame"])


def find_visible(arrays: Arrays) -> VisibleObjects:
    """Return the visible objects that the stage ``visibility`` writes."""
    return make_visible(arrays["hit_object"], arrays["hits"])


def layers_of(arrays: Mapping[str, Any]) -> composite.Layers:
    """Return the ``Layers`` of those layers that exist in ``arrays``."""
    mirror_ball = "reflected" if "reflected" in arrays else "mirror_ball"
    names = ("virtual", "added_light", "shadow_ratio", mirror_ball)
    return composite.make_layers(*(arrays.get(name) for name in names))


SUMMED = "summed_area"
"""Name of the resource with the frame's summed-area table."""
SUMMED_CUT = "summed_area_cut"
"""Name of the resource with the summed-area table of the residual below 8 bits, for deeper frames."""


def box_reads(features: Features) -> tuple[str, ...]:
    """Return the summed-area tables, if the method of ``expose`` uses the surroundings of clipped pixels."""
    if not features.boxed:
        return ()
    return (SUMMED, SUMMED_CUT) if features.request.linear else (SUMMED,)


def clipped_evidence(request: Request, wiring: Wiring, arrays: Arrays) -> ClippedEvidence:
    """Return the ``ClippedEvidence`` (data for estimates of clipped pixels) from the resources that a stage reads."""
    known = [arrays[name] if name in wiring.reads else None for name in (SUMMED, "declipped", SUMMED_CUT)]
    return make_clipped_evidence(request.size[1], *known, levels=arrays["linear_clip"] if request.linear else None)


class GrowingRows:
    """Function that returns the rows with content in this frame or in the previous one, which must be cleared."""

    def __init__(self, current: Callable[[], Rows]) -> None:
        self._current = current
        self._previous: Rows = (0, 0)

    def __call__(self) -> Rows:
        """Return the band of rows that holds this frame's and the previous frame's content; called once per frame."""
        rows, previous = self._current(), self._previous
        self._previous = rows
        if previous[0] >= previous[1]:
            return rows
        if rows[0] >= rows[1]:
            return previous
        return min(rows[0], previous[0]), max(rows[1], previous[1])
