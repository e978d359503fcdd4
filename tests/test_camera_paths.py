"""Ways of cameras in other programs' files: each says the poses that it was written for."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest

from tests.layer_rig import POSES, make_scene
from warp_ar.errors import SceneError, SinkError
from warp_ar.output.camera_files import track_angles, write_track
from warp_ar.output.shot import Shot
from warp_ar.output.usd_file import write_usd
from warp_ar.scene import Pose
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.pose_file import load_pose_file, rotation_of_track

EXACT = 1e-9


def assert_poses(found, expected, atol=EXACT):
    assert len(found) == len(expected)
    for (rotation, translation), pose in zip(found, expected, strict=True):
        np.testing.assert_allclose(np.reshape(rotation, (3, 3)), pose.rotation, atol=atol)
        np.testing.assert_allclose(translation, pose.translation, atol=atol)


def sample(pan=0.0, tilt=0.0, roll=0.0, at=(0.0, 0.0, 0.0)):
    x, y, z = at
    return {"translation": {"x": x, "y": y, "z": z}, "rotation": {"pan": pan, "tilt": tilt, "roll": roll}}


def test_track_by_hand(tmp_path):
    """Level it looks along +y; a positive pan turns it to the left, a positive tilt up, right-handed about z and x."""
    path = tmp_path / "track.json"
    path.write_text(
        json.dumps([{"transforms": [sample(pan=90.0, at=(1.0, 2.0, 3.0))]}, {"transforms": [sample(tilt=30)]}])
    )
    (left, shift), (up, _) = load_pose_file(path).poses
    left, up = np.reshape(left, (3, 3)), np.reshape(up, (3, 3))
    np.testing.assert_allclose(left.T @ [0, 0, 1], [-1, 0, 0], atol=EXACT)
    np.testing.assert_allclose(left.T @ [0, 1, 0], [0, 0, -1], atol=EXACT)
    np.testing.assert_allclose(-left.T @ shift, [1, 2, 3], atol=EXACT)
    np.testing.assert_allclose(up.T @ [0, 0, 1], [0, np.cos(np.pi / 6), 0.5], atol=EXACT)


def test_track_composes_its_transforms(tmp_path):
    """A camera on a turned dolly: the second transform is relative to the first."""
    path = tmp_path / "track.jsonl"
    path.write_text(
        json.dumps({"transforms": [sample(pan=90.0, at=(5.0, 0.0, 0.0)), sample(at=(0.0, 1.0, 0.5))]}) + "\n\n"
    )
    ((rotation, translation),) = load_pose_file(path).poses
    np.testing.assert_allclose(-np.reshape(rotation, (3, 3)).T @ translation, [4.0, 0.0, 0.5], atol=EXACT)


def test_track_angles_and_back():
    rng = np.random.default_rng(0)
    for turn in [rotation_matrix(rng.uniform(-180, 180, 3)) for _ in range(50)] + [
        rotation_of_track(30.0, 90.0, 0.0),
        rotation_of_track(-20.0, -90.0, 10.0),
    ]:
        np.testing.assert_allclose(rotation_of_track(*track_angles(turn)), turn, atol=1e-6)


@pytest.fixture
def shot():
    return Shot(make_scene(), 24.0, POSES)


def test_what_is_exported_is_read_back(shot, tmp_path):
    write_track(tmp_path / "shot.jsonl", shot)
    assert_poses(load_pose_file(tmp_path / "shot.jsonl").poses, POSES)
    first = json.loads((tmp_path / "shot.jsonl").read_text().splitlines()[0])
    assert first["timing"]["sampleRate"] == {"num": 24, "denom": 1}
    assert first["lens"]["pinholeFocalLength"] == pytest.approx(36.0 * 70.0 / 64.0)
    pytest.importorskip("pxr.Usd", reason="needs usd-core, of the extra exchange")
    for suffix in (".usda", ".usdc"):
        write_usd(tmp_path / f"shot{suffix}", shot)
        assert_poses(load_pose_file(tmp_path / f"shot{suffix}").poses, POSES)
    with pytest.raises(SinkError, match="cannot be written"):
        write_track(tmp_path / "missing" / "shot.jsonl", shot)


def test_usd_of_another_program(tmp_path):
    """y up, centimetres, 48 time codes a second at 24 frames, a camera below a scaled rig."""
    Usd = pytest.importorskip("pxr.Usd", reason="needs usd-core, of the extra exchange")
    from pxr import Gf, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "maya.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.SetTimeCodesPerSecond(48)
    stage.SetFramesPerSecond(24)
    stage.SetStartTimeCode(10)
    stage.SetEndTimeCode(14)
    rig = UsdGeom.Xform.Define(stage, "/rig")
    rig.AddScaleOp().Set(Gf.Vec3f(2.0, 2.0, 2.0))
    camera = UsdGeom.Camera.Define(stage, "/rig/camera")
    move = camera.AddTranslateOp()
    for code, x in ((10, 0.0), (14, 50.0)):
        move.Set(Gf.Vec3d(x, 10.0, 20.0), code)
    stage.GetRootLayer().Save()
    # Unturned it looks along its -z, y up: the marker's +y with z up. Doubled by its rig, 20 cm high, 40 cm back.
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    expected = [Pose(level, -level @ np.array([x, -0.4, 0.2])) for x in (0.0, 0.5, 1.0)]
    assert_poses(load_pose_file(tmp_path / "maya.usda").poses, expected, atol=1e-6)


@pytest.mark.parametrize("rate", [24, 25, 30, 60])
def test_usd_that_says_time_codes_alone(tmp_path, rate):
    """As Blender writes it: a time code for each frame, and no rate of frames, which USD then takes for 24."""
    pytest.importorskip("pxr.Usd", reason="needs usd-core, of the extra exchange")
    samples = "".join(f"{code}: ({code}, 0, 0), " for code in range(1, 9))
    (tmp_path / "a.usda").write_text(
        f"#usda 1.0\n(\n  startTimeCode = 1\n  endTimeCode = 8\n  timeCodesPerSecond = {rate}\n  metersPerUnit = 1\n"
        '  upAxis = "Z"\n)\n'
        f'def Camera "c" {{\n  double3 xformOp:translate.timeSamples = {{ {samples} }}\n'
        '  uniform token[] xformOpOrder = ["xformOp:translate"]\n}\n'
    )
    assert [round(-translation[0], 6) for _, translation in load_pose_file(tmp_path / "a.usda").poses] == list(
        range(1, 9)
    )


def test_colmap_binary_says_what_its_text_does(tmp_path):
    text = "1 0.5 0.5 -0.5 0.5 0.1 0.2 0.3 1 b.png\n\n2 1 0 0 0 0 0 1 1 a.png\n\n"
    (tmp_path / "images.txt").write_text(text)
    data = struct.pack("<Q", 2)
    for number, (*values, name) in enumerate(
        [(0.5, 0.5, -0.5, 0.5, 0.1, 0.2, 0.3, b"b.png"), (1, 0, 0, 0, 0, 0, 1, b"a.png")]
    ):
        points = struct.pack("<ddq", 1.0, 2.0, -1) * number
        data += struct.pack("<I7dI", number, *values, 1) + name + b"\0" + struct.pack("<Q", number) + points
    (tmp_path / "images.bin").write_bytes(data)
    assert load_pose_file(tmp_path / "images.bin").poses == load_pose_file(tmp_path / "images.txt").poses
    (tmp_path / "cut.bin").write_bytes(data[:100])
    with pytest.raises(SceneError, match=r"cut\.bin: cut off after 100 bytes"):
        load_pose_file(tmp_path / "cut.bin")


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.jsonl", '{"transforms": []}', r"sample 0: expected transforms"),
        ("a.jsonl", '{"transforms": [{"translation": {"x": 1, "y": 2}}]}', r"expected translation with x, y, z"),
        ("a.json", '[{"transforms": [{"translation": {"x": 1, "y": 2, "z": 3}}]}]', r"expected rotation with pan"),
        ("a.jsonl", json.dumps({"transforms": [sample() | {"scale": dict.fromkeys("xyz", 2)}]}), "scale is"),
        ("a.jsonl", "", r"holds no pose"),
        ("a.abc", "Ogawa", r"a\.abc: Alembic is not read; turn it into USD"),
        ("a.usda", "#usda 1.0\n", r"expected one camera, found 0"),
        ("a.usda", "no USD", r"no USD file that can be read"),
        ("a.usda", '#usda 1.0\ndef Camera "a" {}\ndef Camera "b" {}\n', r"found 2 \(/a, /b\)"),
    ],
)
def test_files_that_are_none_are_named(tmp_path, capfd, name, text, words):
    if name.endswith(".usda"):
        pytest.importorskip("pxr.Usd", reason="needs usd-core, of the extra exchange")
    (tmp_path / name).write_text(text)
    with pytest.raises(SceneError, match=words):
        load_pose_file(tmp_path / name)
    assert capfd.readouterr().err == "", "what USD would print is no message of ours"
