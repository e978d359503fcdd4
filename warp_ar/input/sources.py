"""Frames in: image folders, video files, capture devices, generated clips and a queue that others push into.

Every source yields the same object, a `Frame` in 8-bit RGB, and falls into one of two kinds. A recorded source (folder,
video, generated) loses no frame and is decoded a few frames ahead on one thread. A live source (device, queue) holds
one frame, the newest, because a late frame is worth less than none; what it skips is counted in ``dropped``.

Pictures of other kinds are brought to 8-bit RGB: grey is repeated, alpha is dropped without blending (a camera's colour
does not depend on it), 16-bit values v become round(v / 257), so that 65535 is 255. An orientation that an image or a
video carries is applied.

Frames may alternate between exposures, of which only one is shown: the others tell what clips in it. A folder says so
in its sidecar, ``exposures.json``; any recording by a list of times that its frames have in turn; a capture device is
asked for them, and each of its pictures is measured, because devices follow some frames late.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import difflib
import functools
import itertools
import json
import math
import pathlib
import re
import threading
import time
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any, Protocol, Self

import av
import cv2
import numpy as np
import numpy.typing as npt
from av.video.reformatter import Colorspace, Interpolation, VideoReformatter

from warp_ar.errors import SourceError, UsageError

__all__ = [
    "CaptureDevice",
    "Frame",
    "FrameFolder",
    "QueueSource",
    "Source",
    "Synthetic",
    "VideoFile",
    "open_source",
]

Image = npt.NDArray[np.uint8]

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"})
"""What `FrameFolder` takes for a frame; other files in a folder are ignored."""

SIDECAR = "exposures.json"
"""Optional file in a frame folder, seconds of exposure: ``{"0000.png": 0.008, ...}`` by file name, or ``[0.016,
0.001]``, which frames have in turn."""

DEFAULT_FPS = 30.0
"""Rate of a folder of frames, or of a device that does not tell, in frames per second."""

FRAMES_AHEAD = 4
"""How many frames a recorded source decodes before they are asked for."""

BRACKET_SECONDS = 0.4
"""How often a capture device is asked for its other exposures, during which the picture stands still."""
SETTLE_FRAMES = 5
"""Frames after which a device is expected to have taken on its first exposure."""
MOST_WAIT = 12
"""Frames within which a device must have taken on another."""
MOST_MISSES = 3
"""Times in a row that it may fail to."""
LEAST_RATIO = 1.8
"""Of neighbouring exposures of a device: nearer ones cannot be told apart by what they show."""

HD_HEIGHT = 720
"""Rows from which a video that names no colour matrix is BT.709; below, BT.601: what players do, and encoders
expect."""

# Nearest-neighbour chroma shifts coloured edges by up to a pixel, and truncated products darken by a level or two.
_TO_RGB = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT


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


class Source(ABC):
    """Where frames come from: a context manager, and iterable."""

    size: tuple[int, int]
    """(width, height) of every frame, in pixels."""

    fps: float
    """Nominal rate in frames per second."""

    length: int | None
    """Number of frames in one pass where it is known; a video's is what its header says, or its duration tells."""

    live: bool
    """Whether frames are lost when nobody takes them in time."""

    description: str
    """One line for people."""

    exposures: tuple[float, ...] = ()
    """All exposure times of its frames in seconds, longest first; empty where it does not tell."""

    @property
    def dropped(self) -> int:
        """Frames that were skipped because a newer one had come; 0 unless live."""
        return 0

    @abstractmethod
    def __iter__(self) -> Iterator[Frame]:
        """Frames in order; a recorded source starts from its first frame at every call."""

    @abstractmethod
    def close(self) -> None:
        """Stop every thread and release files and devices; a second call does nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def open_source(
    spec: str | int | pathlib.Path, *, fps: float | None = None, loop: bool = False, exposures: Sequence[float] = ()
) -> Source:
    """Open whatever ``spec`` names.

    Args:
        spec: A folder of images, an image, a video file, the index of a capture device (a number, also as text), the
            URL of a camera's stream (``rtsp://...``), or ``synthetic:NAME``.
        fps: Frames per second: the rate of a folder (default 30), a new rate for a video's frames, or what is asked of
            a device.
        loop: Start again at the end, with index and time going on. Without effect on live sources.
        exposures: Exposure times in seconds that frames have in turn: those of a recording, or to be asked of a device.

    Raises:
        SourceError: There is no such source, or it cannot be read.
        UsageError: ``fps`` is not a positive number, ``exposures`` are no times, or there is no generated source of
            that name.
    """
    _check_fps(fps)
    _check_exposures(exposures)
    text = str(spec)
    if isinstance(spec, int) or (text.isdecimal() and not pathlib.Path(text).exists()):
        return CaptureDevice(int(spec) if isinstance(spec, int) else int(text), fps=fps, exposures=exposures)
    if text.startswith("synthetic:"):
        return Synthetic(text.removeprefix("synthetic:"), fps=fps or DEFAULT_FPS, loop=loop)
    if "://" in text:
        return CaptureDevice(text, fps=fps, exposures=exposures)
    path = _existing(pathlib.Path(spec))
    if path.is_dir() or path.suffix.lower() in IMAGE_SUFFIXES:
        return FrameFolder(path, fps=fps or DEFAULT_FPS, loop=loop, exposures=exposures)
    return VideoFile(path, fps=fps, loop=loop, exposures=exposures)


# ----------------------------------------------------------------------------------------------------- recorded sources


class _RecordedSource(Source):
    """A source that can be read again from the start: decoded ahead on a thread, looped if asked, no frame lost."""

    live = False

    def __init__(self, *, loop: bool, exposures: Sequence[float] = ()) -> None:
        _check_exposures(exposures)
        self._cycle = tuple(map(float, exposures))
        self.exposures = _distinct(self._cycle)
        self._loop = loop
        self._closed = False
        self._running: weakref.WeakSet[Generator[Frame, None, None]] = weakref.WeakSet()

    @abstractmethod
    def _decode(self) -> Generator[Frame, None, None]:
        """One pass over the frames, index and time from 0."""

    def __iter__(self) -> Iterator[Frame]:
        if self._closed:
            raise SourceError(f"{self.description} is closed; open it again to read from it")
        frames = _ahead(self._passes())
        self._running.add(frames)
        return frames

    def close(self) -> None:
        self._closed = True
        for frames in list(self._running):
            frames.close()

    def _passes(self) -> Generator[Frame, None, None]:
        index, start, last = 0, 0.0, 0.0
        while True:
            with contextlib.closing(self._decode()) as frames:
                for frame in frames:
                    last = start + frame.time
                    exposure = self._cycle[frame.index % len(self._cycle)] if self._cycle else frame.exposure_time
                    yield dataclasses.replace(frame, index=index, time=last, exposure_time=exposure)
                    index += 1
            if not self._loop:
                return
            start = last + 1.0 / self.fps


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


class FrameFolder(_RecordedSource):
    """The images of a folder in natural name order (``f2.png`` before ``f10.png``), or one image.

    Args:
        path: The folder or image.
        fps: Frames per second; frame n is shown at n / fps.
        loop: Start again at the end.
        exposures: Exposure times in seconds that images have in turn, instead of what ``exposures.json`` says.

    Raises:
        SourceError: The path does not exist, holds no image, its first image or its ``exposures.json`` cannot be used.
    """

    def __init__(
        self,
        path: str | pathlib.Path,
        *,
        fps: float = DEFAULT_FPS,
        loop: bool = False,
        exposures: Sequence[float] = (),
    ) -> None:
        super().__init__(loop=loop, exposures=exposures)
        _check_fps(fps)
        path = _existing(pathlib.Path(path))
        folder = path if path.is_dir() else path.parent
        self._paths = [path]
        if path.is_dir():
            images = (name for name in _names(path) if pathlib.Path(name).suffix.lower() in IMAGE_SUFFIXES)
            self._paths = [path / name for name in sorted(images, key=_natural_key)]
        if not self._paths:
            raise SourceError(f"{path} holds no images; put frames there as {', '.join(sorted(IMAGE_SUFFIXES))}")
        told = _read_exposures(folder)
        self._exposures = told if isinstance(told, dict) else {}
        if isinstance(told, tuple):
            self._cycle = self._cycle or told
        shown = [self._exposures[path.name] for path in self._paths if path.name in self._exposures]
        self.exposures = _distinct(self._cycle or shown)
        height, width, _ = read_image(self._paths[0]).shape
        self.size, self.fps, self.length = (width, height), fps, len(self._paths)
        self.description = f"{path} ({self.length} images, {width}x{height})"

    def _decode(self) -> Generator[Frame, None, None]:
        for index, path in enumerate(self._paths):
            image = read_image(path)
            _check_size(image, self.size, str(path), index)
            yield Frame(index, index / self.fps, image, self._exposures.get(path.name))


class VideoFile(_RecordedSource):
    """A video file, its first video stream, turned upright as its metadata says.

    Colour is converted with the stream's own matrix and range; one that names none is taken as BT.709 from 720 rows up,
    else BT.601. Frame times are the file's own (a variable rate is kept), counted from the first frame.

    Args:
        path: The file.
        fps: Show frame n at n / fps instead of at its own time.
        loop: Start again at the end.
        exposures: Exposure times in seconds that frames have in turn.

    Raises:
        SourceError: The file does not exist, is no video, or its first frame cannot be decoded.
    """

    def __init__(
        self,
        path: str | pathlib.Path,
        *,
        fps: float | None = None,
        loop: bool = False,
        exposures: Sequence[float] = (),
    ) -> None:
        super().__init__(loop=loop, exposures=exposures)
        _check_fps(fps)
        self._path = _existing(pathlib.Path(path))
        self._retimed = fps is not None
        if self._path.is_dir():
            raise SourceError(f"{self._path} is a folder, not a video file")
        if self._path.stat().st_size == 0:
            raise SourceError(f"{self._path} is empty (0 bytes); a video file is needed")
        with self._open() as container:
            stream = container.streams.video[0]
            rate = float(stream.average_rate or stream.guessed_rate or DEFAULT_FPS)
            seconds = float(container.duration or 0) / av.time_base
            self.fps = fps or rate
            self.length = int(stream.frames) or round(seconds * rate) or None
            codec = stream.codec_context.name
            first = next(self._pictures(container), None)
        if first is None:
            raise SourceError(f"{self._path}: frame 0 cannot be decoded: the video stream holds no picture")
        height, width, _ = first[0].shape
        self.size = (width, height)
        self.description = f"{self._path} ({codec}, {width}x{height}, {self.fps:g} fps)"

    def _open(self) -> Any:
        try:
            container = av.open(str(self._path))
        except (av.FFmpegError, OSError) as error:
            raise SourceError(
                f"{self._path} cannot be read as a video ({_reason(error)}): damaged, cut off, or no video file"
            ) from error
        # FFmpeg draws any text file as a picture.
        if not container.streams.video or container.format.name == "tty":
            kinds = (
                "text"
                if container.format.name == "tty"
                else ", ".join(sorted({stream.type for stream in container.streams})) or "nothing"
            )
            container.close()
            raise SourceError(f"{self._path} has no video stream, only {kinds}; choose a file with pictures")
        return container

    def _decode(self) -> Generator[Frame, None, None]:
        with self._open() as container:
            first, previous = None, -math.inf
            for index, (image, stamp) in enumerate(self._pictures(container)):
                _check_size(image, self.size, str(self._path), index)
                if self._retimed or stamp is None:
                    seconds = index / self.fps if self._retimed or index == 0 else previous + 1.0 / self.fps
                else:
                    first = stamp if first is None else first
                    # Time never stands still or runs back, whatever a broken recorder wrote.
                    seconds = stamp - first if stamp - first > previous else previous + 1.0 / self.fps
                previous = seconds
                yield Frame(index, seconds, image)

    def _pictures(self, container: Any) -> Generator[tuple[Image, float | None], None, None]:
        """Every picture with its time stamp in seconds; whatever precedes damage comes before the error."""
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        to_rgb = functools.partial(_rgb_from_video, VideoReformatter())
        count, packets, damage = 0, 0, ""
        demuxer = container.demux(stream)
        while not damage:
            pictures = []
            try:
                packet = next(demuxer, None)
                if packet is None:
                    break
                # A transport stream marks every gap so, and is made to go on after it.
                if packet.is_corrupt and container.format.name != "mpegts":
                    damage = "the file is cut off or damaged there"
                    break
                packets += packet.size > 0
                pictures = packet.decode()
            except (av.FFmpegError, OSError) as error:
                damage = _reason(error)
            for picture in pictures:
                yield to_rgb(picture), picture.time
                count += 1
        # An MP4's header counts its samples exactly; a file cut between two of them ends like a whole one.
        if not damage and "mp4" in container.format.name and packets < stream.frames:
            damage = f"the file is cut off: its header promises {stream.frames} frames"
        if damage:
            # Threads and reordering hold frames back; those before the damage are still good.
            with contextlib.suppress(av.FFmpegError):
                for picture in stream.decode(None):
                    yield to_rgb(picture), picture.time
                    count += 1
            raise SourceError(f"{self._path}: frame {count} cannot be decoded: {damage}; frames before it are good")


def _rgb_from_video(reformatter: VideoReformatter, picture: Any) -> Image:
    """Upright 8-bit RGB of a decoded picture, with the picture's own colour matrix and range."""
    matrix = None
    if picture.colorspace not in {int(known) for known in Colorspace}:
        matrix = Colorspace.ITU709 if picture.height >= HD_HEIGHT else Colorspace.ITU601
    rgb = reformatter.reformat(picture, format="rgb24", src_colorspace=matrix, interpolation=_TO_RGB, threads=1)
    # Both count the angle counterclockwise.
    return np.ascontiguousarray(np.rot90(rgb.to_ndarray(), round(picture.rotation / 90)))


class Synthetic(_RecordedSource):
    """A generated clip, the same in every run.

    ``checker`` is a sliding checkerboard. ``card`` is a marker seen by a moving camera, with known truth: `pose` and
    `camera_matrix`; the marker is ``DICT_4X4_50`` number 0, its black square ``MARKER_SIZE`` metres wide.

    Args:
        name: ``card`` or ``checker``.
        size: (width, height) in pixels.
        fps: Frames per second.
        length: Number of frames.
        loop: Start again at the end.

    Raises:
        UsageError: There is no such clip.
    """

    NAMES = ("card", "checker")
    MARKER_SIZE = 0.08

    def __init__(
        self,
        name: str = "card",
        *,
        size: tuple[int, int] = (640, 480),
        fps: float = DEFAULT_FPS,
        length: int = 96,
        loop: bool = False,
    ) -> None:
        super().__init__(loop=loop)
        _check_fps(fps)
        if name not in self.NAMES:
            hint = _nearest(name, self.NAMES) or " or ".join(self.NAMES)
            raise UsageError(f"there is no synthetic source {name!r}; did you mean {hint}?")
        if min(size) < 1 or length < 1:
            raise UsageError(f"a synthetic source needs a positive size and length, not {size} and {length}")
        self.name, self.size, self.fps, self.length = name, size, fps, length
        self.description = f"synthetic {name} ({size[0]}x{size[1]}, {length} frames)"

    @property
    def camera_matrix(self) -> npt.NDArray[np.float64]:
        """Pinhole matrix of ``card``, (3, 3), in pixels with centres at integers."""
        width, height = self.size
        focal = 0.9 * width
        return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])

    def pose(self, index: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """(R, t) of ``card``'s frame: marker-frame points X in metres are R X + t in the camera's (x right, y down)."""
        phase = 2 * math.pi * index / (self.length or 1)
        flip = np.diag([1.0, -1.0, -1.0])
        tilt = cv2.Rodrigues(np.array([math.radians(-35 + 8 * math.sin(phase)), 0.0, 0.0]))[0]
        spin = cv2.Rodrigues(np.array([0.0, 0.0, math.radians(15 * math.cos(phase))]))[0]
        return flip @ tilt @ spin, np.array([0.03 * math.sin(phase), 0.02 * math.cos(phase), 0.35])

    def _decode(self) -> Generator[Frame, None, None]:
        draw = self._draw_card if self.name == "card" else self._draw_checker
        for index in range(self.length or 0):
            yield Frame(index, index / self.fps, draw(index))

    def _draw_card(self, index: int) -> Image:
        cells, pixels, scale = 6, 32, 2
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        marker = np.pad(cv2.aruco.generateImageMarker(dictionary, 0, cells * pixels), 2 * pixels, constant_values=240)
        metres, middle = self.MARKER_SIZE / (cells * pixels), (marker.shape[0] - 1) / 2
        world_from_texel = np.array([[metres, 0, -middle * metres], [0, -metres, middle * metres], [0, 0, 1]])
        rotation, translation = self.pose(index)
        pixel_from_world = self.camera_matrix @ np.column_stack([rotation[:, :2], translation])
        # Drawn twice as large and averaged; a coarse pixel's centre lies half a fine pixel past the even fine one.
        fine_from_pixel = np.array([[scale, 0, (scale - 1) / 2], [0, scale, (scale - 1) / 2], [0, 0, 1]])
        width, height = self.size
        fine = cv2.warpPerspective(
            marker,
            fine_from_pixel @ pixel_from_world @ world_from_texel,
            (scale * width, scale * height),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=120,
        )
        grey = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA)
        return np.ascontiguousarray(np.repeat(grey[..., None], 3, axis=2).astype(np.uint8))

    def _draw_checker(self, index: int) -> Image:
        width, height = self.size
        dark = (((np.arange(width) + index) // 32)[None, :] + (np.arange(height) // 32)[:, None]) % 2 == 0
        return np.where(dark[..., None], np.array([40, 60, 90], np.uint8), np.array([220, 200, 170], np.uint8))


# --------------------------------------------------------------------------------------------------------- live sources


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


class _LiveSource(Source):
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
        self._newest.close()


class QueueSource(_LiveSource):
    """Frames that somebody else pushes, such as a web page with a camera.

    Args:
        size: (width, height) of every frame, in pixels.
        fps: Nominal rate in frames per second.
        description: One line for people.
    """

    def __init__(self, size: tuple[int, int], *, fps: float = DEFAULT_FPS, description: str = "pushed frames") -> None:
        super().__init__()
        _check_fps(fps)
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
        _check_size(image, self.size, self.description, self._index)
        return self._newest.put(np.ascontiguousarray(image), time)


class _Capture(Protocol):
    """The part of ``cv2.VideoCapture`` that `CaptureDevice` uses."""

    def isOpened(self) -> bool: ...
    def read(self) -> tuple[bool, npt.NDArray[Any] | None]: ...
    def get(self, key: int, /) -> float: ...
    def getBackendName(self) -> str: ...
    def set(self, key: int, value: float, /) -> bool: ...
    def release(self) -> None: ...


class _Bracketing:
    """Asks a device for one exposure after another, and knows which of them a picture was taken with.

    A device takes some frames to follow. How bright a picture is, against the last one of the longest exposure, says
    whether it has: over the pixels that are well exposed there, the ratio of linear values is that of the times.
    """

    def __init__(self, capture: _Capture, exposures: tuple[float, ...], name: str) -> None:
        self._capture, self.exposures, self._name = capture, exposures, name
        backend = capture.getBackendName()
        self._logarithmic = backend in ("DSHOW", "MSMF")
        capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, 0.25 if self._logarithmic else 1.0)
        self._reference: npt.NDArray[np.float32] | None = None
        self._asked, self._waited, self._settled = 0, 0, False
        self._misses, self._since = 0, 0.0
        self._ask(0)

    def _ask(self, index: int) -> None:
        """Ask for an exposure: drivers of Windows take the logarithm of seconds, others ten-thousandths of one."""
        seconds = self.exposures[index]
        value = math.log2(seconds) if self._logarithmic else 1e4 * seconds
        if not self._capture.set(cv2.CAP_PROP_EXPOSURE, value):
            raise SourceError(
                f"{self._name} does not let its exposure be set to {seconds:g} s; leave exposures out of [source]"
            )
        self._asked, self._waited, self._settled = index, 0, False

    def label(self, image: Image, now: float) -> float | None:
        """Exposure of a picture in seconds; None while the device is between two.

        Raises:
            SourceError: The device does not follow.
        """
        sparse = _DECODE[image[::8, ::8]]
        if not self._settled:
            self._waited += 1
            if self._reference is None:
                self._settled = self._waited > SETTLE_FRAMES
            else:
                self._settled = self._shows(sparse)
            if not self._settled:
                if self._reference is not None and self._waited >= MOST_WAIT:
                    self._give_up(now)
                return None
        seconds = self.exposures[self._asked]
        if self._asked == 0:
            if self._reference is None:
                self._since = now
            self._reference = sparse
            if now - self._since >= BRACKET_SECONDS:
                self._ask(1)
        else:
            self._misses, self._since = 0, now
            self._ask((self._asked + 1) % len(self.exposures))
        return seconds

    def _give_up(self, now: float) -> None:
        """The device is late, or the environment has changed meanwhile: begin anew with the longest exposure."""
        self._misses += self._asked != 0
        if self._misses >= MOST_MISSES:
            raise SourceError(
                f"{self._name} does not follow its exposure: asked for {self.exposures[self._asked]:g} s, the picture "
                "is no darker; leave exposures out of [source]"
            )
        self._ask(0)
        self._since, self._reference = now, None

    def _shows(self, sparse: npt.NDArray[np.float32]) -> bool:
        """Whether a picture is as bright as the exposure that was asked for makes it, rather than another."""
        assert self._reference is not None
        well = (self._reference > 0.05) & (self._reference < 0.9)
        if well.sum() < 30:
            return self._waited > SETTLE_FRAMES  # too dark an environment to tell
        ratio = float(sparse[well].sum() / self._reference[well].sum())
        if ratio <= 0.0:
            return self._asked == len(self.exposures) - 1
        steps = [abs(math.log(ratio * self.exposures[0] / seconds)) for seconds in self.exposures]
        return int(np.argmin(steps)) == self._asked


_DECODE = (((np.arange(256) / 255 + 0.055) / 1.055) ** 2.4).astype(np.float32)
"""About what any camera's codes mean in linear light: ratios of some powers of two need no better."""


class CaptureDevice(_LiveSource):
    """A camera through OpenCV: a thread reads all the time and keeps the newest frame.

    Args:
        device: Index of the device, or the URL of a stream.
        fps: Rate to ask the device for, in frames per second.
        grace: Seconds without a frame after which the device counts as unplugged.
        exposures: Exposure times in seconds between which to alternate: mostly the longest, the others now and then.
        opener: Makes the capture; another one serves tests and unusual backends.

    Raises:
        SourceError: The device cannot be opened, gives no frame or does not let its exposure be set; while iterating,
            it has been unplugged, changed its size or does not follow its exposure.
        UsageError: ``exposures`` are too near each other to be told apart.
    """

    def __init__(
        self,
        device: int | str,
        *,
        fps: float | None = None,
        grace: float = 2.0,
        exposures: Sequence[float] = (),
        opener: Callable[[Any], _Capture] = cv2.VideoCapture,
    ) -> None:
        super().__init__()
        _check_fps(fps)
        self._name = f"capture device {device}" if isinstance(device, int) else str(device)
        self._grace = grace
        _check_exposures(exposures)
        self.exposures = _distinct(exposures)
        if any(longer < LEAST_RATIO * shorter for longer, shorter in itertools.pairwise(self.exposures)):
            raise UsageError(
                f"exposures {', '.join(f'{e:g}' for e in self.exposures)} of {self._name}: expected each to be "
                f"{LEAST_RATIO:g} times the next or more"
            )
        self._bracketing: _Bracketing | None = None
        self._stop = threading.Event()
        self._capture = opener(device)
        try:
            if not self._capture.isOpened():
                raise SourceError(f"{self._name} cannot be opened; is it plugged in, and free of other programs?")
            if fps is not None:
                self._capture.set(cv2.CAP_PROP_FPS, fps)
            first = self._read()
            if first is None:
                raise SourceError(f"{self._name} opened but gave no frame; is another program using it?")
            if len(self.exposures) > 1:
                self._bracketing = _Bracketing(self._capture, self.exposures, self._name)
        except BaseException:
            self._capture.release()
            raise
        self.size = (first.shape[1], first.shape[0])
        told = self._capture.get(cv2.CAP_PROP_FPS)
        self.fps = told if math.isfinite(told) and told > 0 else fps or DEFAULT_FPS
        self.description = f"{self._name} ({self.size[0]}x{self.size[1]}, {self.fps:g} fps)"
        if self._bracketing is None:
            self._newest.put(first, time.monotonic())
        self._thread = threading.Thread(target=self._run, name="warp-ar-capture", daemon=True)
        self._thread.start()

    def _read(self) -> Image | None:
        """The next frame; None once nothing has come for the time of grace, or when told to stop."""
        deadline = time.monotonic() + self._grace
        while not self._stop.is_set():
            ok, picture = self._capture.read()
            if ok and picture is not None and picture.size:
                return _rgb8(picture[..., 2::-1] if picture.ndim == 3 else picture, self._name)
            if time.monotonic() > deadline:
                return None
            self._stop.wait(0.01)
        return None

    def _run(self) -> None:
        error = None
        while not self._stop.is_set():
            try:
                image = self._read()
                if image is None:
                    if not self._stop.is_set():
                        error = SourceError(f"{self._name} gave no frame for {self._grace:g} s; was it unplugged?")
                    break
                _check_size(image, self.size, self._name, None)
                now, exposure = time.monotonic(), None
                if self._bracketing is not None:
                    exposure = self._bracketing.label(image, now)
                    if exposure is None:
                        continue
            except SourceError as problem:
                error = problem
                break
            except cv2.error as problem:
                error = SourceError(f"{self._name}: {_reason(problem)}")
                break
            self._newest.put(image, now, exposure)
        self._newest.close(error)

    def close(self) -> None:
        """End the reader and release the device."""
        self._stop.set()
        super().close()
        self._thread.join()
        self._capture.release()


# --------------------------------------------------------------------------------------------------------------- images


def read_image(path: pathlib.Path) -> Image:
    """8-bit RGB of an image file, as the module's docstring says."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"frame {path} cannot be read: {_reason(error)}") from error
    if not data:
        raise SourceError(f"frame {path} is empty (0 bytes); an image is needed")
    # libpng would refuse a file without its last chunk too, but writes to stderr when it does.
    if data.startswith(b"\x89PNG") and b"IEND\xaeB`\x82" not in data:
        raise SourceError(f"frame {path} is cut off after {len(data)} bytes; copy the whole file")
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH)
    except cv2.error as error:
        raise SourceError(f"frame {path} cannot be decoded: {_reason(error)}") from error
    if picture is None:
        raise SourceError(f"frame {path} cannot be decoded: damaged, cut off, or no image")
    return _rgb8(picture, f"frame {path}")


def _rgb8(picture: npt.NDArray[Any], name: str) -> Image:
    """(H, W, 3) uint8 from grey, RGB or RGBA of 8 or 16 bits."""
    if picture.dtype == np.uint16:
        # Rounds v / 257 exactly: 257 is odd, so there are no ties.
        picture = ((picture.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if picture.dtype != np.uint8:
        raise SourceError(f"{name} holds {picture.dtype} values; 8- or 16-bit whole numbers are needed")
    if picture.ndim == 2:
        picture = picture[..., None]
    if picture.shape[2] == 1:
        picture = np.repeat(picture, 3, axis=2)
    return np.ascontiguousarray(picture[..., :3])


def _check_size(image: Image, size: tuple[int, int], name: str, index: int | None) -> None:
    height, width = image.shape[:2]
    if (width, height) != size:
        which = name if index is None else f"{name}: frame {index}"
        raise SourceError(f"{which} is {width}x{height}, not {size[0]}x{size[1]} like those before it")


def _check_fps(fps: float | None) -> None:
    if fps is not None and not (math.isfinite(fps) and fps > 0):
        raise UsageError(f"fps is {fps}; it must be a positive number of frames per second")


def _check_exposures(exposures: Sequence[float]) -> None:
    if not all(math.isfinite(seconds) and seconds > 0 for seconds in exposures):
        raise UsageError(f"exposures {', '.join(map(str, exposures))}: expected positive numbers of seconds")


def _distinct(exposures: Iterable[float]) -> tuple[float, ...]:
    """Every exposure once, longest first."""
    return tuple(sorted(set(map(float, exposures)), reverse=True))


def _read_exposures(folder: pathlib.Path) -> dict[str, float] | tuple[float, ...]:
    """Exposures in seconds by file name or in turn, from the folder's sidecar; empty where there is none."""
    path = folder / SIDECAR
    if not path.exists():
        return {}
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise SourceError(f"{path} cannot be read: {_reason(error)}") from error
    if not isinstance(table, dict | list) or not table:
        raise SourceError(
            f'{path} must hold an object such as {{"0000.png": 0.008}}, seconds by file name, or a list such as '
            "[0.016, 0.001], seconds that frames have in turn"
        )
    names = _names(folder)
    for name, seconds in table.items() if isinstance(table, dict) else enumerate(table):
        if isinstance(name, str) and name not in names:
            hint = _nearest(name, names)
            advice = f"did you mean {hint!r}?" if hint else "it must name files beside it"
            raise SourceError(f"{path} names {name!r}, which is not there; {advice}")
        if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not 0 < seconds < math.inf:
            raise SourceError(f"{path}: {name!r} is {seconds!r}; it must be a positive number of seconds")
    if isinstance(table, list):
        return tuple(map(float, table))
    return {name: float(seconds) for name, seconds in table.items()}


# -------------------------------------------------------------------------------------------------------- names, errors


def _natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sorts runs of digits by value; the last part keeps ``f01`` and ``f1`` in one order on every machine."""
    parts = [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name) if part]
    return [*parts, (2, 0, name)]


def _existing(path: pathlib.Path) -> pathlib.Path:
    """``path`` if it exists, else an error that names the nearest object that does."""
    try:
        if path.exists():
            return path
        # The first part that is missing is the one that was mistyped.
        missing = path
        while not missing.parent.exists():
            missing = missing.parent
    except OSError as error:
        raise SourceError(f"{path} cannot be read: {_reason(error)}") from error
    folder = missing.parent
    hint = _nearest(missing.name, _names(folder)) if folder.is_dir() else None
    advice = f"did you mean {folder / hint}?" if hint else f"nothing in {folder} has a name like it"
    raise SourceError(f"there is no {path}; {advice}")


def _names(folder: pathlib.Path) -> list[str]:
    try:
        return sorted(entry.name for entry in folder.iterdir())
    except OSError as error:
        raise SourceError(f"{folder} cannot be read: {_reason(error)}") from error


def _nearest(name: str, names: Iterable[str]) -> str | None:
    return next(iter(difflib.get_close_matches(name, list(names), 1)), None)


def _reason(error: BaseException) -> str:
    """What went wrong, on one line, without the path that the message around it names already."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(str(text).split())
