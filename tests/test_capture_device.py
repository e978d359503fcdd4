"""Capture devices: the newest frame, gaps, what is unplugged, and exposures in turn."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from tests.test_sources import PATIENCE, error_of, grey, no_thread_left, take_until_error  # noqa: F401  (a fixture)
from warp_ar.errors import SourceError, UsageError
from warp_ar.sources import capture_device
from warp_ar.sources.capture_device import CaptureDevice

pytestmark = pytest.mark.slow


class FakeCapture:
    """A camera that gives ``count`` frames and is then unplugged; waits at each one while ``gate`` is cleared."""

    def __init__(self, count: int, *, opened: bool = True, change_at: int | None = None, fps: float = 60.0) -> None:
        self.count, self.opened, self.change_at, self.fps = count, opened, change_at, fps
        self.given = 0
        self.released = False
        self.gate = threading.Event()
        self.gate.set()

    def isOpened(self) -> bool:
        return self.opened

    def read(self) -> tuple[bool, np.ndarray | None]:
        self.gate.wait(PATIENCE)
        if self.given >= self.count:
            return False, None
        size = (10, 10) if self.given == self.change_at else (8, 6)
        self.given += 1
        return True, np.full((size[1], size[0], 3), (self.given - 1, 0, 200), np.uint8)

    def get(self, key: int) -> float:
        return self.fps

    def getBackendName(self) -> str:
        return "V4L2"

    def set(self, key: int, value: float) -> bool:
        self.fps = value
        return True

    def release(self) -> None:
        self.released = True


def test_device_drops_to_the_newest_and_reports_being_unplugged() -> None:
    capture = FakeCapture(40)
    with CaptureDevice(3, opener=lambda _: capture, grace=0.3) as source:
        assert (source.size, source.fps, source.live) == ((8, 6), 60.0, True)
        deadline = time.monotonic() + PATIENCE
        while source.dropped < 39 and time.monotonic() < deadline:
            time.sleep(0.001)
        frames = iter(source)
        image = next(frames).image
        assert image[0, 0].tolist() == [200, 0, 39]
        with pytest.raises(SourceError, match=r"capture device 3 gave no frame for 0.3 s.*unplugged"):
            next(frames)
    assert capture.released


def test_device_survives_a_gap_shorter_than_its_grace() -> None:
    capture = FakeCapture(1)
    with CaptureDevice(0, opener=lambda _: capture, grace=PATIENCE) as source:
        frames = iter(source)
        next(frames)
        capture.count = 2
        assert next(frames).image[0, 0, 2] == 1


def test_device_is_not_released_while_it_is_read() -> None:
    class Slow(FakeCapture):
        def read(self) -> tuple[bool, np.ndarray | None]:
            time.sleep(0.05)
            assert not self.released
            return super().read()

    before = set(threading.enumerate())
    source = CaptureDevice(0, opener=lambda _: Slow(1000))
    source.close()
    assert not [thread for thread in set(threading.enumerate()) - before if thread.name == "warp-ar-camera"]
    source.close()


def test_a_driver_that_hangs_does_not_hold_up_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is left to its thread, and not released under it."""
    monkeypatch.setattr(capture_device, "CLOSE_SECONDS", 0.2)
    broken, hangs, mended = threading.Event(), threading.Event(), threading.Event()

    class Hanging(FakeCapture):
        def read(self) -> tuple[bool, np.ndarray | None]:
            if broken.is_set():
                hangs.set()
                mended.wait()
            return super().read()

    capture = Hanging(10**9)
    source = CaptureDevice(0, opener=lambda _: capture)
    broken.set()
    assert hangs.wait(PATIENCE)
    closing = threading.Thread(target=source.close)
    closing.start()
    closing.join(0.5 * PATIENCE)
    ended, released = not closing.is_alive(), capture.released
    mended.set()
    closing.join()
    source._thread.join()
    assert ended, "it waits for the driver"
    assert not released
    source.close()
    assert capture.released


def test_a_reader_that_fails_is_told() -> None:
    """Whatever has happened to it: who waits for a frame would wait for ever."""

    class Broken(FakeCapture):
        def read(self) -> tuple[bool, np.ndarray | None]:
            if self.given == 2:
                raise MemoryError("no room for a picture")
            return super().read()

    source = CaptureDevice(0, opener=lambda _: Broken(1000))
    with ThreadPoolExecutor(1) as reader:
        reading = reader.submit(take_until_error, source)
        try:
            assert "no room for a picture" in reading.result(0.5 * PATIENCE)[1]
        finally:
            source.close()


def test_device_that_changes_size() -> None:
    with CaptureDevice(0, opener=lambda _: FakeCapture(3, change_at=2)) as source:
        assert "10x10, not 8x6" in take_until_error(source)[1]


def test_device_that_does_not_open() -> None:
    closed, silent = FakeCapture(0, opened=False), FakeCapture(0)
    with pytest.raises(SourceError, match="cannot be opened"):
        CaptureDevice(0, opener=lambda _: closed)
    with pytest.raises(SourceError, match="gave no frame"):
        CaptureDevice(0, opener=lambda _: silent, grace=0.05)
    assert closed.released
    assert silent.released


def test_device_is_asked_for_its_rate() -> None:
    with CaptureDevice(0, fps=15, opener=lambda _: FakeCapture(5)) as source:
        assert source.fps == 15
    with CaptureDevice(0, opener=lambda _: FakeCapture(5, fps=0.0)) as source:
        assert source.fps > 0


def test_absent_device_is_an_error(capfd: pytest.CaptureFixture[str]) -> None:
    assert "capture device 97 cannot be opened" in error_of("97")
    assert capfd.readouterr().err == "", "OpenCV complains beside it"


class Exposed(FakeCapture):
    """A camera before a still scene that takes on an exposure ``late`` frames after it was asked."""

    def __init__(self, late: int, *, backend: str = "V4L2", obeys: bool = True, surroundings: float = 1.0) -> None:
        super().__init__(10**6)
        self.late, self.backend, self.obeys, self.surroundings = late, backend, obeys, surroundings
        self.asked = [8e-3] * (late + 1)
        self.scene = np.linspace(0.02, 1.3, 64 * 48).reshape(48, 64, 1) * np.ones(3)

    def getBackendName(self) -> str:
        return self.backend

    def set(self, key: int, value: float) -> bool:
        if key == cv2.CAP_PROP_EXPOSURE:
            if not self.obeys:
                return False
            self.asked[-1] = 2.0**value if self.backend == "DSHOW" else value / 1e4
        return True

    def read(self) -> tuple[bool, np.ndarray | None]:
        time.sleep(0.002)
        self.given += 1
        self.asked.append(self.asked[-1])
        now = self.asked.pop(0)
        linear = np.clip(self.surroundings * self.scene * now / 8e-3, 0, 1)
        return True, np.rint(255 * np.clip(1.055 * linear ** (1 / 2.4) - 0.055, 0, 1)).astype(np.uint8)


@pytest.mark.parametrize(("late", "backend"), [(0, "V4L2"), (2, "DSHOW"), (6, "V4L2")])
def test_device_alternates_and_knows_what_it_shows(late: int, backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """However late the camera follows, no picture is taken for one of another exposure."""
    monkeypatch.setattr("warp_ar.sources.capture_device.BRACKET_SECONDS", 0.02)
    capture = Exposed(late, backend=backend)
    with CaptureDevice(0, exposures=(1e-3, 8e-3), opener=lambda _: capture) as source:
        assert source.exposures == (8e-3, 1e-3)
        seen = []
        for frame in source:
            assert frame.exposure_time is not None
            brightness = float(frame.image.mean())
            assert (brightness > 120) == (frame.exposure_time == 8e-3), (frame.index, brightness)
            seen.append(frame.exposure_time)
            if seen.count(1e-3) == 3:
                break
    assert seen[0] == 8e-3


def test_device_whose_light_changes_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """A lamp that is switched off while the exposure changes is not taken for an exposure forever."""
    monkeypatch.setattr("warp_ar.sources.capture_device.BRACKET_SECONDS", 0.02)
    capture = Exposed(1)
    with CaptureDevice(0, exposures=(8e-3, 2e-3), opener=lambda _: capture) as source:
        frames = iter(source)
        while next(frames).exposure_time != 2e-3:
            pass
        capture.surroundings = 0.24
        seen = [next(frames).exposure_time for _ in range(40)]
    assert {8e-3, 2e-3} <= set(seen)


@pytest.mark.parametrize("stuck", [True, False])
def test_device_whose_exposure_cannot_be_set(stuck: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("warp_ar.sources.capture_device.BRACKET_SECONDS", 0.02)
    if stuck:  # it says yes, and nothing happens
        capture = Exposed(0)
        monkeypatch.setattr(capture, "set", lambda key, value: True)
        with CaptureDevice(0, exposures=(8e-3, 1e-3), opener=lambda _: capture) as source:
            assert "does not follow its exposure" in take_until_error(source)[1]
        return
    with pytest.raises(SourceError, match="does not let its exposure be set"):
        CaptureDevice(0, exposures=(8e-3, 1e-3), opener=lambda _: Exposed(0, obeys=False))
    with pytest.raises(UsageError, match=r"1\.8 times"):
        CaptureDevice(0, exposures=(8e-3, 7e-3), opener=lambda _: Exposed(0))
