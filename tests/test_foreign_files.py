"""Pictures and calibrations as other programs write them: profiles, layouts, hidden files, fisheyes, old boards."""

from __future__ import annotations

import json
import math
import re
import struct

import cv2
import numpy as np
import OpenImageIO
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import ExifTags, Image, ImageCms, PngImagePlugin, TiffImagePlugin

from warp_ar import calibrate, signals
from warp_ar.calibration.camera_calibration import BoardViews
from warp_ar.errors import SceneError
from warp_ar.pictures import srgb_by_profile
from warp_ar.scene import CharucoBoard, Marker, load_scene, loads_scene
from warp_ar.scene.calibration_file import load_calibration
from warp_ar.scene.exif import camera_by_exif, read_exif
from warp_ar.scene.pixel_rays import project, undistorted
from warp_ar.scene.textures import decode_rgba
from warp_ar.sources.frame_folder import read_frame
from warp_ar.sources.sources import open_source
from warp_ar.srgb import decode_srgb, encode_srgb
from warp_ar.tracking.markers import pattern_of

PIXELS = 0.1
"""Error of the rational model that stands for a fisheye's, pixels."""
CODES = 2
"""Codes that ImageCms and a matrix in floats may differ by: it computes in tables of 8 bits."""

# Adobe RGB (1998): gamma 563/256; to linear Rec. 709 primaries.
ADOBE = np.array([[1.39836, -0.39836, 0.0], [0.0, 1.0, 0.0], [0.0, -0.04293, 1.04293]])


def adobe_profile(gamma=563, kind=b"RGB "):
    """Return an ICC profile of Adobe RGB, by its tags: D50 colorants and a gamma of 256ths; or one of grey."""

    def s15(value):
        return int(round(value * 65536)).to_bytes(4, "big", signed=True)

    def xyz(*values):
        return b"XYZ \0\0\0\0" + b"".join(map(s15, values))

    curve = b"curv\0\0\0\0" + (1).to_bytes(4, "big") + gamma.to_bytes(2, "big") + b"\0\0"
    text = b"desc\0\0\0\0" + (10).to_bytes(4, "big") + b"Adobe RGB\0" + bytes(78) + b"\0\0"
    tags = {
        b"desc": text,
        b"cprt": b"text\0\0\0\0none\0\0\0\0",
        b"wtpt": xyz(0.9642, 1.0, 0.8249),
        b"rXYZ": xyz(0.60974, 0.31111, 0.01947),
        b"gXYZ": xyz(0.20528, 0.62567, 0.06087),
        b"bXYZ": xyz(0.14919, 0.06322, 0.74457),
        b"rTRC": curve,
        b"gTRC": curve,
        b"bTRC": curve,
        b"kTRC": curve,
    }
    table, body, at = len(tags).to_bytes(4, "big"), b"", 128 + 4 + 12 * len(tags)
    for name, data in tags.items():
        data += bytes(-len(data) % 4)
        table += name + (at + len(body)).to_bytes(4, "big") + len(data).to_bytes(4, "big")
        body += data
    head = bytearray(128)
    head[0:4] = (at + len(body)).to_bytes(4, "big")
    head[8:12], head[12:24], head[36:40] = b"\x02\x10\0\0", b"mntr" + kind + b"XYZ ", b"acsp"
    head[68:80] = s15(0.9642) + s15(1.0) + s15(0.8249)
    return bytes(head) + table + body


def as_srgb(codes):
    """Return sRGB codes of Adobe RGB's, by its definition."""
    light = np.clip((codes / 255.0) ** (563 / 256) @ ADOBE.T, 0.0, 1.0)
    return 255.0 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(*[st.integers(30, 225)] * 3), min_size=1, max_size=20))
def test_a_profile_is_followed(colors):
    codes = np.array([colors], np.uint8)
    found = srgb_by_profile(codes, adobe_profile())
    assert np.abs(found - as_srgb(codes)).max() <= CODES
    deep = srgb_by_profile(codes.astype(np.uint16) * 257, adobe_profile())
    assert np.abs(deep / 257.0 - as_srgb(codes)).max() <= CODES


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
def test_a_frame_with_a_profile_is_read_in_srgb(tmp_path, suffix):
    codes = np.full((32, 32, 3), (160, 90, 47), np.uint8)
    kind = {"quality": 100} if suffix in (".jpg", ".webp") else {}
    Image.fromarray(codes).save(tmp_path / f"a{suffix}", icc_profile=adobe_profile(), **kind)
    found, _ = read_frame(tmp_path / f"a{suffix}")
    assert np.abs(found[16, 16] - as_srgb(codes[0, 0])).max() <= 2 * CODES  # and the coding's own rounding
    own = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.fromarray(codes).save(tmp_path / f"b{suffix}", icc_profile=own, **kind)
    assert np.abs(read_frame(tmp_path / f"b{suffix}")[0][16, 16].astype(int) - codes[0, 0]).max() <= CODES


def test_a_grey_profile_is_followed(tmp_path):
    for suffix in (".png", ".tif"):
        path = tmp_path / f"a{suffix}"
        Image.new("L", (8, 8), 128).save(path, icc_profile=adobe_profile(256, b"GRAY"))
        assert np.abs(read_frame(path)[0].astype(int) - 188).max() <= CODES  # half of the light


def test_the_mark_of_a_camera_s_adobe_rgb_is_followed(tmp_path):
    """EXIF's interoperability R03, without a profile."""
    exif, codes = Image.Exif(), np.full((16, 16, 3), (160, 90, 47), np.uint8)
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.IFD.Interop] = {1: "R03"}
    Image.fromarray(codes).save(tmp_path / "a.jpg", exif=exif, quality=100)
    assert np.abs(read_frame(tmp_path / "a.jpg")[0][8, 8] - as_srgb(codes[0, 0])).max() <= 2 * CODES


@settings(max_examples=20, deadline=None)
@given(st.sampled_from([0.45455, 1.0, 0.55]), st.tuples(*[st.integers(1, 255)] * 3), st.booleans())
def test_gamma_and_chromaticities_of_a_png_are_followed(tmp_path_factory, gamma, color, wide):
    path, info = tmp_path_factory.mktemp("png") / "a.png", PngImagePlugin.PngInfo()
    info.add(b"gAMA", struct.pack(">I", round(gamma * 1e5)))
    if wide:  # white first, then Adobe RGB's primaries
        xy = (0.3127, 0.329, 0.64, 0.33, 0.21, 0.71, 0.15, 0.06)
        info.add(b"cHRM", struct.pack(">8I", *(round(value * 1e5) for value in xy)))
    Image.new("RGB", (4, 4), color).save(path, pnginfo=info)
    found = read_frame(path)[0][0, 0]
    if gamma == 0.45455:
        assert found.tolist() == list(color)
        return
    light = np.clip((np.array(color) / 255) ** (1 / gamma) @ (ADOBE.T if wide else np.eye(3)), 0, 1)
    shown = 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    assert np.abs(found - shown).max() <= 1


@settings(max_examples=20, deadline=None)
@given(st.sampled_from([1, 9, 12]), st.sampled_from([1, 4, 8, 13]), st.tuples(*[st.integers(20, 235)] * 3))
def test_a_png_s_code_points_are_followed(tmp_path_factory, primaries, transfer, color):
    path, info = tmp_path_factory.mktemp("png") / "a.png", PngImagePlugin.PngInfo()
    info.add(b"cICP", bytes([primaries, transfer, 0, 1]))
    Image.new("RGB", (4, 4), color).save(path, pnginfo=info)
    codes = np.array(color) / 255
    light = {4: codes**2.2, 8: codes}.get(transfer, decode_srgb(codes))
    own = {1: signals.REC_709, 9: signals.REC_2020, 12: signals.P3_D65}[primaries]
    shown = 255 * encode_srgb(np.clip(signals.rgb_from_rgb(own, signals.REC_709) @ light, 0, 1))
    assert np.abs(read_frame(path)[0][0, 0] - shown).max() <= 1


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "RGBA", "CMYK", "YCbCr", "LA"])
@pytest.mark.parametrize("orientation", [1, 6])
def test_a_tiff_is_the_texture_that_was_written(tmp_path, mode, orientation):
    """Red stays red, black black, whatever the TIFF has codes of; glTF and MTL know no orientation but TIFF's own."""
    picture = Image.new("RGB", (6, 4), (160, 90, 47))
    picture.paste((20, 200, 240), (3, 0, 6, 2))
    picture = picture.quantize(8) if mode == "P" else picture.convert(mode)
    picture.save(tmp_path / "a.tif", tiffinfo={274: orientation})
    found = decode_rgba((tmp_path / "a.tif").read_bytes(), "a.tif")
    right = np.rot90(np.asarray(picture.convert("RGBA")), 0 if orientation == 1 else -1)
    assert np.abs(found.astype(int) - right).max() <= 3  # of YCbCr's and CMYK's rounding


@settings(max_examples=20, deadline=None)
@given(
    st.sampled_from(["uint8", "uint16", "float"]), st.sampled_from(["contig", "separate"]), st.sampled_from([1, 3, 4])
)
def test_any_tiff_is_read(tmp_path_factory, kind, planes, channels):
    rng = np.random.default_rng(channels)
    unit = rng.uniform(0.0, 1.0, (6, 8, channels)).astype(np.float32)
    scale = {"uint8": 255, "uint16": 65535, "float": 1}[kind]
    values = unit if kind == "float" else np.round(unit * scale).astype(kind)
    path = tmp_path_factory.mktemp("tiff") / "a.tif"
    spec = OpenImageIO.ImageSpec(8, 6, channels, kind)
    spec["planarconfig"], spec["oiio:UnassociatedAlpha"] = planes, 1
    out = OpenImageIO.ImageOutput.create(str(path))
    assert out.open(str(path), spec)
    assert out.write_image(values)
    out.close()
    image, deep = read_frame(path)
    wanted = np.repeat(values, 3, 2) if channels == 1 else values[..., :3]
    np.testing.assert_array_equal(image if deep is None else deep.picture, wanted)


def test_hidden_files_are_no_frames(tmp_path):
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"IMG_{number}.jpg"), np.full((16, 16, 3), 40, np.uint8))
        (tmp_path / f"._IMG_{number}.jpg").write_bytes(b"\0\x05\x16\x07" + bytes(80))
    with open_source(tmp_path) as source:
        assert len(list(source)) == 3
    for name in ("desk.toml", "._desk.toml"):
        (tmp_path / name).write_text("schema = 1\n[camera]\nfield_of_view = 60\n" if name[0] != "." else "\0")
    assert load_scene(tmp_path).name == "desk"


def photograph(path, size, told, film=None):
    """Write a JPEG of a 50 mm lens on a sensor of 24 mm of which EXIF tells a size in pixels."""
    exif = Image.Exif()
    inner = exif.get_ifd(0x8769)
    inner[0x920A] = TiffImagePlugin.IFDRational(50, 1)
    inner[0xA002], inner[0xA003] = told
    inner[0xA20E] = TiffImagePlugin.IFDRational(120000, 47)
    inner[0xA210] = 3
    if film:
        inner[0xA405] = film
    Image.new("RGB", size).save(path, exif=exif)


def test_resolution_of_the_sensor_holds_for_its_long_side(tmp_path):
    right = 50 * 6000 / 23.5 * 1200 / 6000
    for size, told in (((1200, 800), (6000, 4000)), ((800, 1200), (4000, 6000)), ((1200, 800), (4000, 6000))):
        photograph(tmp_path / "a.jpg", size, told)
        assert read_exif(tmp_path / "a.jpg").focal_length() == pytest.approx(right, rel=1e-3)


@pytest.mark.parametrize("suffix", [".jpg", ".tif", ".png", ".webp"])
@pytest.mark.parametrize("orientation", [1, 6])
def test_a_photograph_on_its_side_has_the_size_of_its_frames(tmp_path, suffix, orientation):
    path = tmp_path / f"a{suffix}"
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    Image.new("RGB", (1200, 800)).save(path, exif=exif)
    height, width = read_frame(path)[0].shape[:2]
    assert (read_exif(path).width, read_exif(path).height) == (width, height)
    assert (width, height) == ((1200, 800) if orientation == 1 else (800, 1200))


def test_a_size_that_was_rewritten_is_seen(tmp_path, capsys):
    photograph(tmp_path / "a.jpg", (1200, 800), (1200, 800), 77)
    assert camera_by_exif(tmp_path / "a.jpg").fx == pytest.approx(50 * 1200 / 23.5, rel=0.01)
    assert "contradicts itself" in capsys.readouterr().err


def calibration(path, **more):
    head = {"image_width": 640, "image_height": 480, "camera_matrix": [[400, 0, 320], [0, 400, 240], [0, 0, 1]]}
    path.write_text(json.dumps(head | more))
    return path


@settings(max_examples=25, deadline=None)
@given(
    st.tuples(st.floats(-0.1, 0.1), st.floats(-0.02, 0.02), st.floats(-0.005, 0.005), st.floats(-0.002, 0.002)),
    st.sampled_from([{"distortion_model": "equidistant"}, {"fisheye_model": 1}, {"camera_model": "fisheye"}]),
)
def test_a_fisheye_projects_as_it_says(tmp_path_factory, terms, said):
    path = calibration(tmp_path_factory.mktemp("c") / "c.json", distortion_coefficients=list(terms), **said)
    camera = load_calibration(path)
    pixels = np.random.default_rng(1).uniform(0, 1, (200, 2)) * (639, 479)
    flat = cv2.fisheye.undistortPoints(pixels[:, None], camera.matrix(), np.array(terms))[:, 0]
    assert np.abs(project(camera, np.column_stack([flat, np.ones(200)])) - pixels).max() < PIXELS
    assert np.abs(undistorted(camera, pixels) - flat).max() < PIXELS / 400 * 4  # a pixel is 4 times wider at the rim


@settings(max_examples=25, deadline=None)
@given(st.floats(82.0, 120.0), st.sampled_from([(640, 480), (3840, 2160), (2704, 1520)]), st.floats(-0.03, 0.03))
def test_the_crop_that_a_wide_fisheye_is_told_can_be_followed(tmp_path_factory, reach, size, term):
    (width, height), angle = size, math.radians(reach)
    focal = math.hypot(*size) / 2 / (angle + term * angle**3)
    path = tmp_path_factory.mktemp("c") / "c.json"

    def wide(width, height):
        matrix = [[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]]
        said = {"image_width": width, "image_height": height, "camera_matrix": matrix, "fisheye_model": 1}
        return calibration(path, **said, distortion_coefficients=[term, 0, 0, 0])

    with pytest.raises(SceneError, match=r"degrees(?: and more)? from its axis; expected 80 at most") as told:
        load_calibration(wide(width, height))
    found = re.search(r"reaches (\d+) degrees( and more)?.* to (\d+)x(\d+) around", str(told.value))
    assert found[2] or abs(int(found[1]) - reach) <= 1.0
    width, height = int(found[3]), int(found[4])
    camera = load_calibration(wide(width, height))
    assert (camera.width, camera.height) == (width, height)


KALIBR = "cam0:\n  camera_model: {}\n  distortion_coeffs: [-0.3, 0.1, 0.001, 0.0]\n  distortion_model: radtan\n"
KALIBR += "  intrinsics: [400, 401, 320, 240]\n  resolution: [640, 480]\n"
NERF = {"w": 640, "h": 480, "fl_x": 400, "fl_y": 401, "cx": 320.5, "cy": 240.5, "frames": []}
REALSENSE = {"width": 640, "height": 480, "ppx": 320, "ppy": 240, "fx": 400, "fy": 401, "model": "Brown Conrady"}
REALSENSE["coeffs"] = [-0.3, 0.1, 0, 0, 0]
ZERO_INVERSE = {"model": "distortion.inverse_brown_conrady", "coeffs": [0.0] * 5}
KALIBR_PLACE = "  T_cam_imu:\n  - [1.0, 0.0, 0.0, 0.1]\n  - [0.0, 1.0, 0.0, 0.0]\n  - [0.0, 0.0, 1.0, 0.0]\n"
SIZED = {"image_width": 640, "image_height": 480, "camera_matrix": [[400, 0, 320], [0, 401, 240], [0, 0, 1]]}


@pytest.mark.parametrize(
    ("name", "text", "distortion"),
    [
        ("a.json", json.dumps(SIZED | {"distortion_coeffs": [-0.3, 0.1, 0, 0, 0]}), (-0.3, 0.1, 0, 0, 0)),
        ("a.json", json.dumps(SIZED | {"k1": -0.3, "p2": 0.01, "k3": 0.2}), (-0.3, 0, 0, 0.01, 0.2, 0, 0, 0)),
        ("a.json", json.dumps(SIZED | {"distortion_model": "none"}), (0, 0, 0, 0, 0)),
        ("a.json", json.dumps(SIZED | {"Distortion": [-0.3, 0.1, 0, 0], "skew": 0}), (-0.3, 0.1, 0, 0)),
        ("a.json", json.dumps(SIZED | {"K1": -0.3, "K2": 0.1}), (-0.3, 0.1, 0, 0, 0, 0, 0, 0)),
        ("transforms.json", json.dumps(NERF | {"k1": -0.3, "k2": 0.1}), (-0.3, 0.1, 0, 0, 0, 0, 0, 0)),
        ("realsense.json", json.dumps(REALSENSE), (-0.3, 0.1, 0, 0, 0)),
        ("realsense.json", json.dumps(REALSENSE | ZERO_INVERSE), (0, 0, 0, 0, 0)),
        ("camchain.yaml", KALIBR.format("pinhole"), (-0.3, 0.1, 0.001, 0)),
        ("camchain.yaml", KALIBR.format("pinhole") + KALIBR_PLACE, (-0.3, 0.1, 0.001, 0)),
        ("cameras.txt", "# list\n1 PINHOLE 640 480 400 401 320.5 240.5\n", (0, 0, 0, 0, 0)),
        ("cameras.txt", "3 OPENCV 640 480 400 401 320.5 240.5 -0.3 0.1 1e-3 0\n", (-0.3, 0.1, 0.001, 0, 0, 0, 0, 0)),
    ],
)
def test_calibrations_of_other_programs(tmp_path, name, text, distortion):
    (tmp_path / name).write_text(text)
    found = load_calibration(tmp_path / name)
    assert (found.width, found.height, found.fx, found.fy, found.cx, found.cy) == (640, 480, 400, 401, 320, 240)
    assert found.distortion == pytest.approx(distortion)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("realsense.json", json.dumps(REALSENSE | {"model": "inverse_brown_conrady"}), "'inverse_brown_conrady'"),
        ("a.json", json.dumps(SIZED | {"lens_coefficients": [0.1, 0, 0, 0]}), "lens_coefficients: not understood"),
        *(
            ("a.json", json.dumps(SIZED | more), said)
            for more, said in (
                ({"s1": 0.1}, "s1: not understood"),
                ({"radial": [0.1, 0]}, "radial: not understood"),
                ({"dist": {"k1": 0.1}}, "distortion_coefficients"),
                ({"dist": [0.1, 0, 0, 0], "k1": 0.2}, "or one of both"),
                ({"dist": ["-0.3", "0.1", "0", "0"]}, "distortion_coefficients"),
            )
        ),
        ("transforms.json", json.dumps(NERF | {"frames": [{"file_path": "a", "k1": 0.1}]}), "k1 of its own"),
        ("cameras.txt", "1 OPENCV 640 480 400 401 320 240 -0.3\n", "expected numbers for width, height, fl_x"),
        ("cameras.txt", "1 PINHOLE 640 480 400 401 320 240 -0.3\n", "expected numbers for width, height, fl_x"),
        ("cameras.txt", "1 PINHOLE 640 480 400 401 320 240\n2 PINHOLE 640 480 nan 4 3 2\n", "2 cameras"),
        ("camchain.yaml", KALIBR.format("pinhole") + KALIBR.format("pinhole").replace("cam0", "cam1"), "2 cameras"),
        ("cameras.txt", "1 FOV 640 480 400 401 320 240 0.9\n", "camera model 'FOV'"),
    ],
)
def test_calibrations_of_other_programs_that_are_not_followed(tmp_path, name, text, said):
    (tmp_path / name).write_text(text)
    with pytest.raises(SceneError, match=said):
        load_calibration(tmp_path / name)


INFO = """height: 480
width: 640
distortion_model: "plumb_bob"
D: [-0.3, 0.1, 0.001, 0.0, 0.0]
K: [400.0, 0.0, 320.0, 0.0, 401.0, 240.0, 0.0, 0.0, 1.0]
binning_x: {}
binning_y: {}
roi:
  x_offset: {}
  y_offset: {}
  height: {}
  width: {}
  do_rectify: False
"""


@settings(max_examples=25, deadline=None)
@given(
    *[st.integers(0, 4)] * 2, *[st.integers(0, 100)] * 2, st.sampled_from([0, 200, 380]), st.sampled_from([0, 300, 540])
)
def test_regions_and_bins_of_ros_are_followed(tmp_path_factory, bin_x, bin_y, left, top, height, width):
    """A point is seen at the mean place of the sensor's pixels that its bin has, counted from the region's corner."""
    path = tmp_path_factory.mktemp("c") / "camera_info.yaml"
    path.write_text(INFO.format(bin_x, bin_y, left, top, height, width))
    found = load_calibration(path)
    bin_x, bin_y = max(bin_x, 1), max(bin_y, 1)
    assert (found.width, found.height) == ((width or 640 - left) // bin_x, (height or 480 - top) // bin_y)
    path.write_text(INFO.format(0, 0, 0, 0, 0, 0))
    points = np.array([[0.2, -0.1, 1.0], [-0.3, 0.25, 1.0]])
    sensor = project(load_calibration(path), points)
    for column, row in ((0, 0), (found.width - 1, found.height - 1)):
        middle = np.array([left + bin_x * column + (bin_x - 1) / 2, top + bin_y * row + (bin_y - 1) / 2])
        moved = (sensor - middle) / (bin_x, bin_y)
        assert project(found, points) == pytest.approx(moved + np.array([column, row]), abs=1e-6)


@pytest.mark.parametrize("wrong", [(1.5, 1, 0, 0, 0, 0), (-2, 1, 0, 0, 0, 0), (1, 1, 600, 0, 100, 100)])
def test_regions_that_the_sensor_has_not_are_refused(tmp_path, wrong):
    (tmp_path / "camera_info.yaml").write_text(INFO.format(*wrong))
    with pytest.raises(SceneError, match="roi and binning_x are"):
        load_calibration(tmp_path / "camera_info.yaml")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.json", json.dumps(SIZED | {"is_fisheye": True, "D": [-0.1, 0.01, 0.02, -0.01]})),
        ("transforms.json", json.dumps(NERF | {"is_fisheye": True, "k1": -0.1, "k2": 0.01, "k3": 0.02, "k4": -0.01})),
        ("cameras.txt", "1 OPENCV_FISHEYE 640 480 400 401 320.5 240.5 -0.1 0.01 0.02 -0.01\n"),
        (
            "a.yaml",
            KALIBR.format("pinhole")
            .replace("radtan", "equidistant")
            .replace("-0.3, 0.1, 0.001, 0.0", "-0.1, 0.01, 0.02, -0.01"),
        ),
    ],
)
def test_fisheyes_of_other_programs(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    seen = project(load_calibration(tmp_path / name), np.array([[0.5, 0.3, 1.0]]))[0]
    assert seen == pytest.approx([496.2, 240 + 105.7 * 401 / 400], abs=0.08)


def board_picture(columns, rows, legacy):
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    board = cv2.aruco.CharucoBoard((columns, rows), 1.0, 0.75, dictionary)
    board.setLegacyPattern(legacy)
    return cv2.copyMakeBorder(
        board.generateImage((80 * columns, 80 * rows)), 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255
    )


@pytest.mark.parametrize(("columns", "rows"), [(8, 6), (5, 4), (7, 6)])
def test_boards_of_the_old_layout_are_found(columns, rows):
    picture, focal = board_picture(columns, rows, True), 900.0
    matrix, views = np.array([[focal, 0, 639.5], [0, focal, 359.5], [0, 0, 1.0]]), BoardViews()
    rng = np.random.default_rng(1)
    flat = np.array([[1 / 80, 0, -(columns / 2 + 0.5)], [0, 1 / 80, -(rows / 2 + 0.5)], [0, 0, 1.0]])
    for _ in range(14):
        turn = cv2.Rodrigues(rng.uniform(-0.6, 0.6, 3) * (1, 1, 0.3))[0]
        place = np.array([rng.uniform(-1, 1), rng.uniform(-0.6, 0.6), rng.uniform(11, 16)])
        map_ = matrix @ np.column_stack([turn[:, :2], place]) @ flat
        views.add(cv2.warpPerspective(picture, map_, (1280, 720), borderValue=128, flags=cv2.INTER_AREA))
    report = views.solve()
    assert report.marker.board.legacy
    assert report.marker.board.columns == columns
    assert report.camera.fx == pytest.approx(focal, rel=0.01)
    text = 'schema = 1\n[camera]\nfield_of_view = 60.0\n[source]\nsynthetic = "card"\n[marker]\nboard = "{}"\n'
    board = CharucoBoard(columns, rows, 0.04, 0.03, legacy=True)
    assert loads_scene(text.format(board)).marker.board == board


@pytest.mark.slow
def test_a_fisheye_is_calibrated(tmp_path):
    """Pictures of a lens of 140 degrees across its corners: focal length, and where the rim's pixels look."""
    width, height, focal, terms = 640, 480, 340.0, np.array([-0.03, 0.01, -0.004, 0.0])
    matrix = np.array([[focal, 0, 322.0], [0, focal, 238.0], [0, 0, 1.0]])
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float64)
    looks = cv2.fisheye.undistortPoints(grid.reshape(-1, 1, 2), matrix, terms).reshape(-1, 2)
    rays = np.column_stack([looks, np.ones(len(looks))])
    rng = np.random.default_rng(3)
    for number in range(16):
        turn = cv2.Rodrigues(rng.uniform(-0.7, 0.7, 3) * (1, 1, 0.3))[0]
        around = 2 * np.pi * number / 16
        away = rng.uniform(5.0, 8.0)
        place = np.array([1.1 * away * np.cos(around), 0.8 * away * np.sin(around), away]) * rng.choice([0.4, 1.0])
        place[2] = max(place[2], 4.0)
        # Where rays meet the board's plane, in squares from its middle.
        u, v, w = (rays @ np.linalg.inv(np.column_stack([turn[:, :2], place])).T).T
        shown = np.where(w > 0, [u / w, v / w], -1e3)
        at = (80 * shown + np.array([[40 + 320], [40 + 240]]) - 0.5).reshape(2, height, width).astype(np.float32)
        picture = cv2.remap(board_picture(8, 6, False), *at, cv2.INTER_LINEAR, borderValue=128)
        cv2.imwrite(str(tmp_path / f"{number:02d}.png"), picture)
    out = tmp_path / "c.yml"
    assert calibrate.main(["camera", str(tmp_path), "--fisheye", "--output", str(out)]) == 0
    found = load_calibration(out)
    assert "fisheye_model" in out.read_text()
    assert found.fx == pytest.approx(focal, rel=2e-3)
    rim = np.array([(5.0, 240.0), (320.0, 470.0), (630.0, 100.0), (40.0, 40.0)])
    flat = cv2.fisheye.undistortPoints(rim[:, None], matrix, terms)[:, 0]
    assert np.abs(project(found, np.column_stack([flat, np.ones(4)])) - rim).max() < 1.0


def test_the_print_of_an_old_board_is_as_opencv_draws_it():
    """The cells between the markers are dark where the picture of the board is: printed edges are fitted to them."""
    for legacy in (False, True):
        pattern = pattern_of(Marker("DICT_5X5_100", board=CharucoBoard(5, 4, 0.08, 0.06, legacy=legacy)))
        picture = board_picture(5, 4, legacy)[40:-40, 40:-40]
        at = np.round(pattern.cells[:, :2] * (1000, -1000) + (200, 160) - 0.5).astype(int)
        shown = picture[np.clip(at[:, 1], 0, 319), np.clip(at[:, 0], 0, 399)] > 127
        np.testing.assert_array_equal(shown, pattern.white)
