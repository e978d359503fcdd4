"""Frames to a CUDA device and pictures back, beside the kernels: pinned memory, and a stream for each direction.

A frame goes into pinned memory (host), to the device (copy engine), through the kernels, and back into pinned memory
(copy engine). Each of ``SLOTS`` slots has buffers for the first two and the last step, so that the host fills one, the
engines move a second and the kernels work on a third. Kernels read and write arrays of their own, at addresses that a
captured graph may keep; they are copied to and from the slots on the device, which takes a hundredth of the way over
the bus. A picture stays in the pinned memory that it came into until nobody refers to it any more: to copy it again
takes the host longer than all the rest. So it is with frames: who writes them where ``new_frame`` says, as a
``Session`` does, has no copy to wait for.
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
"""Frames under way at once; the host waits before it begins one more."""

KEPT = 8
"""Pictures in pinned memory at once; who keeps more gets those in ordinary memory, for which the host waits."""

FRAME_BYTES = 1 << 29
"""Largest total of bytes of pinned frames by ``new_frame``; more are in ordinary memory, which is copied before the
transfer."""

MARKED = 16
"""Frames whose times on the device are remembered."""


class Marks:
    """When a frame took which step on its way to the kernels; streams wait for the same events that tell the times."""

    def __init__(self, device: Any) -> None:
        self.frame = -1
        self.sent, self.arrived, self.started = (wp.Event(device, enable_timing=True) for _ in range(3))


class Slot:
    """Buffers of one frame under way."""

    marks: Marks
    """Events of the last uploaded frame."""

    def __init__(self, shape: tuple[int, int], device: Any) -> None:
        self.own = Pinned(shape)
        """Memory for a frame that lies elsewhere."""
        self.source = self.own
        """Array that is sent."""
        self.given: Image | None = None
        """The caller's picture, while it is sent from where it lies."""
        self.frame = wp.zeros(shape, dtype=wp.vec3ub, device=device)
        self.image = wp.zeros(shape, dtype=wp.vec3ub, device=device)
        self.consumed = wp.Event(device)
        self.downloaded: Any = None
        """Event after the last picture from here, or from a later slot."""

    @property
    def host(self) -> Image:
        """The picture that is sent."""
        return self.source.host if self.given is None else self.given


class Pinned:
    """Memory of the host that the device reads and writes beside what the host does."""

    def __init__(self, shape: tuple[int, int], *, pinned: bool = True) -> None:
        self.array = wp.empty(shape, dtype=wp.vec3ub, device="cpu", pinned=pinned)
        self.host: Image = self.array.numpy()

    def lend(self, free: collections.deque[Any]) -> Image:
        """The memory as an array; when nobody refers to it any more this is among those that are free again."""
        holder = _Holder(self.host)
        weakref.finalize(holder, free.append, self)
        return np.asarray(holder)


class Buffer(Pinned):
    """Memory of the host that a picture comes into, and when it was rendered and was there."""

    def __init__(self, shape: tuple[int, int], device: Any, *, pinned: bool) -> None:
        super().__init__(shape, pinned=pinned)
        self.rendered, self.done = (wp.Event(device, enable_timing=True) for _ in range(2))


class _Holder:
    """Owner of one piece of memory that several arrays refer to: it goes when the last of them does."""

    def __init__(self, host: Image) -> None:
        self.__array_interface__ = host.__array_interface__


def _address(image: Image) -> int:
    return int(image.__array_interface__["data"][0])


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
        for stream in (self._up, self._down):
            stream.wait_stream(self._compute)  # which clears the slots: a frame must not come before that
        self._uploads = self._downloads = 0
        self._marks = [Marks(device) for _ in range(MARKED)]
        self._marking = self._marks[0]
        self._free = collections.deque(Buffer(shape, device, pinned=True) for _ in range(SLOTS))
        self._buffers = SLOTS
        self._frames: dict[int, Pinned] = {}
        """Memory that ``new_frame`` has given, by its address."""
        self._free_frames: collections.deque[Pinned] = collections.deque()

    def close(self) -> None:
        """Let what is on its way to the host arrive before the slots that it lies in go."""
        for slot in self._slots:
            if slot.downloaded is not None:
                wait_for(slot.downloaded)

    def new_frame(self) -> Image:
        """Memory for a frame that is sent from where it lies: it must stay as it is once it has been begun.

        Returns:
            uint8 (height, width, 3), of any values; when nobody refers to it any more it is given again.
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
        """Send a host picture on its way; when this returns, the caller may write it anew.

        A picture that ``new_frame`` gave is sent from where it lies, and is held until it has been sent.

        Returns:
            What to ``receive`` it from, before ``SLOTS`` more are sent.
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
        """Have kernels that are launched from now on see a picture that was sent in ``frame_out``."""
        self._compute.wait_event(slot.marks.arrived)
        self._compute.record_event(slot.marks.started)
        self._marking = slot.marks
        wp.copy(frame_out, slot.frame, stream=self._compute)
        self._compute.record_event(slot.consumed)

    def download(self, image: Any) -> Picture:
        """Send the device's picture to the host as soon as the kernels launched so far have written it."""
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
            # The next picture is sent there on the same stream, so after this one even if nobody waited for it.
            kept = buffer.lend(self._free)
        with exclusive(self._device):  # kernels of other pipelines may be captured on the same stream
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
    """A picture on its way to the host."""

    def __init__(self, image: Image, buffer: Buffer, marks: Marks) -> None:
        """``image`` is there once the buffer is done; ``marks`` are of the frame that it was made of."""
        self._image, self._rendered, self._done = image, buffer.rendered, buffer.done
        self._marks, self._frame = marks, marks.frame

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
            "kernels": (marks.started, self._rendered),
            "download": (self._rendered, self._done),
        }
        times = {name: wp.get_event_elapsed_time(*pair, synchronize=False) for name, pair in pairs.items()}
        return {name: float(milliseconds) for name, milliseconds in times.items()}
