"""Base classes of all sinks of frames, and encoding on threads.

A sink encodes while the next frame is computed, with at most a few frames waiting. Errors are raised by the next
`write` or by `close`. Opening a sink checks that its place can be written.
"""

from __future__ import annotations

import collections
import concurrent.futures
import contextlib
import pathlib
import tempfile
import threading
import weakref
from abc import abstractmethod
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ar.closing import Closing
from warp_ar.errors import SinkError, reason
from warp_ar.files import kind_of

FRAMES_WAITING = 4
"""Number of frames that may wait for encoding before `Sink.write` blocks."""

_open: weakref.WeakSet[ThreadedSink] = weakref.WeakSet()
"""Sinks whose last frame is not yet stored."""


def close_open_sinks() -> None:
    """Close every sink whose `Sink.close` was interrupted or never called.

    A signal's exception may be raised anywhere, also on entry to `close` before its error handling. Code that turns
    signals into exceptions calls this function after the last signal.

    Raises:
        SinkError: The last error of a sink.
    """
    with contextlib.ExitStack() as stack:
        for sink in list(_open):
            stack.callback(sink.close)


class Sink(Closing):
    """Destination of frames: a context manager."""

    description: str
    """Description for users, one line, with a note if frames are changed."""

    written: int = 0
    """Number of stored frames; after a failure, of complete ones."""

    replaced: str = ""
    """Description of the files that the first frame replaces; empty if there are none."""

    @abstractmethod
    def write(self, image: npt.NDArray[Any]) -> None:
        """Write the next frame; the array may be reused immediately.

        Args:
            image: Encoded colour, uint8 RGB, (height, width, 3); linear radiance, float32, where the sink's coding has
                more than 8 bits.

        Raises:
            SinkError: The image's size or type cannot be written, or an earlier frame could not be written.
        """

    def write_at(self, image: npt.NDArray[Any], seconds: float) -> None:
        """Write the next frame with a display time in seconds, which only sinks with time stamps use; as `write`."""
        self.write(image)

    @abstractmethod
    def close(self) -> None:
        """Write waiting frames, finish the file and end all threads; a second call does nothing.

        Raises:
            SinkError: A frame could not be written, and no `write` has raised the error yet.
        """


class ThreadedSink(Sink):
    """Sink that stores frames on threads, with at most FRAMES_WAITING frames waiting."""

    def __init__(self, threads: int) -> None:
        self._executor = _started_pool(threads)
        self._pending: collections.deque[Future[None]] = collections.deque()
        self._error: BaseException | None = None
        self._closed = self._ended = self._finished = False
        self._last: Future[None] | None = None
        self._shape: tuple[int, ...] | None = None
        self._count = 0
        self._counting, self._finishing = threading.Lock(), threading.Lock()
        _open.add(self)

    def _check(self, image: Any) -> None:
        """Raise SinkError if the frame's type cannot be written."""
        check_image(image)

    @abstractmethod
    def _store(self, index: int, image: Any) -> None:
        """Encode and write one frame; runs on a thread and raises SinkError."""

    def write(self, image: Any) -> None:
        """Write the next frame, an array or another object with ``shape`` and ``copy``; it is stored on a thread.

        Raises:
            SinkError: The sink is closed, the frame has another size or kind than those before it, or an earlier one
                could not be stored.
        """
        if self._closed:
            raise SinkError(f"{self.description} is closed; open another one to write to")
        self._check(image)
        self._shape = self._shape or image.shape
        if image.shape != self._shape:
            had, got = (f"{shape[1]}x{shape[0]}" for shape in (self._shape, image.shape))
            raise SinkError(f"{self.description}: frame {self._count} is {got}, not {had} like those before it")
        self._settle(FRAMES_WAITING - 1)
        if self._error is not None:
            raise self._error
        self._pending.append(self._executor.submit(self._keep, self._count, image.copy()))
        self._count += 1

    def _keep(self, index: int, image: Any) -> None:
        self._store(index, image)
        with self._counting:
            self.written += 1

    def _settle(self, waiting: int) -> None:
        """Wait until at most ``waiting`` frames are left, and raise the first error."""
        while self._pending and (self._pending[0].done() or len(self._pending) > waiting):
            # If this wait is interrupted, the frame stays in the queue.
            error = self._pending[0].exception()
            self._pending.popleft()
            if error is not None and self._error is None:
                self._error = error
                raise error

    def close(self) -> None:
        """Store waiting frames and end the threads; after an interruption by a signal, a second call continues."""
        if self._ended:
            return
        self._closed = True
        # Finished on a thread, because a signal may interrupt the main thread anywhere.
        if self._last is None:
            self._last = self._executor.submit(self._finish_after, list(self._pending))
        try:
            self._settle(0)
        finally:
            self._wait_out()
            self._ended = True
            _open.discard(self)
        self._last.result()

    def _finish_after(self, pending: list[Future[None]]) -> None:
        concurrent.futures.wait(pending)
        with self._finishing:
            finished, self._finished = self._finished, True
        if not finished:  # an interrupted call may have submitted it before
            self._finish()

    def _wait_out(self) -> None:
        """Wait for the threads' end, also after one interrupt."""
        try:
            self._executor.shutdown(wait=True)
        except KeyboardInterrupt:
            self._executor.shutdown(wait=True)
            raise

    def _finish(self) -> None:
        """Close open files after the last frame has been stored; runs on a thread."""


def _started_pool(threads: int) -> ThreadPoolExecutor:
    """Return an executor whose threads have all been started.

    An executor starts threads on demand. A signal that interrupts this start makes it forget the running thread and
    start a second one. Starting all threads here, before the first frame, cannot lose a frame.
    """
    pool, everyone = ThreadPoolExecutor(threads, thread_name_prefix="warp-ar-sink"), threading.Event()
    try:
        for _ in range(threads):
            pool.submit(everyone.wait)
    finally:
        everyone.set()
    return pool


class NullSink(Sink):
    """Sink that discards frames."""

    description = "nowhere"

    def write(self, image: npt.NDArray[Any]) -> None:
        """Check the frame."""
        check_image(image)

    def close(self) -> None:
        """Do nothing."""


def check_image(image: npt.NDArray[Any], kind: type = np.uint8) -> None:
    """Check that an array is a frame of codes (uint8) or of linear radiance (float32).

    Raises:
        SinkError: The array is no such frame.
    """
    if image.dtype != kind or image.ndim != 3 or image.shape[2] != 3 or not image.size:
        what = "a frame is uint8" if kind is np.uint8 else "a frame of radiance is float32"
        raise SinkError(f"{what} RGB (height, width, 3), not {image.dtype} {image.shape}")


def make_folder(path: pathlib.Path) -> None:
    """Make the folder and its parents, and check that files can be created in it.

    Raises:
        SinkError: The path is no folder, or is not writable.
    """
    try:
        if (kind := kind_of(path)) not in ("folder", "nothing"):
            raise SinkError(f"{path} is {'a file' if kind == 'file' else kind}, not a folder to write to")
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise SinkError(f"{path} cannot be written to: {reason(error)}; name a folder that you may write to") from error
