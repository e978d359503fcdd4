"""A lit picture as the codes that its encoder takes. No Warp here: who writes video may do without."""

from __future__ import annotations

from collections.abc import Callable

import av
import numpy as np
import numpy.typing as npt


class LitPicture:
    """A lit picture on its way to the encoder: it has a shape and copies itself, as sinks want it."""

    def __init__(self, shape: tuple[int, int, int], codes: npt.NDArray[np.uint8], wait: Callable[[], None]) -> None:
        """``codes`` are there once ``wait`` returns."""
        self.shape = shape
        self._codes, self._wait = codes, wait

    def copy(self) -> av.VideoFrame:
        """PyAV's picture, yuv420p with memory of its own; waits for it."""
        self._wait()
        height, width = self.shape[:2]
        picture = av.VideoFrame(width, height, "yuv420p")
        start = 0
        for plane in picture.planes:
            rows, columns, pitch = plane.height, plane.width, plane.line_size
            values = self._codes[start : start + rows * columns].reshape(rows, columns)
            np.frombuffer(plane, np.uint8)[: rows * pitch].reshape(rows, pitch)[:, :columns] = values
            start += rows * columns
        return picture
