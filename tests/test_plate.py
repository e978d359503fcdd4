"""From two photographs to lit objects in another picture: the ball's and the plate's."""

import cv2
import numpy as np
import pytest

from tests.photo_files import encode_srgb, write_photo
from tests.photo_room import FOCAL, GAIN, ROOM, SIZE, exposed, project
from tests.rendered_room import look_at, render
from warp_ar import capture, live, pose
from warp_ar.command_line import EXIT_DONE
from warp_ar.light.captured import Light
from warp_ar.scene import load_scene

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


@pytest.mark.slow
def test_two_photographs_light_an_object_in_the_plate(tmp_path, capsys):
    ball, picture = write_photo(tmp_path / "ball.jpg", exposed(60), denominator=60), plate(tmp_path / "plate.jpg")
    sheets = [
        ["--rectangle", *numbers(*map(see, CORNERS)), "--rectangle-size", *numbers(WIDE)] for see in (project, on_plate)
    ]
    light, scene = tmp_path / "light.exr", tmp_path / "plate.toml"
    circle = ["--circle", "272.3", "225.6", "49.2", "--device", "cpu"]
    assert capture.main([str(ball), *sheets[0], *circle, "--output", str(light)]) == EXIT_DONE
    assert pose.main([str(picture), *sheets[1], "--light", str(light), "--scene", str(scene)]) == EXIT_DONE
    assert "the plate has 0.5 times the light's exposure" in capsys.readouterr().err
    shown = ["--headless", "--device", "cpu", "--output", str(tmp_path / "out")]
    assert live.main([str(scene), *shown]) == EXIT_DONE
    lit = cv2.imread(str(tmp_path / "out" / "0000.png")).astype(np.float32)
    # The virtual metal ball is as bright as the real one, but for their reflectances; the sheet's middle is the origin.
    real, virtual = on_plate(ROOM.center), on_plate(CORNERS.mean(0) + np.array([0.12, 0.0, 0.04]))
    means = [cv2.getRectSubPix(lit, (24, 24), tuple(map(float, at))).mean() for at in (real, virtual)]
    assert means[1] / means[0] == pytest.approx((0.95 / ROOM.reflectance) ** (1 / 2.2), rel=0.15)


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
    rotation = np.array(found.pose.poses[0][0]).reshape(3, 3)
    eye = -rotation.T @ np.array(found.pose.poses[0][1])
    assert np.abs(eye - -PLATE[0].T @ PLATE[1]).max() < 0.01
    assert np.degrees(np.arccos((np.trace(rotation @ PLATE[0].T) - 1) / 2)) < 0.5
