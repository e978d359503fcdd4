"""Base classes of all sources of frames, and checks of paths, rates and exposure times.

Every source yields a `Frame` in 8-bit RGB. A recorded source (folder, video, generated) loses no frame and is decoded a
few frames ahead on one thread. A live source never makes the camera wait: it keeps only the newest frame, because
latency matters more than completeness.
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
from warp_ar.declared import check_fields
from warp_ar.errors import SourceError, UsageError, reason, warn_renamed
from warp_ar.files import kind_of
from warp_ar.sources.deep_frame import DeepFrame, check_linear

Image = npt.NDArray[np.uint8]

DEFAULT_FPS = 30.0
"""Frame rate of a folder of frames, or of a device that states none, in frames per second."""

FRAMES_AHEAD = 4
"""Number of frames that a recorded source decodes in advance."""


@dataclasses.dataclass(frozen=True)
class Frame:
    """Picture of a source with its time and exposure."""

    index: int
    """Index of the frame, counted from 0 without gaps; continues when a looped source starts again."""

    time: float
    """Seconds since the source's first frame."""

    image: Image
    """Encoded colour, uint8 RGB, (height, width, 3), C-contiguous."""

    exposure_time: float | None = None
    """Exposure time in seconds; None if the source does not state it."""

    deep: DeepFrame | None = None
    """Picture at full bit depth, if it has more than 8 bits and ``keeps_depth`` was set on the source."""

    name: str = ""
    """Path of the frame's file; empty if it has no file of its own."""

    begins: int = 0
    """Index of the first frame of the current pass over a looped clip."""

    def __post_init__(self) -> None:
        """Check the types, and that times are finite."""
        check_fields(self)

    @property
    def plate(self) -> DeepFrame | None:
        """Former name of ``deep``."""
        warn_renamed("Frame.plate", "deep")
        return self.deep

    @property
    def deepest(self) -> DeepFrame | Image:
        """Return the deep frame if there is one, else the 8-bit picture; a pipeline with ``linear=True`` takes both."""
        return self.image if self.deep is None else self.deep


class Source(Closing):
    """Base of all sources of frames: a context manager and an iterable."""

    size: tuple[int, int]
    """(width, height) of every frame, in pixels."""

    fps: float
    """Nominal rate in frames per second."""

    tick: fractions.Fraction | None = None
    """Unit in seconds of which all frame times are whole multiples, if a recording states it; None: 1 / ``fps``."""

    length: int | None
    """Number of frames in one pass; None if unknown. A video's is read from its header or follows from its duration."""

    live: bool
    """True if frames are dropped while nobody takes them."""

    start: float = 0.0
    """``time.monotonic`` in seconds of a live source's first frame; times of its frames are relative to it."""

    description: str
    """Description for users, one line."""

    note: str = ""
    """Note for users on an unexpected conversion of the frames, one line; empty if there is none."""

    deep: str = ""
    """Kind of pictures with more than 8 bits: ``codes`` (encoded by the camera) or ``light`` (linear radiance); empty
    for pictures of 8 bits."""

    curve: str = ""
    """Transfer function of HDR pictures, ``pq`` or ``hlg``; empty for other pictures."""
    keeps_depth: bool = False
    """True to yield deep frames with the 8-bit pictures; must be set before reading."""

    memory: Callable[[], Image] | None = None
    """Function that returns an array for a frame, uint8 (height, width, 3), such as ``Pipeline.new_frame``. Sources
    that decode or convert pictures may write them into it. None: the source allocates."""

    names: tuple[str, ...] = ()
    """Paths of the frames' files; empty if frames have no files of their own."""

    exposures: tuple[float, ...] = ()
    """All exposure times of the frames in seconds, longest first; empty if unknown."""

    dropped: int = 0
    """Number of frames skipped because a newer one had arrived; 0 for recorded sources."""

    def _memory_for(self, height: int, width: int) -> Image | None:
        """Return an array for a picture of that size from ``memory``; None if the source must allocate one."""
        given = None if self.memory is None else self.memory()
        return given if given is not None and given.shape == (height, width, 3) else None

    def keep_depth(self, transfer: str) -> bool:
        """Yield deep frames if the pictures have more than 8 bits, and return True if they have.

        Args:
            transfer: Transfer function of the camera.

        Raises:
            UsageError: The pictures are linear, which does not fit the camera's transfer function.
        """
        if self.deep == "light":
            check_linear(transfer)
        self.keeps_depth = self.deep != ""
        return self.keeps_depth

    @abstractmethod
    def __iter__(self) -> Iterator[Frame]:
        """Iterate over the frames in order; a recorded source starts from its first frame at every call."""

    @abstractmethod
    def close(self) -> None:
        """Stop every thread and release files and devices; a second call does nothing."""


class RecordedSource(Source):
    """Source that can be read again from the start and loses no frames; a thread decodes it ahead of the reader."""

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
        """Yield the frames of one pass, with index and time starting at 0."""

    def __iter__(self) -> Iterator[Frame]:
        """Iterate over the frames in order, decoded ahead on a thread; every call starts from the first frame.

        Raises:
            SourceError: The source is closed; while iterating, a frame cannot be decoded or has another size.
        """
        if self._closed:
            raise SourceError(f"{self.description} is closed; open it again to read from it")
        frames = _ahead(self._passes())
        self._running.add(frames)
        return frames

    def close(self) -> None:
        """End all iterations and their threads."""
        self._closed = True
        for frames in list(self._running):
            # A generator that another thread is running cannot be closed; it ends at its next frame.
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
    """Yield the items of ``frames``, computed on a thread up to ``FRAMES_AHEAD`` items early.

    An error of ``frames`` is raised when its item is due, after all earlier items.
    """
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


class LiveSource(Source):
    """Source that keeps the newest frame of each exposure, for a reader on another thread, and counts replaced frames.

    Every exposure keeps a frame of its own, so that a slow reader does not miss the rare short exposures.
    """

    live = True
    length = None

    def __init__(self, name: str = "") -> None:
        self._name = name
        self._changed, self._stop = threading.Condition(), threading.Event()
        self._items: dict[float | None, tuple[Image, float]] = {}
        self._error: SourceError | None = None
        self._closed = False
        self._index = 0

    def _start_reading(self) -> None:
        """Start a thread that puts pictures."""
        self._thread = threading.Thread(target=self._read_all, name="warp-ar-camera", daemon=True)
        self._thread.start()

    def _read_all(self) -> None:
        failed = None
        try:
            self._run()
        except SourceError as error:
            failed = error
        except Exception as error:  # an error of any type must reach the waiting reader
            failed = SourceError(f"{self._name}: {reason(error)}")
            failed.__cause__ = error
        self._end(failed)

    def _run(self) -> None:
        """Put pictures until the source is closed."""

    def _put(self, image: Image, time: float, exposure: float | None = None) -> bool:
        """Store a picture for the reader; return False if closed.

        Args:
            image: The picture.
            time: Time of the picture on a monotonic clock, seconds.
            exposure: Exposure time in seconds; None if unknown.
        """
        with self._changed:
            if self._closed:
                return False
            self.dropped += self._items.pop(exposure, None) is not None
            self._items[exposure] = (image, time)
            self._changed.notify_all()
            return True

    def _end(self, error: SourceError | None) -> None:
        """Accept no more pictures; after the pictures that are left, iteration raises ``error`` if it is given."""
        with self._changed:
            if not self._closed:
                self._closed, self._error = True, error
            self._changed.notify_all()

    def __iter__(self) -> Iterator[Frame]:
        """Iterate over new frames, skipping all but the newest of each exposure; ends when the source is closed.

        Raises:
            SourceError: The source has failed, once no picture is left.
        """
        while True:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._items) or self._closed)
                if not self._items:
                    if self._error is not None:
                        raise self._error
                    return
                exposure = next(iter(self._items))
                image, stamp = self._items.pop(exposure)
            if self._index == 0:
                self.start = stamp
            self._index += 1
            yield Frame(self._index - 1, stamp - self.start, image, exposure)

    def close(self) -> None:
        """Accept no more frames; iteration ends after the frames that are left."""
        self._end(None)


class QueueSource(LiveSource):
    """Source whose frames are pushed by other code, for example from a web page's camera.

    Args:
        size: (width, height) of every frame, in pixels.
        description: Description for users, one line.
    """

    fps = DEFAULT_FPS

    def __init__(self, size: tuple[int, int], *, description: str = "pushed frames") -> None:
        super().__init__()
        self.size, self.description = size, f"{description} ({size[0]}x{size[1]})"

    def push(self, image: Image, time: float) -> bool:
        """Add a frame, from any thread; it replaces a frame that was not yet taken.

        Args:
            image: uint8 RGB, (height, width, 3); must not be changed afterwards.
            time: Time in seconds on any monotonic clock.

        Returns:
            False if the source is closed and the frame was ignored.

        Raises:
            SourceError: The image has another size or type than the source.
        """
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            got = f"{image.dtype} {image.shape}"
            raise SourceError(f"{self.description}: a frame is {got}, not uint8 RGB (height, width, 3)")
        check_size(image, self.size, self.description, self._index)
        return self._put(np.ascontiguousarray(image), time)


def check_size(image: Image, size: tuple[int, int], name: str, index: int | None) -> None:
    """Check that a picture has the (width, height) of the pictures before it.

    Raises:
        SourceError: The picture has another size.
    """
    height, width = image.shape[:2]
    if (width, height) != size:
        which = name if index is None else f"{name}: frame {index}"
        raise SourceError(f"{which} is {width}x{height}, not {size[0]}x{size[1]} like those before it")


def check_fps(fps: float | None) -> None:
    """Check a rate in frames per second; None is accepted.

    Raises:
        UsageError: The rate is not a positive number.
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
    """Return the distinct exposure times, longest first."""
    return tuple(sorted(set(map(float, exposures)), reverse=True))


def existing_path(path: pathlib.Path) -> pathlib.Path:
    """Return the path if frames can be read from it.

    Raises:
        SourceError: The path does not exist (the message suggests a similar name), cannot be read, or is neither file
            nor folder.
    """
    try:
        if (kind := kind_of(path)) != "nothing":
            if kind in ("file", "folder"):
                return path
            raise SourceError(f"{path} is {kind}; frames are read from folders, files and capture devices")
        # The first missing part of the path is the mistyped one.
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
    """Return the sorted names in a folder, without hidden files such as macOS's ``._NAME``.

    Raises:
        SourceError: The folder cannot be read.
    """
    try:
        return sorted(entry.name for entry in folder.iterdir() if not entry.name.startswith("."))
    except OSError as error:
        raise SourceError(f"{folder} cannot be read: {reason(error)}") from error


def nearest_name(name: str, names: Iterable[str]) -> str | None:
    """Return the one of ``names`` that is most similar to ``name``; None if none is similar."""
    return next(iter(difflib.get_close_matches(name, list(names), 1)), None)
