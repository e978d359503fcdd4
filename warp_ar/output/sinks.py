"""Frames out: numbered PNGs, H.264 video, and environments as OpenEXR.

A sink encodes on threads of its own while the next frame is being made, a few frames deep at most. What fails there is
raised by the next `write`, or by `close`. Whether a place can be written at all is found out when it is opened.

A video is a whole file at any moment: it grows in fragments of half a second, so that a process that is killed leaves
all but about its last second; `close` turns MP4 and MOV into the ordinary form that every player can seek in.
"""

from __future__ import annotations

import collections
import contextlib
import fractions
import math
import os
import pathlib
import tempfile
from abc import ABC, abstractmethod
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any, Self

import av
import av.filter
import cv2
import numpy as np
import numpy.typing as npt
import OpenEXR
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

from warp_ar.errors import SinkError, UsageError

__all__ = [
    "EnvironmentSink",
    "FolderSink",
    "NullSink",
    "Sink",
    "TeeSink",
    "VideoSink",
    "open_sink",
    "read_environment",
    "write_environment",
]

Image = npt.NDArray[np.uint8]

VIDEO_SUFFIXES = (".mp4", ".mkv", ".mov")
"""What `VideoSink` writes."""

FRAMES_WAITING = 4
"""How many frames may wait to be encoded before `Sink.write` waits."""

FOLDER_THREADS = 2
"""Threads that compress the frames of a folder."""

# Camera frames hardly repeat, so looking for repetitions costs time and saves no byte; neighbours are alike.
PNG_OPTIONS = (
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY),
)

CRF = 18
"""Quality of video: x264's constant rate factor at which a loss is hardly seen."""

FRAGMENT_SECONDS = 0.5
"""Longest time between key frames, and so between the fragments that reach the disk."""


class Sink(ABC):
    """Where frames go: a context manager."""

    description: str
    """One line for people, with a note where the frames are changed."""

    @abstractmethod
    def write(self, image: Image) -> None:
        """Take the next frame; the array may be reused at once.

        Args:
            image: Encoded colour, uint8 RGB, (height, width, 3).

        Raises:
            SinkError: The image is of another size or kind than can be written, or an earlier frame could not be
                written.
        """

    @abstractmethod
    def close(self) -> None:
        """Write what waits, finish the file and end every thread; a second call does nothing.

        Raises:
            SinkError: A frame could not be written, and no `write` has said so yet.
        """

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def open_sink(path: str | pathlib.Path, *, fps: float, size: tuple[int, int] | None = None) -> Sink:
    """A sink for ``path``: a video for .mp4, .mkv and .mov, a folder of PNGs for a name without an ending.

    Folders that are missing on the way are made.

    Args:
        path: File or folder; a folder that exists may have any name, as may one whose name ends in a slash.
        fps: Frames per second of a video.
        size: (width, height) of the frames in pixels, if known; the first frame tells otherwise.

    Raises:
        SinkError: The path cannot be written, or its ending is unknown.
        UsageError: ``fps`` is not a positive number.
    """
    named_as_folder = str(path).endswith(("/", os.sep))
    path = pathlib.Path(path)
    if path.suffix.lower() in VIDEO_SUFFIXES and not named_as_folder:
        return VideoSink(path, fps=fps, size=size)
    if path.is_dir() or not path.suffix or named_as_folder:
        return FolderSink(path)
    raise SinkError(f"{path} ends in {path.suffix}; use {', '.join(VIDEO_SUFFIXES)}, or a folder for PNG frames")


class _ThreadedSink(Sink):
    """Stores frames on threads, at most FRAMES_WAITING of them behind."""

    def __init__(self, threads: int) -> None:
        self._executor = ThreadPoolExecutor(threads, thread_name_prefix="warp-ar-sink")
        self._pending: collections.deque[Future[None]] = collections.deque()
        self._error: BaseException | None = None
        self._closed = False
        self._shape: tuple[int, ...] | None = None
        self._count = 0

    def _check(self, image: npt.NDArray[Any]) -> None:
        """Raise SinkError if the array is of a kind that cannot be written."""
        _check_image(image)

    @abstractmethod
    def _store(self, index: int, image: npt.NDArray[Any]) -> None:
        """Encode and write one frame; runs on a thread, and raises SinkError."""

    def write(self, image: npt.NDArray[Any]) -> None:
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
        self._pending.append(self._executor.submit(self._store, self._count, image.copy()))
        self._count += 1

    def _settle(self, waiting: int) -> None:
        """Wait until at most ``waiting`` frames are left, and raise what went wrong first."""
        while self._pending and (self._pending[0].done() or len(self._pending) > waiting):
            # If this wait is interrupted, the frame is still in line.
            error = self._pending[0].exception()
            self._pending.popleft()
            if error is not None and self._error is None:
                self._error = error
                raise error

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        try:
            self._settle(0)
        finally:
            self._executor.shutdown(wait=True)
            self._finish()

    def _finish(self) -> None:
        """Close what is open, after the last frame has been stored."""


class FolderSink(_ThreadedSink):
    """A folder of ``NNNN.png``, numbered from 0: frames of the same numbers are replaced, other files left alone.

    A frame appears under its name only when it is whole.

    Raises:
        SinkError: The folder cannot be made or written to.
    """

    def __init__(self, path: str | pathlib.Path) -> None:
        self._path = pathlib.Path(path)
        if self._path.exists() and not self._path.is_dir():
            raise SinkError(f"{self._path} is a file; name a folder, or a video ending in {', '.join(VIDEO_SUFFIXES)}")
        _make_folder(self._path)
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
            raise SinkError(f"{path} cannot be written: {_reason(error)}") from error


class EnvironmentSink(FolderSink):
    """A folder of ``NNNN.exr``, numbered from 0, each as `write_environment` writes it."""

    def _check(self, image: npt.NDArray[Any]) -> None:
        _check_environment(image)

    def _store(self, index: int, image: npt.NDArray[Any]) -> None:
        write_environment(self._path / f"{index:04d}.exr", image)


class VideoSink(_ThreadedSink):
    """H.264 in MP4, MOV or Matroska: yuv420p, BT.709, limited range, tagged as such.

    Chroma at half resolution needs even sizes: an odd one is padded by repeating the last row or column, and the
    description says so. A file that exists is replaced when the first frame comes; if none comes, it is left as it was.

    Args:
        path: The file.
        fps: Frames per second.
        size: (width, height) of the frames in pixels, if known.

    Raises:
        SinkError: The file cannot be written or has another ending.
        UsageError: ``fps`` is not a positive number.
    """

    def __init__(self, path: str | pathlib.Path, *, fps: float, size: tuple[int, int] | None = None) -> None:
        self._path = pathlib.Path(path)
        if not (math.isfinite(fps) and fps > 0):
            raise UsageError(f"fps is {fps}; it must be a positive number of frames per second")
        if self._path.suffix.lower() not in VIDEO_SUFFIXES:
            raise SinkError(f"{self._path} must end in {', '.join(VIDEO_SUFFIXES)} to be a video")
        if self._path.is_dir():
            raise SinkError(f"{self._path} is a folder; name a file, or a folder without {self._path.suffix}")
        _make_folder(self._path.parent)
        existed = self._path.exists()
        try:
            with self._path.open("ab"):
                pass
            if not existed:
                self._path.unlink()
        except OSError as error:
            raise SinkError(f"{self._path} cannot be written: {_reason(error)}") from error
        self._fps = fps
        self._rate = fractions.Fraction(fps).limit_denominator(1001)
        self._broken = False
        self._container: Any = None
        self._stream: Any = None
        self._converter: Any = None
        self.description = f"{self._path} (H.264, {fps:g} fps)"
        super().__init__(1)
        if size is not None:
            self._shape = (size[1], size[0], 3)
            self._describe()

    def _describe(self) -> None:
        assert self._shape is not None
        height, width = self._shape[:2]
        self.description = f"{self._path} (H.264, {width}x{height}, {self._fps:g} fps)"
        if height % 2 or width % 2:
            self.description += f", padded to {width + width % 2}x{height + height % 2}: H.264 needs even sizes"

    def write(self, image: npt.NDArray[Any]) -> None:
        """Take the next frame; the first one settles the size."""
        super().write(image)
        if self._count == 1:
            self._describe()

    def _start(self, width: int, height: int) -> None:
        movie = self._path.suffix.lower() != ".mkv"
        flags = "hybrid_fragmented+frag_keyframe+empty_moov+default_base_moof"
        fragments = {"movflags": flags} if movie else {"cluster_time_limit": str(round(1000 * FRAGMENT_SECONDS))}
        group = max(1, round(FRAGMENT_SECONDS * self._fps))
        self._container = av.open(str(self._path), "w", options={**fragments, "flush_packets": "1"})
        self._stream = self._container.add_stream(
            "libx264",
            rate=self._rate,
            options={"preset": "veryfast", "crf": str(CRF), "g": str(group)},
        )
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"
        context = self._stream.codec_context
        context.color_range, context.colorspace = ColorRange.MPEG, Colorspace.ITU709
        context.color_primaries, context.color_trc = ColorPrimaries.BT709, ColorTrc.BT709
        self._container.start_encoding()
        self._converter = _rgb_to_yuv(width, height, 1 / self._rate)

    def _store(self, index: int, image: npt.NDArray[Any]) -> None:
        if self._broken:
            return  # FFmpeg may crash when it goes on after a failure.
        height, width = image.shape[:2]
        if height % 2 or width % 2:
            image = cv2.copyMakeBorder(image, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
        try:
            if self._container is None:
                self._start(image.shape[1], image.shape[0])
            picture = av.VideoFrame.from_ndarray(image, format="rgb24")
            picture.pts, picture.time_base = index, 1 / self._rate
            self._converter.push(picture)
            picture = self._converter.pull()
            self._container.mux(self._stream.encode(picture))
        except (av.FFmpegError, OSError) as error:
            self._broken = True
            raise SinkError(f"{self._path}: frame {index} cannot be written: {_reason(error)}") from error

    def _finish(self) -> None:
        if self._container is None:
            return
        container, self._container = self._container, None
        try:
            try:
                if not self._broken:
                    container.mux(self._stream.encode(None))
            finally:
                container.close()
        except (av.FFmpegError, OSError) as error:
            # After a frame that could not be written, the end cannot be either: once is enough.
            if self._error is None:
                raise SinkError(f"{self._path} cannot be finished: {_reason(error)}") from error


def _rgb_to_yuv(width: int, height: int, time_base: fractions.Fraction) -> Any:
    """Filter from rgb24 to yuv420p as an H.264 stream means it unless it says otherwise.

    BT.709, limited range, and chroma sited at the left one of each pair of columns: the plain converter puts it between
    the two, which players show shifted by half a pixel.
    """
    graph = av.filter.Graph()
    graph.threads = 1
    nodes = (
        graph.add_buffer(width=width, height=height, format="rgb24", time_base=time_base),
        graph.add(
            "scale",
            "out_color_matrix=bt709:out_range=tv:out_chroma_loc=left:flags=bilinear+accurate_rnd+full_chroma_inp",
        ),
        graph.add("format", "yuv420p"),
        graph.add("buffersink"),
    )
    graph.link_nodes(*nodes).configure()
    return graph


class NullSink(Sink):
    """Takes frames and forgets them; ``count`` tells how many."""

    description = "nowhere"

    def __init__(self) -> None:
        self.count = 0

    def write(self, image: Image) -> None:
        """Count the frame."""
        _check_image(image)
        self.count += 1

    def close(self) -> None:
        """Do nothing."""


class TeeSink(Sink):
    """Gives each frame to several sinks, and closes them all even if one fails."""

    def __init__(self, *sinks: Sink) -> None:
        self._sinks = sinks
        self.description = " and ".join(sink.description for sink in sinks) or NullSink.description

    def write(self, image: Image) -> None:
        """Give the frame to every sink, in order."""
        for sink in self._sinks:
            sink.write(image)

    def close(self) -> None:
        """Close every sink, in order; of several errors the last is raised, the others in its context."""
        with contextlib.ExitStack() as stack:
            for sink in reversed(self._sinks):
                stack.callback(sink.close)


def write_environment(path: str | pathlib.Path, radiance: npt.NDArray[np.float32]) -> None:
    """Write a latlong environment as a 32-bit float OpenEXR, ZIP-compressed, channels R, G, B.

    Args:
        path: The file; folders that are missing on the way are made.
        radiance: Linear RGB in camera values, float32, (height, width, 3); row 0 looks toward +z, the centre column
            toward +x, columns grow toward +y.

    Raises:
        SinkError: The array is of another kind, or the file cannot be written.
    """
    path = pathlib.Path(path)
    _check_environment(radiance)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        OpenEXR.File(header, {"RGB": np.ascontiguousarray(radiance)}).write(str(path))
    except (RuntimeError, OSError) as error:
        raise SinkError(f"{path} cannot be written: {_reason(error)}") from error


def read_environment(path: str | pathlib.Path) -> npt.NDArray[np.float32]:
    """Read an OpenEXR with channels R, G, B as float32 (height, width, 3); alpha and other channels are left out.

    Raises:
        SinkError: The file is missing, no OpenEXR, or has no R, G and B.
    """
    path = pathlib.Path(path)
    if not path.is_file():
        raise SinkError(f"there is no file {path}; an environment is an OpenEXR file")
    try:
        with OpenEXR.File(str(path)) as file:
            channels = {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}
    except (RuntimeError, OSError, ValueError) as error:
        raise SinkError(f"{path} cannot be read as OpenEXR: {_reason(error)}") from error
    for name in ("RGB", "RGBA"):
        if name in channels:
            return np.ascontiguousarray(channels[name][..., :3])
    if not {"R", "G", "B"} <= channels.keys():
        raise SinkError(f"{path} has channels {', '.join(channels)}; R, G and B are needed")
    return np.stack([channels[name] for name in "RGB"], axis=-1)


def _check_environment(radiance: npt.NDArray[Any]) -> None:
    if radiance.dtype != np.float32 or radiance.ndim != 3 or radiance.shape[2] != 3 or not radiance.size:
        raise SinkError(f"an environment is float32 (height, width, 3), not {radiance.dtype} {radiance.shape}")


def _check_image(image: npt.NDArray[Any]) -> None:
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise SinkError(f"a frame is uint8 RGB (height, width, 3), not {image.dtype} {image.shape}")


def _make_folder(path: pathlib.Path) -> None:
    """Make the folder and its parents, and find out whether files can be made in it."""
    if path.exists() and not path.is_dir():
        raise SinkError(f"{path} is a file, not a folder to write to")
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise SinkError(
            f"{path} cannot be written to: {_reason(error)}; name a folder that you may write to"
        ) from error


def _reason(error: BaseException) -> str:
    """What went wrong, on one line."""
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(str(text).split())
