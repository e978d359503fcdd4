"""Frames to a CUDA device and pictures back, beside the kernels: pinned memory, and a stream for each direction.

A frame goes into pinned memory (host), to the device (copy engine), through the kernels, and back into pinned memory
(copy engine). Each of ``SLOTS`` slots has buffers for the first two and the last step, so that the host fills one, the
engines move a second and the kernels work on a third. Kernels read and write arrays of their own, at addresses that a
captured graph may keep; they are copied to and from the slots on the device, which takes a hundredth of the way over
the bus. A picture stays in the pinned memory that it came into until nobody refers to it any more: to copy it again
takes the host longer than all the rest. So it is with frames: who writes them where ``new_frame`` says has no copy to
wait for.
"""

from __future__ import annotations

import collections
import itertools
import math
import queue
import threading
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

COPY_THREADS = 4
"""Threads at most that copy a frame into pinned memory."""

COPY_BYTES = 3_000_000
"""That each of them copies at least: to hand a part over, and to hear that it is done, takes turns with other threads
at the interpreter. Of a frame that is smaller than two such parts the caller's thread copies all."""

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
        self.sent = True
        """True if the picture that was copied to here has been sent on its way."""

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


class _Copier:
    """A thread that copies parts of frames, and lets go of the interpreter's lock meanwhile."""

    def __init__(self) -> None:
        self._jobs: queue.SimpleQueue[tuple[Image, Image] | None] = queue.SimpleQueue()
        self._begun, self._done = threading.Lock(), threading.Lock()
        self._begun.acquire()
        self._done.acquire()
        held = self._jobs, self._begun, self._done  # and not this object: the thread ends with it
        self._thread = threading.Thread(target=_copy, args=held, name="warp_ar-copy", daemon=True)
        self._thread.start()
        weakref.finalize(self, self._jobs.put, None)

    def begin(self, target: Image, source: Image) -> None:
        """Have a part copied."""
        self._jobs.put((target, source))

    def wait_for_begin(self) -> None:
        """Let it have the interpreter's lock until it needs it no more."""
        self._begun.acquire()

    def wait(self) -> None:
        """Wait until the part that was begun is copied."""
        self._done.acquire()

    def close(self) -> None:
        """End the thread."""
        self._jobs.put(None)
        self._thread.join()


def _copy(jobs: queue.SimpleQueue[tuple[Image, Image] | None], begun: threading.Lock, done: threading.Lock) -> None:
    """The life of a copying thread."""
    while (job := jobs.get()) is not None:
        begun.release()
        np.copyto(*job)
        del job  # the caller's picture is not held until the next one comes
        done.release()


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
        self._parts = split_rows(*shape)
        self._copiers = [_Copier() for _ in self._parts] if len(self._parts) > 1 else []
        self._are_copying = False
        self._marks = [Marks(device) for _ in range(MARKED)]
        self._marking = self._marks[0]
        self._free = collections.deque(Buffer(shape, device, pinned=True) for _ in range(SLOTS))
        self._buffers = SLOTS
        self._frames: dict[int, Pinned] = {}
        """Memory that ``new_frame`` has given, by its address."""
        self._free_frames: collections.deque[Pinned] = collections.deque()

    def close(self) -> None:
        """Stop the copying threads; what is on its way to the host arrives before the slots that it lies in go."""
        for copier in self._copiers:
            copier.close()
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

    def begin(self, image: Image) -> Slot:
        """Begin to copy a host picture to where it is sent from; ``send`` must follow before the caller writes it anew.

        A picture that ``new_frame`` gave is there, and is held until it has been sent.

        Returns:
            What to ``send`` and to ``receive`` it from, before ``SLOTS`` more are begun.
        """
        slot = self._slots[self._uploads % SLOTS]
        if self._uploads >= SLOTS:
            wait_for(slot.marks.arrived)
            self._up.wait_event(slot.consumed)
        self._wait_for_copies()
        marks = slot.marks = self._marks[self._uploads % MARKED]
        marks.frame, slot.sent = self._uploads, False
        self._uploads += 1
        given = self._frames.get(_address(image))
        slot.source, slot.given = (slot.own, None) if given is None else (given, image)
        if given is not None:
            return slot
        if not self._copiers:
            np.copyto(slot.host, image)
            return slot
        for copier, part in zip(self._copiers, self._parts, strict=True):
            copier.begin(slot.host[part], image[part])
        for copier in self._copiers:
            copier.wait_for_begin()
        self._are_copying = True
        return slot

    def _wait_for_copies(self) -> None:
        if self._are_copying:
            for copier in self._copiers:
                copier.wait()
            self._are_copying = False

    def send(self, slot: Slot) -> None:
        """Send a picture on its way once it has been copied, unless it was; then the caller may write it anew."""
        if slot.sent:
            return
        self._wait_for_copies()
        marks, slot.sent = slot.marks, True
        self._up.record_event(marks.sent)
        wp.copy(slot.frame, slot.source.array, stream=self._up)
        self._up.record_event(marks.arrived)

    def upload(self, image: Image) -> Slot:
        """Send a host picture on its way; when this returns, the caller may write it anew.

        Returns:
            What to ``receive`` it from, before ``SLOTS`` more are sent.
        """
        slot = self.begin(image)
        self.send(slot)
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


def split_rows(height: int, width: int) -> list[slice]:
    """Rows of a frame in as many parts as threads copy it: ``COPY_BYTES`` each or more."""
    parts = min(COPY_THREADS, max(3 * height * width // COPY_BYTES, 1))
    return [slice(*pair) for pair in itertools.pairwise(height * part // parts for part in range(parts + 1))]


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
