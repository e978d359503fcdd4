"""The command that writes shots: its files, and one line for what cannot be."""

from __future__ import annotations

import json
import pathlib

import numpy as np
import pytest

from tests.test_live import message, write_scene
from warp_ar import export
from warp_ar.output.sinks import read_environment
from warp_ar.scene.pose_file import load_poses


def run(*arguments: object) -> int:
    return export.main([str(argument) for argument in ("--device", "cpu", *arguments)])


@pytest.fixture
def clip(tmp_path: pathlib.Path) -> pathlib.Path:
    """A scene whose frames lie in a folder."""
    import cv2

    from warp_ar.sources.sources import Synthetic

    frames = tmp_path / "frames"
    frames.mkdir()
    with Synthetic("card") as card:
        for index, frame in zip(range(3), card, strict=False):
            cv2.imwrite(str(frames / f"{index:04d}.png"), frame.image[..., ::-1])
    return write_scene(tmp_path, source='path = "frames"\nfps = 25.0')


def test_a_shot_is_written_with_its_light(clip: pathlib.Path, tmp_path: pathlib.Path, capsys) -> None:
    out = tmp_path / "out"
    assert run(clip, "--output", out / "shot.glb", "--stmaps") == 0
    assert sorted(path.name for path in out.iterdir()) == [
        "shot.glb",
        "shot_distort.exr",
        "shot_environment.exr",
        "shot_undistort.exr",
    ]
    assert capsys.readouterr().out.splitlines()[0] == "3 frames"
    assert np.isfinite(read_environment(out / "shot_environment.exr")).all()
    data = (out / "shot.glb").read_bytes()
    tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    assert tree["asset"]["extras"] == {"plate": "../frames", "fps": 25.0, "environment": "shot_environment.exr"}
    # A second time its own files are replaced.
    assert run(clip, "--output", out / "shot.glb") == 0
    assert "is replaced: this program wrote it before" in capsys.readouterr().err


def test_every_balls_light_is_written(clip: pathlib.Path, tmp_path: pathlib.Path, capsys) -> None:
    """In files of their own, which say where the ball stands; a program that knows one light takes the first."""
    more = "\n[[probe]]\ncenter = [0.1, 0.03, 0.03]\nradius = 0.03\n"
    clip.write_text(clip.read_text().replace("[probe]", "[[probe]]") + more)
    assert run(clip, "--output", tmp_path / "shot.glb", "--frames", 1) == 0
    printed = capsys.readouterr().out.splitlines()
    maps = [tmp_path / f"shot_{name}.exr" for name in ("environment", "environment_1")]
    assert [str(path) for path in maps] == [line for line in printed if line.endswith(".exr")]
    first, second = map(read_environment, maps)
    assert np.abs(first - second).max() > 0.0
    data = (tmp_path / "shot.glb").read_bytes()
    extras = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])["asset"]["extras"]
    assert extras["environment"] == "shot_environment.exr"
    assert extras["other_environments"] == [{"file": "shot_environment_1.exr", "at": [0.1, 0.03, 0.03]}]
    usd = pytest.importorskip("pxr.Usd", reason="needs usd-core, of the extra exchange")
    assert run(clip, "--output", tmp_path / "shot.usda", "--frames", 1) == 0
    stage = usd.Stage.Open(str(tmp_path / "shot.usda"))
    other = stage.GetPrimAtPath("/shot/lights/environment_1")
    assert stage.GetPrimAtPath("/shot/lights/environment").IsActive()
    assert not other.IsActive()
    assert tuple(other.GetCustomDataByKey("at")) == (0.1, 0.03, 0.03)
    # With one ball less nothing of the other's light stays; what is somebody else's does.
    theirs = tmp_path / "shot_environment_7.exr"
    theirs.write_bytes(b"somebody's")
    clip.write_text(clip.read_text().replace(more, ""))
    capsys.readouterr()
    assert run(clip, "--output", tmp_path / "shot.glb", "--frames", 1) == 0
    assert "shot_environment_1.exr: of an earlier export" in capsys.readouterr().err
    assert maps[0].exists()
    assert not maps[1].exists()
    assert theirs.exists()


def test_a_way_comes_back_as_poses(clip: pathlib.Path, tmp_path: pathlib.Path) -> None:
    assert run(clip, "--output", tmp_path / "way.jsonl", "--frames", 2) == 0
    assert not (tmp_path / "way_environment.exr").exists()
    assert len(load_poses(tmp_path / "way.jsonl")) == 2
    pytest.importorskip("pxr.Usd", reason="needs usd-core, of the extra exchange")
    assert run(clip, "--output", tmp_path / "way.usda", "--frames", 2, "--no-environment") == 0
    for one, other in zip(load_poses(tmp_path / "way.usda"), load_poses(tmp_path / "way.jsonl"), strict=True):
        np.testing.assert_allclose(np.concatenate(one), np.concatenate(other), atol=1e-9)
    assert run(clip, "--output", tmp_path / "way.usda", "--frames", 1, "--no-environment") == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--output", "shot.fbx"), "--output shot.fbx ends in '.fbx'; use .usda, .usdc, .usd, .glb, .jsonl"),
        (("--output", "shot.glb", "--frames", "0"), "--frames 0: expected a number of frames, 1 or more"),
        (("--output", "shot.glb", "--source", "missing"), "missing"),
    ],
)
def test_what_cannot_be_is_said(
    clip: pathlib.Path, tmp_path: pathlib.Path, monkeypatch, capsys, arguments: tuple, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(clip, *arguments) != 0
    assert words in message(capsys)


def test_frames_without_a_marker_have_no_way(clip: pathlib.Path, tmp_path: pathlib.Path, capsys) -> None:
    import cv2

    for path in (tmp_path / "frames").iterdir():
        cv2.imwrite(str(path), np.full((480, 640, 3), 128, np.uint8))
    assert run(clip, "--output", tmp_path / "shot.glb", "--no-environment") == 1
    assert "no frame shows the marker" in message(capsys)
    assert not (tmp_path / "shot.glb").exists()


def test_files_of_others_stay(clip: pathlib.Path, tmp_path: pathlib.Path, capsys) -> None:
    (tmp_path / "shot.glb").write_bytes(b"somebody's")
    assert run(clip, "--output", tmp_path / "shot.glb", "--no-environment") == 1
    assert "this program did not write it" in message(capsys)
    assert run(clip, "--output", tmp_path / "shot.glb", "--no-environment", "--overwrite", "--frames", 1) == 0


def test_usd_without_its_library_is_named(clip: pathlib.Path, tmp_path: pathlib.Path, monkeypatch, capsys) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pxr", None)
    assert run(clip, "--output", tmp_path / "shot.usda") == 2
    assert 'USD files need usd-core; install it with pip install "warp-ar[exchange]"' in message(capsys)


def test_every_usd_is_known_again(clip: pathlib.Path, tmp_path: pathlib.Path, capsys) -> None:
    pytest.importorskip("pxr.Usd", reason="needs usd-core, of the extra exchange")
    for name in ("shot.usdc", "shot.usd"):
        for _ in range(2):
            assert run(clip, "--output", tmp_path / name, "--frames", 1, "--no-environment") == 0
        assert f"{name} is replaced: this program wrote it before" in capsys.readouterr().err
    (tmp_path / "other.usdc").write_bytes(b"PXR-USDC and then nothing that it should have")
    assert run(clip, "--output", tmp_path / "other.usdc", "--frames", 1, "--no-environment") == 1
    assert "this program did not write it" in message(capsys)


BOX = """
[[object]]
shape = "box"
size = [0.02, 0.02, 0.02]
material = { model = "lambert", base_color = "%s" }
"""


def test_pictures_of_others_beside_a_usd_stay(tmp_path: pathlib.Path, clip: pathlib.Path, capsys) -> None:
    """A texture goes beside the file: not over somebody's picture, and not over the one that it is made from."""
    import cv2

    pytest.importorskip("pxr.Usd", reason="needs usd-core, of the extra exchange")
    own, written = tmp_path / "wood.png", tmp_path / "shot_object_1_box.png"
    for path in (own, written):
        cv2.imwrite(str(path), np.full((8, 8, 3), 90, np.uint8))
    before, text = written.read_bytes(), clip.read_text()
    options = (clip, "--output", tmp_path / "shot.usda", "--frames", 1, "--no-environment")
    for name, words in (("shot_object_1_box", "is the same as"), ("wood", "this program did not write it")):
        clip.write_text(text + BOX % f"{name}.png")
        assert run(*options) != 0
        assert words in message(capsys)
        assert written.read_bytes() == before
    for more in (("--overwrite",), ()):  # its own the second time
        assert run(*options, *more) == 0
        assert written.read_bytes() != before
