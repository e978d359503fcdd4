"""Files that this program writes are known as its own; others are not, whatever they hold."""

from __future__ import annotations

import json
import pathlib

import numpy as np
import pytest

from warp_ar import calibrate
from warp_ar.calibration.camera_calibration import CameraReport, write_camera
from warp_ar.calibration.response import write_response
from warp_ar.kernels.color import decode_table
from warp_ar.output.sinks import open_sink, write_environment
from warp_ar.scene import Camera, load_calibration
from warp_ar.signature import PROGRAM, is_signed, sign_png
from warp_ar.tracking.card_layout import SHEET

REPORT = CameraReport(Camera(64, 48, 60.0, 61.0, 31.5, 23.5), 0.1, (0.1,), 0.1, 1.0, (), SHEET, (5.0, 40.0))
CURVE = np.repeat(np.linspace(0.0, 1.0, 256)[:, None] ** 2, 3, axis=1)


def write(path: pathlib.Path) -> None:
    """Write a file of the kind that its name tells, as the program does."""
    if path.suffix in (".mp4", ".mov", ".mkv"):
        with open_sink(path, fps=24) as sink:
            for _ in range(20):
                sink.write(np.zeros((16, 16, 3), np.uint8))
    elif path.suffix == ".exr":
        write_environment(path, np.zeros((4, 8, 3), np.float32))
    elif path.suffix == ".png":
        assert calibrate.main(["card", "--output", str(path), "--dpi", "100"]) == 0
    elif path.suffix == ".txt":
        write_response(CURVE, path)
    elif path.name == "run.json":
        path.write_text(json.dumps({"program": PROGRAM, "frames": []}, indent=1))
    else:
        write_camera(REPORT, path)


@pytest.mark.parametrize(
    "name", ["a.mp4", "a.mov", "a.mkv", "a.exr", "a.png", "a.txt", "run.json", "a.yml", "a.json", "a.xml"]
)
def test_what_is_written_here_is_known(tmp_path: pathlib.Path, name: str) -> None:
    path = tmp_path / name
    write(path)
    assert is_signed(path)
    path.write_bytes(path.read_bytes().replace(PROGRAM.encode(), b"another"))
    assert not is_signed(path)


@pytest.mark.parametrize("suffix", ["yml", "json", "xml"])
def test_a_signed_calibration_is_read(tmp_path: pathlib.Path, suffix: str) -> None:
    write_camera(REPORT, tmp_path / f"a.{suffix}")
    assert load_calibration(tmp_path / f"a.{suffix}").matrix() == pytest.approx(REPORT.camera.matrix())


def test_a_signed_response_is_read(tmp_path: pathlib.Path) -> None:
    write_response(CURVE, tmp_path / "a.txt")
    assert np.allclose(decode_table(tmp_path / "a.txt"), CURVE, atol=1e-7)


def test_others_are_not(tmp_path: pathlib.Path) -> None:
    for number, data in enumerate((b"", b"warp_ar", b"{}", b'{"frames": [], "program": "warp_ar"}', b"\x89PNG")):
        (tmp_path / str(number)).write_bytes(data)
        assert not is_signed(tmp_path / str(number))
    assert not is_signed(tmp_path)
    assert not is_signed(tmp_path / "nothing")


def test_a_signed_png_is_the_same_picture() -> None:
    import cv2

    image = np.random.default_rng(0).integers(0, 256, (9, 7, 3), np.uint8)
    ok, data = cv2.imencode(".png", image)
    assert ok
    assert np.array_equal(cv2.imdecode(np.frombuffer(sign_png(data.tobytes()), np.uint8), cv2.IMREAD_COLOR), image)


def test_a_card_is_replaced_with_a_word_and_a_foreign_picture_only_if_asked(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "card.png"
    card = ["card", "--output", str(path), "--dpi", "100"]
    assert calibrate.main(card) == 0
    assert capsys.readouterr().err == ""
    assert calibrate.main(card) == 0
    assert "this program wrote it before" in capsys.readouterr().err
    path.write_bytes(b"mine")
    assert calibrate.main(card) == 2
    assert path.read_bytes() == b"mine"
    assert calibrate.main([*card, "--overwrite"]) == 0
    assert is_signed(path)
    picture = path.read_bytes()
    assert calibrate.main(["response", str(path), "--exposures", "1", "--output", str(path)]) == 2
    assert "name another" in capsys.readouterr().err
    assert path.read_bytes() == picture
