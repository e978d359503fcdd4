"""Base of all sources of frames: a `Frame` in 8-bit RGB at a time, recorded ones decoded ahead.

A recorded source (folder, video, generated) loses no frame and is decoded a few frames ahead on one thread. A live one
does not wait: it holds one frame, the newest, because a late frame is worth less than none. What names a place that is
not there, or an impossible rate, is complained about here too.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import difflib
import fractions
import functools
import math
import pathlib
import threading
import weakref
from abc import abstractmethod
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import numpy.typing as npt

from warp_ar.closing import Closing
from warp_ar.errors import SourceError, UsageError, reason
from warp_ar.files import kind_of
from warp_ar.sources.deep_frame import Plate

Image = npt.NDArray[np.uint8]

DEFAULT_FPS = 30.0
"""Rate of a folder of frames, or of a device that does not tell, in frames per second."""

FRAMES_AHEAD = 4
"""Frames that a recorded source decodes before they are asked for."""


@dataclasses.dataclass(frozen=True)
class Frame:
    """One picture of a source."""

    index: int
    """Number of the frame, counted from 0 without gaps; goes on counting where a looped source starts again."""

    time: float
    """Seconds since the source's first frame."""

    image: Image
    """Encoded colour, uint8 RGB, (height, width, 3), C-contiguous."""

    exposure_time: float | None = None
    """Exposure in seconds, None where the source does not tell."""

    plate: Plate | None = None
    """The picture at its full depth, where it has more than 8 bits and the source was told to keep them."""

    name: str = ""
    """Path of the frame's file; empty where it has none of its own."""

    begins: int = 0
    """Index of the first frame of its pass: of a clip that is looped, grows."""

    @property
    def deepest(self) -> Plate | Image:
        """The picture at the depth that is known of it: what a pipeline of ``linear`` frames takes."""
        return self.image if self.plate is None else self.plate


class Source(Closing):
    """Origin of frames: a context manager, and iterable."""

    size: tuple[int, int]
    """(width, height) of every frame, in pixels."""

    fps: float
    """Nominal rate in frames per second."""

    tick: fractions.Fraction | None = None
    """Seconds that times of its frames are whole multiples of, where a recording tells them; None: ``fps`` tells."""

    length: int | None
    """Number of frames in one pass where it is known; a video's is what its header says, or its duration tells."""

    live: bool
    """True if frames are lost when nobody takes them in time."""

    start: float = 0.0
    """Time of a live source's first frame, seconds of ``time.monotonic``; its frames' times count from there."""

    description: str
    """One line for people."""

    note: str = ""
    """Note on what is done to its frames that people may not expect, one line; empty: nothing is."""

    deep: str = ""
    """Its pictures have more than 8 bits: ``codes`` of the camera, or linear ``light``; empty: they have not."""

    curve: str = ""
    """Transfer of HDR pictures, ``pq`` or ``hlg``; empty: they are no HDR."""
    keeps_depth: bool = False
    """True if frames come with their plates; to be set before they are read."""

    memory: Callable[[], Image] | None = None
    """Gives memory, uint8 (height, width, 3), into which whoever reads the frames has them written, such as
    ``Pipeline.new_frame``; sources that make pictures anew write them there. None: into memory of their own."""

    names: tuple[str, ...] = ()
    """Paths of its frames' files; empty where frames have none of their own."""

    exposures: tuple[float, ...] = ()
    """All exposure times of its frames in seconds, longest first; empty where it does not tell."""

    @property
    def dropped(self) -> int:
        """Frames that were skipped because a newer one had come; 0 unless live."""
        return 0

    def _memory_for(self, height: int, width: int) -> Image | None:
        """Return where to write a picture of that size; None: into memory of its own."""
        given = None if self.memory is None else self.memory()
        return given if given is not None and given.shape == (height, width, 3) else None

    @abstractmethod
    def __iter__(self) -> Iterator[Frame]:
        """Frames in order; a recorded source starts from its first frame at every call."""

    @abstractmethod
    def close(self) -> None:
        """Stop every thread and release files and devices; a second call does nothing."""


class RecordedSource(Source):
    """A source that can be read again from the start: decoded ahead on a thread, looped if asked, no frame lost."""

    live = False

    def __init__(self, *, loop: bool, exposures: Sequence[float] = ()) -> None:
        check_exposures(exposures)
        self._cycle = tuple(map(float, exposures))
        self.exposures = distinct(self._cycle)
        self._loop = loop
        self._closed = False
        self._running: weakref.WeakSet[Generator[Frame, None, None]] = weakref.WeakSet()

    @abstractmethod
    def _decode(self) -> Generator[Frame, None, None]:
        """One pass over the frames, index and time from 0."""

    def __iter__(self) -> Iterator[Frame]:
        """Frames in order, decoded ahead on a thread; every call starts from the first.

        Raises:
            SourceError: The source is closed; while iterating, a frame cannot be decoded or has another size.
        """
        if self._closed:
            raise SourceError(f"{self.description} is closed; open it again to read from it")
        frames = _ahead(self._passes())
        self._running.add(frames)
        return frames

    def close(self) -> None:
        """End every iteration and its thread."""
        self._closed = True
        for frames in list(self._running):
            # One whose next frame another thread is waiting for cannot be closed by this one: it ends with that frame.
            with contextlib.suppress(ValueError):
                frames.close()

    def _passes(self) -> Generator[Frame, None, None]:
        index, begins, start, last = 0, 0, 0.0, 0.0
        while True:
            with contextlib.closing(self._decode()) as frames:
                for frame in frames:
                    if self._closed:
                        return
                    last = start + frame.time
                    exposure = self._cycle[frame.index % len(self._cycle)] if self._cycle else frame.exposure_time
                    yield dataclasses.replace(frame, index=index, begins=begins, time=last, exposure_time=exposure)
                    index += 1
            if not self._loop:
                return
            begins, start = index, last + 1.0 / self.fps


def _ahead(frames: Generator[Frame, None, None]) -> Generator[Frame, None, None]:
    """Yield what ``frames`` yields, computed up to FRAMES_AHEAD frames early; errors keep their place in the order."""
    pending: collections.deque[Future[Frame | None]] = collections.deque()
    take = functools.partial(next, frames, None)
    with contextlib.closing(frames), ThreadPoolExecutor(1, thread_name_prefix="warp-ar-source") as executor:
        try:
            while True:
                while len(pending) <= FRAMES_AHEAD:
                    pending.append(executor.submit(take))
                frame = pending.popleft().result()
                if frame is None:
                    return
                yield frame
        finally:
            executor.shutdown(wait=True, cancel_futures=True)


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

    def __init__(self, name: str = "") -> None:
        self._name = name
        self._newest, self._stop = _Newest(), threading.Event()
        self._index = 0

    def _start_reading(self) -> None:
        """Have a thread put pictures into ``_newest``."""
        self._thread = threading.Thread(target=self._read_all, name="warp-ar-camera", daemon=True)
        self._thread.start()

    def _read_all(self) -> None:
        try:
            self._run()
        except SourceError as error:
            self._end(error)
        except Exception as error:  # whatever it is, who waits for a picture is told
            failed = SourceError(f"{self._name}: {reason(error)}")
            failed.__cause__ = error
            self._end(failed)
        else:
            self._end(None)

    def _run(self) -> None:
        """Put pictures into ``_newest`` until told to stop."""

    def _end(self, error: SourceError | None) -> None:
        self._newest.close(error)

    @property
    def dropped(self) -> int:
        """Frames that were skipped because a newer one had come."""
        return self._newest.dropped

    def __iter__(self) -> Iterator[Frame]:
        """The newest frame each time, waiting for one that has not been seen; ends when the source is closed."""
        while (item := self._newest.take()) is not None:
            image, stamp, exposure = item
            if self._index == 0:
                self.start = stamp
            frame = Frame(self._index, stamp - self.start, image, exposure)
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


def check_size(image: Image, size: tuple[int, int], name: str, index: int | None) -> None:
    """Check that a picture is of the (width, height) of those before it.

    Raises:
        SourceError: It is not.
    """
    height, width = image.shape[:2]
    if (width, height) != size:
        which = name if index is None else f"{name}: frame {index}"
        raise SourceError(f"{which} is {width}x{height}, not {size[0]}x{size[1]} like those before it")


def check_fps(fps: float | None) -> None:
    """Check a rate in frames per second; None is none given.

    Raises:
        UsageError: It is not a positive number.
    """
    if fps is not None and not (math.isfinite(fps) and fps > 0):
        raise UsageError(f"fps is {fps}; it must be a positive number of frames per second")


def check_exposures(exposures: Sequence[float]) -> None:
    """Check exposure times in seconds.

    Raises:
        UsageError: One of them is not a positive number.
    """
    if not all(math.isfinite(seconds) and seconds > 0 for seconds in exposures):
        raise UsageError(f"exposures {', '.join(map(str, exposures))}: expected positive numbers of seconds")


def distinct(exposures: Iterable[float]) -> tuple[float, ...]:
    """Every exposure once, longest first."""
    return tuple(sorted(set(map(float, exposures)), reverse=True))


def existing_path(path: pathlib.Path) -> pathlib.Path:
    """The path itself, if frames can be read from it.

    Raises:
        SourceError: It does not exist (the error names the nearest name that does), cannot be read, or is neither file
            nor folder.
    """
    try:
        if (kind := kind_of(path)) != "nothing":
            if kind in ("file", "folder"):
                return path
            raise SourceError(f"{path} is {kind}; frames are read from folders, files and capture devices")
        # The first part that is missing is the one that was mistyped.
        missing = path
        while kind_of(missing.parent) == "nothing":
            missing = missing.parent
    except OSError as error:
        raise SourceError(f"{path} cannot be read: {reason(error)}") from error
    folder = missing.parent
    hint = nearest_name(missing.name, names_in(folder)) if folder.is_dir() else None
    advice = f"did you mean {folder / hint}?" if hint else f"nothing in {folder} has a name like it"
    raise SourceError(f"there is no {path}; {advice}")


def names_in(folder: pathlib.Path) -> list[str]:
    """Return the names of all that a folder holds, sorted, without hidden files such as macOS's ``._NAME``.

    Raises:
        SourceError: It cannot be read.
    """
    try:
        return sorted(entry.name for entry in folder.iterdir() if not entry.name.startswith("."))
    except OSError as error:
        raise SourceError(f"{folder} cannot be read: {reason(error)}") from error


def nearest_name(name: str, names: Iterable[str]) -> str | None:
    """The one of ``names`` that ``name`` may have meant; None if none is near."""
    return next(iter(difflib.get_close_matches(name, list(names), 1)), None)
