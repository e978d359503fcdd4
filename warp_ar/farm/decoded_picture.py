"""A decoded picture whose codes go to the device as they are. No Warp here: a driver reads recordings too."""

from __future__ import annotations

from typing import Any

from av.video.reformatter import Colorspace

from warp_ar.sources.deep_video import HD_HEIGHT

LEAST_SIZE = 16
"""Rows and columns below which FFmpeg's filters weigh samples at the border in another way than the device."""
INTERLEAVED = "nv12"
"""Format in which Cb and Cr lie in turn."""
_PLANAR = ("yuv420p", "yuvj420p")
_MATRICES = {int(Colorspace.ITU709): "bt709", int(Colorspace.ITU601): "bt601"}


class DecodedPicture:
    """A picture as its decoder gave it; it stands where a source has RGB."""

    def __init__(self, picture: Any) -> None:
        """Keep PyAV's picture, one that ``can_convert``."""
        self.picture = picture
        self.shape = (picture.height, picture.width, 3)


def can_convert(picture: Any) -> bool:
    """Whether a device can convert PyAV's picture to RGB as the host does."""
    size = picture.height, picture.width
    known = picture.format.name in (*_PLANAR, INTERLEAVED) and matrix_of(picture) is not None
    return known and not picture.rotation and min(size) >= LEAST_SIZE and not any(n % 2 for n in size)


def matrix_of(picture: Any) -> str | None:
    """Name of a picture's matrix, as ``rgb_from_video`` takes it; None: another."""
    if int(picture.colorspace) not in {int(known) for known in Colorspace}:
        return "bt709" if picture.height >= HD_HEIGHT else "bt601"
    return _MATRICES.get(int(picture.colorspace))
