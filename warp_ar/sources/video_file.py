"""Video file as a source of frames, with rotation, pixel shape and edit list of its container applied.

Pictures with more than 8 bits, and HDR pictures, also yield deep frames. A signal of 10 to 16 bits with standard
transfer and primaries becomes 16-bit codes, which are decoded by the camera's transfer. A PQ or HLG signal becomes
linear radiance with reference white at 1 and Rec. 709 primaries. So does a signal of more than 8 bits with BT.2020 or
P3 primaries. For deep frames, FFmpeg only upsamples chroma. Matrix, range and transfer are computed here, because
FFmpeg's own conversion to 16-bit RGB is off by 0.4 %.
"""

from __future__ import annotations

import contextlib
import fractions
import functools
import math
import pathlib
from collections.abc import Callable, Generator, Sequence
from typing import Any, Final, TypeAlias, TypeVar

import av
import cv2
import numpy as np
import numpy.typing as npt
from av.sidedata.sidedata import Type as SideDataType
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc, Interpolation, VideoReformatter

from warp_ar.errors import SourceError, reason
from warp_ar.files import limits, too_much
from warp_ar.signals import P3_D65, REC_709, REC_2020, converted, light_of_hlg, light_of_pq
from warp_ar.sources.deep_frame import CLIP_MARGINS, DeepFrame, codes8, srgb8
from warp_ar.sources.source import DEFAULT_FPS, Frame, RecordedSource, check_fps, check_size, existing_path
from warp_ar.srgb import decode_srgb

Image = npt.NDArray[np.uint8]
Taken: TypeAlias = tuple[Image, float | None, DeepFrame | None]
"""8-bit picture, its time stamp in seconds (None if it has none), and its deep frame if deep frames are kept."""

# Containers of video only: FFmpeg also renders text as pictures, and follows play lists to other files and hosts.
_FORMATS = (
    "mov,mp4,matroska,webm,avi,mpegts,mpeg,mpegvideo,m4v,h264,hevc,av1,obu,ivf,flv,live_flv,asf,ogg,mxf,dv,nut,"
    "mjpeg,mjpeg_2000,gif,apng,yuv4mpegpipe,wtv,rm,vc1,vc1test,swf,r3d,bink,roq,nsv,smk,gxf,wav"
)
# FFmpeg converts these formats to planar RGB in half the time of interleaved RGB. The results are identical, except
# that some codes differ by one if chroma is subsampled and the number of rows is odd.
_IN_PLANES = frozenset(
    ("yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p", "nv12", "yuv420p10le", "p010le")
)
_OPTIONS = {"format_whitelist": _FORMATS, "protocol_whitelist": "file"}
Float = npt.NDArray[np.float32]
_Picture = TypeVar("_Picture", bound=npt.NDArray[Any])

_LUMA: Final = {
    int(Colorspace.ITU709): (0.2126, 0.0722),
    int(Colorspace.BT2020): (0.2627, 0.0593),
    int(Colorspace.ITU601): (0.299, 0.114),
    6: (0.299, 0.114),  # SMPTE 170M has the same matrix
}
"""Coefficients of red and blue in luma."""
_WIDE: Final = {
    int(ColorPrimaries.BT2020): REC_2020,
    int(ColorPrimaries.SMPTE432): P3_D65,
}
HD_HEIGHT = 720
"""Number of rows from which a video without stated colour matrix counts as BT.709."""

# Nearest-neighbour chroma would shift coloured edges by up to a pixel, and truncation would darken by one or two codes.
TO_RGB = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT

_STEPS = 65536
_LAST_CODE: Final = round((1.0 - CLIP_MARGINS[0] / 255.0) * (_STEPS - 1))
"""Step of a signal from which a channel counts as clipped."""

# If an encoder has rounded the picture's size, the pixel aspect ratio compensates: 854x480 for 16:9 has 1280:1281.
_NEARLY_SQUARE = 0.005


class VideoFile(RecordedSource):
    """First video stream of a file, presented as its container specifies.

    Colour is converted with the stream's matrix and range. A stream that states none counts as BT.709 from 720 rows up,
    else as BT.601, as in players and encoders. Frame times are relative to the first frame.

    Follows:
        edit lists; display matrix, to quarter turns; variable rates; matrix, range, primaries, transfer (PQ, HLG too);
        8 to 16 bits; pixels not square (beyond 0.5 %), by resampling columns.

    Names:
        pixels made square.

    Args:
        path: The file.
        fps: Rate that replaces the frames' own times: frame n is shown at n / fps.
        loop: Start again at the end.
        exposures: Exposure times in seconds that repeat over the frames.

    Raises:
        SourceError: Damaged before its first frame.
        UsageError: ``fps`` or one of ``exposures`` is not positive.
    """

    _decoders = 0
    """Number of decoder threads; 0: one more than the number of cores, up to sixteen."""

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
        """Open the file's container; ``how`` are further arguments of PyAV."""
        try:
            container = av.open(str(self._path), options=_OPTIONS, **how)
        except (av.FFmpegError, OSError, ValueError) as error:
            raise SourceError(
                f"{self._path} cannot be read as a video ({reason(error)}): damaged, cut off, or no video file"
            ) from error
        try:
            self._shape = pixel_shape(video_stream(container, str(self._path)))
        except BaseException:
            container.close()
            raise
        return container

    def _decode(self) -> Generator[Frame, None, None]:
        with self._open() as container:
            first, previous = None, -math.inf
            for index, (image, stamp, deep) in enumerate(self._pictures(container)):
                check_size(image, self.size, str(self._path), index)
                if self._retimed or stamp is None or not math.isfinite(stamp):
                    seconds = index / self.fps if self._retimed or index == 0 else previous + 1.0 / self.fps
                else:
                    first = stamp if first is None else first
                    # Times increase strictly, even if a broken recorder wrote others.
                    seconds = stamp - first if stamp - first > previous else previous + 1.0 / self.fps
                previous = seconds
                yield Frame(index, seconds, image, deep=deep)

    def _pictures(self, container: Any, first: int | None = None) -> Generator[Taken, None, None]:
        """Yield every picture with its time stamp in seconds, and its deep frame if deep frames are kept.

        All pictures before a damaged place are yielded before the error is raised.

        Args:
            container: Container of the file.
            first: Time stamp, in ticks of the stream, of the first wanted picture; the container must be positioned
                before it. None: all pictures from the start.
        """
        reformatter = VideoReformatter()
        for picture in self._decoded(container, first):
            yield self._taken(reformatter, picture)

    def _decoded(self, container: Any, first: int | None) -> Generator[Any, None, None]:
        """Yield the pictures as PyAV decodes them; the arguments are those of ``_pictures``."""
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
                # A transport stream reports every gap as an error; decoding continues after it.
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
        # An MP4's index counts its samples exactly, without those that an edit list removes; a file truncated between
        # two samples otherwise ends like a complete one.
        promised = min(stream.frames, len(stream.index_entries))
        if not damage and first is None and "mp4" in container.format.name and packets < promised:
            damage = f"the file is cut off: its index promises {promised} frames"
        if damage:
            # Threads and reordering delay frames; those before the damage are still valid.
            with contextlib.suppress(av.FFmpegError):
                for picture in stream.decode(None):
                    yield picture
                    count += 1
            raise SourceError(f"{self._path}: frame {count} cannot be decoded: {damage}; frames before it are good")

    def _taken(self, reformatter: VideoReformatter, picture: Any) -> Taken:
        """Return 8-bit RGB of a decoded picture, its time stamp in seconds, and its deep frame if they are kept."""
        if self.deep != "light":
            deep = deep_frame_from_video(reformatter, picture, self._shape) if self.deep and self.keeps_depth else None
            return rgb_from_video(reformatter, picture, self._memory_for, self._shape), picture.time, deep
        deep = deep_frame_from_video(reformatter, picture, self._shape)
        image = codes8(deep, "srgb") if deep.codes is None else deep.codes
        return image, picture.time, deep if self.keeps_depth else None


def video_stream(container: Any, name: str) -> Any:
    """Return a container's first video stream, with limits on the size of its pictures.

    Raises:
        SourceError: There is no readable video stream; the message contains ``name``.
    """
    if not container.streams.video:
        kinds = ", ".join(sorted({stream.type for stream in container.streams})) or "nothing"
        raise SourceError(f"{name} has no video stream, only {kinds}; choose one with pictures")
    stream = container.streams.video[0]
    context = stream.codec_context
    if context is None:
        raise SourceError(f"{name} has a video stream of no known codec; choose another encoding")
    width, height = max(context.width, square_width(context.width, pixel_shape(stream))), context.height
    if width * height > limits().picture_pixels:
        label = f"{name} is {width}x{height}: a frame of it"
        raise SourceError(too_much(label, width * height, "pixels", "picture_pixels"))
    context.options = {"max_pixels": str(limits().picture_pixels)}  # the size may change within the stream
    return stream


def _frames_shown(stream: Any) -> int:
    """Return the number of frames that the header states, without those that an edit list removes; 0 if unknown."""
    left_out = sum(entry.is_discard for entry in stream.index_entries)
    return min(stream.frames, len(stream.index_entries) - left_out) if left_out else int(stream.frames)


def rgb_from_video(
    reformatter: VideoReformatter,
    picture: Any,
    memory: Callable[[int, int], Image | None] | None = None,
    shape: fractions.Fraction = fractions.Fraction(1),
) -> Image:
    """Return 8-bit RGB of a decoded picture, rotated and with square pixels.

    Colour matrix and range are those that the picture states.

    Args:
        reformatter: Reformatter of the current thread.
        picture: Picture decoded by PyAV.
        memory: Function of height and width that returns an array for the result, or None to allocate one.
        shape: Pixel aspect ratio, as returned by ``pixel_shape``.
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
    """Return interleaved RGB, (height, width, 3), of a picture with planes in the order green, blue, red.

    Args:
        picture: Picture of PyAV.
        out: Array for the result; None to allocate one.
    """
    green, blue, red = (
        np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)[:, : plane.width]
        for plane in picture.planes
    )
    return np.asarray(cv2.merge([red, green, blue], out), np.uint8)


def depth_of(context: Any) -> str:
    """Return the kind of a stream's deep frames.

    ``light`` stands for linear radiance (from PQ or HLG, or from more than 8 bits with BT.2020 or P3 primaries),
    ``codes`` for other pictures with more than 8 bits. The result is empty for streams without deep frames.

    Args:
        context: Codec context of the stream, by PyAV.
    """
    components = () if context.format is None else context.format.components
    bits = components[0].bits if components else 0  # hardware pictures do not state their software format
    if not 8 <= bits <= 16:
        return ""  # float formats, and streams without a picture yet
    if context.color_trc in (ColorTrc.SMPTE2084, ColorTrc.ARIB_STD_B67):
        return "light"
    wide = context.color_primaries in _WIDE
    return "" if bits == 8 else "light" if wide else "codes"


def curve_of(context: Any) -> str:
    """Return the transfer function of an HDR stream, ``pq`` or ``hlg``; empty for other streams.

    Args:
        context: Codec context of the stream, by PyAV.
    """
    return {int(ColorTrc.SMPTE2084): "pq", int(ColorTrc.ARIB_STD_B67): "hlg"}.get(int(context.color_trc), "")


def pixel_shape(stream: Any) -> fractions.Fraction:
    """Return the width of a stream's pixels divided by their height; 1 if unknown or nearly 1."""
    shape = fractions.Fraction(stream.sample_aspect_ratio or 1)
    return shape if shape > 0 and abs(shape - 1) > _NEARLY_SQUARE else fractions.Fraction(1)


def square_width(width: int, shape: fractions.Fraction) -> int:
    """Return the number of columns of a picture after conversion to square pixels.

    Args:
        width: Number of columns before it.
        shape: Pixel aspect ratio, as returned by ``pixel_shape``.
    """
    return max(1, round(width * shape))


def turn_of(picture: Any) -> tuple[bool, bool, bool]:
    """Return three flags for turning a decoded picture upright: transpose, reverse the columns, reverse the rows.

    The operations are applied in this order. The display matrix of the container or stream maps (x, y) to (a x + c y,
    b x + d y). It is replaced by the nearest of the eight rotations and reflections that map pixels to pixels.
    """
    said = picture.side_data.get(SideDataType.DISPLAYMATRIX)
    if said is None:
        return False, False, False
    a, b, _, c, d = (int(value) for value in np.frombuffer(bytes(said), np.int32)[:5])
    transposed = abs(b) + abs(c) > abs(a) + abs(d)
    return (True, c < 0, b < 0) if transposed else (False, a < 0, d < 0)


def presented(image: _Picture, picture: Any, shape: fractions.Fraction) -> _Picture:
    """Return an image with square pixels, rotated and mirrored by its display matrix.

    Args:
        image: Image of the decoded picture, (height, width, 3).
        picture: Picture decoded by PyAV.
        shape: Pixel aspect ratio, as returned by ``pixel_shape``.
    """
    height, width = image.shape[:2]
    if shape != 1:
        how = cv2.INTER_LINEAR if shape > 1 else cv2.INTER_AREA
        image = cv2.resize(image, (square_width(width, shape), height), interpolation=how)
    transposed, columns, rows = turn_of(picture)
    turned = image.swapaxes(0, 1) if transposed else image
    return np.ascontiguousarray(turned[:: -1 if rows else 1, :: -1 if columns else 1])  # type: ignore[return-value]


def deep_frame_from_video(
    reformatter: VideoReformatter, picture: Any, shape: fractions.Fraction = fractions.Fraction(1)
) -> DeepFrame:
    """Return the deep frame of a decoded picture, with the colour matrix, range, transfer and primaries it states.

    Args:
        reformatter: Reformatter of the current thread.
        picture: Picture decoded by PyAV.
        shape: Pixel aspect ratio, as returned by ``pixel_shape``.
    """
    signal = presented(_signal(reformatter, picture), picture, shape)
    transfer, wide = picture.color_trc, _WIDE.get(picture.color_primaries)
    if transfer not in (ColorTrc.SMPTE2084, ColorTrc.ARIB_STD_B67) and wide is None:
        return DeepFrame(_steps(signal).astype(np.uint16))
    light = _light_table(int(transfer))[_steps(signal)]
    clip = float("inf") if transfer == ColorTrc.SMPTE2084 else float(_light_table(int(transfer))[_LAST_CODE])
    light = converted(light, REC_709 if wide is None else wide, REC_709)
    return DeepFrame(light, clip, srgb8(light))


def _steps(signal: Float) -> npt.NDArray[np.int32]:
    """Return a signal, nominally 0 to 1, as whole numbers 0 to 65535; values outside are clamped."""
    return (np.clip(signal, 0.0, 1.0) * np.float32(_STEPS - 1) + np.float32(0.5)).astype(np.int32)


@functools.cache
def _light_table(transfer: int) -> Float:
    """Return the linear value of each of 65536 equal steps of a signal from 0 to 1, (65536,).

    Args:
        transfer: FFmpeg's number of the transfer function; every one but PQ and HLG is decoded as sRGB.
    """
    curve = {int(ColorTrc.SMPTE2084): light_of_pq, int(ColorTrc.ARIB_STD_B67): light_of_hlg}.get(transfer, decode_srgb)
    return curve(np.arange(_STEPS) / (_STEPS - 1.0)).astype(np.float32)


def _signal(reformatter: VideoReformatter, picture: Any) -> Float:
    """Return the encoded R'G'B' of a picture, (height, width, 3), nominally 0 to 1.

    A coding with limited range allows values slightly below 0 and above 1.
    """
    bits = picture.format.components[0].bits
    kind = "gbrp" if picture.format.is_rgb else "yuv444p"
    wanted = kind if bits == 8 else f"{kind}{bits}le"
    if picture.format.name != wanted:
        picture = reformatter.reformat(picture, format=wanted, interpolation=TO_RGB, threads=1)
    planes = [_plane(plane, np.uint8 if bits == 8 else np.uint16) for plane in picture.planes[:3]]
    if kind == "gbrp":
        green, blue, red = planes
        return np.stack([red, green, blue], -1) / np.float32(2**bits - 1)
    return _rgb_of_yuv(planes, picture, bits)


def _rgb_of_yuv(planes: list[Float], picture: Any, bits: int) -> Float:
    """Return R'G'B', (height, width, 3), of Y'CbCr planes of full resolution.

    Quantisation and matrices are those of BT.709-6 and BT.2020-2 (non-constant luminance).

    Args:
        planes: Y', Cb and Cr as stored, (height, width) each.
        picture: Picture that states range and matrix.
        bits: Bits per value.
    """
    unit = float(2 ** (bits - 8))
    if picture.color_range == ColorRange.JPEG:
        black, luma, chroma = 0.0, 2.0**bits - 1.0, 2.0**bits - 1.0
    else:
        black, luma, chroma = 16.0 * unit, 219.0 * unit, 224.0 * unit
    kr, kb = _LUMA.get(picture.colorspace, _LUMA[1 if picture.height >= HD_HEIGHT else 5])
    y = (planes[0] - np.float32(black)) / np.float32(luma)
    cb, cr = ((plane - np.float32(128.0 * unit)) / np.float32(chroma) for plane in planes[1:])
    red, blue = y + np.float32(2.0 * (1.0 - kr)) * cr, y + np.float32(2.0 * (1.0 - kb)) * cb
    green = (y - np.float32(kr) * red - np.float32(kb) * blue) / np.float32(1.0 - kr - kb)
    return np.stack([red, green, blue], -1)


def _plane(plane: av.video.plane.VideoPlane, kind: Any) -> Float:
    rows = np.frombuffer(plane, kind).reshape(plane.height, -1)
    return rows[:, : plane.width].astype(np.float32)
