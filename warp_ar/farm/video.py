"""A segment as video, and segments joined into one recording without encoding again.

Frames keep the time stamps of the recording that they come from, so that a variable rate stays what it was and the
recording's own sound fits. Segments have no B-frames: a packet's decoding time is then its picture's, and packets of
one segment follow those of another whatever their times are. The encoder's threads are fixed, for its bytes depend on
their number.
"""

from __future__ import annotations

import contextlib
import fractions
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import av
import numpy.typing as npt

from warp_ar.errors import SinkError, SourceError, reason
from warp_ar.farm.codes import LitPicture
from warp_ar.output.encoders import Encoding, find_encoding, last_packets
from warp_ar.output.sink import ThreadedSink, check_image, check_radiance
from warp_ar.output.video_sink import (
    FRAGMENT_SECONDS,
    add_stream,
    of_even_size,
    rgb_to_yuv,
    signal_of,
    tag_for_players,
    yuv_picture,
)
from warp_ar.signature import PROGRAM

ENCODER_THREADS = 2
"""Of x264 and x265, on every machine."""
_X264 = "rc-lookahead=10:mbtree=1"
"""With these of `veryfast`, x264's preset `superfast` looks no less far ahead. What it leaves out is the search for
motion by fractions of a pixel: three fifths of the processor time for a twentieth more bytes and 0.1 codes of error."""
_X265 = f"pools=none:frame-threads={ENCODER_THREADS}:open-gop=0"
"""x265's threads that share a picture depend on the machine's cores: there are none, only some that take one each."""
_MOST_SCALE = 100_000_000
_LANGUAGES = ("language", "title", "handler_name")
"""Metadata of a stream that stays true in another file."""


def part_encoding(coding: str = "8bit") -> Encoding:
    """Return the encoding of segments: H.264 in 8 bits, else H.265; the same bytes on every machine.

    Args:
        coding: One of ``CODINGS``.

    Raises:
        SinkError: The encoder is not there.
    """
    if coding == "8bit":
        own = {"preset": "superfast", "threads": str(ENCODER_THREADS), "x264-params": _X264}
    else:
        own = {"x265-params": _X265}
    return find_encoding(coding, options={"bf": "0", **own})


class PartSink(ThreadedSink):
    """Video in MP4 whose frames have given time stamps.

    Args:
        path: The file.
        ticks: Time stamp of every frame that will come, growing.
        tick: Seconds of a tick.
        fps: Mean rate of the whole recording: all its parts have one header.
        coding: One of ``CODINGS``; but for ``8bit`` frames are linear radiance, as those of ``VideoSink``.
        transfer: The camera's, by which 10-bit codes are encoded.

    Raises:
        SinkError: A frame cannot be written.
    """

    def __init__(
        self,
        path: Path,
        ticks: Sequence[int],
        tick: fractions.Fraction,
        fps: float,
        *,
        coding: str = "8bit",
        transfer: str = "srgb",
    ) -> None:
        super().__init__(1)
        self._encoding, self._transfer = part_encoding(coding), transfer
        self.description = str(path)
        self._path, self._ticks, self._tick, self._fps = path, ticks, tick, fps
        self._container: Any = None

    def write(self, image: Any) -> None:
        """Take the next frame: an array, or a ``LitPicture``, whose codes are encoded as they are."""
        super().write(image)

    def _check(self, image: Any) -> None:
        if isinstance(image, LitPicture):
            if self._encoding.coding != "8bit":
                raise SinkError(f"{self.description}: a picture of 8 bits among those of {self._encoding.coding}")
        elif self._encoding.coding == "8bit":
            check_image(image)
        else:
            check_radiance(image)

    def _start(self, width: int, height: int) -> None:
        encoding = self._encoding
        self._container = av.open(str(self._path), "w", format="mp4")
        self._container.metadata["comment"] = PROGRAM
        rate = fractions.Fraction(self._fps).limit_denominator(1001)
        group = max(1, round(FRAGMENT_SECONDS * self._fps))
        self._stream = add_stream(self._container, rate, width, height, encoding, {"g": str(group)})
        if encoding.encoder == "libx265":
            tag_for_players(self._stream)
        self._stream.time_base = self._stream.codec_context.time_base = self._tick
        self._converter = rgb_to_yuv(width, height, self._tick, encoding.coding, encoding.pixel_format)

    def _store(self, index: int, image: npt.NDArray[Any] | av.VideoFrame) -> None:
        is_coded, coding = isinstance(image, av.VideoFrame), self._encoding.coding
        try:
            if isinstance(image, av.VideoFrame):
                picture = image
            else:
                image = of_even_size(image)
                if coding == "8bit":
                    picture = av.VideoFrame.from_ndarray(image, format="rgb24")
                else:
                    picture = yuv_picture(signal_of(image, coding, self._transfer), coding)
            if self._container is None:
                self._start(picture.width, picture.height)
            picture.pts, picture.time_base = int(self._ticks[index] - self._ticks[0]), self._tick
            if not is_coded:
                self._converter.push(picture)
                picture = self._converter.pull()
            self._container.mux(self._stream.encode(picture))
        except (av.FFmpegError, OSError) as error:
            raise SinkError(f"{self._path}: frame {index} cannot be written: {reason(error)}") from error

    def _finish(self) -> None:
        container, self._container = self._container, None
        if container is None:
            return
        try:
            try:
                if self._error is None:
                    container.mux(last_packets(self._stream, self._count))
            finally:
                container.close()
        except (av.FFmpegError, OSError) as error:
            if self._error is None:
                raise SinkError(f"{self._path} cannot be finished: {reason(error)}") from error


def join_parts(
    parts: Sequence[Path],
    starts: Sequence[int],
    tick: fractions.Fraction,
    output: Path,
    *,
    recording: Path | None,
    zero: int = 0,
    until: float | None = None,
) -> int:
    """Put segments into one file, packet by packet, with the sound and the metadata of the recording.

    Args:
        parts: Videos of ``PartSink``, in order.
        starts: Time stamp of each one's first frame in the recording, in ticks.
        tick: Seconds of a tick.
        output: The MP4 to write.
        recording: Where sound and metadata come from; None where it is no video.
        zero: Time stamp in ticks that becomes 0 of the file.
        until: Seconds of the recording at which what was lit ends, so that the sound ends there; None: at its own end.

    Returns:
        Frames of the file.

    Raises:
        SinkError: It cannot be written.
        SourceError: A segment or the recording cannot be read.
    """
    try:
        with contextlib.ExitStack() as stack:
            source = None if recording is None else stack.enter_context(av.open(str(recording)))
            options = {"movie_timescale": str(_common_scale(tick, source))}
            target = stack.enter_context(av.open(str(output), "w", format="mp4", options=options))
            with av.open(str(parts[0])) as first:
                video = target.add_stream_from_template(first.streams.video[0])
                if first.streams.video[0].codec_context.name == "hevc":
                    tag_for_players(video)
                header = bytes(first.streams.video[0].codec_context.extradata or b"")
            video.time_base = tick
            sound: Iterator[Any] = iter(())
            if source is not None:
                sound = _sound(source, target, float(zero * tick), until)
                _copy_metadata(source, target, video)
            target.metadata["comment"] = PROGRAM
            count = 0
            waiting = next(sound, None)
            for packet in _video_packets(parts, starts, tick, header, zero):
                while waiting is not None and waiting[0] <= float(packet.pts * packet.time_base):
                    target.mux(waiting[1])
                    waiting = next(sound, None)
                packet.stream = video
                target.mux(packet)
                count += 1
            while waiting is not None:
                target.mux(waiting[1])
                waiting = next(sound, None)
    except (av.FFmpegError, OSError, ValueError) as error:
        raise SinkError(f"{output} cannot be joined: {reason(error)}") from error
    return count


def _copy_metadata(source: Any, target: Any, video: Any) -> None:
    """Into a file and its stream of pictures, what is said of a recording."""
    for name, value in source.metadata.items():
        target.metadata.setdefault(name, value)
    said = source.streams.video[0].metadata
    video.metadata.update({name: said[name] for name in _LANGUAGES if name in said})


def _common_scale(tick: fractions.Fraction, source: Any) -> int:
    """Units a second in which every stream's start is a whole number.

    Where a stream does not begin at 0, an edit list says so in this unit; MP4's usual milliseconds would round it.
    """
    ticks = [tick, *(stream.time_base for stream in source.streams.audio if stream.time_base)] if source else [tick]
    scale = math.lcm(*(fractions.Fraction(unit).denominator for unit in ticks))
    return scale if scale <= _MOST_SCALE else min(tick.denominator, _MOST_SCALE)


def _video_packets(
    parts: Sequence[Path], starts: Sequence[int], tick: fractions.Fraction, header: bytes, zero: int
) -> Iterable[Any]:
    """Packets of all segments with their time stamps in the file, in ticks."""
    for path, start in zip(parts, starts, strict=True):
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            if bytes(stream.codec_context.extradata or b"") != header:
                raise SourceError(
                    f"{path} was encoded in another way than the segments before it; remove it and resume"
                )
            for packet in container.demux(stream):
                if not packet.size:
                    continue
                ticks = fractions.Fraction(packet.pts * packet.time_base / tick)
                if ticks.denominator != 1 or packet.pts != packet.dts:
                    raise SourceError(f"{path}: time stamp {packet.pts} is none of its recording; remove it and resume")
                length = round(packet.duration * packet.time_base / tick)
                packet.time_base = tick
                packet.pts = packet.dts = int(ticks) + start - zero
                packet.duration = length
                yield packet


def _sound(source: Any, target: Any, zero: float, until: float | None) -> Iterator[tuple[float, Any]]:
    """Sound packets of a recording with their times in seconds of the file, as they were encoded."""
    streams = {}
    for stream in source.streams.audio:
        made = target.add_stream_from_template(stream)
        for name in _LANGUAGES:
            if name in stream.metadata:
                made.metadata[name] = stream.metadata[name]
        streams[stream.index] = made

    def packets() -> Iterator[tuple[float, Any]]:
        for packet in source.demux(list(source.streams.audio)) if streams else ():
            if not packet.size or packet.pts is None:
                continue
            seconds = float(packet.pts * packet.time_base) - zero
            if (zero and seconds < 0.0) or (until is not None and seconds + zero >= until):
                continue
            shift = round(zero / float(packet.time_base))
            packet.pts -= shift
            packet.dts = packet.pts  # sound is never reordered
            packet.stream = streams[packet.stream.index]
            yield seconds, packet

    return packets()
