"""Frames of a part of a recording, with their indices and times in the whole recording."""

from __future__ import annotations

import contextlib
import dataclasses
import fractions
from collections.abc import Generator
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt
from av.codec.hwaccel import HWAccel

from warp_ar.errors import SourceError, reason
from warp_ar.sources.frame_folder import FrameFolder
from warp_ar.sources.source import DEFAULT_FPS, Frame, RecordedSource
from warp_ar.sources.sources import open_source
from warp_ar.sources.video_file import VideoFile

DECODERS = 4
"""Number of a decoder's threads."""


@dataclasses.dataclass(frozen=True, eq=False)
class FrameIndex:
    """Index of a recording's frames: their time stamps."""

    ticks: npt.NDArray[np.int64]
    """Time stamp of every frame in ticks, increasing, (n,)."""
    tick: fractions.Fraction
    """Duration of a tick in seconds."""
    seekable: bool
    """True if the time stamps are those of the file, so that a reader can seek."""

    @property
    def length(self) -> int:
        """Number of frames."""
        return len(self.ticks)


class VideoPart(VideoFile):
    """Frames ``first`` to ``end`` of a video, with the indices and times that they have in the whole video.

    Args:
        path: The file.
        index: Index of its frames.
        first: Index of the first frame.
        end: Index after the last frame.
        fps: Show frame n at n / fps instead of its own time; None: at its own time.
        gpu: Index of the GPU to decode with, if it supports the codec; None: the processor decodes.
    """

    _decoders = DECODERS

    def __init__(
        self, path: Path, index: FrameIndex, first: int, end: int, fps: float | None, gpu: int | None = None
    ) -> None:
        self._gpu = gpu
        super().__init__(path, fps=fps)
        self._index, self._first, self._end = index, first, end
        self.length = end - first

    def _open(self, **how: Any) -> Any:
        """Open the file's container; if the GPU cannot decode it, the processor does, with equal pictures."""
        if self._gpu is not None:
            unit = HWAccel("cuda", device=str(self._gpu), allow_software_fallback=True)
            with contextlib.suppress(SourceError, NotImplementedError):
                return super()._open(**how, hwaccel=unit)
            self._gpu = None
        return super()._open(**how)

    def _passes(self) -> Generator[Frame, None, None]:
        """Yield the frames of one pass, with their indices in the whole video."""
        ticks, tick = self._index.ticks, self._index.tick
        if not self._index.seekable or self._first == 0:
            for frame in self._decode():
                if frame.index >= self._end:
                    return
                if frame.index >= self._first:
                    yield dataclasses.replace(frame, time=self._time_of(frame.index))
            return
        start = int(ticks[self._first])
        with self._open() as container:
            try:
                container.seek(start, stream=container.streams.video[0], backward=True)
            except (av.FFmpegError, OSError) as error:
                raise SourceError(f"{self._path}: frame {self._first} cannot be reached: {reason(error)}") from error
            number = self._first
            for image, stamp, deep in self._pictures(container, start):
                expected = float(ticks[number] * tick)
                if stamp is None or abs(stamp - expected) > 0.5 * tick:
                    raise SourceError(
                        f"{self._path}: frame {number} is stamped {stamp} s, not {expected:g} s as its packet; "
                        "leave segment_frames out, so that it is lit as one"
                    )
                yield Frame(number, self._time_of(number), image, deep=deep)
                number += 1
                if number == self._end:
                    return
        raise SourceError(f"{self._path} ends before frame {number}; its packets promise {self._end}")

    def _time_of(self, number: int) -> float:
        """Return the time in seconds of frame ``number`` since the first frame of the whole video.

        It is computed from the index, so that it is equal in all parts that contain the frame.
        """
        ticks = self._index.ticks
        return number / self.fps if self._retimed else float(int(ticks[number] - ticks[0]) * self._index.tick)


class FolderPart(FrameFolder):
    """Pictures ``first`` to ``end`` of a folder, with the indices and times that they have in the whole folder."""

    def __init__(self, path: Path, first: int, end: int, fps: float) -> None:
        super().__init__(path, fps=fps)
        self._first = first
        self._paths = self._paths[first:end]
        self.length = len(self._paths)

    def _passes(self) -> Generator[Frame, None, None]:
        """Yield the pictures of one pass, with their indices in the whole folder."""
        for frame in self._decode():
            number = frame.index + self._first
            yield dataclasses.replace(frame, index=number, time=number / self.fps)


def index_frames(path: Path, fps: float | None) -> FrameIndex:
    """Return the times of a recording's frames; a video is not decoded, only its packets are read.

    Args:
        path: A video file or a folder of pictures.
        fps: Show frame n at n / fps; None: at its own time.

    Raises:
        SourceError: The recording cannot be read.
    """
    with open_source(path, fps=fps) as source:
        if source.exposures:
            raise SourceError(f"{path}: its frames alternate between exposures, which a farm does not light")
        if not isinstance(source, VideoFile):
            rate = fractions.Fraction(fps or DEFAULT_FPS).limit_denominator(1001)
            return FrameIndex(np.arange(source.length or 0), 1 / rate, False)
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            kept = [p for p in container.demux(stream) if p.size and not p.is_discard]
            stamps = [packet.pts for packet in kept]
            tick, rate = stream.time_base, stream.average_rate or fractions.Fraction(30)
    except (av.FFmpegError, OSError, ValueError) as error:
        raise SourceError(f"{path} cannot be read as a video ({reason(error)})") from error
    known = bool(stamps) and tick is not None and None not in stamps and len(set(stamps)) == len(stamps)
    if not known:
        return FrameIndex(np.arange(len(stamps)), 1 / fractions.Fraction(fps or rate).limit_denominator(1001), False)
    ticks = np.array(sorted(s for s in stamps if s is not None), np.int64)
    return FrameIndex(ticks, fractions.Fraction(tick), True)


def open_part(
    path: Path, index: FrameIndex, first: int, end: int, fps: float | None, gpu: int | None = None
) -> RecordedSource:
    """Return frames ``first`` to ``end`` of a recording as a source.

    Args:
        path: A video file or a folder of pictures.
        index: Index of the recording's frames.
        first: Index of the first frame.
        end: Index after the last frame.
        fps: Show frame n at n / fps instead of its own time; None: at its own time.
        gpu: Index of the GPU to decode with; None: the processor decodes.
    """
    with open_source(path, fps=fps) as source:
        is_video = isinstance(source, VideoFile)
    if is_video:
        return VideoPart(path, index, first, end, fps, gpu)
    return FolderPart(path, first, end, fps or DEFAULT_FPS)


def mean_rate(ticks: npt.NDArray[np.int64], tick: fractions.Fraction) -> float:
    """Return the mean frame rate of time stamps in ticks, (n,), with ticks of ``tick`` seconds."""
    seconds = float(int(ticks[-1] - ticks[0]) * tick)
    return (len(ticks) - 1) / seconds if seconds > 0.0 else DEFAULT_FPS


def shown_ticks(index: FrameIndex, fps: float | None) -> tuple[npt.NDArray[np.int64], fractions.Fraction]:
    """Return the time stamps of written frames in ticks, (n,), and the duration of a tick in seconds.

    They are the recording's own, or those of a constant rate ``fps`` if it is given.
    """
    if fps is None:
        return index.ticks, index.tick
    rate = fractions.Fraction(fps).limit_denominator(1001)
    return np.arange(index.length), 1 / rate
