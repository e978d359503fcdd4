"""Frames to a CUDA device and pictures back, beside the kernels: pinned memory, and a stream for each direction.

A frame takes four steps: into pinned memory (host), to the device (copy engine), through the kernels, back into pinned
memory (copy engine). Each of ``SLOTS`` slots has buffers for all four, so that the host fills one, the engines move a
second and the kernels work on a third. Kernels read and write arrays of their own, at addresses that a captured graph
may keep; they are copied to and from the slots on the device, which takes a hundredth of the way over the bus.
"""

from __future__ import annotations

import itertools
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

Image = npt.NDArray[np.uint8]

SLOTS = 3
"""Frames under way at once; the host waits before it begins one more."""

COPY_THREADS = 4
"""Threads that copy one frame to or from pinned memory; one alone takes longer than the bus."""

_COPY_ROWS = 256
"""Rows from which splitting a host copy pays for handing parts over."""


class _Slot:
    """Buffers of one frame under way."""

    def __init__(self, shape: tuple[int, int], device: Any) -> None:
        self.to_device = wp.zeros(shape, dtype=wp.vec3ub, device="cpu", pinned=True)
        self.from_device = wp.zeros(shape, dtype=wp.vec3ub, device="cpu", pinned=True)
        self.to_device_host, self.from_device_host = self.to_device.numpy(), self.from_device.numpy()
        self.frame = wp.zeros(shape, dtype=wp.vec3ub, device=device)
        self.image = wp.zeros(shape, dtype=wp.vec3ub, device=device)
        self.uploaded, self.consumed, self.rendered, self.downloaded = (wp.Event(device) for _ in range(4))
        self.fetched: Future[Image] | None = None


class Transfers:
    """Moves frames of one size to and from one CUDA device."""

    def __init__(self, shape: tuple[int, int], device: Any) -> None:
        """Allocate the slots.

        Args:
            shape: Rows and columns of a frame.
            device: CUDA device.
        """
        self._compute = wp.get_stream(device)
        self._up, self._down = wp.Stream(device), wp.Stream(device)
        self._slots = [_Slot(shape, device) for _ in range(SLOTS)]
        self._uploads = self._downloads = 0
        self._pool = ThreadPoolExecutor(COPY_THREADS, "warp_ar-copy") if shape[0] >= 2 * _COPY_ROWS else None
        self._fetcher = ThreadPoolExecutor(1, "warp_ar-fetch")

    def close(self) -> None:
        """Stop the copying threads."""
        self._fetcher.shutdown()
        if self._pool is not None:
            self._pool.shutdown()

    def _copy(self, target: Image, source: Image) -> None:
        """Copy one host picture to another."""
        if self._pool is None:
            np.copyto(target, source)
            return
        edges = np.linspace(0, len(source), COPY_THREADS + 1).astype(int)
        parts = [slice(start, stop) for start, stop in itertools.pairwise(edges)]
        others = [self._pool.submit(np.copyto, target[part], source[part]) for part in parts[1:]]
        np.copyto(target[parts[0]], source[parts[0]])
        for other in others:
            other.result()

    def upload(self, image: Image, frame_out: Any) -> None:
        """Send a host picture to ``frame_out``; kernels launched from now on see it, those under way do not."""
        slot = self._slots[self._uploads % SLOTS]
        if self._uploads >= SLOTS:
            wp.synchronize_event(slot.uploaded)
            self._up.wait_event(slot.consumed)
        self._uploads += 1
        self._copy(slot.to_device_host, image)
        wp.copy(slot.frame, slot.to_device, stream=self._up)
        self._up.record_event(slot.uploaded)
        self._compute.wait_event(slot.uploaded)
        wp.copy(frame_out, slot.frame, stream=self._compute)
        self._compute.record_event(slot.consumed)

    def download(self, image: Any) -> Future[Image]:
        """Send the device's picture to the host as soon as the kernels launched so far have written it.

        Returns:
            Gives the picture, an array of its own; a thread waits for it and copies it out of pinned memory.
        """
        slot = self._slots[self._downloads % SLOTS]
        self._downloads += 1
        if slot.fetched is not None:
            slot.fetched.result()  # its buffers are needed now
            self._compute.wait_event(slot.downloaded)
        wp.copy(slot.image, image, stream=self._compute)
        self._compute.record_event(slot.rendered)
        self._down.wait_event(slot.rendered)
        wp.copy(slot.from_device, slot.image, stream=self._down)
        self._down.record_event(slot.downloaded)
        slot.fetched = self._fetcher.submit(self._fetch, slot)
        return slot.fetched

    def _fetch(self, slot: _Slot) -> Image:
        wp.synchronize_event(slot.downloaded)
        image: Image = np.empty(slot.from_device_host.shape, np.uint8)
        self._copy(image, slot.from_device_host)
        return image
