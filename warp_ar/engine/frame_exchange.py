"""Frames in the memory of other libraries: objects with ``__dlpack__`` or ``__cuda_array_interface__``.

A frame on the pipeline's CUDA device is read without a copy. The device waits until the library that made the frame,
its producer, has written it: a DLPack producer is told the reading stream, and ``__cuda_array_interface__`` names the
writing stream. The frame is referenced until the kernels have read it, so that its owner does not reuse the memory
meanwhile.

References:
    Python array API standard, ``__dlpack__``; Numba, CUDA Array Interface, version 3.
"""

from __future__ import annotations

import collections
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar.device import exclusive
from warp_ar.errors import UsageError, reason

HOST = (1, 3)
"""DLPack device types that the host can read: CPU, and memory pinned by CUDA."""

CUDA = (2, 13)
"""DLPack device types of CUDA memory and of memory managed by CUDA."""


def adopt_frame(image: Any, size: tuple[int, int], device: Any) -> npt.NDArray[np.uint8] | Any:
    """Return a frame of any supported kind as an array that the pipeline can read.

    Args:
        image: uint8 RGB (height, width, 3) as a NumPy array or an object with ``__dlpack__`` or
            ``__cuda_array_interface__``, or a Warp array (height, width) of ``wp.vec3ub``.
        size: Width and height of the pipeline's frames.
        device: Device of the pipeline.

    Returns:
        A contiguous NumPy array, or a Warp array of ``wp.vec3ub`` on the device that refers to the frame's memory.

    Raises:
        UsageError: The frame has another size or type, or lies on another device.
    """
    width, height = size
    if isinstance(image, wp.array) and image.dtype != wp.uint8:
        if image.shape != (height, width) or image.dtype != wp.vec3ub or image.device != device:
            raise UsageError(
                f"frame is a Warp array {image.shape} of {image.dtype.__name__} on {image.device}; "
                f"expected ({height}, {width}) of vec3ub on {device}"
            )
        return image
    if isinstance(image, np.ndarray):
        return _host_frame(image, size, "")
    kind = type(image).__name__
    if hasattr(image, "__dlpack__") and hasattr(image, "__dlpack_device__"):
        return _from_dlpack(image, size, device, kind)
    if hasattr(image, "__cuda_array_interface__"):
        return _from_cuda(image, size, device, kind)
    raise UsageError(f"frame is {kind}; expected uint8 RGB ({height}, {width}, 3)")


def _host_frame(image: npt.NDArray[Any], size: tuple[int, int], kind: str) -> npt.NDArray[np.uint8]:
    expected = (size[1], size[0], 3)
    if image.shape != expected or image.dtype != np.uint8:
        raise UsageError(f"frame is {kind}{image.dtype} {image.shape}; expected uint8 RGB {expected}")
    return np.ascontiguousarray(image)


def _from_dlpack(image: Any, size: tuple[int, int], device: Any, kind: str) -> Any:
    place, ordinal = (int(number) for number in image.__dlpack_device__())
    refused = (TypeError, ValueError, BufferError, RuntimeError)
    if place in HOST:
        try:
            return _host_frame(np.from_dlpack(image), size, f"{kind} ")
        except refused as error:
            if isinstance(error, UsageError):
                raise
            raise UsageError(f"frame is {kind}, which gives no array by __dlpack__: {reason(error)}") from error
    if place not in CUDA or not device.is_cuda or ordinal != device.ordinal:
        where = f"cuda:{ordinal}" if place in CUDA else f"a device of DLPack's kind {place}"
        here = f" or on {device}" if device.is_cuda else ""
        raise UsageError(f"frame is {kind} on {where}; expected one on the host{here}")
    try:
        with exclusive(device):
            array = wp.from_dlpack(image)
            told = np.dtype(wp.dtype_to_numpy(array.dtype))
            _check_strides(kind, told, array.shape, array.strides, size)
            return wp.from_dlpack(image, dtype=wp.vec3ub)
    except refused as error:
        if isinstance(error, UsageError):
            raise
        raise UsageError(f"frame is {kind}, which gives no array by __dlpack__: {reason(error)}") from error


def _from_cuda(image: Any, size: tuple[int, int], device: Any, kind: str) -> Any:
    if not device.is_cuda:
        raise UsageError(f"frame is {kind} on a CUDA device; expected one on the host")
    told = image.__cuda_array_interface__
    _check_strides(kind, np.dtype(told["typestr"]), told["shape"], told.get("strides"), size)
    with exclusive(device):
        stream = told.get("stream")
        if stream is not None:
            wp.get_stream(device).wait_stream(wp.Stream(device, cuda_stream=int(stream)))
        array = wp.array(image, dtype=wp.vec3ub, device=device, copy=False)
    array.owner = image
    return array


def _check_strides(
    kind: str, dtype: np.dtype[Any], shape: tuple[int, ...], strides: tuple[int, ...] | None, size: tuple[int, int]
) -> None:
    """Check that an array on the device holds a frame with three adjacent bytes per pixel.

    Args:
        kind: Name of the frame's type in messages.
        dtype: Type of the array's elements.
        shape: Shape of the array.
        strides: Strides of the array in bytes; None: contiguous.
        size: Width and height of the pipeline's frames.

    Raises:
        UsageError: The array has another size, type or layout.
    """
    expected = (size[1], size[0], 3)
    if tuple(shape) != expected or dtype != np.uint8:
        raise UsageError(f"frame is {kind} {dtype} {tuple(shape)}; expected uint8 RGB {expected}")
    if strides is not None and tuple(strides[1:]) != (3, 1):
        raise UsageError(f"frame is {kind} with strides {tuple(strides)}; expected pixels of 3 bytes side by side")


class Borrowed:
    """References to frames in the memory of other libraries, which kernels are still reading."""

    def __init__(self, device: Any) -> None:
        self._device = device
        self._kept: collections.deque[tuple[Any, Any]] = collections.deque()

    def keep(self, frame: Any) -> None:
        """Refer to a frame until the kernels launched so far are done; release frames whose kernels are done."""
        if not self._device.is_cuda:
            return
        with exclusive(self._device):
            while self._kept and self._kept[0][1].is_complete:
                self._kept.popleft()
            self._kept.append((frame, wp.get_stream(self._device).record_event()))
