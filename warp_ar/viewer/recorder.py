"""Records what viewers see as a video that they can save."""

from __future__ import annotations

import contextlib
import threading
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from warp_ar.errors import UsageError, WarpArError
from warp_ar.output.sinks import VideoSink

MOST_FRAMES: Final = 9000
"""After so many a recording ends by itself: five minutes at 30 a second."""


class Recorder:
    """One recording at a time. Methods may be called from any thread."""

    def __init__(self, folder: Path) -> None:
        """Start without a recording.

        Args:
            folder: Where the video is kept; the newest recording replaces the one before.
        """
        self._path = folder / "recording.mp4"
        self._lock = threading.Lock()
        self._sink: VideoSink | None = None
        self._count = 0

    @property
    def count(self) -> int | None:
        """Frames recorded so far; None while nothing is recorded."""
        return None if self._sink is None else self._count

    def start(self, fps: float) -> None:
        """Record from now on; a recording that runs goes on."""
        with self._lock:
            if self._sink is None:
                self._path.unlink(missing_ok=True)
                self._sink, self._count = VideoSink(self._path, fps=fps), 0

    def stop(self) -> None:
        """Finish the recording, if there is one."""
        with self._lock:
            self._finish()

    def _finish(self) -> None:
        if self._sink is not None:
            sink, self._sink = self._sink, None
            sink.close()

    def add(self, image: npt.NDArray[np.uint8]) -> None:
        """Record a frame, if a recording runs.

        Raises:
            WarpArError: It cannot be recorded, such as one of another size; the recording has ended.
        """
        with self._lock:
            if self._sink is None:
                return
            try:
                self._sink.write(image)
            except WarpArError:
                with contextlib.suppress(WarpArError):
                    self._finish()
                raise
            self._count += 1
            if self._count >= MOST_FRAMES:
                self._finish()

    def video(self) -> bytes:
        """The finished recording, an MP4.

        Raises:
            UsageError: There is none.
        """
        with self._lock:  # a file that is being finished is not whole yet
            if self._sink is not None or not self._path.is_file():
                raise UsageError("nothing was recorded, or it has not ended")
            return self._path.read_bytes()
