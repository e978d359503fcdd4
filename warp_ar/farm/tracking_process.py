"""A process that reads a clip and looks for its marker, beside the one that gathers the clip's light.

Both are many short calls of Python and NumPy, which hold the interpreter's lock. Pictures come in memory that the
processes share, one slot after another; where the marker is comes with a message. What is found is, to the bit, what
the same steps find here.
"""

from __future__ import annotations

import contextlib
import dataclasses
import mmap
import os
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from warp_ar.closing import Closing
from warp_ar.farm.frames import FrameIndex, open_part
from warp_ar.farm.records import OPENCV_THREADS
from warp_ar.light.solving_process import own_streams, read_message, start_process, write_message
from warp_ar.scene import Camera, Marker
from warp_ar.sources.source import Frame
from warp_ar.tracking.tracking import Image, Track, Tracker

SLOTS = 12
"""Pictures at once in shared memory: those that are being lit, and those by which tracking is ahead."""
_MEMORY = "warp_ar-frames"
"""What the system calls the shared memory."""


@dataclasses.dataclass(frozen=True)
class Reading:
    """What is read, and what is looked for."""

    path: Path
    index: FrameIndex
    first: int
    end: int
    fps: float | None
    gpu: int | None
    converters: int
    marker: Marker
    camera: Camera
    """Of the frames, with their size."""
    slots: int = SLOTS
    """Pictures at once in shared memory."""

    @property
    def bytes_each(self) -> int:
        """Of a picture, uint8 RGB."""
        return 3 * self.camera.width * self.camera.height

    def picture(self, memory: mmap.mmap, number: int) -> Image:
        """Where the n-th frame's picture lies, uint8 RGB (height, width, 3)."""
        shape = self.camera.height, self.camera.width, 3
        offset = number % self.slots * self.bytes_each
        return np.frombuffer(memory, np.uint8, self.bytes_each, offset).reshape(shape)


def can_share() -> bool:
    """Whether this system shares memory that goes with the last process that uses it."""
    try:
        os.close(os.memfd_create(_MEMORY))
    except (AttributeError, OSError):  # another system than Linux, or a Linux that does not let it
        return False
    return True


class TrackingProcess(Closing):
    """Frames with where their marker is, found by another process, which starts here."""

    def __init__(self, reading: Reading, *, held: int) -> None:
        """Start.

        Args:
            reading: What to read.
            held: Frames whose pictures stay as they are when more are asked for; there are two more slots, or more.
        """
        self._reading, self._held = reading, held
        descriptor = os.memfd_create(_MEMORY)
        try:
            os.ftruncate(descriptor, reading.slots * reading.bytes_each)
            self._memory = mmap.mmap(descriptor, 0)
            self._process = start_process(__name__, (descriptor,))
            write_message(self._process.stdin, (reading, descriptor))
        finally:
            os.close(descriptor)

    def __iter__(self) -> Iterator[tuple[Frame, Track]]:
        """Frames in order, and where their marker is.

        Raises:
            EOFError: The process has gone.
            Exception: What went wrong there.
        """
        number = 0
        while True:
            kind, value = read_message(self._process.stdout)
            if kind == "error":
                raise value
            if kind == "end":
                return
            index, time, track = value
            yield Frame(index, time, self._reading.picture(self._memory, number)), track
            number += 1
            if number > self._held:
                with contextlib.suppress(OSError):  # it has told all and gone, or died: the next message says which
                    write_message(self._process.stdin, "seen")

    def close(self) -> None:
        """End the process; the memory goes with this and the last picture that refers to it."""
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            with contextlib.suppress(OSError):
                stream.close()


def serve() -> None:
    """What the process does: reads, looks and tells, until the clip or the other process ends."""
    with own_streams() as (source, target):
        cv2.setNumThreads(OPENCV_THREADS)
        reading, descriptor = read_message(source)
        memory = mmap.mmap(descriptor, 0)
        free = threading.Semaphore(reading.slots)

        def listen() -> None:
            with contextlib.suppress(EOFError, OSError):
                while True:
                    read_message(source)
                    free.release()
            os._exit(0)  # the other process is gone

        threading.Thread(target=listen, name="warp_ar-seen", daemon=True).start()
        told: tuple[str, Any] = ("end", None)
        try:
            _read(reading, memory, free, target)
        except Exception as error:
            told = "error", error
        with contextlib.suppress(OSError):
            write_message(target, told)
        os._exit(0)  # at once: a thread still reads


def _read(reading: Reading, memory: mmap.mmap, free: threading.Semaphore, target: Any) -> None:
    """Tell of one frame after another; its picture goes to where there is room while its marker is looked for."""
    tracker = Tracker(reading.marker, reading.camera)
    part = reading.path, reading.index, reading.first, reading.end, reading.fps, reading.gpu
    before: tuple[Frame, Future[Track]] | None = None

    def tell() -> None:
        if before is not None:
            frame, track = before
            write_message(target, ("frame", (frame.index, frame.time, track.result())))

    with open_part(*part, converters=reading.converters) as frames, ThreadPoolExecutor(1, "warp_ar-track") as thread:
        try:
            for number, frame in enumerate(frames):
                track = thread.submit(tracker.track, frame.image, frame.time)
                free.acquire()
                np.copyto(reading.picture(memory, number), frame.image)
                tell()
                before = frame, track
        finally:
            tell()  # what comes before damage comes before its error
