"""Linear pictures from files: primaries, windows, axes, and values that are not finite, by one reader for all."""

from __future__ import annotations

import itertools
import json
import pathlib
import struct

import cv2
import hypothesis
import numpy as np
import OpenEXR
import OpenImageIO
import pytest
from hypothesis import strategies as st

from warp_ar import environment, signals
from warp_ar.errors import SceneError
from warp_ar.exr_file import read_linear_picture
from warp_ar.light.captured import Light
from warp_ar.light.latlong_axes import AXES, from_axes, to_axes
from warp_ar.output.environment_file import encode_hdr, read_environment, write_environment
from warp_ar.scene import loads_scene
from warp_ar.scene.textures import load_emission
from warp_ar.signals import P3_D65, REC_709, REC_2020, xyz_from_rgb
from warp_ar.sources.frame_folder import read_frame

AP1 = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
FLOAT32 = 2e-6
"""Rounding of a product with a matrix in single precision, of values up to 2."""
PRIMARIES = 2e-4
"""AP1's chromaticities have five digits, and the Bradford matrix four."""


def write(path: pathlib.Path, values: np.ndarray, **header: object) -> pathlib.Path:
    OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, {"RGB": np.ascontiguousarray(values)}).write(str(path))
    return path


def gradient(height: int = 8) -> np.ndarray:
    return np.random.default_rng(5).uniform(0.1, 2.0, (height, 2 * height, 3)).astype(np.float32)


def test_this_programs_own_acescg_comes_back(tmp_path: pathlib.Path) -> None:
    red = np.zeros((8, 16, 3), np.float32)
    red[..., 0] = 1.0
    write_environment(tmp_path / "a.exr", red, color_space="acescg")
    np.testing.assert_allclose(Light.load(tmp_path / "a.exr").radiance, red, atol=PRIMARIES)
    np.testing.assert_allclose(read_environment(tmp_path / "a.exr"), red, atol=PRIMARIES)


@pytest.mark.parametrize("primaries", [AP1, REC_2020, P3_D65, REC_709])
def test_grey_of_other_primaries_is_grey_for_every_reader(tmp_path: pathlib.Path, primaries: tuple) -> None:
    path = write(tmp_path / "0001.exr", np.full((8, 16, 3), 0.5, np.float32), chromaticities=primaries)
    frame = read_frame(path)[1]
    emission, peak = load_emission(path)
    for found in (Light.load(path).radiance, read_environment(path), frame.picture, peak * emission / 255.0):
        np.testing.assert_allclose(found, 0.5, atol=PRIMARIES)


@hypothesis.settings(max_examples=25, deadline=None)
@hypothesis.given(
    st.sampled_from([AP1, REC_2020, P3_D65]),
    st.lists(st.floats(0.0, 2.0, width=32), min_size=3, max_size=3),
)
def test_primaries_are_followed(tmp_path_factory: pytest.TempPathFactory, primaries: tuple, color: list) -> None:
    path = write(
        tmp_path_factory.mktemp("a") / "a.exr", np.full((2, 4, 3), color, np.float32), chromaticities=primaries
    )
    found = read_linear_picture(path, SceneError, "a").color[0, 0]
    xyz, white = xyz_from_rgb(primaries) @ np.float32(color), xyz_from_rgb(primaries).sum(1)
    back, d65 = xyz_from_rgb(REC_709) @ found, xyz_from_rgb(REC_709).sum(1)
    # Von Kries in Bradford's cones: their ratios to the white are kept.
    cones = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
    np.testing.assert_allclose((cones @ back) / (cones @ d65), (cones @ xyz) / (cones @ white), atol=10 * FLOAT32)


@pytest.mark.parametrize("wrong", [(0.0,) * 8, (0.3, 0.3) * 4, (*REC_709[:7], float("nan"))])
def test_chromaticities_that_are_none_are_refused(tmp_path: pathlib.Path, wrong: tuple) -> None:
    path = write(tmp_path / "a.exr", gradient(), chromaticities=wrong)
    with pytest.raises(SceneError, match="its chromaticities are"):
        Light.load(path)


def test_what_is_not_finite_is_read_alike(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = gradient()
    values[0, 0], values[1, 1], values[2, 2] = np.nan, np.inf, -np.inf
    path = write(tmp_path / "0001.exr", values)
    assert environment.main([str(path), "--output", str(tmp_path / "x.json")]) == 0
    json.loads((tmp_path / "x.json").read_text(), parse_constant=lambda word: pytest.fail(word))
    assert "9 values are not finite; NaN is read as 0, infinity as 65504" in capsys.readouterr().err
    values = np.nan_to_num(values, nan=0.0, posinf=65504.0, neginf=0.0)
    np.testing.assert_array_equal(read_environment(path, axes="z-up"), values)
    np.testing.assert_array_equal(Light.load(path, "z-up").radiance, values)
    np.testing.assert_array_equal(read_frame(path)[1].picture, values)


def windowed(path: pathlib.Path, values: np.ndarray, data: tuple, display: tuple) -> None:
    write(path, values, dataWindow=data, displayWindow=display)


def test_the_display_window_is_the_picture(tmp_path: pathlib.Path) -> None:
    values = gradient()[2:6]
    window = ((0, 2), (15, 5)), ((0, 0), (15, 7))
    windowed(tmp_path / "a.exr", values, *(tuple(np.array(corner, np.int32) for corner in one) for one in window))
    whole = np.zeros((8, 16, 3), np.float32)
    whole[2:6] = values
    np.testing.assert_array_equal(read_environment(tmp_path / "a.exr", axes="z-up"), whole)
    np.testing.assert_array_equal(Light.load(tmp_path / "a.exr", "z-up").radiance, whole)
    np.testing.assert_array_equal(read_frame(tmp_path / "a.exr")[1].picture, whole)


@pytest.mark.parametrize("kept", ["own", "envmap", "plain"])
@pytest.mark.parametrize("load", [read_environment, lambda *a, **k: Light.load(*a, **k).radiance])
def test_axes_of_an_openexr(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str], kept: str, load: object
) -> None:
    path = tmp_path / "a.exr"
    if kept == "own":
        write_environment(path, gradient(), axes="opengl")
        expected = gradient()
    else:
        write(path, gradient(), **({"envmap": OpenEXR.ENVMAP_LATLONG} if kept == "envmap" else {}))
        expected = from_axes(gradient(), "y-up")
    np.testing.assert_array_equal(load(path), expected)
    assert ("y-up is assumed" in capsys.readouterr().err) == (kept != "own")
    for axes in AXES:
        np.testing.assert_array_equal(load(path, axes=axes), from_axes(load(path, axes="z-up"), axes))


def test_radiance_files_are_read_as_blender_does(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.hdr"
    cv2.imwrite(str(path), np.ascontiguousarray(to_axes(gradient(), "blender")[..., ::-1]))
    # RGBE keeps 8 bits of a pixel's brightest channel.
    np.testing.assert_allclose(Light.load(path).radiance, gradient(), atol=2.0 / 128)
    np.testing.assert_allclose(read_environment(path), gradient(), atol=2.0 / 128)
    assert "blender is assumed" in capsys.readouterr().err


def test_a_map_whose_quarter_is_half_a_column_is_turned(tmp_path: pathlib.Path) -> None:
    path = write(tmp_path / "a.exr", np.linspace(0, 1, 10, dtype=np.float32)[None, :, None].repeat(5, 0).repeat(3, 2))
    found = Light.load(path, "y-up").radiance
    assert found.shape == (5, 10, 3)
    assert found.mean() == pytest.approx(0.5, abs=1e-6)


def test_a_scene_says_the_axes_of_its_light(tmp_path: pathlib.Path) -> None:
    write(tmp_path / "a.exr", gradient())
    text = 'schema = 1\n[camera]\nfield_of_view = 60\n[marker]\nsize = 0.1\n[light]\nfile = "a.exr"\naxes = "{}"'
    assert loads_scene(text.format("opengl"), tmp_path / "s.toml").captured.axes == "opengl"
    with pytest.raises(SceneError, match='one of "z-up", "blender", "y-up", "opengl"'):
        loads_scene(text.format("sideways"), tmp_path / "s.toml")


def subsampled(path: pathlib.Path, channels: dict[str, int]) -> pathlib.Path:
    """Write an OpenEXR of 8x4 pixels by its bytes: of a channel every n-th pixel of every n-th row is kept."""

    def attribute(name: str, kind: str, value: bytes) -> bytes:
        return f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value

    listed = sorted(channels.items())
    kinds = b"".join(name.encode() + b"\0" + struct.pack("<iB3xii", 2, 0, step, step) for name, step in listed)
    window = struct.pack("<4i", 0, 0, 7, 3)
    head = b"\x76\x2f\x31\x01\2\0\0\0" + attribute("channels", "chlist", kinds + b"\0")
    head += attribute("compression", "compression", b"\0") + attribute("lineOrder", "lineOrder", b"\0")
    head += attribute("dataWindow", "box2i", window) + attribute("displayWindow", "box2i", window)
    head += attribute("pixelAspectRatio", "float", struct.pack("<f", 1.0))
    head += attribute("screenWindowCenter", "v2f", bytes(8))
    head += attribute("screenWindowWidth", "float", struct.pack("<f", 1.0)) + b"\0"
    table, body = b"", b""
    for row in range(4):
        values = b"".join(np.full(8 // step, 0.5, "<f4").tobytes() for _, step in listed if row % step == 0)
        table += struct.pack("<Q", len(head) + 4 * 8 + len(body))
        body += struct.pack("<ii", row, len(values)) + values
    path.write_bytes(head + table + body)
    return path


@pytest.mark.parametrize(
    ("channels", "said"),
    [
        ({"Y": 1, "RY": 2, "BY": 2}, "has channels BY, RY, Y"),
        ({"Y": 2}, "channels of several sizes"),
        ({"R": 1, "G": 1, "B": 2}, "channels of several sizes"),
        ({"R": 1, "G": 1, "B": 1, "A": 2}, ""),
    ],
)
def test_subsampled_colours_are_refused(tmp_path: pathlib.Path, channels: dict[str, int], said: str) -> None:
    path = subsampled(tmp_path / "a.exr", channels)
    if said:
        with pytest.raises(SceneError, match=said):
            read_linear_picture(path, SceneError, "a")
    else:
        np.testing.assert_array_equal(read_linear_picture(path, SceneError, "a").color, np.full((4, 8, 3), 0.5))


@pytest.mark.parametrize(
    ("told", "primaries"),
    [
        ({"acesImageContainerFlag": 1}, signals.AP0),
        ({"acesImageContainerFlag": 1, "chromaticities": signals.REC_2020}, signals.REC_2020),
        ({"colorInteropID": "lin_ap1_scene"}, signals.AP1),
        ({"colorInteropID": "lin_p3d65_scene"}, signals.P3_D65),
        ({"colorInteropID": "lin_rec709_scene"}, signals.REC_709),
    ],
)
def test_colour_spaces_that_other_attributes_tell_are_followed(
    tmp_path: pathlib.Path, told: dict, primaries: tuple
) -> None:
    color = np.array([0.2, 0.5, 0.1])
    planes = {name: np.full((4, 8), value, np.float32) for name, value in zip("RGB", color, strict=True)}
    OpenEXR.File({"type": OpenEXR.scanlineimage, **told}, planes).write(str(tmp_path / "a.exr"))
    found = read_linear_picture(tmp_path / "a.exr", SceneError, "a").color[1, 2]
    np.testing.assert_allclose(found, signals.rgb_from_rgb(primaries, signals.REC_709) @ color, rtol=FLOAT32, atol=1e-7)


def radiance(path: pathlib.Path, picture: np.ndarray, line: str, head: str = "") -> pathlib.Path:
    """A Radiance picture whose pixels lie in the order of an array, by any line of its size."""
    pixels = encode_hdr(picture, "").split(b"\n\n-Y", 1)[1].split(b"\n", 1)[1]
    path.write_bytes(f"#?RADIANCE\n{head}FORMAT=32-bit_rle_rgbe\n\n{line}\n".encode() + pixels)
    return path


@pytest.mark.parametrize(("rows", "columns", "major"), list(itertools.product("-+", "-+", "YX")))
def test_radiance_files_lie_in_any_order(tmp_path: pathlib.Path, rows: str, columns: str, major: str) -> None:
    right = read_linear_picture(radiance(tmp_path / "a.hdr", gradient(4), "-Y 4 +X 8"), SceneError, "a").color
    stored = gradient(4)[:: 1 if rows == "-" else -1, :: 1 if columns == "+" else -1]
    sizes = f"{rows}Y 4", f"{columns}X 8"
    stored, line = (stored, sizes) if major == "Y" else (stored.swapaxes(0, 1), sizes[::-1])
    path = radiance(tmp_path / "b.hdr", stored, " ".join(line))
    np.testing.assert_array_equal(read_linear_picture(path, SceneError, "b").color, right)


@hypothesis.settings(max_examples=25, deadline=None)
@hypothesis.given(
    st.lists(st.floats(0.01, 100.0), max_size=3), st.lists(st.tuples(*[st.floats(0.1, 10.0)] * 3), max_size=2)
)
def test_what_a_radiance_file_was_multiplied_by_is_divided_out(
    tmp_path_factory: pytest.TempPathFactory, exposures: list[float], corrections: list[tuple]
) -> None:
    path = tmp_path_factory.mktemp("h") / "a.hdr"
    shown = read_linear_picture(radiance(path, gradient(4), "-Y 4 +X 8"), SceneError, "a").color
    head = "".join(f"EXPOSURE={value!r}\n" for value in exposures)
    head += "".join("COLORCORR= {!r} {!r} {!r}\n".format(*value) for value in corrections)
    found = read_linear_picture(radiance(path, gradient(4), "-Y 4 +X 8", head), SceneError, "a").color
    factor = np.prod([(value,) * 3 for value in exposures] + corrections, axis=0)
    np.testing.assert_allclose(found, shown / factor, rtol=FLOAT32)


@pytest.mark.parametrize(
    ("head", "said"),
    [
        ("EXPOSURE=0\n", "factors above 0"),
        ("EXPOSURE=bright\n", "EXPOSURE=bright: expected a number"),
        ("COLORCORR=1 2\n", "COLORCORR=1 2: expected 3 numbers"),
        ("GAMMA=2.2\n", "of GAMMA 2.2"),
        ("PRIMARIES=0.6 0.3\n", "expected 8 numbers"),
    ],
)
def test_headers_of_radiance_files_that_are_refused(tmp_path: pathlib.Path, head: str, said: str) -> None:
    with pytest.raises(SceneError, match=said):
        read_linear_picture(radiance(tmp_path / "a.hdr", gradient(4), "-Y 4 +X 8", head), SceneError, "a")


def test_headers_of_radiance_files_of_other_programs(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    right = read_linear_picture(radiance(tmp_path / "a.hdr", gradient(4), "-Y 4 +X 8"), SceneError, "a").color
    photoshop = "# Made with Adobe Photoshop\nGAMMA=1\nPRIMARIES=0 0 0 0 0 0 0 0\n"
    render = "rpict -vf front.vf room.oct\n\tpfilt -1\nVIEW= -vtv -vh 45\nPIXASPECT=1.1\n"
    for head, said in ((photoshop, ""), (render, "VIEW and PIXASPECT of its header are not followed")):
        path = radiance(tmp_path / "b.hdr", gradient(4), "-Y 4 +X 8", head)
        np.testing.assert_array_equal(read_linear_picture(path, SceneError, f"b {said}").color, right)
        assert said in capsys.readouterr().err


def test_the_part_of_an_openexr_with_a_picture_is_taken(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    header = {"type": OpenEXR.scanlineimage}
    parts = [OpenEXR.Part(dict(header), {"Z": gradient()[..., 0].copy()}, "depth")]
    parts += [OpenEXR.Part(dict(header), {"RGB": gradient()}, "beauty")]
    OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(read_linear_picture(tmp_path / "a.exr", SceneError, "a").color, gradient())
    assert "has the parts depth, beauty; beauty is taken" in capsys.readouterr().err


def write_by_openimageio(path: pathlib.Path, kind: str) -> None:
    """Write ``gradient`` in tiles or as deep pixels."""
    height, width, _ = gradient().shape
    spec = OpenImageIO.ImageSpec(width, height, 3, "float")
    spec.tile_width = spec.tile_height = 4 if kind == "tiled" else 0
    spec.deep = kind == "deep"
    out = OpenImageIO.ImageOutput.create(str(path))
    assert out.open(str(path), spec)
    if kind == "deep":
        data = OpenImageIO.DeepData()
        data.init(width * height, 3, [OpenImageIO.TypeDesc("float")] * 3, ("R", "G", "B"))
        assert out.write_deep_image(data)
    else:
        assert out.write_tiles(0, width, 0, height, 0, 1, gradient())
    assert out.close()


def test_tiles_are_read_and_deep_pixels_refused(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "a.exr"
    write_by_openimageio(path, "tiled")
    np.testing.assert_array_equal(read_linear_picture(path, SceneError, "a").color, gradient())
    write_by_openimageio(path, "deep")
    with pytest.raises(SceneError, match="a is a deep OpenEXR; save it flat"):
        read_linear_picture(path, SceneError, "a")
