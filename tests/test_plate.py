"""From two photographs to lit objects in another picture: the ball's and the plate's."""

import dataclasses
import importlib
import re
import shlex
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.photo_files import encode_srgb, write_photo
from tests.photo_room import FOCAL, GAIN, ROOM, SIZE
from tests.rendered_room import look_at, render
from warp_ar import pose
from warp_ar.command_line import EXIT_DONE, EXIT_USAGE
from warp_ar.light.captured import Light
from warp_ar.scene import PoseSpec, load_scene
from warp_ar.tracking import card_layout

CORNERS = np.array([[-0.15, -0.1, 0.0], [0.15, -0.1, 0.0], [0.15, 0.11, 0.0], [-0.15, 0.11, 0.0]])
"""Of a sheet on the table, metres."""
WIDE = (0.3, 0.21)
MATRIX = np.array([[FOCAL, 0, (SIZE[0] - 1) / 2], [0, FOCAL, (SIZE[1] - 1) / 2], [0, 0, 1]])
PLATE = look_at(np.array([-0.3, -0.5, 0.4]), np.array([0.03, 0.0, 0.0]), roll=3.0)


def on_plate(point):
    x, y, z = PLATE[0] @ point + PLATE[1]
    return x / z * FOCAL + MATRIX[0, 2], y / z * FOCAL + MATRIX[1, 2]


def plate(path, denominator=120, **told):
    light = GAIN / denominator * render(ROOM, MATRIX, PLATE, SIZE, samples=1)
    return write_photo(path, encode_srgb(light), denominator=denominator, **told)


def some_light(path):
    Light(np.full((32, 64, 3), 0.5, np.float32), np.ones((32, 64), np.float32)).save(path)
    return path


def numbers(*values):
    return [f"{value:.6f}" for part in values for value in np.ravel(part)]


def test_points_in_depth_tell_pose_and_focal_length(tmp_path, capsys):
    points = [*CORNERS, (0.0, 0.3, 0.12), (-0.2, 0.1, 0.2)]
    picture = plate(tmp_path / "plate.png", denominator=60)
    cv2.imwrite(str(picture), cv2.imread(str(picture)))  # without EXIF
    given = [text for point in points for text in ("--point", *numbers(point, on_plate(np.array(point))))]
    scene = tmp_path / "plate.toml"
    assert (
        pose.main([str(picture), *given, "--light", str(some_light(tmp_path / "light.exr")), "--scene", str(scene)])
        == EXIT_DONE
    )
    said = capsys.readouterr().err
    assert "states no exposure" in said
    assert "it is uncertain" not in said
    found = load_scene(scene)
    assert found.camera.fx == pytest.approx(FOCAL, rel=0.02)
    far, turned = eye_and_turn(found)
    assert far < 0.01
    assert turned < 0.5


def eye_and_turn(scene):
    """Distance in metres and angle in degrees of a scene's camera from the plate's own."""
    rotation = np.array(scene.pose.poses[0][0]).reshape(3, 3)
    eye = -rotation.T @ np.array(scene.pose.poses[0][1])
    turned = np.degrees(np.arccos((np.trace(rotation @ PLATE[0].T) - 1) / 2))
    return np.linalg.norm(eye - -PLATE[0].T @ PLATE[1]), turned


def test_vanishing_lines_tell_pose_and_focal_length(tmp_path, capsys):
    """Edges of a sheet and of a box that stands on it."""
    picture = plate(tmp_path / "plate.png", denominator=60)
    cv2.imwrite(str(picture), cv2.imread(str(picture)))  # without EXIF
    a, b, c, d = CORNERS
    high = np.array([0.0, 0.0, 0.2])
    lines = {"x": (a, b, d, c), "y": (a, d, b, c), "z": (a, a + high, c, c + high)}
    picked = {
        axis: [f"--vanishing-{axis}", *numbers(*(np.round(on_plate(end), 1) for end in ends))]
        for axis, ends in lines.items()
    }
    length = ["--length", *numbers(on_plate(a), on_plate(b), WIDE[0])]
    light, scene = some_light(tmp_path / "light.exr"), tmp_path / "plate.toml"
    files = ["--light", str(light), "--scene", str(scene), "--overwrite"]
    for axes in ("xyz", "xy", "xz", "yz"):
        given = [text for axis in axes for text in picked[axis]]
        assert pose.main([str(picture), *given, *length, *files]) == EXIT_DONE
        assert "the focal length is" in capsys.readouterr().err
        found = load_scene(scene)
        assert found.camera.fx == pytest.approx(FOCAL, rel=0.03)
        rotation, translation = (np.array(part) for part in found.pose.poses[0])
        moved = dataclasses.replace(
            found, pose=PoseSpec(((tuple(rotation), tuple(translation - rotation.reshape(3, 3) @ a)),))
        )
        far, turned = eye_and_turn(moved)
        assert far < 0.02
        assert turned < 1.0
    sky = ["--length", *numbers(on_plate(a), (300.0, -5000.0), 1.0)]
    given = [text for axis in "xy" for text in picked[axis]]
    assert pose.main([str(picture), *given, *sky, *files]) == EXIT_USAGE
    assert "expected points below the horizon" in capsys.readouterr().err


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
def test_a_colmap_model_gives_pose_and_lens(tmp_path, capsys, binary):
    """Of twice the plate's size, in units of two metres, with another camera's photograph in it."""
    picture = plate(tmp_path / "plate.jpg", denominator=60)
    x, y, z, w = Rotation.from_matrix(PLATE[0]).as_quat()
    views = {7: (w, x, y, z, *(PLATE[1] / 2), 3, "set/plate.jpg"), 8: (1, 0, 0, 0, 0, 0, 0, 1, "set/ball.jpg")}
    middle = [2 * (MATRIX[axis, 2] + 0.5) for axis in (0, 1)]
    lenses = {1: (0, 64, 48, 50.0, 32.0, 24.0), 3: (1, 2 * SIZE[0], 2 * SIZE[1], 2 * FOCAL, 2 * FOCAL, *middle)}
    model = tmp_path / "sparse"
    model.mkdir()
    if binary:
        parts = [struct.pack("<I7dI", n, *v[:8]) + v[8].encode() + b"\0" + bytes(8) for n, v in views.items()]
        (model / "images.bin").write_bytes(struct.pack("<Q", len(parts)) + b"".join(parts))
        parts = [struct.pack(f"<IiQQ{len(v) - 3}d", n, *v) for n, v in lenses.items()]
        (model / "cameras.bin").write_bytes(struct.pack("<Q", len(parts)) + b"".join(parts))
    else:
        (model / "images.txt").write_text("".join(f"{n} {' '.join(map(str, v))}\n\n" for n, v in views.items()))
        names = "SIMPLE_PINHOLE", "PINHOLE"
        lines = [f"{n} {names[model_]} {' '.join(map(str, v))}\n" for n, (model_, *v) in lenses.items()]
        (model / "cameras.txt").write_text("".join(lines))
    light, scene = some_light(tmp_path / "light.exr"), tmp_path / "plate.toml"
    files = ["--light", str(light), "--scene", str(scene), "--overwrite"]
    given = ["--colmap", str(model), "--colmap-scale", "2", *files]
    assert pose.main([str(picture), *given]) == EXIT_DONE
    found = load_scene(scene)
    camera = found.camera
    np.testing.assert_allclose((camera.fx, camera.cx, camera.cy), (FOCAL, MATRIX[0, 2], MATRIX[1, 2]), rtol=1e-6)
    far, turned = eye_and_turn(found)
    assert far < 1e-5
    assert turned < 1e-3
    # The objects stand in the middle of the picture.
    assert on_plate(np.mean([one.at for one in found.objects], 0) * (1, 1, 0)) == pytest.approx(MATRIX[:2, 2], abs=0.1)
    other = picture.rename(tmp_path / "other.jpg")
    assert pose.main([str(other), *given]) == EXIT_USAGE
    assert "expected one picture of the name other.jpg among 2" in capsys.readouterr().err


def commands_of_the_docs():
    """The commands of docs/photographs.md that light an object in a plate by the printed card."""
    text = (Path(__file__).parent.parent / "docs" / "photographs.md").read_text()
    (block,) = (part for part in re.findall(r"```sh\n(.*?)```", text, re.S) if "calibrate card" in part)
    return [shlex.split(line, comments=True)[2:] for line in block.splitlines()]


@pytest.mark.slow
@pytest.mark.parametrize("exif", [True, False], ids=["EXIF", "no EXIF"])
def test_the_commands_of_the_docs_light_an_object(tmp_path, capsys, monkeypatch, exif):
    """As written there, from the card that is printed to the picture; only the device and the quality are others."""
    monkeypatch.chdir(tmp_path)
    room = dataclasses.replace(ROOM, card=True)
    told = {"denominator": 60} if exif else {}
    eye = look_at(ROOM.center + np.array([0.06, -0.42, 0.25]), np.array([0.02, 0.02, 0.03]))
    write_photo(tmp_path / "ball.jpg", encode_srgb(GAIN / 60 * render(room, MATRIX, eye, SIZE)), **told)
    told = {"denominator": 120} if exif else {}
    write_photo(tmp_path / "plate.jpg", encode_srgb(GAIN / 120 * render(room, MATRIX, PLATE, SIZE)), **told)
    commands = commands_of_the_docs()
    assert len(commands) <= 5
    for module, *arguments in commands:
        own = {"warp_ar.capture": ["--device", "cpu"], "warp_ar.live": ["--device", "cpu", "--quality", "low"]}
        main = importlib.import_module(module).main
        assert main([*arguments, *own.get(module, [])]) == EXIT_DONE
    said = capsys.readouterr().err
    assert "the plane is the printed card's" in said
    times = float(re.search(r"the plate has (\S+) times the light's exposure", said)[1])
    assert times == pytest.approx(0.5, rel=1e-3 if exif else 0.2)
    assert ("by the card's paper" in said) != exif
    scene = load_scene(tmp_path / "plate.toml")
    lit = cv2.imread(str(tmp_path / "out" / "0000.png")).astype(np.float32)
    shift = np.array([0.0, -card_layout.BALL_PLACE[1], 0.0])  # of the card's world in the room's
    metal = next(one for one in scene.objects if getattr(one.material, "metallic", 0.0) == 1.0)
    seen = on_plate(ROOM.center), on_plate(np.array(metal.at) + shift)
    means = [cv2.getRectSubPix(lit, (24, 24), tuple(map(float, at))).mean() for at in seen]
    assert means[1] / means[0] == pytest.approx((0.95 / ROOM.reflectance) ** (1 / 2.2), rel=0.2)
