"""A video file as frames: those that its container presents, as it presents them."""

from __future__ import annotations

import collections
import contextlib
import fractions
import math
import pathlib
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeAlias

import av
import cv2
import numpy as np
import numpy.typing as npt
from av.video.reformatter import Colorspace, VideoReformatter

from warp_ar.errors import SourceError, reason
from warp_ar.files import limits, too_much
from warp_ar.sources.deep_frame import Plate, codes8
from warp_ar.sources.deep_video import (
    HD_HEIGHT,
    TO_RGB,
    curve_of,
    depth_of,
    pixel_shape,
    plate_from_video,
    presented,
    square_width,
    turn_of,
)
from warp_ar.sources.source import DEFAULT_FPS, Frame, RecordedSource, check_fps, check_size, existing_path

Image = npt.NDArray[np.uint8]
Taken: TypeAlias = tuple[Image, float | None, Plate | None]
"""A picture, its time stamp in seconds, and its plate if that is kept."""

# Containers of video alone: FFmpeg also draws text as a picture, and follows play lists to other files and machines.
_FORMATS = (
    "mov,mp4,matroska,webm,avi,mpegts,mpeg,mpegvideo,m4v,h264,hevc,av1,obu,ivf,flv,live_flv,asf,ogg,mxf,dv,nut,"
    "mjpeg,mjpeg_2000,gif,apng,yuv4mpegpipe,wtv,rm,vc1,vc1test,swf,r3d,bink,roq,nsv,smk,gxf,wav"
)
# FFmpeg converts these to RGB in planes in half the time that it takes for RGB in turn, to the same bits. Of halved
# chroma in an odd number of rows some codes differ by one.
_IN_PLANES = frozenset(
    ("yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p", "nv12", "yuv420p10le", "p010le")
)
_OPTIONS = {"format_whitelist": _FORMATS, "protocol_whitelist": "file"}


class VideoFile(RecordedSource):
    """A video file, its first video stream, as its container presents it.

    Frames that an edit list leaves out are none, the display matrix turns and mirrors, and pixels that are not square
    are resampled to square ones, the rows kept.

    Colour is converted with the stream's own matrix and range; one that names none is taken as BT.709 from 720 rows up,
    else BT.601: what players do, and encoders expect. Frame times are the file's own (a variable rate is kept), counted
    from the first frame.

    Args:
        path: The file.
        fps: Show frame n at n / fps instead of at its own time.
        loop: Start again at the end.
        exposures: Exposure times in seconds that frames have in turn.

    Raises:
        SourceError: The file does not exist, is no video, or its first frame cannot be decoded.
        UsageError: ``fps`` or one of ``exposures`` is not a positive number.
    """

    _converters = 1
    """Threads that convert pictures to RGB beside the one that decodes; 1: that one does."""
    _decoders = 0
    """Threads of the decoder; 0: one more than there are cores, up to sixteen."""

    def __init__(
        self,
        path: str | pathlib.Path,
        *,
        fps: float | None = None,
        loop: bool = False,
        exposures: Sequence[float] = (),
    ) -> None:
        super().__init__(loop=loop, exposures=exposures)
        check_fps(fps)
        self._path = existing_path(pathlib.Path(path))
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
            self.length = _frames_shown(stream) or round(seconds * rate) or None
            self.tick = None if self._retimed else stream.time_base
            codec = stream.codec_context.name
            self.deep = depth_of(stream.codec_context)
            self.curve = curve_of(stream.codec_context) if self.deep else ""
            first = next(self._pictures(container), None)
        if first is None:
            raise SourceError(f"{self._path}: frame 0 cannot be decoded: the video stream holds no picture")
        height, width, _ = first[0].shape
        self.size = (width, height)
        self.description = f"{self._path} ({codec}, {width}x{height}, {self.fps:g} fps)"
        if self._shape != 1:
            x, y = self._shape.as_integer_ratio()
            self.note = f"{self._path} has pixels of {x}:{y}; its frames are resampled to {width}x{height}, square ones"

    def _open(self, **how: Any) -> Any:
        """The file's container; ``how``: more of PyAV's arguments."""
        try:
            container = av.open(str(self._path), options=_OPTIONS, **how)
        except (av.FFmpegError, OSError, ValueError) as error:
            raise SourceError(
                f"{self._path} cannot be read as a video ({reason(error)}): damaged, cut off, or no video file"
            ) from error
        try:
            self._check_stream(container)
        except BaseException:
            container.close()
            raise
        return container

    def _check_stream(self, container: Any) -> None:
        if not container.streams.video:
            kinds = ", ".join(sorted({stream.type for stream in container.streams})) or "nothing"
            raise SourceError(f"{self._path} has no video stream, only {kinds}; choose a file with pictures")
        stream = container.streams.video[0]
        if stream.codec_context is None:
            raise SourceError(f"{self._path} has a video stream of no known codec; choose another encoding")
        self._shape = pixel_shape(stream)
        width, height = stream.codec_context.width, stream.codec_context.height
        width = max(width, square_width(width, self._shape))
        if width * height > limits().picture_pixels:
            label = f"{self._path} is {width}x{height}: a frame of it"
            raise SourceError(too_much(label, width * height, "pixels", "picture_pixels"))
        # The size may change on the way.
        stream.codec_context.options = {"max_pixels": str(limits().picture_pixels)}

    def _decode(self) -> Generator[Frame, None, None]:
        with self._open() as container:
            first, previous = None, -math.inf
            for index, (image, stamp, plate) in enumerate(self._pictures(container)):
                check_size(image, self.size, str(self._path), index)
                if self._retimed or stamp is None:
                    seconds = index / self.fps if self._retimed or index == 0 else previous + 1.0 / self.fps
                else:
                    first = stamp if first is None else first
                    # Time never stands still or runs back, whatever a broken recorder wrote.
                    seconds = stamp - first if stamp - first > previous else previous + 1.0 / self.fps
                previous = seconds
                yield Frame(index, seconds, image, plate=plate)

    def _pictures(self, container: Any, first: int | None = None) -> Generator[Taken, None, None]:
        """Every picture with its time stamp in seconds, and its plate if that is kept.

        Whatever precedes damage comes before the error.

        Args:
            container: Of the file.
            first: Time stamp, in ticks of the stream, from which on pictures are wanted, where the container stands
                somewhere before it; None: all are, from the start.
        """
        pictures = self._decoded(container, first)
        if self._converters == 1:
            reformatter = VideoReformatter()
            for picture in pictures:
                yield self._taken(reformatter, picture)
        else:
            yield from _convert_beside(pictures, self._converters, self._taken)

    def _decoded(self, container: Any, first: int | None) -> Generator[Any, None, None]:
        """As ``_pictures``, each as its codec has it."""
        stream = container.streams.video[0]
        stream.thread_type, stream.codec_context.thread_count = "AUTO", self._decoders
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
            except (av.FFmpegError, OSError, ValueError) as error:
                damage = reason(error)
            for picture in pictures:
                if first is None or picture.pts >= first:
                    yield picture
                count += 1
        # An MP4's index lists its samples exactly, without those that an edit list makes needless; a file cut between
        # two of them ends like a whole one.
        promised = min(stream.frames, len(stream.index_entries))
        if not damage and first is None and "mp4" in container.format.name and packets < promised:
            damage = f"the file is cut off: its index promises {promised} frames"
        if damage:
            # Threads and reordering hold frames back; those before the damage are still good.
            with contextlib.suppress(av.FFmpegError):
                for picture in stream.decode(None):
                    yield picture
                    count += 1
            raise SourceError(f"{self._path}: frame {count} cannot be decoded: {damage}; frames before it are good")

    def _taken(self, reformatter: VideoReformatter, picture: Any) -> Taken:
        """8-bit RGB of a picture, its time stamp, and its plate if that is kept."""
        if self.deep != "light":
            plate = plate_from_video(reformatter, picture, self._shape) if self.deep and self.keeps_depth else None
            return rgb_from_video(reformatter, picture, self._memory_for, self._shape), picture.time, plate
        plate = plate_from_video(reformatter, picture, self._shape)
        image = codes8(plate, "srgb") if plate.codes is None else plate.codes
        return image, picture.time, plate if self.keeps_depth else None


def _frames_shown(stream: Any) -> int:
    """Return how many frames a header promises, without those that an edit list leaves out; 0 where it is unknown."""
    left_out = sum(entry.is_discard for entry in stream.index_entries)
    return min(stream.frames, len(stream.index_entries) - left_out) if left_out else int(stream.frames)


def _convert_beside(
    pictures: Iterator[Any], threads: int, take: Callable[[VideoReformatter, Any], Taken]
) -> Generator[Taken, None, None]:
    """Pictures in RGB with their times, in order, converted while the next are decoded; errors keep their place."""
    own = threading.local()

    def convert(picture: Any) -> Taken:
        if not hasattr(own, "reformatter"):
            own.reformatter = VideoReformatter()
        return take(own.reformatter, picture)

    waiting: collections.deque[Future[Taken]] = collections.deque()
    damage: SourceError | None = None
    with ThreadPoolExecutor(threads, thread_name_prefix="warp-ar-convert") as pool:
        try:
            try:
                for picture in pictures:
                    waiting.append(pool.submit(convert, picture))
                    if len(waiting) > threads:
                        yield waiting.popleft().result()
            except SourceError as error:
                damage = error
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    if damage is not None:
        raise damage


def rgb_from_video(
    reformatter: VideoReformatter,
    picture: Any,
    memory: Callable[[int, int], Image | None] | None = None,
    shape: fractions.Fraction = fractions.Fraction(1),
) -> Image:
    """Return 8-bit RGB of a decoded picture as it is presented, with the picture's own colour matrix and range.

    Args:
        reformatter: The thread's.
        picture: Of PyAV.
        memory: Gives memory for a picture of a height and width, or None: it is then made anew.
        shape: As ``pixel_shape`` has it.
    """
    matrix = None
    if picture.colorspace not in {int(known) for known in Colorspace}:
        matrix = Colorspace.ITU709 if picture.height >= HD_HEIGHT else Colorspace.ITU601
    in_planes = picture.format.name in _IN_PLANES and picture.height % 2 == 0
    wanted = "gbrp" if in_planes else "rgb24"
    converted = reformatter.reformat(picture, format=wanted, src_colorspace=matrix, interpolation=TO_RGB, threads=1)
    if in_planes:
        stored = shape == 1 and not any(turn_of(picture))
        out = memory(picture.height, picture.width) if memory is not None and stored else None
        rgb = _interleaved(converted, out)
    else:
        rgb = np.asarray(converted.to_ndarray(), np.uint8)
    return presented(rgb, picture, shape)


def _interleaved(picture: Any, out: Image | None) -> Image:
    """RGB of a picture that has green, blue and red in planes of their own, in ``out`` or anew."""
    green, blue, red = (
        np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)[:, : plane.width]
        for plane in picture.planes
    )
    return np.asarray(cv2.merge([red, green, blue], out), np.uint8)
