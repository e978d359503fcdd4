"""What the camera's picture shows, as stages hand it to their kernels."""

from __future__ import annotations

from warp_ar.kernels.structs import Picture, make_picture
from warp_ar.kernels.visibility import VisibleObjects, make_visible
from warp_ar.stages.base import Arrays


def find_picture(arrays: Arrays, *, frame: bool = True) -> Picture:
    """The frame with its decode table and rays; without the frame for a stage that does not read it."""
    return make_picture(arrays["frame"] if frame else None, arrays["decode"], arrays["rays"])


def find_visible(arrays: Arrays) -> VisibleObjects:
    """The objects that pixels show, of the stage ``visibility``."""
    return make_visible(arrays["hit_object"], arrays["hits"])
