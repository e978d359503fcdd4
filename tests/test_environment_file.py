"""What an environment's file says of itself, and other readers of it."""

from __future__ import annotations

import datetime
import json
import pathlib

import cv2
import numpy as np
import OpenEXR
import pytest

from warp_ar.errors import SinkError, UsageError
from warp_ar.light.captured import Light
from warp_ar.light.latlong_axes import AXES, DESCRIPTIONS, to_axes
from warp_ar.output.environment_axes import CUBES, to_cube
from warp_ar.output.environment_file import EnvironmentInfo, read_environment, read_environment_info, write_environment
from warp_ar.signals import REC_709

FLOAT32 = 1e-6
HDR_STEP = 1.0 / 256.0
TAKEN = datetime.datetime(2026, 5, 1, 14, 30, 5, tzinfo=datetime.timezone(datetime.timedelta(hours=2)))
INFO = EnvironmentInfo(white_level=0.9, exposure=0.5, taken=TAKEN, place=(13.4, 52.5, 34.0))


def radiance() -> np.ndarray:
    return np.random.default_rng(0).exponential(1.0, (8, 16, 3)).astype(np.float32)


def header(path: pathlib.Path) -> dict[str, object]:
    with OpenEXR.File(str(path), header_only=True) as file:
        return dict(file.header())


@pytest.mark.parametrize("axes", AXES)
def test_a_latlong_says_its_axes_and_comes_back(tmp_path: pathlib.Path, axes: str) -> None:
    path = tmp_path / "e.exr"
    write_environment(path, radiance(), axes=axes)
    said = header(path)
    assert said["axes"] == DESCRIPTIONS[axes]
    assert said.get("envmap") == (None if axes == "z-up" else OpenEXR.ENVMAP_LATLONG)
    np.testing.assert_allclose(said["chromaticities"], REC_709, rtol=FLOAT32)
    assert said["whiteLevel"] == 1.0
    assert "whiteLuminance" not in said
    with OpenEXR.File(str(path)) as file:
        np.testing.assert_array_equal(file.channels()["RGB"].pixels, to_axes(radiance(), axes))
    np.testing.assert_array_equal(read_environment(path), radiance())


@pytest.mark.parametrize("axes", CUBES)
def test_a_cube_is_six_faces_in_one_column(tmp_path: pathlib.Path, axes: str) -> None:
    path = tmp_path / "e.exr"
    write_environment(path, radiance(), axes=axes, layout="cube", size=3)
    assert header(path)["envmap"] == OpenEXR.ENVMAP_CUBE
    assert header(path)["axes"] == CUBES[axes]
    with OpenEXR.File(str(path)) as file:
        np.testing.assert_array_equal(file.channels()["RGB"].pixels, to_cube(radiance(), axes, 3))
    with pytest.raises(SinkError, match="faces of a cube; a latlong is needed"):
        read_environment(path)


def test_time_place_and_white_are_openexrs_own_attributes(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "e.exr"
    write_environment(path, radiance(), info=INFO)
    said = header(path)
    assert (said["capDate"], said["utcOffset"]) == ("2026:05:01 12:30:05", 0.0)
    np.testing.assert_allclose([said[name] for name in ("longitude", "latitude", "altitude")], INFO.place, rtol=FLOAT32)
    # ISO 12232: a camera clips at 78 / 65 / (t ISO / (100 N^2)) cd/m^2, here the value 0.9.
    assert said["whiteLuminance"] == pytest.approx(78 / 65 / 0.5 / 0.9, rel=FLOAT32)
    back = read_environment_info(path)
    assert back.taken == TAKEN
    np.testing.assert_allclose(back.place, INFO.place, rtol=FLOAT32)
    assert back.exposure == 0.5
    assert back.white_level == pytest.approx(0.9, rel=FLOAT32)
    assert back.luminance_of_one() == pytest.approx(78 / 65 / 0.5 / 0.9, rel=FLOAT32)


def test_a_given_luminance_goes_before_the_exposure(tmp_path: pathlib.Path) -> None:
    write_environment(tmp_path / "e.exr", radiance(), info=EnvironmentInfo(white_luminance=250.0, exposure=0.5))
    assert header(tmp_path / "e.exr")["whiteLuminance"] == 250.0


def test_a_local_time_is_read_with_its_offset(tmp_path: pathlib.Path) -> None:
    """OpenEXR: UTC is the local time plus ``utcOffset`` seconds."""
    attributes = {"type": OpenEXR.scanlineimage, "capDate": "2026:05:01 14:30:05", "utcOffset": -7200.0}
    OpenEXR.File(attributes, {"RGB": radiance()}).write(str(tmp_path / "e.exr"))
    assert read_environment_info(tmp_path / "e.exr").taken == TAKEN
    attributes["capDate"] = "yesterday"
    OpenEXR.File(attributes, {"RGB": radiance()}).write(str(tmp_path / "e.exr"))
    with pytest.raises(SinkError, match="capDate 'yesterday' is no date"):
        read_environment_info(tmp_path / "e.exr")


def test_an_environment_of_somebody_elses_says_nothing(tmp_path: pathlib.Path) -> None:
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": radiance()}).write(str(tmp_path / "e.exr"))
    assert read_environment_info(tmp_path / "e.exr") == EnvironmentInfo()
    np.testing.assert_array_equal(read_environment(tmp_path / "e.exr", axes="z-up"), radiance())


def test_captured_light_is_read_with_what_it_says(tmp_path: pathlib.Path) -> None:
    light = Light(radiance(), np.ones((8, 16), np.float32), white_level=0.9, exposure=0.5)
    light.save(tmp_path / "light.exr")
    info = read_environment_info(tmp_path / "light.exr")
    assert (info.white_level, info.exposure) == (pytest.approx(0.9, rel=FLOAT32), 0.5)
    np.testing.assert_array_equal(read_environment(tmp_path / "light.exr"), radiance())


def test_hdr_holds_the_turned_picture(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "e.hdr"
    write_environment(path, radiance(), axes="opengl")
    back = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1]
    expected = to_axes(radiance(), "opengl")
    assert (np.abs(back - expected) <= HDR_STEP * expected.max(2, keepdims=True)).all()
    write_environment(path, radiance(), axes="y-up", layout="cube")
    assert cv2.imread(str(path), cv2.IMREAD_UNCHANGED).shape == (24, 4, 3)


def test_json_holds_harmonics(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "e.json"
    write_environment(path, radiance(), axes="y-up", info=INFO)
    content = json.loads(path.read_text(encoding="utf-8"))
    assert np.array(content["radiance"]).shape == np.array(content["irradiance"]).shape == (9, 3)
    assert (content["whiteLevel"], content["axes"]) == (0.9, "x, y, z = x, z, -y of the marker, y up")
    with pytest.raises(UsageError, match="no layout cube"):
        write_environment(path, radiance(), axes="y-up", layout="cube")


def test_what_cannot_be_is_said(tmp_path: pathlib.Path) -> None:
    with pytest.raises(UsageError, match=r"white_luminance = -1\.0"):
        EnvironmentInfo(white_luminance=-1.0)
    with pytest.raises(UsageError, match="expected a time with its zone"):
        EnvironmentInfo(taken=TAKEN.replace(tzinfo=None))
    with pytest.raises(UsageError, match="longitude of -180 to 180"):
        EnvironmentInfo(place=(0.0, 95.0, 0.0))
    with pytest.raises(UsageError, match="layout 'dome': expected latlong or cube"):
        write_environment(tmp_path / "e.exr", radiance(), layout="dome")
    assert list(tmp_path.iterdir()) == []
