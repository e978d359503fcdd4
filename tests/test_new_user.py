"""Wrong orders, typos and poor pictures of somebody new: each line says what to do, and nothing worse is written."""

from __future__ import annotations

import shutil

import imageio.v3
import numpy as np
import pytest

from tests.printed_card import PrintedCard
from tests.rendered_room import look_at
from warp_ar import __main__, calibrate, doctor
from warp_ar.scene import Camera, Pose

pytestmark = pytest.mark.slow

CAMERA = Camera(640, 480, 600.0, 600.0, 321.0, 238.0)


def encode(linear):
    return np.clip(linear, 0, 1) ** (1 / 2.2)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a new desk, and pictures of its card from one side, under one light."""
    folder = tmp_path_factory.mktemp("desk")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert __main__.main(["init", "my_desk", "--radius", "0.03", "--source", "pictures"]) == 0
    (folder / "pictures").mkdir()
    card = PrintedCard(np.random.default_rng(0))
    for k in range(5):
        # Moved across the picture, never tilted: focal length and distance cannot be told apart.
        place = np.array([0.06 * k - 0.12, 0.04 * (k % 2), 0.0])
        pose = Pose(*look_at(place + np.array([0.0, -0.01, 1.0]), place))
        imageio.v3.imwrite(folder / "pictures" / f"{k}.png", card.photograph(CAMERA, pose, 0.8, encode))
    return folder


@pytest.fixture
def desk(made, tmp_path, monkeypatch):
    """A copy of it to work in."""
    monkeypatch.chdir(tmp_path)
    return shutil.copytree(made, tmp_path, dirs_exist_ok=True)


def keep_pictures(desk, count):
    """Looking for a ball takes a second a picture."""
    for path in sorted((desk / "pictures").iterdir())[count:]:
        path.unlink()


def test_pictures_that_tell_too_little_are_not_written(desk, capsys, monkeypatch):
    monkeypatch.setattr(calibrate, "MOST_DEVIATION", 0.05)  # five pictures under one lamp tell 0.1
    before = (desk / "my_desk" / "scene.toml").read_text()
    for kind, said in (("camera", "the card was tilted by"), ("response", "the curve is known only to")):
        assert calibrate.main([kind, "pictures", "--write", "my_desk"]) == 1
        assert said in (told := capsys.readouterr().err)
        assert "nothing is written" in told
    assert (desk / "my_desk" / "scene.toml").read_text() == before
    assert not (desk / "my_desk" / "camera.yml").exists()
    assert not (desk / "my_desk" / "response.txt").exists()


def test_a_ball_that_is_not_there_is_not_written(desk, capsys):
    keep_pictures(desk, 2)
    before = (desk / "my_desk" / "scene.toml").read_text()
    assert calibrate.main(["ball", "my_desk", "--write"]) != 0
    told = capsys.readouterr().err
    assert "the camera is guessed" in told
    assert "no mirror ball is seen" in told or "too wide to be used" in told or "shows no reflections" in told
    assert (desk / "my_desk" / "scene.toml").read_text() == before


def test_all_commands_are_listed(capsys):
    assert __main__.main([]) == 0
    said = capsys.readouterr().out
    assert "python -m warp_ar.init my_desk" in said
    from docs.tables import COMMANDS

    assert {name.removesuffix(".cli") for name in COMMANDS} == set(__main__.COMMANDS)


def test_remedies_name_the_scene(desk, capsys):
    keep_pictures(desk, 2)
    assert doctor.main(["my_desk"]) == 1
    said = capsys.readouterr().out
    assert "do: python -m warp_ar.calibrate camera PICTURES --write my_desk" in said
    assert "SCENE" not in said
    assert "FLIP is the mean visible difference" in said
