"""Segments as videos, and their concatenation to one recording without re-encoding.

Frames keep the time stamps of their recording, so that a variable frame rate is preserved and the recording's sound
stays synchronous. Segments have no B-frames. The decoding time of each packet therefore equals its presentation time,
and packets of one segment can directly follow those of another. The number of the encoder's threads is fixed, because
the encoded bytes depend on it.
"""

from __future__ import annotations

import contextlib
import fractions
import heapq
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import av

from warp_ar.errors import SinkError, SourceError, reason
from warp_ar.output.encoders import find_encoding
from warp_ar.output.video_sink import VideoSink, tag_for_players
from warp_ar.signature import PROGRAM

ENCODER_THREADS = 2
"""Number of threads of x264 and x265, the same on every machine."""
_X264 = "rc-lookahead=10:mbtree=1"
"""Options that give x264's preset ``superfast`` the lookahead of ``veryfast``. It still omits the search for subpixel
motion. Compared with ``veryfast``, it takes three fifths of the processor time, writes a twentieth more bytes and errs
by 0.1 codes more."""
_X265 = f"pools=none:frame-threads={ENCODER_THREADS}:open-gop=0"
"""Options of x265 without its thread pool, which depends on the number of cores; only frame threads are used."""
_MOST_SCALE = 100_000_000
"""Largest number of time units per second in a file's header."""
_LANGUAGES = ("language", "title", "handler_name")
"""Names of a stream's metadata that remain valid in another file."""


def open_part_sink(path: Path, tick: fractions.Fraction, fps: float, coding: str, transfer: str) -> VideoSink:
    """Open a segment's video; frames are added by ``write_at``.

    It is H.264 for 8 bits, else H.265; its bytes are the same on every machine.

    Args:
        path: The file.
        tick: Duration of a tick of the recording in seconds.
        fps: Mean frame rate of the whole recording, so that all segments have an equal header.
        coding: One of ``CODINGS``.
        transfer: Transfer function of the camera, with which 10-bit pictures are encoded.

    Raises:
        SinkError: The encoder is missing.
    """
    if coding == "8bit":
        own = {"preset": "superfast", "threads": str(ENCODER_THREADS), "x264-params": _X264}
    else:
        own = {"x265-params": _X265}
    encoding = find_encoding(coding, options={"bf": "0", **own})
    return VideoSink(path, fps=fps, encoding=encoding, transfer=transfer, tick=tick)


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
    """Concatenate segments packet by packet into one file, with the recording's sound and metadata.

    Args:
        parts: Videos from ``open_part_sink``, in order.
        starts: For each segment, the time stamp that its first frame has in the recording, in ticks.
        tick: Duration of a tick in seconds.
        output: The MP4 to write.
        recording: Source of sound and metadata; None if it is not a video.
        zero: Time stamp in the recording, in ticks, that becomes time 0 of the joined file.
        until: Time in seconds of the recording at which the sound ends; None: at its own end.

    Returns:
        Number of frames of the file.

    Raises:
        SinkError: The file cannot be written.
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
            sound: Iterator[tuple[float, Any]] = iter(())
            if source is not None:
                sound = _sound(source, target, float(zero * tick), until)
                target.metadata.update(source.metadata)
                said = source.streams.video[0].metadata
                video.metadata.update({name: said[name] for name in _LANGUAGES if name in said})
            target.metadata["comment"] = PROGRAM
            count = 0
            pictures = _video_packets(parts, starts, tick, header, zero)
            for _, packet in heapq.merge(sound, pictures, key=lambda timed: timed[0]):
                if packet.stream.type == "video":
                    packet.stream = video
                    count += 1
                target.mux(packet)
    except (av.FFmpegError, OSError, ValueError) as error:
        raise SinkError(f"{output} cannot be joined: {reason(error)}") from error
    return count


def _common_scale(tick: fractions.Fraction, source: Any) -> int:
    """Return a number of time units per second such that the start of every stream is a whole number of units.

    If a stream does not begin at 0, an edit list states its start in this unit. MP4's usual unit, the millisecond,
    would round it.

    Args:
        tick: Duration of a tick of the video in seconds.
        source: Container of the recording with the sound, or None.
    """
    ticks = [tick, *(stream.time_base for stream in source.streams.audio if stream.time_base)] if source else [tick]
    scale = math.lcm(*(fractions.Fraction(unit).denominator for unit in ticks))
    return scale if scale <= _MOST_SCALE else min(tick.denominator, _MOST_SCALE)


def _video_packets(
    parts: Sequence[Path], starts: Sequence[int], tick: fractions.Fraction, header: bytes, zero: int
) -> Iterator[tuple[float, Any]]:
    """Yield the packets of all segments, each with its time in the joined file, in seconds.

    Args:
        parts: Videos of the segments, in order.
        starts: For each segment, the time stamp that its first frame has in the recording, in ticks.
        tick: Duration of a tick in seconds.
        header: Header of the encoder, which must be equal in all segments.
        zero: Time stamp in the recording, in ticks, that becomes time 0 of the joined file.

    Raises:
        SourceError: A segment was encoded differently or has wrong time stamps.
    """
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
                yield float(packet.pts * tick), packet


def _sound(source: Any, target: Any, zero: float, until: float | None) -> Iterator[tuple[float, Any]]:
    """Add a recording's sound streams to a file, and yield their packets, each with its time in the file in seconds.

    Args:
        source: Container of the recording.
        target: Container of the joined file.
        zero: Time in seconds of the recording that becomes 0 in the file.
        until: Time in seconds of the recording at which the sound ends; None: at its own end.
    """
    streams = {}
    for stream in source.streams.audio:
        made = target.add_stream_from_template(stream)
        made.metadata.update({name: stream.metadata[name] for name in _LANGUAGES if name in stream.metadata})
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
            packet.dts = packet.pts  # sound packets are never reordered
            packet.stream = streams[packet.stream.index]
            yield seconds, packet

    return packets()
