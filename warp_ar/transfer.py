"""Frames to a CUDA device and pictures back, beside the kernels: pinned memory, and a stream for each direction.

A frame goes into pinned memory (host), to the device (copy engine), through the kernels, and back into pinned memory
(copy engine). Each of ``SLOTS`` slots has buffers for the first two and the last step, so that the host fills one, the
engines move a second and the kernels work on a third. Kernels read and write arrays of their own, at addresses that a
captured graph may keep; they are copied to and from the slots on the device, which takes a hundredth of the way over
the bus. A picture stays in the pinned memory that it came into until nobody refers to it any more: to copy it again
takes the host longer than all the rest.
"""

from __future__ import annotations

import collections
import itertools
import weakref
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar.device import exclusive, wait_for

Image = npt.NDArray[np.uint8]

SLOTS = 3
"""Frames under way at once; the host waits before it begins one more."""

KEPT = 8
"""Pictures in pinned memory at once; who keeps more gets those in ordinary memory, for which the host waits."""


COPY_THREADS = 4
"""Threads that copy a large frame into pinned memory."""

COPY_BYTES = 12_000_000
"""From which on that pays for handing parts over; a smaller frame's copy is no longer than its kernels."""

MARKED = 16
"""Frames whose times on the device are remembered."""


class Marks:
    """When a frame took which step on the device."""

    def __init__(self, device: Any) -> None:
        self.frame = -1
        self.sent, self.arrived, self.started, self.rendered, self.returned = (
            wp.Event(device, enable_timing=True) for _ in range(5)
        )


class Slot:
    """Buffers of one frame under way."""

    marks: Marks

    def __init__(self, shape: tuple[int, int], device: Any) -> None:
        self.pinned = wp.zeros(shape, dtype=wp.vec3ub, device="cpu", pinned=True)
        self.host = self.pinned.numpy()
        self.frame = wp.zeros(shape, dtype=wp.vec3ub, device=device)
        self.image = wp.zeros(shape, dtype=wp.vec3ub, device=device)
        self.uploaded, self.consumed, self.rendered, self.downloaded = (wp.Event(device) for _ in range(4))


class _Holder:
    """What arrays over one buffer of pictures refer to: it goes when the last of them does."""

    def __init__(self, host: Image) -> None:
        self.__array_interface__ = host.__array_interface__


class Transfers:
    """Moves frames of one size to and from one CUDA device."""

    def __init__(self, shape: tuple[int, int], device: Any) -> None:
        """Allocate the slots.

        Args:
            shape: Rows and columns of a frame.
            device: CUDA device.
        """
        self._shape, self._device = shape, device
        self._compute = wp.get_stream(device)
        self._up, self._down = wp.Stream(device), wp.Stream(device)
        self._slots = [Slot(shape, device) for _ in range(SLOTS)]
        self._uploads = self._downloads = 0
        large = 3 * shape[0] * shape[1] >= COPY_BYTES
        self._pool = ThreadPoolExecutor(COPY_THREADS - 1, "warp_ar-copy") if large else None
        self._marks = [Marks(device) for _ in range(MARKED)]
        self._marking = self._marks[0]
        self._free: collections.deque[tuple[Any, Image, Any]] = collections.deque()
        for _ in range(SLOTS):
            self._free.append(self._new_buffer())
        self._buffers = SLOTS

    def _new_buffer(self) -> tuple[Any, Image, Any]:
        pinned = wp.zeros(self._shape, dtype=wp.vec3ub, device="cpu", pinned=True)
        return pinned, pinned.numpy(), wp.Event(self._device)

    def close(self) -> None:
        """Stop the copying threads."""
        if self._pool is not None:
            self._pool.shutdown()

    def _copy(self, target: Image, source: Image) -> None:
        if self._pool is None:
            np.copyto(target, source)
            return
        edges = [len(source) * part // COPY_THREADS for part in range(COPY_THREADS + 1)]
        parts = [slice(*pair) for pair in itertools.pairwise(edges)]
        others = [self._pool.submit(np.copyto, target[part], source[part]) for part in parts[1:]]
        np.copyto(target[parts[0]], source[parts[0]])
        for other in others:
            other.result()

    def upload(self, image: Image) -> Slot:
        """Send a host picture on its way; when this returns, the caller may write it anew.

        Returns:
            What to ``receive`` it from, before ``SLOTS`` more are sent.
        """
        slot = self._slots[self._uploads % SLOTS]
        if self._uploads >= SLOTS:
            wait_for(slot.uploaded)
            self._up.wait_event(slot.consumed)
        slot.marks = self._marks[self._uploads % MARKED]
        slot.marks.frame = self._uploads
        self._uploads += 1
        self._copy(slot.host, image)
        self._up.record_event(slot.marks.sent)
        wp.copy(slot.frame, slot.pinned, stream=self._up)
        self._up.record_event(slot.marks.arrived)
        self._up.record_event(slot.uploaded)
        return slot

    def receive(self, slot: Slot, frame_out: Any) -> None:
        """Have kernels that are launched from now on see an uploaded picture in ``frame_out``."""
        self._compute.wait_event(slot.uploaded)
        self._compute.record_event(slot.marks.started)
        self._marking = slot.marks
        wp.copy(frame_out, slot.frame, stream=self._compute)
        self._compute.record_event(slot.consumed)

    def download(self, image: Any) -> Picture:
        """Send the device's picture to the host as soon as the kernels launched so far have written it."""
        slot, marks = self._slots[self._downloads % SLOTS], self._marking
        self._downloads += 1
        self._compute.wait_event(slot.downloaded)
        wp.copy(slot.image, image, stream=self._compute)
        self._compute.record_event(slot.rendered)
        self._compute.record_event(marks.rendered)
        self._down.wait_event(slot.rendered)
        if not self._free and self._buffers < KEPT:
            with exclusive(self._device):
                self._free.append(self._new_buffer())
            self._buffers += 1
        try:
            buffer = self._free.popleft()
        except IndexError:
            ordinary = wp.empty(self._shape, dtype=wp.vec3ub, device="cpu")
            buffer = (ordinary, ordinary.numpy(), wp.Event(self._device))
            kept: Image = buffer[1]
        else:
            holder = _Holder(buffer[1])
            # The next picture is sent there on the same stream, so after this one even if nobody waited for it.
            weakref.finalize(holder, self._free.append, buffer)
            kept = np.asarray(holder)
        target, _, done = buffer
        wp.copy(target, slot.image, stream=self._down)
        self._down.record_event(slot.downloaded)
        self._down.record_event(marks.returned)
        self._down.record_event(done)
        return Picture(kept, done, marks)


class Picture:
    """A picture on its way to the host."""

    def __init__(self, image: Image, done: Any, marks: Marks) -> None:
        """``image`` is there once the event ``done`` has come to pass."""
        self._image, self._done, self._marks, self._frame = image, done, marks, marks.frame

    def result(self) -> Image:
        """Wait for the picture; the array is the caller's for as long as anything refers to it."""
        wait_for(self._done)
        return self._image

    def steps(self) -> dict[str, float]:
        """Milliseconds of its steps on the device; none where ``MARKED`` later frames have overwritten them."""
        wait_for(self._done)
        marks = self._marks
        if marks.frame != self._frame:
            return {}
        pairs = {
            "upload": (marks.sent, marks.arrived),
            "kernels": (marks.started, marks.rendered),
            "download": (marks.rendered, marks.returned),
        }
        times = {name: wp.get_event_elapsed_time(*pair, synchronize=False) for name, pair in pairs.items()}
        return {name: float(milliseconds) for name, milliseconds in times.items()}
