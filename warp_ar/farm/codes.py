"""Pictures between decoder, GPU and encoder as video has them: 4:2:0 codes, which the GPU turns into RGB and back.

The host neither converts nor copies RGB, and half as many bytes go over the bus. Codes are the same to the bit as by
the host's conversion (``warp_ar.kernels.picture.video_color``): that is looked at in the first picture of each segment,
and a segment in which something differs takes the host's way.

All that a frame takes of the device is on one stream, in order. Nobody waits but who wants the codes of the picture.
"""

from __future__ import annotations

import fractions
from collections.abc import Callable
from typing import Any

import av
import numpy as np
import numpy.typing as npt
import warp as wp
from av.video.reformatter import ColorRange, Colorspace

from warp_ar.device import exclusive, translating, wait_for
from warp_ar.kernels.picture.video_color import rgb_factors, rgb_from_yuv, yuv_from_rgb, yuv_layout
from warp_ar.output.video_sink import rgb_to_yuv
from warp_ar.sources.deep_video import HD_HEIGHT, turn_of

LEAST_SIZE = 16
"""Rows and columns below which FFmpeg's filters weigh samples at the border in another way than the device."""
INTERLEAVED = "nv12"
"""Format in which Cb and Cr lie in turn."""
_PLANAR = ("yuv420p", "yuvj420p")
_MATRICES = {int(Colorspace.ITU709): "bt709", int(Colorspace.ITU601): "bt601"}


class DecodedPicture:
    """A picture as its decoder gave it; it stands where a source has RGB."""

    def __init__(self, picture: Any) -> None:
        """Keep PyAV's picture, one that ``can_convert``."""
        self.picture = picture
        self.shape = (picture.height, picture.width, 3)


def can_convert(picture: Any) -> bool:
    """Return whether a device can convert PyAV's picture to RGB as the host does."""
    size = picture.height, picture.width
    known = picture.format.name in (*_PLANAR, INTERLEAVED) and matrix_of(picture) is not None
    return known and not any(turn_of(picture)) and min(size) >= LEAST_SIZE and not any(n % 2 for n in size)


def matrix_of(picture: Any) -> str | None:
    """Name of a picture's matrix, as ``rgb_from_video`` takes it; None: another."""
    if int(picture.colorspace) not in {int(known) for known in Colorspace}:
        return "bt709" if picture.height >= HD_HEIGHT else "bt601"
    return _MATRICES.get(int(picture.colorspace))


class LitPicture:
    """A lit picture on its way to the encoder: it has a shape and copies itself, as sinks want it."""

    def __init__(self, shape: tuple[int, int, int], codes: npt.NDArray[np.uint8], wait: Callable[[], None]) -> None:
        """``codes`` are there once ``wait`` returns."""
        self.shape = shape
        self._codes, self._wait = codes, wait

    def copy(self) -> av.VideoFrame:
        """PyAV's picture, yuv420p with memory of its own; waits for it."""
        self._wait()
        height, width = self.shape[:2]
        picture = av.VideoFrame(width, height, "yuv420p")
        start = 0
        for plane in picture.planes:
            rows, columns, pitch = plane.height, plane.width, plane.line_size
            values = self._codes[start : start + rows * columns].reshape(rows, columns)
            np.frombuffer(plane, np.uint8)[: rows * pitch].reshape(rows, pitch)[:, :columns] = values
            start += rows * columns
        return picture


Codes = npt.NDArray[np.uint8]

SLOTS = 3
"""Frames whose codes are kept: one that is lit, one that is encoded, one between."""


class _Slot:
    """Codes of a frame on the host."""

    def __init__(self, count: int, device: Any) -> None:
        pinned = bool(device.is_cuda)
        self.sent_array, self.fetched_array = (
            wp.zeros(count, dtype=wp.uint8, device="cpu", pinned=pinned) for _ in range(2)
        )
        self.sent, self.fetched = self.sent_array.numpy(), self.fetched_array.numpy()
        self.done = wp.Event(device) if pinned else None
        self.used = False

    def wait(self) -> None:
        """Wait until the codes that were fetched last are there."""
        if self.used and self.done is not None:
            wait_for(self.done)


class DeviceVideo:
    """Conversion on a device of pictures of one size."""

    def __init__(self, size: tuple[int, int], device: Any) -> None:
        """Allocate.

        Args:
            size: Width and height in pixels, as ``can_convert`` wants them.
            device: Warp device.
        """
        self._width, self._height = size
        self._device = device
        count = self._width * self._height * 3 // 2
        with translating(device), wp.ScopedDevice(device):
            self._stream: Any = wp.get_stream(device) if device.is_cuda else None
            self._slots = [_Slot(count, device) for _ in range(SLOTS)]
            self._codes, self._lit_codes = (wp.zeros(count, dtype=wp.uint8) for _ in range(2))
            luma = self._width * self._height
            self._planes, self._lit_planes = ((codes[:luma], codes[luma:]) for codes in (self._codes, self._lit_codes))
            self._rgb = wp.zeros((self._height, self._width), dtype=wp.vec3ub)
            self._layouts = {
                (interleaved, left): yuv_layout(self._height, self._width, interleaved=interleaved, left=left)
                for interleaved in (False, True)
                for left in (False, True)
            }
            wp.load_module("warp_ar.kernels.picture.video_color", device)
        self._count = 0
        self.left = True
        """True if chroma of pictures that are sent lies at the left one of two columns, else between them."""

    def send(self, decoded: DecodedPicture) -> Any:
        """RGB of a picture on the device, (height, width) of ``wp.vec3ub``; the next one overwrites it."""
        picture = decoded.picture
        slot = self._slots[self._count % SLOTS]
        slot.wait()
        full = picture.format.name == "yuvj420p" or picture.color_range == ColorRange.JPEG
        matrix = matrix_of(picture)
        assert matrix is not None
        factors = rgb_factors(matrix, full_range=full)
        interleaved = picture.format.name == INTERLEAVED
        _copy_planes(picture, slot.sent, interleaved=interleaved)
        with exclusive(self._device):
            wp.copy(self._codes, slot.sent_array, stream=self._stream)
            layout = self._layouts[interleaved, self.left]
            rgb_from_yuv(*self._planes, layout, factors, self._rgb, device=self._device, stream=self._stream)
        return self._rgb

    def send_rgb(self, image: npt.NDArray[np.uint8]) -> Any:
        """As ``send``, of a picture that the host has converted."""
        with exclusive(self._device):
            self._rgb.assign(image)
        return self._rgb

    def fetch(self, image: Any) -> LitPicture:
        """Begin to bring a picture, (height, width) of ``wp.vec3ub``, to the encoder.

        It is to be copied before ``SLOTS`` more are sent.
        """
        slot = self._slots[self._count % SLOTS]
        self._count += 1
        with exclusive(self._device):
            layout = self._layouts[False, True]
            yuv_from_rgb(image, layout, *self._lit_planes, device=self._device, stream=self._stream)
            wp.copy(slot.fetched_array, self._lit_codes, stream=self._stream)
            if self._stream is not None:
                self._stream.record_event(slot.done)
        slot.used = True
        return LitPicture((self._height, self._width, 3), slot.fetched, slot.wait)

    def adapt(self, decoded: DecodedPicture, expected: npt.NDArray[np.uint8]) -> bool:
        """Find out where a picture's chroma lies, which PyAV does not tell, by trying.

        Args:
            decoded: The picture.
            expected: Its RGB as the host converts it.

        Returns:
            Whether it becomes the same RGB here, to the bit, and that the codes that the host makes of it.
        """
        for self.left in (True, False):
            rgb = self.send(decoded)
            codes = self.fetch(rgb)
            with exclusive(self._device):
                same = np.array_equal(rgb.numpy(), expected)
            if same:
                return self._are_codes_of(codes.copy(), expected)
        return False

    def _are_codes_of(self, picture: av.VideoFrame, image: npt.NDArray[np.uint8]) -> bool:
        """Return whether the host makes the same codes of a picture in RGB."""
        tick = fractions.Fraction(1, 30)
        source = av.VideoFrame.from_ndarray(image, format="rgb24")
        source.pts, source.time_base = 0, tick
        converter = rgb_to_yuv(self._width, self._height, tick)
        converter.push(source)
        expected, mine = (np.empty(self._width * self._height * 3 // 2, np.uint8) for _ in range(2))
        for codes, made in ((expected, converter.pull()), (mine, picture)):
            _copy_planes(made, codes, interleaved=False)
        return bool(np.array_equal(expected, mine))


def _copy_planes(picture: Any, codes_out: Codes, *, interleaved: bool) -> None:
    """Codes of a picture without the gaps behind its rows."""
    start = 0
    for plane in picture.planes:
        columns = plane.width * (2 if interleaved and start else 1)
        rows = np.frombuffer(plane, np.uint8)[: plane.height * plane.line_size].reshape(plane.height, plane.line_size)
        np.copyto(codes_out[start : start + plane.height * columns].reshape(plane.height, columns), rows[:, :columns])
        start += plane.height * columns
