"""Frames as numbered PNGs."""

from __future__ import annotations

import contextlib
import pathlib
from typing import Any

import cv2
import numpy.typing as npt

from warp_ar.errors import SinkError, reason
from warp_ar.output.sink import ThreadedSink, make_folder
from warp_ar.output.video_sink import VIDEO_SUFFIXES

FOLDER_THREADS = 2
"""Threads that compress the frames of a folder."""

# Camera frames hardly repeat, so looking for repetitions costs time and saves no byte; neighbours are alike.
PNG_OPTIONS = (
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY),
)


class FolderSink(ThreadedSink):
    """A folder of ``NNNN.png``, numbered from 0: frames of the same numbers are replaced, other files left alone.

    A frame appears under its name only when it is whole.

    Raises:
        SinkError: The folder cannot be made or written to.
    """

    def __init__(self, path: str | pathlib.Path) -> None:
        self._path = pathlib.Path(path)
        if self._path.exists() and not self._path.is_dir():
            raise SinkError(f"{self._path} is a file; name a folder, or a video ending in {', '.join(VIDEO_SUFFIXES)}")
        make_folder(self._path)
        self.description = f"{self._path} (numbered frames)"
        super().__init__(FOLDER_THREADS)

    def _store(self, index: int, image: npt.NDArray[Any]) -> None:
        path = self._path / f"{index:04d}.png"
        ok, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), PNG_OPTIONS)
        if not ok:
            raise SinkError(f"{path} cannot be encoded as PNG")
        part = path.with_name(f".{path.name}.part")
        try:
            part.write_bytes(data.tobytes())
            part.replace(path)
        except OSError as error:
            with contextlib.suppress(OSError):
                part.unlink()
            raise SinkError(f"{path} cannot be written: {reason(error)}") from error
