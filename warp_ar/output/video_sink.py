"""Frames as video: H.264 with 8 bits, H.265 with 10 bits and HDR, or another encoder of FFmpeg.

A video is playable at any moment: it is written in fragments of half a second, so that a killed process loses only
about the last second. `close` converts MP4 and MOV into the ordinary form, in which every player can seek.
"""

from __future__ import annotations

import contextlib
import fractions
import math
import os
import pathlib
from typing import Any

import av
import av.filter
import cv2
import numpy as np
import numpy.typing as npt
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

from warp_ar.errors import SinkError, UsageError, reason
from warp_ar.files import create_new, name_aside, take_name
from warp_ar.output.encoders import Encoding, find_encoding, last_packets
from warp_ar.output.places import check_replaceable
from warp_ar.output.sink import ThreadedSink, check_image, make_folder
from warp_ar.signals import REC_709, REC_2020, converted, hlg_of_light, pq_of_light
from warp_ar.signature import PROGRAM

_FORMATS = {".mp4": "mp4", ".mkv": "matroska", ".mov": "mov"}
VIDEO_SUFFIXES = tuple(_FORMATS)
"""Suffixes of video files."""

FRAGMENT_SECONDS = 0.5
"""Longest time between key frames, and thus between fragments."""


_TAGS = {
    "8bit": (Colorspace.ITU709, ColorPrimaries.BT709, ColorTrc.BT709),
    "10bit": (Colorspace.ITU709, ColorPrimaries.BT709, ColorTrc.BT709),
    "pq": (Colorspace.BT2020, ColorPrimaries.BT2020, ColorTrc.SMPTE2084),
    "hlg": (Colorspace.BT2020, ColorPrimaries.BT2020, ColorTrc.ARIB_STD_B67),
}
"""Matrix, primaries and transfer in a stream's metadata, by coding."""
_MATROSKA_TICK = fractions.Fraction(1, 1000)
"""Time unit of Matroska in seconds; closer times would become equal."""
_MPEG4_TICKS = 60000
"""Largest number of ticks per second of MPEG-4 part 2, which counts them in 16 bits."""
_FULL_CHROMA = "yuv444p10le"
_WORDS = {"libx264": "H.264", "libx265": "H.265"}


_MEDIA = (b"mdat", b"\x1f\x43\xb6\x75")
"""First bytes of picture data: a box of MP4, a cluster of Matroska."""
_BUFFER = 1 << 27
"""Bytes that FFmpeg collects before it writes; a fragment that is not larger is written at once."""
_SEEK_SIZE = 0x10000
"""FFmpeg's value of ``whence`` that asks for the file's size."""


class VideoSink(ThreadedSink):
    """Video in MP4, MOV or Matroska: 4:2:0, limited range, with its colour space in the metadata.

    8-bit codes are written as BT.709. The 10-bit codings take linear radiance, and write it as the camera's codes in
    BT.709 or as HDR in BT.2020. Reference white is 1, which is 203 cd/m² in PQ and 75 % of HLG's signal.

    Chroma at half resolution needs even sizes: an odd size is padded by repeating the last row or column, and the
    description notes it. An existing file is replaced when the first frames have been stored; until then it is
    unchanged.

    Args:
        path: The file.
        fps: Frames per second.
        size: (width, height) of the frames in pixels, if known.
        overwrite: True to replace a file that this program did not write.
        encoding: Encoder and options; None: H.264 with 8 bits.
        transfer: Transfer function of the camera, for 10-bit codes.
        tick: Seconds of the unit in which times of `write_at` are kept; None: frame n is shown at n / fps.

    Raises:
        SinkError: The file cannot be written, may not be replaced, or has another ending; the encoder does not work.
        UsageError: ``fps`` is not a positive number.
    """

    def __init__(
        self,
        path: str | pathlib.Path,
        *,
        fps: float,
        size: tuple[int, int] | None = None,
        overwrite: bool = False,
        encoding: Encoding | None = None,
        transfer: str = "srgb",
        tick: fractions.Fraction | None = None,
    ) -> None:
        self._path = pathlib.Path(path)
        if not (math.isfinite(fps) and fps > 0):
            raise UsageError(f"fps is {fps}; it must be a positive number of frames per second")
        if self._path.suffix.lower() not in VIDEO_SUFFIXES:
            raise SinkError(f"{self._path} must end in {', '.join(VIDEO_SUFFIXES)} to be a video")
        self._encoding = find_encoding() if encoding is None else encoding
        self._transfer = transfer
        self._words = _WORDS.get(self._encoding.encoder, self._encoding.encoder)
        if self._encoding.coding != "8bit":
            self._words += f", {self._encoding.coding}"
        self.replaced = check_replaceable(self._path, overwrite=overwrite)
        make_folder(self._path.parent)
        self._fps = fps
        self._rate = fractions.Fraction(fps).limit_denominator(1001)
        self._tick = 1 / self._rate if tick is None else tick
        if self._encoding.encoder == "mpeg4" and self._tick.denominator > _MPEG4_TICKS:
            self._tick = fractions.Fraction(1, _MPEG4_TICKS)
        if tick is not None and self._path.suffix.lower() == ".mkv":
            self._tick = max(self._tick, _MATROSKA_TICK)
        self._times: dict[int, float] = {}
        self._last_stamp = -1
        self._timed = tick is not None
        self._broken = False
        self._container: Any = None
        self._file: WholeFragments | None = None
        self._stream: Any = None
        self._converter: Any = None
        super().__init__(1)
        if size is not None:
            self._shape = (size[1], size[0], 3)
        self._describe()

    def _describe(self) -> None:
        height, width = (self._shape or (0, 0))[:2]
        size = f"{width}x{height}, " if self._shape else ""
        self.description = f"{self._path} ({self._words}, {size}{self._fps:g} fps)"
        if height % 2 or width % 2:
            self.description += f", padded to {width + width % 2}x{height + height % 2}: 4:2:0 needs even sizes"

    def _check(self, image: Any) -> None:
        check_image(image, np.uint8 if self._encoding.coding == "8bit" else np.float32)

    def write(self, image: npt.NDArray[Any]) -> None:
        """Write the next frame; the first one determines the size."""
        super().write(image)
        if self._count == 1:
            self._describe()

    def write_at(self, image: npt.NDArray[Any], seconds: float) -> None:
        """Write the next frame, displayed at ``seconds`` if time stamps are kept; the first one determines the size."""
        if self._timed:
            self._times[self._count] = seconds
        self.write(image)

    def _stamp(self, index: int) -> int:
        """Return the time stamp of the next frame in ticks, later than the one before it."""
        seconds = self._times.pop(index, None)
        stamp = fractions.Fraction(index / self._rate if seconds is None else seconds) / self._tick
        self._last_stamp = max(round(stamp), self._last_stamp + 1)
        return self._last_stamp

    def _start(self, width: int, height: int) -> None:
        movie = self._path.suffix.lower() != ".mkv"
        flags = "hybrid_fragmented+frag_keyframe+empty_moov+default_base_moof+negative_cts_offsets"
        fragments = {"movflags": flags} if movie else {"cluster_time_limit": str(round(1000 * FRAGMENT_SECONDS))}
        group = max(1, round(FRAGMENT_SECONDS * self._fps))
        self._file = WholeFragments(self._path)
        options = {**fragments, "flush_packets": "1"}
        kind = _FORMATS[self._path.suffix.lower()]
        self._container = av.open(self._file, "w", format=kind, options=options, buffer_size=_BUFFER)
        self._container.metadata["comment"] = PROGRAM
        encoding, options = self._encoding, {"g": str(group), **self._encoding.options}
        self._stream = self._container.add_stream(encoding.encoder, rate=self._rate, options=options)
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, encoding.pixel_format
        context = self._stream.codec_context
        context.color_range = ColorRange.MPEG
        context.colorspace, context.color_primaries, context.color_trc = _TAGS[encoding.coding]
        if movie and encoding.encoder in ("libx265", "hevc_nvenc", "hevc_videotoolbox"):
            tag_for_players(self._stream)
        self._stream.time_base = context.time_base = self._tick
        self._container.start_encoding()
        self._converter = rgb_to_yuv(width, height, self._tick, encoding.coding, encoding.pixel_format)

    def _store(self, index: int, image: npt.NDArray[Any]) -> None:
        if self._broken:
            return  # FFmpeg may crash if writing continues after a failure.
        height, width = image.shape[:2]
        if height % 2 or width % 2:
            image = cv2.copyMakeBorder(image, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
        try:
            if self._container is None:
                self._start(image.shape[1], image.shape[0])
            if self._encoding.coding == "8bit":
                picture = av.VideoFrame.from_ndarray(image, format="rgb24")
            else:
                picture = yuv_picture(signal_of(image, self._encoding.coding, self._transfer), self._encoding.coding)
            picture.pts, picture.time_base = self._stamp(index), self._tick
            self._converter.push(picture)
            picture = self._converter.pull()
            self._container.mux(self._stream.encode(picture))
            self._file.check()  # type: ignore[union-attr]
        except (av.FFmpegError, OSError) as error:
            self._broken = True
            raise SinkError(f"{self._path}: frame {index} cannot be written: {reason(error)}") from error

    def _finish(self) -> None:
        if self._file is None or self._container is None:
            return
        try:
            try:
                if not self._broken:
                    self._container.mux(last_packets(self._stream, self._count))
            finally:
                self._container.close()
                self._file.close()
            self._file.check()
        except (av.FFmpegError, OSError) as error:
            # After a failed frame, the trailer fails as well; one error is enough.
            if self._error is None:
                raise SinkError(f"{self._path} cannot be finished: {reason(error)}") from error
        finally:
            if self._broken or self._file.error is not None:
                self.written = _count_frames(self._path)


def _count_frames(path: pathlib.Path) -> int:
    """Return the number of frames in an unfinished video, because the encoder held some back."""
    try:
        with av.open(str(path)) as container:
            return sum(packet.size > 0 for packet in container.demux(video=0))
    except (av.FFmpegError, OSError, ValueError):
        return 0


def tag_for_players(stream: Any) -> None:
    """Set the tag of H.265 in MP4 and MOV that Apple's players expect."""
    stream.codec_context.codec_tag = "hvc1"


def rgb_to_yuv(width: int, height: int, time_base: fractions.Fraction, coding: str, pixel_format: str) -> Any:
    """Return the filter from rgb24, or from 16-bit Y'CbCr without subsampling, to an encoder's input format.

    8-bit RGB becomes BT.709 with limited range; pictures with more bits are Y'CbCr already. Chroma is sited at the left
    column of each pair, the default of video streams. The plain converter sites it between both columns, which players
    would show shifted by half a pixel.
    """
    graph = av.filter.Graph()
    graph.threads = 1
    flags = "flags=bilinear+accurate_rnd+full_chroma_inp"
    if coding == "8bit":
        source, scale = "rgb24", f"out_color_matrix=bt709:out_range=tv:out_chroma_loc=left:{flags}"
    else:
        source, scale = _FULL_CHROMA, f"in_range=tv:out_range=tv:out_chroma_loc=left:{flags}"
    nodes = (
        graph.add_buffer(width=width, height=height, format=source, time_base=time_base),
        graph.add("scale", scale),
        graph.add("format", pixel_format),
        graph.add("buffersink"),
    )
    graph.link_nodes(*nodes).configure()
    return graph


def signal_of(radiance: npt.NDArray[np.float32], coding: str, transfer: str) -> npt.NDArray[np.float64]:
    """Return R'G'B' from 0 to 1 of linear radiance, (height, width, 3), for a 10-bit coding.

    Args:
        radiance: float32, Rec. 709 primaries.
        coding: ``10bit``, ``pq`` or ``hlg``.
        transfer: Transfer function of the camera, for ``10bit``.
    """
    from warp_ar.kernels.color import encode_codes  # loads Warp: only after the page is open

    if coding == "10bit":
        return np.asarray(encode_codes(transfer, radiance))
    curve = pq_of_light if coding == "pq" else hlg_of_light
    return curve(converted(radiance, REC_709, REC_2020))


def yuv_picture(signal: npt.NDArray[np.float64], coding: str) -> av.VideoFrame:
    """Return 10-bit Y'CbCr, limited range, without subsampling, of R'G'B' from 0 to 1, (height, width, 3).

    BT.709 for ``10bit``, BT.2020 with non-constant luminance for HDR (BT.709-6 and BT.2020-2, tables of quantisation).
    """
    kr, kb = (0.2126, 0.0722) if coding == "10bit" else (0.2627, 0.0593)
    red, green, blue = (signal[..., channel] for channel in range(3))
    luma = kr * red + (1.0 - kr - kb) * green + kb * blue
    cb, cr = 0.5 * (blue - luma) / (1.0 - kb), 0.5 * (red - luma) / (1.0 - kr)
    values = (876.0 * luma + 64.0, 896.0 * cb + 512.0, 896.0 * cr + 512.0)
    picture = av.VideoFrame(signal.shape[1], signal.shape[0], _FULL_CHROMA)
    for plane, value in zip(picture.planes, values, strict=True):
        rows = np.zeros((plane.height, plane.line_size // 2), np.uint16)
        rows[:, : plane.width] = np.rint(np.clip(value, 4.0, 1019.0)).astype(np.uint16)
        plane.update(rows.tobytes())
    return picture


class WholeFragments:
    """File object through which FFmpeg writes a video.

    The file is written under a temporary name and gets its final name with its first fragment, so that an existing file
    stays until then. FFmpeg hands over whole fragments; one that does not fit on the disk is removed again. Errors are
    stored in ``error``, because FFmpeg continues regardless.
    """

    def __init__(self, path: pathlib.Path) -> None:
        """Create the file; ``path`` is its final path.

        Raises:
            OSError: The file cannot be created.
        """
        self._path = pathlib.Path(os.path.realpath(path))
        part = name_aside(self._path)
        self._part: pathlib.Path | None = part
        try:
            self._file = create_new(part)
        except BaseException:  # a signal, when the file may exist already
            with contextlib.suppress(OSError):
                part.unlink()
            raise
        self._size = self._at = 0
        self._closed = False
        self.error: OSError | None = None
        """Error that ended the writing; nothing was written afterwards."""

    def write(self, data: bytes) -> int:
        """Write bytes at the current position."""
        if self.error is not None:
            return len(data)
        try:
            written = 0
            while written < len(data):
                written += os.pwrite(self._file, data[written:], self._at + written)
        except OSError as error:
            self.error = error
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, self._size)
            return len(data)
        self._at += len(data)
        self._size = max(self._size, self._at)
        if self._part is not None and any(mark in data for mark in _MEDIA):
            # Where open files cannot be renamed, it is renamed when it is closed.
            with contextlib.suppress(PermissionError):
                take_name(self._part, self._path)
                self._part = None
        return len(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Change the position, or return the size."""
        if whence == _SEEK_SIZE:
            return self._size
        self._at = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._size}[whence]
        return self._at

    def tell(self) -> int:
        """Return FFmpeg's position in the file."""
        return self._at

    def check(self) -> None:
        """Raise the error that ended the writing, if any.

        Raises:
            OSError: Writing failed.
        """
        if self.error is not None:
            raise OSError(*self.error.args) from self.error

    def close(self) -> None:
        """Close the file; an empty file is removed."""
        if self._closed:
            return
        self._closed = True
        own = os.fstat(self._file)
        os.close(self._file)
        try:
            if self._part is not None and self._size and self.error is None:
                take_name(self._part, self._path)
            elif self._part is not None:
                self._part.unlink(missing_ok=True)
            elif not os.path.samestat(own, os.stat(self._path)):
                raise OSError("another file took its name while it was written, as by a second run with this output")
        except FileNotFoundError:
            self.error = self.error or OSError("it, or its folder, was removed while it was written")
        except OSError as error:
            self.error = self.error or error
