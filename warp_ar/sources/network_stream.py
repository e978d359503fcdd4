"""Network camera or phone, decoded by PyAV: RTSP, HTTP (including motion JPEG), and other protocols of FFmpeg.

A thread decodes pictures as they arrive and keeps the newest, so that a slow reader lags by one frame instead of by a
growing queue. A broken connection is opened again after a tenth of a second. Each failed attempt doubles the pause
before the next, up to two seconds. The source ends only after ``grace`` seconds without a picture.
"""

from __future__ import annotations

import contextlib
import threading
import time
from typing import Any

import av
import numpy as np
import numpy.typing as npt
from av.video.reformatter import VideoReformatter

from warp_ar.errors import SourceError, reason
from warp_ar.sources.source import DEFAULT_FPS, LiveSource, check_size
from warp_ar.sources.video_file import pixel_shape, rgb_from_video, video_stream

Image = npt.NDArray[np.uint8]

SCHEMES = ("rtsp", "rtsps", "http", "https", "rtmp", "rtmps", "srt", "udp", "tcp")
"""URL schemes of streams."""

GRACE_SECONDS = 15.0
"""Seconds without a picture after which the source ends."""
OPEN_SECONDS = 5.0
"""Timeout in seconds of one connection attempt, and of waiting for data."""
FIRST_PAUSE = 0.1
LONGEST_PAUSE = 2.0
"""Longest pause in seconds before another attempt."""

# Network protocols only: a server's answer must not refer to a local file.
_PROTOCOLS = "rtsp,rtsps,rtp,srtp,udp,tcp,tls,http,https,httpproxy,crypto,rtmp,rtmps,srt"
_OPTIONS = {
    "protocol_whitelist": _PROTOCOLS,
    "fflags": "nobuffer",
    "flags": "low_delay",
    "max_delay": "200000",
}
_RTSP = {
    # Lost UDP packets would corrupt the picture from which light is estimated; UDP is used only if a camera needs it.
    "rtsp_transport": "tcp+udp",
    "rtsp_flags": "prefer_tcp",
    "fpsprobesize": "3",  # the stream states its rate: measuring it would delay the first picture by half a second
}
# Limits on the analysis of a stream before its first picture.
_PROBING = {"probesize": "500000", "analyzeduration": "1000000"}


class NetworkStream(LiveSource):
    """Stream from the network, which is opened again when its connection breaks.

    Args:
        address: URL of the stream, with one of ``SCHEMES``.
        fps: Nominal rate if the stream states none.
        grace: Seconds without a picture after which the source ends.

    Raises:
        SourceError: The stream cannot be opened or gives no picture; while iterating, the connection stays broken, or
            the pictures change their size.
    """

    def __init__(self, address: str, *, fps: float | None = None, grace: float = GRACE_SECONDS) -> None:
        super().__init__(_without_password(address))
        self._address, self._grace = address, grace
        self._ready = threading.Event()
        self._problem = ""
        self._failed: SourceError | None = None
        self.size = (0, 0)
        self.fps = fps or DEFAULT_FPS
        self._told_fps = fps is not None
        self._start_reading()
        self._ready.wait()
        if self._failed is not None:
            self._thread.join()
            raise self._failed
        self.description = f"{self._name} ({self.size[0]}x{self.size[1]}, {self.fps:g} fps)"

    def _run(self) -> None:
        """Decode pictures until the source is closed, opening the connection again whenever it breaks."""
        last, pause = time.monotonic(), FIRST_PAUSE
        while not self._stop.is_set():
            came, heard = False, time.monotonic()
            try:
                for image in self._pictures():
                    self._take(image)
                    came, last, pause = True, time.monotonic(), FIRST_PAUSE
                    heard = last
                    if self._stop.is_set():
                        break
                self._problem = "the stream ended"
            except (av.FFmpegError, OSError, ValueError) as error:
                # The type of FFmpeg's error after a timeout depends on the call that timed out.
                silent = time.monotonic() - heard > 0.9 * OPEN_SECONDS
                self._problem = f"no picture came for {OPEN_SECONDS:g} s" if silent else reason(error)
            if self._stop.is_set():
                break
            first = not self._ready.is_set()
            if first or time.monotonic() - last > self._grace:
                what = "cannot be opened" if first and not came else f"gave no picture for {self._grace:g} s"
                raise SourceError(f"{self._name} {what} ({self._problem}); check its address, and that it is on")
            self._stop.wait(pause)
            pause = min(2.0 * pause, LONGEST_PAUSE)

    def _end(self, error: SourceError | None) -> None:
        self._failed = error
        super()._end(error)
        self._ready.set()

    def _take(self, image: Image) -> None:
        if not self._ready.is_set():
            self.size = (image.shape[1], image.shape[0])
            self._ready.set()
        check_size(image, self.size, self._name, None)
        self._put(image, time.monotonic())

    def _pictures(self) -> Any:
        """Yield the pictures of one connection as they arrive."""
        waits = (OPEN_SECONDS, OPEN_SECONDS)
        rtsp = self._address.lower().startswith("rtsp")
        with contextlib.closing(
            av.open(self._address, options={**_OPTIONS, **_PROBING, **(_RTSP if rtsp else {})}, timeout=waits)
        ) as container:
            stream = video_stream(container, self._name)
            shape = pixel_shape(stream)
            rate = float(stream.average_rate or stream.guessed_rate or 0.0)
            if rate > 0.0 and not self._told_fps:
                self.fps = rate
            stream.thread_type = "SLICE"  # decoding frames in parallel would delay each by the number of threads
            reformatter, last = VideoReformatter(), time.monotonic()
            # Audio packets are read as well, so that the timeout below is checked while only audio arrives.
            for packet in container.demux():
                if self._stop.is_set():
                    return
                if time.monotonic() - last > OPEN_SECONDS:
                    raise TimeoutError
                if packet.stream_index != stream.index:
                    continue
                try:
                    pictures = packet.decode()
                except av.InvalidDataError:
                    continue  # a damaged packet: decoding recovers with the next key frame
                for picture in pictures:
                    yield rgb_from_video(reformatter, picture, self._memory_for, shape)
                    last = time.monotonic()

    def close(self) -> None:
        """Stop the reading thread."""
        self._stop.set()
        super().close()
        self._thread.join(2.0 * OPEN_SECONDS)


def _without_password(address: str) -> str:
    """Return the address for messages, without user name, password and query."""
    scheme, _, rest = address.partition("://")
    place, slash, path = rest.partition("/")
    return f"{scheme}://{place.rpartition('@')[2]}{slash}{path.partition('?')[0]}"
