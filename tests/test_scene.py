"""Scene files: what loads, and what does not and why."""

from __future__ import annotations

import dataclasses
import json
import math
import pathlib
import tomllib
import typing
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from warp_ar import keys
from warp_ar import scene as sc
from warp_ar.errors import SceneError, UsageError, WarpArError
from warp_ar.scene import Camera, Scene, bundled_scenes, dumps_scene, load_calibration, load_scene, loads_scene
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.key_tables import keys as all_keys
from warp_ar.scene.scene_files import SceneFiles, files_of

CAMERA = """
schema = 1
[camera]
width = 640
height = 480
fx = 600.0
fy = 601.0
cx = 319.5
cy = 239.5
"""
MARKER = "[marker]\nsize = 0.08\n"
BASE = CAMERA + MARKER
SPHERE = '[[object]]\nshape = "sphere"\nradius = 0.03\n'
SPOT = (
    '[[light]]\nkind = "spot"\nat = [0, 0, 1]\ntarget = [0, 0, 0]\nintensity = 1\nouter_angle = 30\ninner_angle = 20\n'
)

# Products and sums of a few float64 numbers of order one.
ROUNDING = 1e-14


@pytest.fixture
def folder(tmp_path: pathlib.Path) -> pathlib.Path:
    """A folder with one file of each sort that scenes name; their contents are read later, not with the scene."""
    for name in ("model.ply", "wood.png", "response.json", "notes.txt"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "frames").mkdir()
    return tmp_path


# --- What loads -------------------------------------------------------------------------------------------------------


def test_truth_scenes_load_and_survive_writing(shared: pathlib.Path) -> None:
    files = sorted((shared / "truth").glob("*/scene_*.toml"))
    assert files
    for file in files:
        scene = load_scene(file)
        raw = tomllib.loads(file.read_text())
        assert (scene.name, scene.path) == (raw["name"], file)
        assert scene.source is not None
        assert scene.source.path == (file.parent / "camera").resolve()
        assert len(scene.proxies) == len(raw["proxy"])
        assert [light.intensity for light in scene.lights] == [light["intensity"] for light in raw.get("light", [])]
        assert scene.exposure.scale == raw.get("exposure", {}).get("scale", 1.0)
        assert loads_scene(dumps_scene(scene)) == scene


def test_least_scene_has_the_documented_defaults() -> None:
    scene = loads_scene(CAMERA)
    assert scene == Scene(camera=Camera(640, 480, 600.0, 601.0, 319.5, 239.5))
    assert scene.camera.transfer == "srgb"
    assert scene.exposure.scale == 1.0
    assert scene.marker.white == 0.85
    assert scene.source is None
    assert scene.path is None


EVERY_KEY = """
schema = 1
name = "all"
[camera]
width = 320
height = 240
fx = 300
fy = 301
cx = 160
cy = 120
distortion = [1, 2, 3, 4, 5, 6, 7, 8]
transfer = "response.json"
[source]
path = "frames"
fps = 25
[marker]
dictionary = "DICT_APRILTAG_36h11"
id = 586
size = 0.1
white = 0.7
[[probe]]
center = [1, 2, 3]
radius = 0.04
reflectance = 0.5
[[probe]]
center = [4, 5, 6]
radius = 0.05
reflectance = [0.1, 0.2, 0.3]
[[proxy]]
shape = "mesh"
file = "model.ply"
[[object]]
shape = "torus"
major_radius = 0.2
minor_radius = 0.1
animate = { turn = [0, 0, 90], pivot = [1, 0, 0], sway = [0, 0, 0.1], period = 2 }
[object.material]
model = "phong"
diffuse = "wood.png"
specular = [0.1, 0.2, 0.3]
shininess = 8
[[light]]
kind = "point"
at = [0, 0, 1]
color = [1, 2, 3]
intensity = 4
attenuation = [1, 0.5, 0.25]
radius = 0.02
[[light]]
kind = "directional"
direction = [0, 0, -2]
intensity = 3
[exposure]
scale = "auto"
"""


def test_every_key_arrives(folder: pathlib.Path) -> None:
    scene = loads_scene(EVERY_KEY, folder / "all.toml")
    root = folder.resolve()
    assert scene == Scene(
        name="all",
        camera=Camera(320, 240, 300, 301, 160, 120, (1, 2, 3, 4, 5, 6, 7, 8), root / "response.json"),
        source=sc.SourceSpec(path=root / "frames", fps=25.0),
        marker=sc.Marker("DICT_APRILTAG_36h11", 586, 0.1, 0.7),
        probes=(sc.Probe((1, 2, 3), 0.04, (0.5, 0.5, 0.5)), sc.Probe((4, 5, 6), 0.05, (0.1, 0.2, 0.3))),
        proxies=(sc.Proxy("mesh", file=root / "model.ply"),),
        objects=(
            sc.Object(
                "torus",
                major_radius=0.2,
                minor_radius=0.1,
                material=sc.PhongMaterial(root / "wood.png", (0.1, 0.2, 0.3), 8.0),
                animate=sc.Animation((0, 0, 90), (1, 0, 0), (0, 0, 0.1), 2.0),
            ),
        ),
        lights=(
            sc.Light("point", 4.0, (1, 2, 3), (0, 0, 1), attenuation=(1, 0.5, 0.25), radius=0.02),
            sc.Light("directional", 3.0, direction=(0, 0, -2)),
        ),
        exposure=sc.Exposure("auto"),
    )


def test_single_probe_may_be_a_plain_table() -> None:
    assert loads_scene(BASE + "[probe]\ncenter = [0, 0, 1]\nradius = 0.03").probes == (sc.Probe((0, 0, 1), 0.03),)


@pytest.mark.parametrize(
    ("text", "board", "markers", "size"),
    [
        ("charuco 5x7 0.04 0.03", sc.CharucoBoard(5, 7, 0.04, 0.03), 17, (0.2, 0.28)),
        ("grid 4x3 0.04 0.01", sc.GridBoard(4, 3, 0.04, 0.01), 12, (0.19, 0.14)),
    ],
)
def test_boards(text: str, board: sc.Board, markers: int, size: tuple[float, float]) -> None:
    marker = loads_scene(CAMERA + f'[marker]\nboard = "{text}"').marker
    assert marker.board == board
    assert str(board) == text
    assert board.marker_count == markers
    assert board.size == pytest.approx(size)


def test_charuco_marker_count_is_opencvs() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
    for columns, rows in [(5, 7), (4, 4), (3, 2), (3, 3)]:
        board = cv2.aruco.CharucoBoard((columns, rows), 0.04, 0.03, dictionary)
        assert sc.CharucoBoard(columns, rows, 0.04, 0.03).marker_count == len(board.getIds())


def test_bundled_scenes_are_found_by_name(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "__init__.py").write_text("")
    (tmp_path / "desk.toml").write_text(CAMERA)
    monkeypatch.setattr("importlib.resources.files", lambda package: tmp_path)
    assert bundled_scenes() == {"desk": tmp_path / "desk.toml"}
    scene = load_scene("desk")
    assert (scene.name, scene.path) == ("desk", tmp_path / "desk.toml")
    with pytest.raises(SceneError, match=r'desc: no such scene; .*did you mean "desk"'):
        load_scene("desc")


# --- The camera -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(640, 480), (320, 240), (960, 720)])
def test_scaled_camera_sees_the_same_directions(size: tuple[int, int]) -> None:
    camera = Camera(640, 480, 600.0, 601.0, 317.0, 243.0)
    scaled = camera.scaled_to(*size)
    # The outer corner of the picture is half a pixel before the first pixel's centre, at every size.
    for x, y in ((0, 0), (1, 1), (0.3, 0.8)):
        a, b = (
            ((x * one.width - 0.5 - one.cx) / one.fx, (y * one.height - 0.5 - one.cy) / one.fy)
            for one in (camera, scaled)
        )
        assert b == pytest.approx(a, abs=ROUNDING)
    assert (scaled.width, scaled.height) == size


@pytest.mark.parametrize("size", [(640, 481), (0, 0)])
def test_another_aspect_cannot_be_scaled(size: tuple[int, int]) -> None:
    with pytest.raises(SceneError, match=f"calibrated for 640x480, frames are {size[0]}x{size[1]}.*aspect"):
        loads_scene(CAMERA).camera.scaled_to(*size)


@pytest.mark.parametrize("suffix", [".yml", ".json", ".xml"])
def test_calibration_written_by_opencv(folder: pathlib.Path, suffix: str) -> None:
    camera = Camera(800, 600, 700.0, 701.0, 400.5, 299.25, (0.1, -0.2, 0.001, 0.002, 0.3, 0.01, 0.02, 0.03), "linear")
    path = folder / f"camera{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 800)
    storage.write("image_height", 600)
    storage.write("camera_matrix", camera.matrix())
    storage.write("distortion_coefficients", np.array([*camera.distortion, 0, 0, 0, 0, 0, 0]).reshape(-1, 1))
    storage.release()
    scene = loads_scene(
        f'schema = 1\n[camera]\ncalibration = "camera{suffix}"\ntransfer = "linear"', folder / "scene.toml"
    )
    assert scene.camera == camera
    assert loads_scene(dumps_scene(scene)) == scene


def test_calibration_as_ros_and_scripts_write_it(folder: pathlib.Path) -> None:
    ros = folder / "ros.yaml"
    ros.write_text(
        "image_width: 640\nimage_height: 480\ncamera_name: front\n"
        "camera_matrix:\n  rows: 3\n  cols: 3\n  data: [600, 0, 320, 0, 601.5, 240, 0, 0, 1]\n"
        "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0.1, 0, 0, 0, 0]\n"
    )
    assert load_calibration(ros) == Camera(640, 480, 600.0, 601.5, 320.0, 240.0, (0.1, 0.0, 0.0, 0.0, 0.0))
    script = folder / "script.json"
    script.write_text(
        json.dumps(
            {"mtx": [[600, 0, 320], [0, 601.5, 240], [0, 0, 1]], "dist": [[0, 0, 0, 0]], "image_size": [640, 480]}
        )
    )
    assert load_calibration(script) == Camera(640, 480, 600.0, 601.5, 320.0, 240.0, (0.0,) * 4)


GOOD_CALIBRATION: dict[str, Any] = {
    "image_width": 640,
    "image_height": 480,
    "camera_matrix": [600, 0, 320, 0, 600, 240, 0, 0, 1],
    "distortion_coefficients": [0, 0, 0, 0, 0],
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image_width": None}, "image_width"),
        ({"image_width": 0}, "image_width"),
        ({"camera_matrix": None}, "camera_matrix is missing: expected a 3x3 matrix"),
        ({"camera_matrix": [1, 2, 3]}, "3x3"),
        ({"camera_matrix": [-600, 0, 320, 0, 600, 240, 0, 0, 1]}, "above 0"),
        ({"camera_matrix": [600, 3, 320, 0, 600, 240, 0, 0, 1]}, "without skew"),
        ({"camera_matrix": [600, 0, 320, 0, 600, 240, 0, 0, 2]}, "without skew"),
        ({"distortion_coefficients": [0, 0, 0]}, "4, 5 or 8"),
        ({"distortion_coefficients": [0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0]}, "4, 5 or 8"),
    ],
)
def test_calibration_errors(folder: pathlib.Path, change: dict[str, Any], message: str) -> None:
    path = folder / "camera.json"
    data = {key: value for key, value in (GOOD_CALIBRATION | change).items() if value is not None}
    path.write_text(json.dumps(data))
    with pytest.raises(SceneError, match=message) as caught:
        load_calibration(path)
    assert_helpful(caught.value, path)


@pytest.mark.parametrize(
    "text", ["", "hello world", "{", "<a>", "%YAML:1.0\ncamera_matrix: !!opencv-matrix\n  rows: x"]
)
@pytest.mark.parametrize("suffix", [".yml", ".json", ".xml", ".txt"])
def test_calibration_that_is_none(folder: pathlib.Path, text: str, suffix: str) -> None:
    path = folder / f"camera{suffix}"
    path.write_text(text)
    with pytest.raises(SceneError) as caught:
        load_calibration(path)
    assert_helpful(caught.value, path)


# --- Motion -----------------------------------------------------------------------------------------------------------


def test_objects_stand_still_without_animation() -> None:
    item = sc.Object("sphere", radius=1.0, at=(1, 2, 3), rotate=(10, 20, 30))
    for seconds in (0.0, 7.5):
        rotation, position = item.pose_at(seconds)
        np.testing.assert_array_equal(rotation, rotation_matrix((10, 20, 30)))
        np.testing.assert_array_equal(position, (1, 2, 3))


def test_object_turns_in_place_and_about_a_pivot() -> None:
    spin = sc.Animation(turn=(0, 0, 90))
    rotation, position = sc.Object("box", size=(1.0, 1.0, 1.0), at=(1, 0, 5), rotate=(90, 0, 0), animate=spin).pose_at(
        1.0
    )
    np.testing.assert_allclose(rotation, rotation_matrix((0, 0, 90)) @ rotation_matrix((90, 0, 0)), atol=ROUNDING)
    np.testing.assert_allclose(position, (1, 0, 5), atol=ROUNDING)
    orbit = dataclasses.replace(spin, pivot=(0.0, 0.0, 0.0))
    np.testing.assert_allclose(
        sc.Object("box", size=(1.0, 1.0, 1.0), at=(1, 0, 5), animate=orbit).pose_at(1.0)[1], (0, 1, 5), atol=ROUNDING
    )


def test_sway_is_a_sine() -> None:
    sway = sc.Animation(sway=(0, 0, 0.2), period=3.0)
    for seconds in (0.0, 0.75, 1.5, 2.25, 3.0, 3000.75):
        height = sc.Object("box", size=(1.0, 1.0, 1.0), at=(1, 2, 3), animate=sway).pose_at(seconds)[1][2]
        assert height == pytest.approx(3.0 + 0.2 * math.sin(2 * math.pi * (seconds % 3.0) / 3.0), abs=1e-12)


def test_lights_point_at_their_target_or_turn_their_direction() -> None:
    orbit = sc.Animation(turn=(0, 0, 90), pivot=(0, 0, 0))
    position, direction = sc.Light("spot", 1.0, at=(1, 0, 1), target=(0, 0, 0), animate=orbit).pose_at(1.0)
    np.testing.assert_allclose(position, (0, 1, 1), atol=ROUNDING)
    np.testing.assert_allclose(direction, np.array([0, -1, -1]) / math.sqrt(2), atol=ROUNDING)
    position, direction = sc.Light("spot", 1.0, at=(1, 0, 1), direction=(3, 0, 0), animate=orbit).pose_at(1.0)
    np.testing.assert_allclose(direction, (0, 1, 0), atol=ROUNDING)


@pytest.mark.parametrize("length", [1e-17, 1.0, 1e17])
def test_directions_come_out_unit_at_any_length(length: float) -> None:
    _, direction = sc.Light("directional", 1.0, direction=(0, -length, -length)).pose_at(0.0)
    np.testing.assert_allclose(direction, np.array([0, -1, -1]) / math.sqrt(2), atol=ROUNDING)


def test_light_on_its_target_still_has_a_direction() -> None:
    _, direction = sc.Light("spot", 1.0, at=(1, 2, 3), target=(1, 2, 3)).pose_at(0.0)
    np.testing.assert_array_equal(direction, (0, 0, -1))


# --- Errors -----------------------------------------------------------------------------------------------------------


def assert_helpful(error: BaseException, path: pathlib.Path) -> None:
    """One line that begins with the file."""
    assert isinstance(error, WarpArError)
    assert isinstance(error, ValueError)
    message = str(error)
    assert message.startswith(f"{path}: ")
    assert len(message.splitlines()) == 1
    assert len(message) < 600


def light(**changes: str) -> str:
    """A spot light with some of its lines changed; None takes one away."""
    lines = {line.split(" = ")[0]: line for line in SPOT.splitlines()}
    lines |= {key: f"{key} = {value}" for key, value in changes.items() if value}
    return BASE + "\n".join(line for key, line in lines.items() if changes.get(key) != "")


ERRORS = [
    # Not TOML, or not a scene.
    ("schema = ", r"not valid TOML"),
    ("schema = 1\n[probe]\nradius = 0,035 # metres\n", r"not valid TOML: .*line 3.*; 0,035 is written 0\.035$"),
    ("[[" * 5000, r"levels of nesting"),
    ("", r"schema is missing: expected schema = 1"),
    (CAMERA.replace("schema = 1", "schema = 2"), r"schema = 2: this program reads schema 1"),
    ("schema = 1", r"\[camera\] is missing"),
    ("schema = 1\ncamera = 3", r"camera = 3: expected a table with width"),
    # Unknown keys and sections.
    (BASE + "[lite]\nx = 1", r'lite: unknown key; did you mean "light"\?'),
    (BASE + SPHERE.replace("radius", "radious"), r'object\[0\]\.radious: unknown key; did you mean "radius"\?'),
    (BASE + SPHERE + '"a\\nb" = 1', r'object\[0\]\."a\\nb": unknown key'),
    (BASE + SPHERE + 'material = { model = "lambert", basecolor = [1, 1, 1] }', r'did you mean "base_color"\?'),
    (BASE + "[light]\nkind = 'point'", r"light: there may be several: write \[\[light\]\]"),
    # The camera.
    ("schema = 1\n[camera]\ntransfer = 'srgb'", r"camera\.width is missing: give width, height, .*or calibration"),
    (CAMERA.replace("width = 640", "width = 640.5"), r"camera\.width = 640\.5: expected a whole number from 1"),
    (CAMERA.replace("fx = 600.0", ""), r"camera\.fx is missing: expected a number above 0 \(pixels\)"),
    (CAMERA.replace("fx = 600.0", "fx = nan"), r"camera\.fx = NaN"),
    (CAMERA.replace("cx = 319.5", "cx = 0x" + "f" * 8000), r"camera\.cx = a number of thousands of digits: "),
    (CAMERA + "distortion = [0, 0, 0]", r"camera\.distortion = \[0, 0, 0\]: expected a list of 4 or 5 or 8 numbers"),
    (CAMERA + "transfer = 'sRGBB'", r'camera\.transfer = "sRGBB": expected "srgb", "linear".*no such file: .*sRGBB'),
    (CAMERA + "transfer = 'gamma:x'", r'camera\.transfer = "gamma:x": expected "srgb".*"gamma:2\.2" \(0\.1 to 10\)'),
    (CAMERA + "calibration = 'notes.txt'", r"camera\.width = 640: not used beside calibration"),
    # The source.
    (BASE + "[source]\nfps = 3", r"source\.path is missing: expected exactly one of path, camera and synthetic"),
    (BASE + '[source]\npath = "a\\u0000b"', r"source\.path = .*cannot be one"),
    # The marker.
    (CAMERA + SPHERE, r"\[marker\] is missing: \[object\] has its place in the marker's frame"),
    (CAMERA + "[marker]\nid = 0", r"marker\.size is missing: expected a number above 0 \(metres\)"),
    (BASE + "dictionary = 'DICT_4X4_5O'", r'marker\.dictionary = "DICT_4X4_5O": unknown; did you mean "DICT_4X4_50"\?'),
    (BASE + "id = 50", r"marker\.id = 50: expected a whole number from 0 to 49"),
    (BASE + "board = 'grid 4x3 0.04 0.01'", r"marker\.size = 0\.08: not used beside board"),
    (CAMERA + "[marker]\nboard = 'chess 4x3 1 1'", r'marker\.board = "chess 4x3 1 1": expected "charuco COLUMNSxROWS'),
    (CAMERA + "[marker]\nboard = 'grid 4x3 a b'", r"marker_length: expected a number above 0"),
    (CAMERA + "[marker]\nboard = 'charuco 5x7 0.03 0.04'", r"a marker must be smaller than its square"),
    (CAMERA + "[marker]\nboard = 'grid 8x8 0.03 0.04'", r"needs 64 markers; DICT_4X4_50 has 50"),
    # The probe.
    (BASE + "[probe]\ncenter = [0, 0]\nradius = 1", r"probe\.center = \[0, 0\]: expected a list of 3 numbers"),
    # Proxies.
    (BASE + "[[proxy]]\nshape = 'mesh'\nfile = 'x.ply'", r'proxy\[0\]\.file = "x\.ply": no such file: .*/x\.ply'),
    (BASE + "[[proxy]]\nshape = 'mesh'\nfile = 'notes.txt'", r"unknown mesh format; use one of \.ply, \.obj"),
    # Objects.
    (
        BASE + "[[object]]\nshape = 'torus'\nmajor_radius = 1\nminor_radius = 1",
        r"minor_radius = 1: expected less than major_",
    ),
    (BASE + SPHERE + "animate = { period = 3 }", r"animate\.period = 3: .*give sway too"),
    # Materials.
    (BASE + SPHERE + "[object.material]", r"object\[0\]\.material\.model is missing: expected one of \"phong\""),
    (
        BASE + SPHERE + "[object.material]\nmodel = 'lambert'\nroughness = 1",
        r'roughness = 1: not used with model = "lam',
    ),
    (BASE + SPHERE + "[object.material]\nmodel = 'mirror'\nbase_color = 'w.png'", r'"w\.png": no such file: .*/w\.png'),
    # Lights.
    (light(kind="'point'"), r'light\[0\]\.target = .*not used with kind = "point"'),
    (light(intensity=""), r"light\[0\]\.intensity is missing: expected a number, 0 or more"),
    (light(target=""), r"light\[0\]\.target is missing: a spot light needs a target"),
    (light(direction="[0, 0, 1]"), r"light\[0\]\.direction = .*target is given too"),
    (light(target="", direction="[0, 0, 0]"), r"light\[0\]\.direction = .*has no length"),
    (light(target="[0, 0, 1]"), r"light\[0\]\.target = .*is where the light itself is"),
    (light(inner_angle="31"), r"light\[0\]\.inner_angle = 31: expected no more than outer_angle, 30"),
    (light(attenuation="[0, 0, 0]"), r"light\[0\]\.attenuation = .*is zero everywhere"),
    # Exposure.
    (BASE + "[exposure]\nscale = 'of'", r'exposure\.scale = "of": expected a number, 0 or more, or "auto"'),
]


@pytest.mark.parametrize(("text", "message"), ERRORS)
def test_errors_name_file_key_and_value(folder: pathlib.Path, text: str, message: str) -> None:
    path = folder / "scene.toml"
    with pytest.raises(SceneError, match=message) as caught:
        loads_scene(text, path)
    assert_helpful(caught.value, path)


def test_scenes_that_are_no_files(folder: pathlib.Path) -> None:
    for name in (folder, folder / "none.toml", "x" * 5000, "a\0b", ""):
        with pytest.raises(SceneError, match=r"no such scene; expected a|expected a folder with one scene file"):
            load_scene(name)
    latin = folder / "latin.toml"
    latin.write_bytes(b'schema = 1\nname = "\xe9"')
    with pytest.raises(SceneError, match="not a text file in UTF-8") as caught:
        load_scene(latin)
    assert_helpful(caught.value, latin)


@pytest.mark.parametrize("section", ["object", "light", "proxy"])
def test_too_many_entries_are_refused_by_a_limit_that_says_what_it_is(section: str) -> None:
    entry = {"object": SPHERE, "light": SPOT, "proxy": "[[proxy]]\nshape = 'plane'\nsize = [1, 1]\n"}[section]
    with pytest.raises(SceneError, match=rf"2,001 \[\[{section}\]\] tables; at most 2,000 .*MAX_SCENE_ENTRIES"):
        loads_scene(BASE + entry * 2001)


@pytest.mark.parametrize("text", [light(inner_angle="90", outer_angle="90"), light(inner_angle="0", outer_angle="0")])
def test_cones_at_their_limits_are_legal(text: str) -> None:
    assert len(loads_scene(text).lights) == 1


# --- Scenes from outside name no file but those that came with them, whatever key names it ----------------------------


HEAD = "schema = 1\n[camera]\nfield_of_view = 60\n"
MARKER_SCENE_FILES = "[marker]\nsize = 0.1\n"
OBJECT = MARKER_SCENE_FILES + '[[object]]\nshape = "sphere"\nradius = 0.1\nmaterial = {{ model = '
CASES = {
    ("Camera", "transfer"): 'transfer = "{}"',
    ("SourceSpec", "path"): '[source]\npath = "{}"',
    ("Proxy", "file"): MARKER_SCENE_FILES + '[[proxy]]\nshape = "mesh"\nfile = "{}"',
    ("Object", "file"): MARKER_SCENE_FILES + '[[object]]\nshape = "mesh"\nfile = "{}"',
    ("PhongMaterial", "diffuse"): OBJECT + '"phong", diffuse = "{}" }}',
    ("PhongMaterial", "specular"): OBJECT + '"phong", specular = "{}" }}',
    ("MetallicRoughnessMaterial", "base_color"): OBJECT + '"metallic_roughness", base_color = "{}" }}',
    ("LambertMaterial", "base_color"): OBJECT + '"lambert", base_color = "{}" }}',
    ("MirrorMaterial", "base_color"): OBJECT + '"mirror", base_color = "{}" }}',
    ("EmissiveMaterial", "image"): OBJECT + '"emissive", image = "{}" }}',
    ("CapturedLight", "file"): '[marker]\nsize = 0.1\n[light]\nfile = "{}"',
    ("PoseSpec", "file"): '[pose]\nfile = "{}"',
}
"""A scene file that names one path, by the class and field that keep it."""
OTHER = {
    "calibration": 'schema = 1\n[camera]\ncalibration = "{}"',
    "exif": 'schema = 1\n[camera]\ncalibration = "exif"\n[source]\npath = "{}"',
    "image of an area light": HEAD
    + MARKER_SCENE_FILES
    + '[[light]]\nkind = "rect"\nat = [0, 0, 1]\nsize = [1, 1]\nintensity = 1\nimage = "{}"',
}
"""Keys whose path the scene does not keep in a field of its own."""


def path_fields(kind: type, seen: set[type] | None = None) -> set[tuple[str, str]]:
    """Fields of a dataclass, and of those that it holds, whose type has a path in it."""
    seen = set() if seen is None else seen
    if kind in seen or not dataclasses.is_dataclass(kind):
        return set()
    seen.add(kind)
    found = set()
    for name, hint in typing.get_type_hints(kind).items():
        pending = [hint]
        while pending:
            item = pending.pop()
            pending += typing.get_args(item)
            if item is pathlib.Path:
                found.add((kind.__name__, name))
            elif isinstance(item, type):
                found |= path_fields(item, seen)
    return found


def test_every_field_that_holds_a_path_has_its_case() -> None:
    assert path_fields(Scene) - {("Scene", "path")} == set(CASES)


@pytest.mark.parametrize("text", [*(HEAD + case for case in CASES.values()), *OTHER.values()])
@pytest.mark.parametrize("name", ["id_rsa", "..", ".", "{folder}/id_rsa", "sub/../id_rsa", "link", "no_such"])
def test_a_scene_from_outside_reaches_no_file_but_its_own(tmp_path: pathlib.Path, text: str, name: str) -> None:
    (tmp_path / "id_rsa").write_text("secret")
    own = tmp_path / "own"
    own.mkdir()
    (own / "link").symlink_to(tmp_path / "id_rsa")
    (own / "mesh.ply").write_bytes(trimesh.creation.box((1, 1, 1)).export(file_type="ply"))
    files = SceneFiles.of(own, [own / "mesh.ply"])
    with pytest.raises(SceneError) as raised:
        loads_scene(text.format(name.format(folder=tmp_path)), "dropped.toml", files)
    message = str(raised.value).replace(name.format(folder=tmp_path), "")
    assert "came with the scene" in message
    assert str(tmp_path) not in message


def test_its_own_files_and_cameras_are_taken(tmp_path: pathlib.Path) -> None:
    mesh = tmp_path / "mesh.ply"
    mesh.write_bytes(trimesh.creation.box((1, 1, 1)).export(file_type="ply"))
    text = HEAD + "[source]\ncamera = 2\n" + CASES["Object", "file"].format("mesh.ply")
    scene = loads_scene(text, "dropped.toml", SceneFiles.of(tmp_path, [mesh], cameras=[2]))
    assert list(files_of(dataclasses.replace(scene, path=None))) == [mesh]
    with pytest.raises(SceneError, match="opens no capture device"):
        loads_scene(text, "dropped.toml", SceneFiles.of(tmp_path, [mesh]))


def test_a_users_own_scene_names_any_file(tmp_path: pathlib.Path) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "mesh.ply").write_bytes(trimesh.creation.box((1, 1, 1)).export(file_type="ply"))
    (tmp_path / "deep" / "scene.toml").write_text(HEAD + CASES["Object", "file"].format("../mesh.ply"))
    assert load_scene(tmp_path / "deep").objects[0].file == tmp_path / "mesh.ply"


# Values that scene constructors take are checked where they are given, with class, field, value and what is right.


@pytest.mark.parametrize(
    ("make", "values", "message"),
    [
        (sc.Object, {"shape": "cube"}, "Object: shape = 'cube': expected one of .*"),
        (sc.Object, {"shape": "sphere", "radius": 0}, "Object: radius = 0: expected a number above 0"),
        (sc.Object, {"shape": "mesh"}, "a mesh needs its file"),
        (sc.Object, {"shape": "sphere", "radius": 1, "at": (0, 0)}, r"at = \(0, 0\): expected a list of 3 numbers"),
        (sc.LambertMaterial, {"base_color": (255, 0, 0)}, r"base_color = \(255, 0, 0\): .* from 0 to 1"),
        (sc.Light, {"kind": "point", "intensity": True}, "intensity = True: expected a number"),
        (sc.Light, {"kind": "directional", "intensity": 1, "direction": (0, 0, 0)}, "the way the light travels"),
        (sc.Light, {"kind": "point", "intensity": 1, "at": (0, math.nan, 0)}, r"at = .*nan.*each finite"),
        (sc.Object, {"shape": "sphere", "radius": 1, "material": "red"}, "material = 'red': expected .*Material or"),
        (sc.Object, {"shape": "sphere", "radius": 1, "marker": 7}, "marker = 7: expected Marker"),
        (sc.Marker, {"board": 3}, "board = 3: expected CharucoBoard or GridBoard"),
        (sc.Marker, {"dictionary": "4X4_50"}, 'did you mean "DICT_4X4_50"'),
        (sc.Marker, {"id": 50}, "0 to 49"),
        (sc.GridBoard, {"columns": 0, "rows": 3, "marker_length": 0.04, "separation": 0.01}, "columns = 0: expected a"),
        (sc.CapturedLight, {"file": 3}, "file = 3: expected a path"),
        (sc.AreaLight, {"kind": "rect", "intensity": 1, "at": (0, 0, 1)}, "expected 2 lengths above 0"),
        (sc.Camera.guessed, {"width": 9, "height": 9, "field_of_view": 60.0, "transfer": "foo"}, "transfer = 'foo'"),
        (sc.Camera.guessed, {"width": 9, "height": 9, "field_of_view": 9, "transfer": pathlib.Path("foo")}, "transfer"),
    ],
)
def test_what_cannot_be_is_named(make: Any, values: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError, match=message):
        make(**values)


@pytest.mark.parametrize("rotation", [2 * np.eye(3), np.diag([1, 1, -1]), np.zeros((3, 3)), np.ones((3, 3))])
def test_a_pose_has_a_rotation(rotation: np.ndarray) -> None:
    with pytest.raises(UsageError, match="expected a rotation matrix"):
        sc.Pose(rotation, np.zeros(3))


def test_numbers_of_numpy_are_numbers() -> None:
    item = sc.Object("sphere", radius=np.float32(0.1), at=np.array([0.0, 1.0, 2.0], np.float32))
    assert item.radius == np.float32(0.1)
    assert item == dataclasses.replace(item, at=[0.0, 1.0, 2.0])
    assert hash(item) == hash(dataclasses.replace(item, radius=float(np.float32(0.1))))
    assert sc.CapturedLight("a.exr").file == pathlib.Path("a.exr")


def test_poses_of_lists_are_poses() -> None:
    pose = sc.Pose(np.eye(3, dtype=np.float32), [0, 0, 1])
    assert pose == sc.Pose(np.eye(3).tolist(), np.array([0.0, 0.0, 1.0]))
    assert pose != sc.Pose(np.eye(3), np.zeros(3))
    for rotation, translation in ((1j * np.eye(3), np.zeros(3)), (np.eye(3), ["a", "b", "c"]), (None, None)):
        with pytest.raises(UsageError, match=r"Pose: (rotation|translation) .*expected an array"):
            sc.Pose(rotation, translation)


# --- ``python -m warp_ar.keys`` ---------------------------------------------------------------------------------------


def test_all_keys_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert keys.main([]) == 0
    text = capsys.readouterr().out
    assert all(f"  {key.name} = " in text for key in all_keys())


def test_a_section_that_is_none_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert keys.main(["camra"]) == 2
    assert "camera" in capsys.readouterr().err
