"""What phones and webcams write: each is read as it was seen, or refused with what to do."""

from __future__ import annotations

import struct
import sys

import av
import numpy as np
import pytest

from tests.photo_files import write_photo
from tests.test_sources import error_of, patch_centers, patches
from warp_ar import calibrate, capture
from warp_ar.calibration.camera_calibration import calibrate_camera
from warp_ar.errors import UsageError
from warp_ar.output.encoders import last_packets
from warp_ar.sources.sources import open_source

HEVC_LEVELS = 6
"""Codes: what x265 at its default quality and chroma at half the size leave of flat patches, measured 3."""


def write_hevc(path, pictures, *, transfer=1, pixels="yuv420p10le", primaries=1, matrix=1):
    """HEVC as phones write it: 10 bits, tagged."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx265", rate=30)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = pixels
        stream.options = {"preset": "ultrafast", "x265-params": "log-level=none", "crf": "8"}
        context = stream.codec_context
        context.color_trc, context.color_primaries, context.colorspace = transfer, primaries, matrix
        for number, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format=pixels, dst_colorspace="itu709")
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(last_packets(stream, len(pictures)))
    return path


def test_ten_bits_are_read(tmp_path):
    with open_source(write_hevc(tmp_path / "clip.mp4", [patches()] * 3)) as source:
        frames = list(source)
    assert len(frames) == 3
    assert np.abs(patch_centers(frames[-1].image) - patch_centers(patches())).max() <= HEVC_LEVELS


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photographs_are_upright(tmp_path, orientation):
    upright = np.zeros((48, 96, 3), np.uint8)
    upright[:16, :32] = 250
    # How the sensor had it, for each of EXIF's eight orientations.
    stored = {
        1: upright,
        2: upright[:, ::-1],
        3: upright[::-1, ::-1],
        4: upright[::-1],
        5: upright.transpose(1, 0, 2),
        6: np.rot90(upright, 1),
        7: np.rot90(upright, 2).transpose(1, 0, 2),
        8: np.rot90(upright, -1),
    }[orientation]
    write_photo(tmp_path / "a.jpg", stored, denominator=50, orientation=orientation)
    with open_source(tmp_path) as source:
        image = next(iter(source)).image
    assert image.shape == upright.shape
    assert np.abs(image.astype(int) - upright).mean() < 4


def test_photographs_held_both_ways_are_named():
    wide, tall = np.full((48, 64, 3), 90, np.uint8), np.full((64, 48, 3), 90, np.uint8)
    with pytest.raises(UsageError, match=r"picture 1: 48x64.*64x48.*hold the camera the same way"):
        calibrate_camera([wide, tall])


def heic():
    """The first box of an iPhone's photograph, and what may follow."""
    return struct.pack(">I", 24) + b"ftypheic" + bytes(4) + b"mif1heic" + bytes(200)


@pytest.mark.parametrize("name", ["IMG_1.HEIC", "IMG_1.heif"])
def test_heic_is_refused_with_what_to_do(tmp_path, name, capsys):
    (tmp_path / name).write_bytes(heic())
    for path in (tmp_path / name, tmp_path):
        said = error_of(path)
        assert "HEIC, which is not read: save it as JPEG" in said
        assert name in said
    assert calibrate.main(["camera", str(tmp_path), "--output", str(tmp_path / "camera.yml")]) == 2
    assert capture.main([str(tmp_path / name), "--output", str(tmp_path / "light.exr")]) == 2
    assert capsys.readouterr().err.count("save it as JPEG") == 2


def test_heic_that_is_called_jpeg_is_told_by_its_bytes(tmp_path):
    (tmp_path / "IMG_1.jpg").write_bytes(heic())
    assert "IMG_1.jpg is HEIC" in error_of(tmp_path / "IMG_1.jpg")


def test_raw_is_refused_with_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rawpy", None)
    (tmp_path / "IMG_1.CR3").write_bytes(b"\0\0\0\x18ftypcrx " + bytes(100))
    assert "a raw photograph: pip install" in error_of(tmp_path / "IMG_1.CR3")
