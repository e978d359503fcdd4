"""What the camera's picture shows, as stages hand it to their kernels."""

from __future__ import annotations

from warp_ar.kernels.rays.visibility import VisibleObjects, make_visible
from warp_ar.kernels.structs import Picture, make_picture
from warp_ar.stages.base import Arrays
from warp_ar.stages.features import Features


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
