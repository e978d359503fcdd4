"""Asynchronous transfers of frames to a CUDA device and of pictures back, by pinned memory and two streams.

A frame is written to pinned host memory, transferred to the device and processed by the kernels; the picture is then
transferred back to pinned memory. Each of ``SLOTS`` slots has buffers for one frame, so that the host fills one slot
while the copy engines transfer a second and the kernels work on a third. Kernels use separate arrays, because a
captured graph needs fixed addresses. The copies between these arrays and the slots, on the device, take a hundredth of
the time of the transfers.

A picture stays in its pinned memory until nothing refers to it, because another copy would take the host longer than
all other steps. A frame is not copied on the host either, if the source writes it into the memory of ``new_frame``, as
a ``Session`` does.
"""

from __future__ import annotations

import collections
import math
import weakref
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar.device import exclusive, wait_for

Image = npt.NDArray[np.uint8]

SLOTS = 3
"""Largest number of frames in progress; the host waits before it begins one more."""

KEPT = 8
"""Largest number of pictures in pinned memory; further ones use ordinary memory, for which the host waits."""

FRAME_BYTES = 1 << 29
"""Largest total size in bytes of pinned frames by ``new_frame``; further frames use ordinary memory, which is copied
before the transfer."""

MARKED = 16
"""Number of latest frames whose times on the device are kept."""


class Marks:
    """CUDA events of one frame's steps, for which streams wait and which measure the times.

    ``frame`` is the number of the frame; -1 before the first.
    """

    def __init__(self, device: Any) -> None:
        self.frame = -1
        self.sent, self.arrived, self.started = (wp.Event(device, enable_timing=True) for _ in range(3))


class Slot:
    """Buffers of one frame in progress."""

    marks: Marks
    """Events of the last uploaded frame."""

    def __init__(self, shape: tuple[int, int], device: Any) -> None:
        self.own = Pinned(shape)
        """Pinned memory for a frame whose own memory is not pinned."""
        self.source = self.own
        """Pinned memory from which the frame is sent."""
        self.given: Image | None = None
        """Caller's picture, if it is sent from its own memory."""
        self.frame = wp.zeros(shape, dtype=wp.vec3ub, device=device)
        self.image = wp.zeros(shape, dtype=wp.vec3ub, device=device)
        self.consumed = wp.Event(device)
        self.downloaded: Any = None
        """Event after the last download from this slot, or after a later download into the same buffer."""

    @property
    def host(self) -> Image:
        """Picture that is being sent."""
        return self.source.host if self.given is None else self.given


class Pinned:
    """Host memory that the device reads and writes asynchronously."""

    def __init__(self, shape: tuple[int, int], *, pinned: bool = True) -> None:
        self.array = wp.empty(shape, dtype=wp.vec3ub, device="cpu", pinned=pinned)
        self.host: Image = self.array.numpy()

    def lend(self, free: collections.deque[Any]) -> Image:
        """Return the memory as an array; once nothing refers to the array, this object is appended to ``free``."""
        holder = _Holder(self.host)
        weakref.finalize(holder, free.append, self)
        return np.asarray(holder)


class Buffer(Pinned):
    """Host memory for a downloaded picture, with the events of its rendering and its arrival."""

    def __init__(self, shape: tuple[int, int], device: Any, *, pinned: bool) -> None:
        super().__init__(shape, pinned=pinned)
        self.rendered, self.done = (wp.Event(device, enable_timing=True) for _ in range(2))


class _Holder:
    """Owner of memory to which several arrays refer; it is freed with the last of them."""

    def __init__(self, host: Image) -> None:
        self.__array_interface__ = host.__array_interface__


def _address(image: Image) -> int:
    return int(image.__array_interface__["data"][0])


class Transfers:
    """Transfers of frames of one size to and from one CUDA device."""

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
        for stream in (self._up, self._down):
            stream.wait_stream(self._compute)  # the compute stream clears the slots; the first frame must come later
        self._uploads = self._downloads = 0
        self._marks = [Marks(device) for _ in range(MARKED)]
        self._marking = self._marks[0]
        self._free = collections.deque(Buffer(shape, device, pinned=True) for _ in range(SLOTS))
        self._buffers = SLOTS
        self._frames: dict[int, Pinned] = {}
        """Pinned memory for frames from ``new_frame``, by its address."""
        self._free_frames: collections.deque[Pinned] = collections.deque()

    def close(self) -> None:
        """Wait for transfers to the host before their slots are freed."""
        for slot in self._slots:
            if slot.downloaded is not None:
                wait_for(slot.downloaded)

    def new_frame(self) -> Image:
        """Return an array for a frame that is sent without a copy; it must not be changed after it has been submitted.

        Returns:
            uint8 (height, width, 3), of any values. The memory is reused when nothing refers to it any more.
        """
        try:
            memory = self._free_frames.popleft()
        except IndexError:
            if 3 * math.prod(self._shape) * len(self._frames) >= FRAME_BYTES:
                return np.empty((*self._shape, 3), np.uint8)
            with exclusive(self._device):
                memory = Pinned(self._shape)
            self._frames[_address(memory.host)] = memory
        return memory.lend(self._free_frames)

    def upload(self, image: Image) -> Slot:
        """Start the transfer of a host picture to the device.

        A picture in an array of ``new_frame`` is sent from there; it must not be changed. Any other picture is copied
        first, so that the caller may overwrite it.

        Returns:
            Slot to pass to ``receive``, before ``SLOTS`` more pictures are sent.
        """
        slot = self._slots[self._uploads % SLOTS]
        if self._uploads >= SLOTS:
            wait_for(slot.marks.arrived)
            self._up.wait_event(slot.consumed)
        marks = slot.marks = self._marks[self._uploads % MARKED]
        marks.frame = self._uploads
        self._uploads += 1
        given = self._frames.get(_address(image))
        slot.source, slot.given = (slot.own, None) if given is None else (given, image)
        if given is None:
            np.copyto(slot.host, image)
        self._up.record_event(marks.sent)
        wp.copy(slot.frame, slot.source.array, stream=self._up)
        self._up.record_event(marks.arrived)
        return slot

    def receive(self, slot: Slot, frame_out: Any) -> None:
        """Copy an uploaded picture into ``frame_out`` on the stream of the kernels, which read it afterwards."""
        self._compute.wait_event(slot.marks.arrived)
        self._compute.record_event(slot.marks.started)
        self._marking = slot.marks
        wp.copy(frame_out, slot.frame, stream=self._compute)
        self._compute.record_event(slot.consumed)

    def download(self, image: Any) -> Picture:
        """Start the transfer of the device's picture to the host, after the kernels launched so far."""
        slot = self._slots[self._downloads % SLOTS]
        self._downloads += 1
        if not self._free and self._buffers < KEPT:
            with exclusive(self._device):
                self._free.append(Buffer(self._shape, self._device, pinned=True))
            self._buffers += 1
        try:
            buffer = self._free.popleft()
        except IndexError:
            buffer = Buffer(self._shape, self._device, pinned=False)
            kept: Image = buffer.host
        else:
            # The next picture for this memory is sent on the same stream, so it cannot arrive before this one.
            kept = buffer.lend(self._free)
        with exclusive(self._device):  # other pipelines may be capturing on the same stream
            if slot.downloaded is not None:
                self._compute.wait_event(slot.downloaded)
            wp.copy(slot.image, image, stream=self._compute)
            self._compute.record_event(buffer.rendered)
        self._down.wait_event(buffer.rendered)
        wp.copy(buffer.array, slot.image, stream=self._down)
        self._down.record_event(buffer.done)
        slot.downloaded = buffer.done
        return Picture(kept, buffer, self._marking)


class Picture:
    """Picture in transfer to the host."""

    def __init__(self, image: Image, buffer: Buffer, marks: Marks) -> None:
        """Store the host array, which is complete after the event ``buffer.done``, and the events of its frame."""
        self._image, self._rendered, self._done = image, buffer.rendered, buffer.done
        self._marks, self._frame = marks, marks.frame

    def result(self) -> Image:
        """Wait for the picture and return it; its memory is not reused while anything refers to it."""
        wait_for(self._done)
        return self._image

    def steps(self) -> dict[str, float]:
        """Return milliseconds of the frame's steps on the device, by name.

        The result is empty if ``MARKED`` later frames have reused the events.
        """
        wait_for(self._done)
        marks = self._marks
        if marks.frame != self._frame:
            return {}
        pairs = {
            "upload": (marks.sent, marks.arrived),
            "kernels": (marks.started, self._rendered),
            "download": (self._rendered, self._done),
        }
        times = {name: wp.get_event_elapsed_time(*pair, synchronize=False) for name, pair in pairs.items()}
        return {name: float(milliseconds) for name, milliseconds in times.items()}
