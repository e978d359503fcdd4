"""Camera opened through OpenCV, optionally with alternating exposures.

Devices apply a new exposure time several frames late. The exposure of each picture is therefore found from its
brightness.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.errors import SourceError, UsageError
from warp_ar.sources.frame_folder import rgb8
from warp_ar.sources.source import DEFAULT_FPS, LiveSource, check_size, distinct

Image = npt.NDArray[np.uint8]

BRACKET_SECONDS = 0.4
"""Seconds for which the longest exposure is used between two rounds of the others. The displayed picture stands still
during a round."""

SETTLE_FRAMES = 5
"""Number of frames after which a device is assumed to use its first exposure."""

MOST_WAIT = 12
"""Number of frames within which a device must use a newly requested exposure."""

CLOSE_SECONDS = 3.0
"""Longest time in seconds that closing waits for a picture being read, because a driver may hang."""

MOST_MISSES = 3
"""Number of consecutive failed changes of the exposure after which the source gives up."""

LEAST_RATIO = 1.8
"""Smallest ratio of neighbouring exposures; closer exposures cannot be distinguished by brightness."""


class _Bracketing:
    """Exposure control of a device: requests one exposure after another and finds that of each picture.

    A device takes some frames to change its exposure. Each picture is therefore compared with the last picture of the
    longest exposure. Over the pixels that are well exposed in that picture, the ratio of linear values equals the ratio
    of exposure times.
    """

    def __init__(self, capture: Any, exposures: tuple[float, ...], name: str) -> None:
        self._capture, self.exposures, self._name = capture, exposures, name
        backend = capture.getBackendName()
        self._logarithmic = backend in ("DSHOW", "MSMF")
        capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, 0.25 if self._logarithmic else 1.0)
        self._reference: npt.NDArray[np.float32] | None = None
        self._asked, self._waited, self._settled = 0, 0, False
        self._misses, self._since = 0, 0.0
        self._ask(0)

    def _ask(self, index: int) -> None:
        """Request an exposure; drivers on Windows expect the logarithm of seconds, others units of 1/10,000 second."""
        seconds = self.exposures[index]
        value = math.log2(seconds) if self._logarithmic else 1e4 * seconds
        if not self._capture.set(cv2.CAP_PROP_EXPOSURE, value):
            raise SourceError(
                f"{self._name} does not let its exposure be set to {seconds:g} s; leave exposures out of [source]"
            )
        self._asked, self._waited, self._settled = index, 0, False

    def label(self, image: Image, now: float) -> float | None:
        """Return the exposure of a picture in seconds; None while the device changes between two exposures.

        Raises:
            SourceError: The device does not change its exposure.
        """
        sparse = _DECODE[image[::8, ::8]]
        if not self._settled:
            self._waited += 1
            self._settled = self._shows(sparse)
            if not self._settled:
                if self._waited >= MOST_WAIT:
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
        """Start again with the longest exposure after a change that was not seen in the pictures.

        Either the device does not change its exposure, or the brightness of the environment has changed.

        Args:
            now: Time of the present picture, seconds.

        Raises:
            SourceError: This was failure number ``MOST_MISSES`` in a row.
        """
        self._misses += self._asked != 0
        if self._misses >= MOST_MISSES:
            raise SourceError(
                f"{self._name} does not follow its exposure: asked for {self.exposures[self._asked]:g} s, the picture "
                "is no darker; leave exposures out of [source]"
            )
        self._ask(0)
        self._since, self._reference = now, None

    def _shows(self, sparse: npt.NDArray[np.float32]) -> bool:
        """Return True if a picture's brightness fits the requested exposure better than any other exposure.

        Args:
            sparse: Linear values of every eighth pixel in both directions, (h, w, 3).
        """
        if self._reference is None:
            return self._waited > SETTLE_FRAMES
        well = (self._reference > 0.05) & (self._reference < 0.9)
        if well.sum() < 30:
            return self._waited > SETTLE_FRAMES  # too few well exposed pixels to compare
        ratio = float(sparse[well].sum() / self._reference[well].sum())
        if ratio <= 0.0:
            return self._asked == len(self.exposures) - 1
        steps = [abs(math.log(ratio * self.exposures[0] / seconds)) for seconds in self.exposures]
        return int(np.argmin(steps)) == self._asked


_DECODE = (((np.arange(256) / 255 + 0.055) / 1.055) ** 2.4).astype(np.float32)
"""Approximate linear value of each 8-bit pixel value, (256,); exposures differ enough for an approximation."""


def _open_device(device: Any) -> Any:
    """Return OpenCV's capture object of a device, opened without OpenCV's messages on stderr.

    A failure is reported by `CaptureDevice` in one line.
    """
    log: Any = cv2.utils.logging
    level = log.getLogLevel()
    log.setLogLevel(log.LOG_LEVEL_ERROR)  # OpenCV warns for every backend that has no such device
    try:
        return cv2.VideoCapture(device)
    finally:
        log.setLogLevel(level)


class CaptureDevice(LiveSource):
    """Camera opened through OpenCV; a thread reads continuously and keeps the newest frame.

    Args:
        device: Index of the device, or the URL of a stream.
        fps: Rate to ask the device for, in frames per second.
        grace: Seconds without a frame after which the device counts as unplugged.
        exposures: Exposure times in seconds to alternate between: mostly the longest, the others periodically.
        opener: Function that returns an object like ``cv2.VideoCapture``, for tests and unusual backends.

    Raises:
        SourceError: The device cannot be opened, gives no frame or does not let its exposure be set; while iterating,
            the device was unplugged, changed its frame size or does not change its exposure.
        UsageError: ``exposures`` are too close to each other to be distinguished.
    """

    def __init__(
        self,
        device: int | str,
        *,
        fps: float | None = None,
        grace: float = 2.0,
        exposures: Sequence[float] = (),
        opener: Callable[[Any], Any] = _open_device,
    ) -> None:
        super().__init__(f"capture device {device}" if isinstance(device, int) else str(device))
        self._grace = grace
        self.exposures = distinct(exposures)
        if any(longer < LEAST_RATIO * shorter for longer, shorter in itertools.pairwise(self.exposures)):
            raise UsageError(
                f"exposures {', '.join(f'{e:g}' for e in self.exposures)} of {self._name}: expected each to be "
                f"{LEAST_RATIO:g} times the next or more"
            )
        self._bracketing: _Bracketing | None = None
        self._capture = opener(device)
        try:
            if not self._capture.isOpened():
                raise SourceError(
                    f"{self._name} cannot be opened; is it plugged in, and free of other programs? "
                    "--source PATH|INDEX takes other frames"
                )
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
            self._put(first, time.monotonic())
        self._start_reading()

    def _read(self) -> Image | None:
        """Return the next frame; None if none came within ``grace`` or the source was closed."""
        deadline = time.monotonic() + self._grace
        while not self._stop.is_set():
            ok, picture = self._capture.read()
            if ok and picture is not None and picture.size:
                return self._in_rgb(picture)
            if time.monotonic() > deadline:
                return None
            self._stop.wait(0.01)
        return None

    def _in_rgb(self, picture: npt.NDArray[Any]) -> Image:
        """Return a picture of the capture as 8-bit RGB."""
        if picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[2] == 3:
            return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB, self._memory_for(*picture.shape[:2])), np.uint8)
        return rgb8(picture[..., 2::-1] if picture.ndim == 3 else picture, self._name)

    def _run(self) -> None:
        while (image := self._read()) is not None:
            check_size(image, self.size, self._name, None)
            now = time.monotonic()
            exposure = None if self._bracketing is None else self._bracketing.label(image, now)
            if self._bracketing is None or exposure is not None:
                self._put(image, now, exposure)
        if not self._stop.is_set():
            raise SourceError(f"{self._name} gave no frame for {self._grace:g} s; was it unplugged?")

    def close(self) -> None:
        """Stop the reading thread and release the device; if its driver hangs, it is left open."""
        self._stop.set()
        super().close()
        self._thread.join(CLOSE_SECONDS)
        if not self._thread.is_alive():
            self._capture.release()
