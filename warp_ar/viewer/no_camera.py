"""What the page shows while the scene's capture device cannot be opened: a picture that says so, until a camera comes.

A desk of one's own names the camera of its machine. Where there is none, a browser's, or a phone's, lights it all the
same: so the page is served, and says which button opens that.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.checks.finding import Finding
from warp_ar.errors import SourceError
from warp_ar.sources.source import Frame, Source

REMEDY: Final = "press “My camera”, which opens the camera of the machine that shows this page"
_WORDS: Final = ("No camera here.", 'Press "My camera".')
_GREY, _WHITE = 64, 235
_SECONDS: Final = 0.5
"""Between pictures, which are all the same."""


class NoCamera(Source):
    """One grey picture with words, again and again."""

    live = True
    length = None
    fps = 1.0 / _SECONDS

    def __init__(self, size: tuple[int, int], error: SourceError) -> None:
        """Say what is wrong.

        Args:
            size: (width, height) of the picture, pixels.
            error: Why the capture device cannot be opened.
        """
        self.size, self.description, self.error = size, "no camera", error
        self.finding = Finding("source.absent", str(error).partition(";")[0], REMEDY)
        """What is wrong, and what to do on the page."""
        self._closed = threading.Event()

    def __iter__(self) -> Iterator[Frame]:
        """The picture, until the source is closed."""
        image, start, index = _picture(self.size), time.monotonic(), 0
        while not self._closed.is_set():
            yield Frame(index, time.monotonic() - start, image)
            index += 1
            self._closed.wait(_SECONDS)

    def close(self) -> None:
        """End the pictures."""
        self._closed.set()


def _picture(size: tuple[int, int]) -> npt.NDArray[np.uint8]:
    """Words in the middle of a grey picture, RGB (height, width, 3)."""
    image = np.full((size[1], size[0], 3), _GREY, np.uint8)
    scale = size[0] / 640
    for line, words in enumerate(_WORDS):
        (width, height), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, scale, 2)
        place = ((size[0] - width) // 2, size[1] // 2 + round((2.0 * line - 0.5) * height))
        cv2.putText(image, words, place, cv2.FONT_HERSHEY_SIMPLEX, scale, (_WHITE,) * 3, 2, cv2.LINE_AA)
    return image
