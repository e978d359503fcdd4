"""The way of frames to a CUDA device and of pictures back."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from warp_ar.engine import transfer
from warp_ar.engine.transfer import COPY_BYTES, COPY_THREADS, KEPT, Transfers, split_rows


@pytest.mark.parametrize(("height", "width", "parts"), [(480, 640, 1), (1080, 1920, 2), (2160, 3840, COPY_THREADS)])
def test_parts_are_a_whole_frame(height: int, width: int, parts: int) -> None:
    """Threads copy every row once, and none of them less than pays."""
    rows = split_rows(height, width)
    assert len(rows) == parts
    np.testing.assert_array_equal(np.concatenate([np.arange(height)[part] for part in rows]), np.arange(height))
    assert parts == 1 or min(3 * width * (part.stop - part.start) for part in rows) >= COPY_BYTES


@pytest.mark.parametrize("size", [(48, 64), (1080, 1920)])
def test_pictures_come_back_as_they_went(device: str, size: tuple[int, int]) -> None:
    """More pictures than there is pinned memory for, all kept, each with its bits; what was sent is written anew."""
    if wp.get_device(device).is_cpu:
        pytest.skip("on the CPU nothing is sent")
    transfers = Transfers(size, wp.get_device(device))
    frame = wp.zeros(size, dtype=wp.vec3ub, device=device)
    images = np.random.default_rng(1).integers(0, 256, (KEPT + 3, *size, 3), np.uint8)
    source, pictures = np.empty_like(images[0]), []
    for image in images:
        source[...] = image
        slot = transfers.upload(source)
        source[...] = 0
        transfers.receive(slot, frame)
        pictures.append(transfers.download(frame))
    for image, picture in zip(images, pictures, strict=True):
        np.testing.assert_array_equal(picture.result(), image)
        assert all(milliseconds > 0.0 for milliseconds in picture.steps().values())
        assert set(picture.steps()) == {"upload", "kernels", "download"}
    transfers.close()


def test_what_is_on_its_way_arrives_before_its_memory_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pipeline may be let go while its last pictures are copied from slots that go with it."""
    waited: list[str] = []
    monkeypatch.setattr(transfer, "wait_for", waited.append)
    transfers = Transfers.__new__(Transfers)
    transfers._pool = None
    transfers._slots = [SimpleNamespace(downloaded=event) for event in ("first", "second", None)]
    transfers.close()
    assert waited == ["first", "second"]
