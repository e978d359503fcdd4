"""The way of frames to a CUDA device and of pictures back."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp

from warp_ar.engine import transfer
from warp_ar.engine.transfer import KEPT, Transfers


@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize("size", [(48, 64), (1080, 1920)])
def test_pictures_come_back_as_they_went(device: str, size: tuple[int, int], given: bool) -> None:
    """More pictures than there is pinned memory for, all kept, each with its bits; what was sent is written anew."""
    if wp.get_device(device).is_cpu:
        pytest.skip("on the CPU nothing is sent")
    transfers = Transfers(size, wp.get_device(device))
    frame = wp.zeros(size, dtype=wp.vec3ub, device=device)
    images = np.random.default_rng(1).integers(0, 256, (KEPT + 3, *size, 3), np.uint8)
    source, pictures = np.empty_like(images[0]), []
    for image in images:
        source = transfers.new_frame() if given else source
        source[...] = image
        slot = transfers.upload(source)
        if not given:
            source[...] = 0
        transfers.receive(slot, frame)
        pictures.append(transfers.download(frame))
    for image, picture in zip(images, pictures, strict=True):
        np.testing.assert_array_equal(picture.result(), image)
        assert all(milliseconds > 0.0 for milliseconds in picture.steps().values())
        assert set(picture.steps()) == {"upload", "kernels", "download"}
    transfers.close()


def test_a_new_frame_is_sent_from_where_it_lies(hosts_side) -> None:
    """Nothing is copied on the host; it is held until it has been sent, and given again when nobody refers to it."""
    (make, done), size = hosts_side, (1080, 1920)
    transfers, frame = make(size), wp.zeros(size, dtype=wp.vec3ub, device="cpu")
    assert done == ["up waits for compute", "down waits for compute"]  # which clears the slots
    values = np.random.default_rng(3).integers(0, 256, (*size, 3), np.uint8)
    first = transfers.new_frame()
    first[...] = values
    done.clear()
    slot = transfers.upload(first)
    assert np.shares_memory(slot.host, first)
    assert not np.shares_memory(slot.own.host, first)
    assert done == ["up record", "up copy", "up record"]
    transfers.receive(slot, frame)
    np.testing.assert_array_equal(frame.numpy(), values)

    place = first.ctypes.data
    del first
    others = [transfers.new_frame() for _ in range(2)]
    assert place not in [other.ctypes.data for other in others]  # it may be on its way
    for _ in range(transfer.SLOTS):
        transfers.upload(values)
    assert transfers.new_frame().ctypes.data == place
    # Memory that was given counts as such in whatever array it comes; other memory is copied.
    other = others[0].reshape(-1).reshape(others[0].shape)
    assert transfers.upload(other).given is other
    assert transfers.upload(values).given is None
    transfers.close()


def test_frames_that_are_kept_come_in_ordinary_memory_in_the_end(hosts_side, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is sent as any picture is; once others have gone there is pinned memory again."""
    size = (48, 64)
    monkeypatch.setattr(transfer, "FRAME_BYTES", 3 * 3 * 48 * 64)
    transfers = hosts_side[0](size)
    frames = [transfers.new_frame() for _ in range(4)]
    assert [frame.shape for frame in frames] == [(*size, 3)] * 4
    assert [transfers.upload(frame).given is None for frame in frames] == [False, False, False, True]
    del frames[:2]
    for _ in range(transfer.SLOTS):
        transfers.upload(np.zeros((*size, 3), np.uint8))
    frames.append(transfers.new_frame())
    assert transfers.upload(frames[-1]).given is frames[-1]
    transfers.close()


class _Stream:
    """What is put on a stream, in order."""

    def __init__(self, done: list[str], name: str) -> None:
        self.done, self.name = done, name

    def record_event(self, event: object) -> None:
        self.done.append(f"{self.name} record")

    def wait_event(self, event: object) -> None:
        self.done.append(f"{self.name} wait")

    def wait_stream(self, other: _Stream) -> None:
        self.done.append(f"{self.name} waits for {other.name}")


@pytest.fixture
def hosts_side(monkeypatch: pytest.MonkeyPatch) -> tuple[Callable[[tuple[int, int]], Transfers], list[str]]:
    """Transfers without a device: what they copy there is copied at once, and noted."""
    done: list[str] = []
    empty, zeros, copy = wp.empty, wp.zeros, wp.copy
    names = iter(["up", "down"])

    def noted_copy(target: Any, source: Any, stream: Any) -> None:
        done.append(f"{stream.name} copy")
        copy(target, source)

    monkeypatch.setattr(wp, "zeros", lambda *given, pinned=False, **more: zeros(*given, **more))
    monkeypatch.setattr(wp, "empty", lambda *given, pinned=False, **more: empty(*given, **more))
    monkeypatch.setattr(wp, "Event", lambda *_, **__: SimpleNamespace())
    monkeypatch.setattr(wp, "Stream", lambda device: _Stream(done, next(names)))
    monkeypatch.setattr(wp, "get_stream", lambda device: _Stream(done, "compute"))
    monkeypatch.setattr(wp, "copy", noted_copy)
    monkeypatch.setattr(transfer, "wait_for", lambda event: None)
    return lambda size: Transfers(size, wp.get_device("cpu")), done
