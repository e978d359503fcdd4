"""Sources that do not wait: one frame is held, the newest, because a late frame is worth less than none."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from warp_ar.errors import SourceError
from warp_ar.sources.source import DEFAULT_FPS, Frame, Source, check_fps, check_size

Image = npt.NDArray[np.uint8]


class _Newest:
    """Slots for one picture, its time and its exposure each: putting replaces what was not taken, and counts that.

    Every exposure has a slot of its own: a reader that is slower than the camera must not miss the rare short one.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._items: dict[float | None, tuple[Image, float]] = {}
        self._error: SourceError | None = None
        self._closed = False
        self.dropped = 0

    def put(self, image: Image, time: float, exposure: float | None = None) -> bool:
        """Offer a picture; False if the slot is closed."""
        with self._changed:
            if self._closed:
                return False
            self.dropped += self._items.pop(exposure, None) is not None
            self._items[exposure] = (image, time)
            self._changed.notify_all()
            return True

    def close(self, error: SourceError | None = None) -> None:
        """Take no more; whoever waits gets what is left, then ``error`` if there is one, else the end."""
        with self._changed:
            if not self._closed:
                self._closed, self._error = True, error
            self._changed.notify_all()

    def take(self) -> tuple[Image, float, float | None] | None:
        """Wait for a picture, of several the oldest; None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._items) or self._closed)
            if self._items:
                exposure = next(iter(self._items))
                return (*self._items.pop(exposure), exposure)
            if self._error is not None:
                raise self._error
            return None


class LiveSource(Source):
    """A source that holds the newest frame and counts those that it replaces."""

    live = True
    length = None

    def __init__(self) -> None:
        self._newest = _Newest()
        self._index, self._start = 0, 0.0

    @property
    def dropped(self) -> int:
        """Frames that were skipped because a newer one had come."""
        return self._newest.dropped

    def __iter__(self) -> Iterator[Frame]:
        """The newest frame each time, waiting for one that has not been seen; ends when the source is closed."""
        while (item := self._newest.take()) is not None:
            image, stamp, exposure = item
            if self._index == 0:
                self._start = stamp
            frame = Frame(self._index, stamp - self._start, image, exposure)
            self._index += 1
            yield frame

    def close(self) -> None:
        """Take no more; iteration ends after what is left."""
        self._newest.close()


class QueueSource(LiveSource):
    """Frames that somebody else pushes, such as a web page with a camera.

    Args:
        size: (width, height) of every frame, in pixels.
        fps: Nominal rate in frames per second.
        description: One line for people.
    """

    def __init__(self, size: tuple[int, int], *, fps: float = DEFAULT_FPS, description: str = "pushed frames") -> None:
        super().__init__()
        check_fps(fps)
        self.size, self.fps, self.description = size, fps, f"{description} ({size[0]}x{size[1]})"

    def push(self, image: Image, time: float) -> bool:
        """Offer a frame from any thread; it replaces one that was not yet taken.

        Args:
            image: uint8 RGB, (height, width, 3); must not be changed afterwards.
            time: Seconds, on any clock that only goes forward.

        Returns:
            False if the source is closed and the frame was left aside.

        Raises:
            SourceError: The image is not of the source's size or kind.
        """
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            got = f"{image.dtype} {image.shape}"
            raise SourceError(f"{self.description}: a frame is {got}, not uint8 RGB (height, width, 3)")
        check_size(image, self.size, self.description, self._index)
        return self._newest.put(np.ascontiguousarray(image), time)
