"""Values that change per frame, in one block of memory: camera, virtual lights, virtual objects, proxies.

The host writes the block and uploads it in one copy to a fixed address. A CUDA graph therefore reads new values without
being captured again. The copy is asynchronous, from pinned memory that is not overwritten before the copy is done.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_ar.device import wait_for
from warp_ar.kernels.structs import FrameParams, Light, Shape, struct_dtype

_ALIGNMENT = 16
_SLOTS = 4  # largest number of uploads in progress


class FrameBlock:
    """Block of memory, as typed NumPy views on the host and as Warp arrays of its uploaded copy on the device."""

    def __init__(self, device: Any, lights: int, objects: int, proxies: int = 0) -> None:
        """Allocate the block.

        Args:
            device: Warp device.
            lights: Number of virtual lights.
            objects: Number of virtual objects.
            proxies: Number of proxies.
        """
        layout = (
            ("params", FrameParams, 1),
            ("lights", Light, lights),
            ("objects", Shape, objects),
            ("proxies", Shape, proxies),
        )
        offsets: list[int] = []
        size = 0
        for _, struct, count in layout:
            offsets.append(size)
            bytes_needed = struct_dtype(struct).itemsize * max(count, 1)
            size += -(-bytes_needed // _ALIGNMENT) * _ALIGNMENT
        self._device_buffer = wp.zeros(size, dtype=wp.uint8, device=device)
        self._pinned: list[tuple[Any, Any, Any]] = []
        if device.is_cpu:
            self._bytes = self._device_buffer.numpy()
        else:
            buffers = [wp.zeros(size, dtype=wp.uint8, device="cpu", pinned=True) for _ in range(_SLOTS)]
            self._pinned = [(buffer, buffer.numpy(), wp.Event(device)) for buffer in buffers]
            self._stream, self._bytes = wp.get_stream(device), np.zeros(size, np.uint8)
        self._uploads = 0
        self._host: dict[str, Any] = {}
        self._device: dict[str, Any] = {}
        for (name, struct, count), offset in zip(layout, offsets, strict=True):
            dtype = struct_dtype(struct)
            self._host[name] = self._bytes[offset : offset + dtype.itemsize * count].view(dtype)
            pointer = self._device_buffer.ptr + offset if count else None
            self._device[name] = wp.array(ptr=pointer, dtype=struct, shape=(count,), device=device)

    def host(self, name: str) -> Any:
        """Return a writable NumPy structured view of ``params``, ``lights``, ``objects`` or ``proxies``."""
        return self._host[name]

    def device_array(self, name: str) -> Any:
        """Return the Warp array of ``params``, ``lights``, ``objects`` or ``proxies``, which ``upload`` fills."""
        return self._device[name]

    def upload(self) -> None:
        """Copy the host's values to the device; on CPU both are the same memory."""
        if not self._pinned:
            return
        buffer, view, done = self._pinned[self._uploads % _SLOTS]
        if self._uploads >= _SLOTS:
            wait_for(done)
        self._uploads += 1
        view[:] = self._bytes
        wp.copy(self._device_buffer, buffer, stream=self._stream)
        self._stream.record_event(done)
