"""The virtual camera: a real one where the kernel has v4l2loopback, else one that takes its place, and what is said."""

from __future__ import annotations

import glob
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.test_live import write_scene
from warp_ar import live
from warp_ar.errors import SinkError, UsageError
from warp_ar.output.virtual_camera import VirtualCameraSink

FRAMES = 3


class Taken:
    """What pyvirtualcam's camera is to its users (0.15: width, height, fps, device; send, close)."""

    made: list[Taken] = []  # noqa: RUF012 - cleared by the fixture

    def __init__(self, width: int, height: int, fps: float, *, device: str | None = None) -> None:
        if device == "/dev/none":
            raise RuntimeError("'v4l2loopback' backend: No v4l2 loopback device found.\nDid you run modprobe?")
        self.size, self.fps, self.device = (width, height), fps, device or "/dev/video7"
        self.frames: list[np.ndarray] = []
        self.waits, self.open = 0, True
        Taken.made.append(self)

    def send(self, frame: np.ndarray) -> None:
        assert self.open
        assert frame.flags["C_CONTIGUOUS"]
        self.frames.append(frame.copy())

    def sleep_until_next_frame(self) -> None:
        self.waits += 1

    def close(self) -> None:
        self.open = False


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch) -> Any:
    Taken.made.clear()
    monkeypatch.setitem(sys.modules, "pyvirtualcam", types.SimpleNamespace(Camera=Taken))
    return Taken


def test_frames_go_to_the_camera(library: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = write_scene(tmp_path)
    arguments = [str(scene), "--virtual-camera", "--frames", str(FRAMES), "--device", "cpu", "--quality", "low"]
    assert live.main([*arguments, "--output", str(tmp_path / "out")]) == 0
    (camera,) = library.made
    assert not camera.open
    assert len(camera.frames) == camera.waits == FRAMES
    assert camera.frames[0].shape == (*camera.size[::-1], 3)
    assert len(list((tmp_path / "out").glob("*.png"))) == FRAMES
    assert "frames are sent to /dev/video7 (virtual camera, " in capsys.readouterr().err


def test_a_camera_that_is_not_there_is_one_line(
    library: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [str(write_scene(tmp_path)), "--virtual-camera", "/dev/none", "--frames", "1", "--device", "cpu"]
    assert live.main([*arguments, "--quality", "low"]) == 2
    said = [line for line in capsys.readouterr().err.splitlines() if "virtual camera" in line]
    assert said == [
        "warp_ar: the virtual camera /dev/none cannot be opened: 'v4l2loopback' backend: "
        "No v4l2 loopback device found. Did you run modprobe?"
    ]


def test_wrong_frames_and_a_missing_library_are_named(library: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    with VirtualCameraSink(None, fps=25.0, size=(64, 48)) as sink:
        with pytest.raises(SinkError, match="frame 0 is 32x24, not 64x48"):
            sink.write(np.zeros((24, 32, 3), np.uint8))
        sink.write(np.zeros((48, 64, 3), np.uint8))
        assert sink.written == 1
        assert library.made[0].waits == 0
    with pytest.raises(SinkError, match="is closed"):
        sink.write(np.zeros((48, 64, 3), np.uint8))
    monkeypatch.setitem(sys.modules, "pyvirtualcam", None)
    with pytest.raises(UsageError, match=r'pip install "warp-ar\[virtual-camera\]"'):
        VirtualCameraSink(None, fps=25.0, size=(64, 48))


def test_the_library_itself_opens_or_says_why() -> None:
    pytest.importorskip("pyvirtualcam", reason="needs the extra virtual-camera")
    if not glob.glob("/sys/devices/virtual/video4linux/*"):
        with pytest.raises(SinkError, match=r"a virtual camera cannot be opened: [^\n]+$"):
            VirtualCameraSink(None, fps=25.0, size=(64, 48))
        return
    with VirtualCameraSink(None, fps=25.0, size=(64, 48)) as sink:
        sink.write(np.zeros((48, 64, 3), np.uint8))
        assert sink.written == 1
