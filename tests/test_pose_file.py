"""Poses without a marker: conventions, files, and the plane under a ball."""

import itertools
import json

import cv2
import numpy as np
import pytest

from tests.photo_room import ROOM, photograph, project, sphere
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import SceneError, UsageError
from warp_ar.photographs.support import plane_from_contact, plane_from_rectangle
from warp_ar.scene import dumps_scene, loads_scene
from warp_ar.scene.pose_file import load_pose_file, pose_of_position, rotation_of_quaternion
from warp_ar.session import Session

HEAD = """schema = 1
[camera]
width = 8
height = 6
fx = 8.0
fy = 8.0
cx = 3.5
cy = 2.5
[pose]
"""


def pose_of(text):
    rotation, translation = loads_scene(HEAD + text).pose.at(0)
    return rotation, translation


def test_all_conventions_say_the_same():
    rotation = cv2.Rodrigues(np.array([0.3, -0.2, 0.5]))[0]
    translation = np.array([0.1, 0.2, 0.9])
    angle = np.linalg.norm([0.3, -0.2, 0.5])
    axis = np.array([0.3, -0.2, 0.5]) / angle
    quaternion = [float(np.cos(angle / 2)), *(np.sin(angle / 2) * axis).tolist()]
    for text in (
        f"R = {rotation.reshape(-1).tolist()}\nt = {translation.tolist()}",
        f"quaternion = {[3 * q for q in quaternion]}\nt = {translation.tolist()}",
    ):
        found = pose_of(text)
        assert np.allclose(found[0], rotation, atol=1e-12)
        assert np.allclose(found[1], translation)
    assert np.allclose(np.array(rotation_of_quaternion(*quaternion)).reshape(3, 3), rotation)


def test_a_position_is_where_the_camera_stands():
    rotation, translation = pose_of("position = [0.1, -0.5, 0.2]\nrotate = [-30.0, 0.0, 0.0]")
    assert np.allclose(-rotation.T @ translation, [0.1, -0.5, 0.2])
    # Unturned it looks along +y, upright; turned by -30 degrees about x, 30 degrees down.
    assert np.allclose(rotation.T @ [0, 0, 1], [0, np.cos(np.pi / 6), -0.5])
    assert np.allclose(rotation.T @ [1, 0, 0], [1, 0, 0])
    level, _ = pose_of_position((0, 0, 0), (0, 0, 0))
    assert np.allclose(np.array(level).reshape(3, 3).T @ [0, 1, 0], [0, 0, -1])


COLMAP = """# Image list
2 1 0 0 0 0.2 0 1 1 b.png
1 2 3
1 0.7071067811865476 0 0 0.7071067811865476 0.1 0 1 1 a.png
"""


def test_poses_of_a_clip(tmp_path):
    (tmp_path / "images.txt").write_text(COLMAP)
    scene = loads_scene(HEAD + 'file = "images.txt"\n', tmp_path / "scene.toml")
    assert len(scene.pose.poses) == 2
    assert scene.pose.at(0)[1][0] == 0.1  # by name, not by number
    assert np.allclose(scene.pose.at(0)[0], [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert scene.pose.at(2) is None  # none is made up
    assert loads_scene(dumps_scene(scene), tmp_path / "scene.toml") == scene
    entries = [{"R": np.eye(3).tolist(), "t": [0, 0, 1]}, {"R": list(range(9)), "t": [0, 0, 1]}]
    (tmp_path / "poses.json").write_text(json.dumps(entries[:1]))
    assert load_pose_file(tmp_path / "poses.json").poses[0][1] == (0.0, 0.0, 1.0)
    (tmp_path / "poses.json").write_text(json.dumps(entries))
    with pytest.raises(SceneError, match="pose 1: expected R, a rotation matrix"):
        load_pose_file(tmp_path / "poses.json")
    entries = [{"R": np.eye(3).tolist(), "t": [0, 0, 1], **name} for name in ({"name": "a.png"}, {})]
    (tmp_path / "poses.json").write_text(json.dumps(entries))
    with pytest.raises(SceneError, match="1 of 2 poses have names"):
        load_pose_file(tmp_path / "poses.json")
    (tmp_path / "images.txt").write_text("1 0 0 0 0 0 0 1 1 a.png\n")
    with pytest.raises(SceneError, match="QW QX QY QZ"):
        load_pose_file(tmp_path / "images.txt")


@pytest.mark.parametrize("points", ["\n", "", "1.5 2 -1 3 4 5 6 7 8 9 10 11\n"], ids=["none", "left out", "four"])
def test_poses_are_those_of_the_pictures_of_their_names(tmp_path, points):
    names = ["left/f1.jpg", "right/f1.jpg", "left/f2.jpg", "left/f10.jpg"]
    lines = [f"{n} 1 0 0 0 {n} 0 1 1 {name}\n{points}" for n, name in enumerate(names)]
    (tmp_path / "images.txt").write_text("".join(lines))
    pose = load_pose_file(tmp_path / "images.txt")
    shift = {
        name: pose.at(7, name) for name in ("/a/left/f1.jpg", "right/f1.png", "f10.jpg", "f2.exr", "f1.jpg", "f3.jpg")
    }
    assert {name: None if found is None else found[1][0] for name, found in shift.items()} == {
        "/a/left/f1.jpg": 0.0,
        "right/f1.png": 1.0,
        "f10.jpg": 3.0,
        "f2.exr": 2.0,
        "f1.jpg": None,
        "f3.jpg": None,  # one of two, and of none
    }
    assert [pose.at(index)[1][0] for index in range(4)] == [0.0, 2.0, 3.0, 1.0]  # a video's: in natural order


def test_poses_of_nerf(tmp_path):
    """By name, OpenGL's axes: the camera looks along its own -z."""
    level = [[1, 0, 0, 0.1], [0, 0, -1, -0.5], [0, 1, 0, 0.2], [0, 0, 0, 1]]  # along +y, upright
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"frames": [{"file_path": ".\\train\\r_0", "transform_matrix": level}]}))
    rotation, translation = load_pose_file(path).at(9, "train/r_0.png")
    assert np.allclose(rotation, np.reshape(pose_of_position((0.1, -0.5, 0.2), (0, 0, 0))[0], (3, 3)))
    assert np.allclose(-rotation.T @ translation, [0.1, -0.5, 0.2])
    for wrong in (
        {},
        {"file_path": "a", "transform_matrix": [[1, 2], [3]]},
        {"file_path": 3, "transform_matrix": level},
        {"file_path": "a", "transform_matrix": np.transpose(level).tolist()},  # by columns
    ):
        path.write_text(json.dumps({"frames": [wrong]}))
        with pytest.raises(SceneError, match="frame 0: expected file_path and transform_matrix"):
            load_pose_file(path)


def test_a_session_takes_poses_by_name(tmp_path, device):
    """Unpadded names, a picture that was not placed, a clip that is looped."""
    (tmp_path / "frames").mkdir()
    for number in (1, 2, 10, 11):
        cv2.imwrite(str(tmp_path / f"frames/f{number}.png"), np.full((6, 8, 3), number, np.uint8))
    lines = [f"{n} 1 0 0 0 {n} 0 1 1 f{n}.png\n\n" for n in (1, 10, 11)]
    (tmp_path / "images.txt").write_text("".join(lines))
    scene = loads_scene(HEAD + 'file = "images.txt"\n', tmp_path / "scene.toml")
    with Session(
        scene, source=tmp_path / "frames", device=device, quality="low", outputs=("pose", "image"), loop=True
    ) as session:
        poses = [result.pose for _, result in itertools.islice(session, 6)]
        (note,) = session.notes
    assert [None if pose is None else pose.translation[0] for pose in poses] == [1.0, None, 10.0, 11.0, 1.0, None]
    assert "1 frame has no pose there, f2.png" in note


def test_frames_without_names_take_their_poses_in_turn(tmp_path, device):
    (tmp_path / "images.txt").write_text(COLMAP)
    scene = loads_scene(HEAD + 'file = "images.txt"\n', tmp_path / "scene.toml")
    with Pipeline(scene, device=device, quality="low", outputs=("pose", "image")) as pipeline:
        poses = [pipeline(np.zeros((6, 8, 3), np.uint8)).pose for _ in range(3)]
    assert [None if pose is None else pose.translation[0] for pose in poses] == [0.1, 0.2, None]


def normal_error(rotation):
    """Degrees between a plane's normal and the table's."""
    true = photograph()[2][:, 2]
    return np.degrees(np.arccos(np.clip(rotation[:, 2] @ true, -1, 1)))


def test_the_plane_by_a_rectangle():
    corners = [project([x, y, 0.0]) for x, y in ((-0.1, -0.07), (0.1, -0.07), (0.1, 0.07), (-0.1, 0.07))]
    camera = photograph()[1]
    for order in (corners, corners[::-1]):
        found = plane_from_rectangle(camera, [list(p) for p in order], (0.2, 0.14))
        assert normal_error(found.pose.rotation) < 1e-3
        assert np.linalg.det(found.pose.rotation) == pytest.approx(1.0)
        assert np.allclose(found.pose.translation, photograph()[3], atol=1e-6)
    moved = [list(p + np.array([0.7, -0.7])) for p in corners[:2]] + [list(p) for p in corners[2:]]
    found = plane_from_rectangle(camera, moved, (0.2, 0.14))
    assert normal_error(found.pose.rotation) < 4 * found.tilt_deviation
    with pytest.raises(UsageError, match="span an area"):
        plane_from_rectangle(camera, [[0, 0], [1, 1], [2, 2], [3, 3]], (0.2, 0.14))


def test_the_plane_by_the_balls_contact():
    camera = photograph()[1]
    contact = project([0.0, 0.0, 0.0])
    exact = plane_from_contact(sphere(), camera, contact, ROOM.radius)
    assert normal_error(exact.pose.rotation) < 1e-3
    assert np.allclose(exact.pose.translation, photograph()[3], atol=1e-6)
    off = plane_from_contact(sphere(), camera, contact + np.array([2.0, 0.0]), ROOM.radius, picked=2.0)
    assert 0.5 < normal_error(off.pose.rotation) < 1.5 * off.tilt_deviation
    with pytest.raises(UsageError, match="not on the ball"):
        plane_from_contact(sphere(), camera, (1.0, 1.0))
