"""What the camera's picture shows, as stages hand it to their kernels."""

from __future__ import annotations

from warp_ar.kernels.structs import Picture
from warp_ar.kernels.visibility import VisibleObjects
from warp_ar.stages.base import Arrays


def make_picture(arrays: Arrays, *, frame: bool = True) -> Picture:
    """The frame with its decode table and rays; without the frame for a stage that does not read it."""
    picture = Picture()
    if frame:
        picture.frame = arrays["frame"]
    picture.decode_table, picture.rays = arrays["decode"], arrays["rays"]
    return picture


def make_visible(arrays: Arrays) -> VisibleObjects:
    """The objects that pixels show, of the stage ``visibility``."""
    visible = VisibleObjects()
    visible.objects, visible.hits = arrays["hit_object"], arrays["hits"]
    return visible
