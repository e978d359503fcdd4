"""EXIF of photographs, and what their names say of exposures."""

import math
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.photo_files import write_dng, write_photo
from warp_ar.errors import SceneError, SourceError
from warp_ar.photographs.photographs import Photograph, exposures_by_exif, exposures_by_name, read_photograph
from warp_ar.scene import loads_scene
from warp_ar.scene.exif import PhotoInfo, read_exif
from warp_ar.srgb import decode_srgb

pytestmark = pytest.mark.slow

GREY = np.full((600, 800, 3), 90, np.uint8)


def test_exif_gives_exposure_and_focal_length(tmp_path):
    info = read_exif(write_photo(tmp_path / "a.jpg", GREY, denominator=50, iso=400, f_number=2.0, focal_35mm=28))
    assert (info.width, info.height) == (800, 600)
    assert info.exposure == pytest.approx(1 / 50 * 400 / 100 / 4)
    # 28 mm of a frame whose diagonal is 43.27 mm.
    assert info.focal_length() == pytest.approx(28 / math.hypot(36, 24) * 1000)
    camera = info.camera()
    assert (camera.cx, camera.cy) == (399.5, 299.5)


def test_a_cut_picture_has_no_focal_length(tmp_path):
    info = read_exif(write_photo(tmp_path / "a.jpg", GREY[:590, :600], denominator=50))
    assert info.focal_35mm is not None
    assert info.focal_length() is None


def test_a_sensor_resolution_beats_the_rounded_35mm_length():
    info = PhotoInfo(6000, 4000, focal_35mm=80.0, focal_pixels=12_000.0)
    assert info.focal_length() == 12_000.0


def test_no_photograph(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"nothing")
    with pytest.raises(SceneError, match="photograph"):
        read_exif(tmp_path / "a.jpg")
    with pytest.raises(SourceError, match="no photograph"):
        read_photograph(tmp_path / "b.jpg")


def test_raw_photographs_are_refused_though_they_hold_a_thumbnail(tmp_path, monkeypatch):
    """As most raw files are, this is a TIFF with a small picture in it."""
    cv2.imwrite(str(tmp_path / "thumbnail.tif"), np.full((120, 160, 3), 90, np.uint8))
    (tmp_path / "a.NEF").write_bytes((tmp_path / "thumbnail.tif").read_bytes())
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(SourceError, match=r'a\.NEF is a raw photograph: pip install "warp-ar\[raw\]" reads it'):
        read_photograph(tmp_path / "a.NEF")


def test_a_raw_photograph_is_linear_and_tells_its_exposure(tmp_path):
    pytest.importorskip("rawpy", reason="needs the extra raw")
    linear = np.linspace(0.02, 1.1, 640)[None, :, None] * np.ones((480, 1, 1)) * (0.9, 0.6, 0.3)
    write_dng(tmp_path / "a.dng", linear, denominator=50, iso=200, f_number=2.0)
    found = read_photograph(tmp_path / "a.dng")
    assert found.is_raw
    assert found.info.exposure == pytest.approx(1 / 50 * 2 / 4)
    assert (found.info.width, found.info.height) == (640, 480)
    # Rounding to 16 bits, of the sensor's values and of the codes.
    seen = decode_srgb(found.deep[240, 8:-8] / 65535)
    np.testing.assert_allclose(seen, np.minimum(linear[240, 8:-8], 1.0), atol=3e-4)
    (tmp_path / "b.dng").write_bytes((tmp_path / "a.dng").read_bytes()[:400])
    with pytest.raises(SourceError, match=r"b\.dng cannot be read as a raw photograph"):
        read_photograph(tmp_path / "b.dng")


def named(*names, infos=None):
    infos = infos or [PhotoInfo(800, 600)] * len(names)
    return [Photograph(Path(name), GREY, info) for name, info in zip(names, infos, strict=True)]


@pytest.mark.parametrize(
    ("names", "denominators"),
    [
        (("d1_25.jpg", "d1_100.jpg", "d1_400.jpg"), (25, 100, 400)),
        (("probe_1-4.png", "probe_1-13.png"), (4, 13)),
        (("0024.jpg", "0060.jpg", "0553.jpg"), (24, 60, 553)),
        (("IMG_4031.jpg", "IMG_4032.jpg", "IMG_4033.jpg"), None),
        (("1.jpg", "2.jpg", "3.jpg"), None),
        (("ball.jpg", "ball_100.jpg"), None),
    ],
)
def test_names_tell_exposures_or_number_pictures(names, denominators):
    told = exposures_by_name(named(*names))
    assert told == (None if denominators is None else tuple(1 / d for d in denominators))


def test_half_a_bracket_without_iso_is_refused():
    infos = [PhotoInfo(800, 600, 0.01, 100.0, 2.0), PhotoInfo(800, 600, 0.04, None, 2.0)]
    with pytest.raises(SourceError, match=r"b.jpg.*iso"):
        exposures_by_exif(named("a.jpg", "b.jpg", infos=infos))
    assert exposures_by_exif(named("a.jpg", infos=[PhotoInfo(800, 600)])) is None


SCENE = """schema = 1
[camera]
calibration = "exif"
transfer = "gamma:2.0"
[source]
path = "a.jpg"
"""


def test_a_scene_takes_its_camera_from_exif(tmp_path):
    write_photo(tmp_path / "a.jpg", GREY, denominator=50, focal_35mm=50)
    camera = loads_scene(SCENE, tmp_path / "scene.toml").camera
    assert camera.fx == pytest.approx(50 / math.hypot(36, 24) * 1000)
    assert (camera.width, camera.transfer) == (800, "gamma:2.0")
    with pytest.raises(SceneError, match=r"camera.calibration.*source"):
        loads_scene(SCENE.split("[source]")[0])
    write_photo(tmp_path / "a.jpg", GREY[:, :333], denominator=50)
    with pytest.raises(SceneError, match="a part of a photograph"):
        loads_scene(SCENE, tmp_path / "scene.toml")
