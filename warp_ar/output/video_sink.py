"""Frames as H.264 video.

A video is a whole file at any moment: it grows in fragments of half a second, so that a process that is killed leaves
all but about its last second; `close` turns MP4 and MOV into the ordinary form that every player can seek in.
"""

from __future__ import annotations

import fractions
import math
import pathlib
from collections.abc import Mapping
from typing import Any

import av
import av.filter
import cv2
import numpy.typing as npt
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

from warp_ar.errors import SinkError, UsageError, reason
from warp_ar.output.places import check_replaceable
from warp_ar.output.sink import ThreadedSink, make_folder
from warp_ar.output.whole_fragments import WholeFragments
from warp_ar.signature import PROGRAM

_FORMATS = {".mp4": "mp4", ".mkv": "matroska", ".mov": "mov"}
VIDEO_SUFFIXES = tuple(_FORMATS)
"""What `VideoSink` writes."""

CRF = 18
"""Quality of video: x264's constant rate factor at which a loss is hardly seen."""

FRAGMENT_SECONDS = 0.5
"""Longest time between key frames, and so between the fragments that reach the disk."""


class VideoSink(ThreadedSink):
    """H.264 in MP4, MOV or Matroska: yuv420p, BT.709, limited range, tagged as such.

    Chroma at half resolution needs even sizes: an odd one is padded by repeating the last row or column, and the
    description says so. A file that exists is replaced when the first frames are on the disk; if none come, or none
    fits there, it is left as it was.

    Args:
        path: The file.
        fps: Frames per second.
        size: (width, height) of the frames in pixels, if known.
        overwrite: Whether a file that this program did not write may be replaced.

    Raises:
        SinkError: The file cannot be written, may not be replaced, or has another ending.
        UsageError: ``fps`` is not a positive number.
    """

    def __init__(
        self, path: str | pathlib.Path, *, fps: float, size: tuple[int, int] | None = None, overwrite: bool = False
    ) -> None:
        self._path = pathlib.Path(path)
        if not (math.isfinite(fps) and fps > 0):
            raise UsageError(f"fps is {fps}; it must be a positive number of frames per second")
        if self._path.suffix.lower() not in VIDEO_SUFFIXES:
            raise SinkError(f"{self._path} must end in {', '.join(VIDEO_SUFFIXES)} to be a video")
        self.replaced = check_replaceable(self._path, overwrite=overwrite)
        make_folder(self._path.parent)
        self._fps = fps
        self._rate = fractions.Fraction(fps).limit_denominator(1001)
        self._broken = False
        self._container: Any = None
        self._file: WholeFragments | None = None
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
        self._file = WholeFragments(self._path, boxes=movie)
        options = {**fragments, "flush_packets": "1"}
        self._container = av.open(self._file, "w", format=_FORMATS[self._path.suffix.lower()], options=options)
        self._container.metadata["comment"] = PROGRAM
        self._stream = add_h264(self._container, self._rate, width, height, {"g": str(group)})
        self._container.start_encoding()
        self._converter = rgb_to_yuv(width, height, 1 / self._rate)

    def _store(self, index: int, image: npt.NDArray[Any]) -> None:
        if self._broken:
            return  # FFmpeg may crash when it goes on after a failure.
        image = of_even_size(image)
        try:
            if self._container is None:
                self._start(image.shape[1], image.shape[0])
            picture = av.VideoFrame.from_ndarray(image, format="rgb24")
            picture.pts, picture.time_base = index, 1 / self._rate
            self._converter.push(picture)
            picture = self._converter.pull()
            self._container.mux(self._stream.encode(picture))
            self._check_file()
        except (av.FFmpegError, OSError) as error:
            self._broken = True
            raise SinkError(f"{self._path}: frame {index} cannot be written: {reason(error)}") from error

    def _check_file(self) -> None:
        if self._file is not None and self._file.error is not None:
            raise self._file.error

    def _finish(self) -> None:
        container, self._container = self._container, None
        try:
            try:
                if container is not None and not self._broken:
                    container.mux(self._stream.encode(None))
            finally:
                if container is not None:
                    container.close()
                if self._file is not None:
                    self._file.close()
            self._check_file()
        except (av.FFmpegError, OSError) as error:
            # After a frame that could not be written, the end cannot be either: once is enough.
            if self._error is None:
                raise SinkError(f"{self._path} cannot be finished: {reason(error)}") from error
        finally:
            if self._broken or (self._file is not None and self._file.error is not None):
                self.written = _count_frames(self._path)


def _count_frames(path: pathlib.Path) -> int:
    """Frames of a video that was not finished, of which the encoder held some back."""
    try:
        with av.open(str(path)) as container:
            return sum(packet.size > 0 for packet in container.demux(video=0))
    except (av.FFmpegError, OSError, ValueError):
        return 0


def add_h264(container: Any, rate: fractions.Fraction, width: int, height: int, options: Mapping[str, str]) -> Any:
    """A stream of H.264 in a new container, of colours as they are commonly understood.

    Args:
        container: PyAV's.
        rate: Frames per second.
        width: Even.
        height: Even.
        options: Of x264, besides speed and quality.
    """
    stream = container.add_stream("libx264", rate=rate, options={"preset": "veryfast", "crf": str(CRF), **options})
    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
    context = stream.codec_context
    context.color_range, context.colorspace = ColorRange.MPEG, Colorspace.ITU709
    context.color_primaries, context.color_trc = ColorPrimaries.BT709, ColorTrc.BT709
    return stream


def of_even_size(image: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """A picture whose last row or column stands twice where its size is odd: chroma has half the size."""
    height, width = image.shape[:2]
    if height % 2 or width % 2:
        image = cv2.copyMakeBorder(image, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
    return image


def rgb_to_yuv(width: int, height: int, time_base: fractions.Fraction) -> Any:
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
