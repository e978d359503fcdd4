"""The quick half of the checks: made anew where anything that it depends on differs, else taken from the last run."""

import dataclasses
import json
import os
from pathlib import Path

import imageio.v3
import numpy as np
import pytest

from warp_ar.checks import checkup, quick_check
from warp_ar.checks.finding import Finding
from warp_ar.scene import load_scene

FINDING = Finding("ball.dull", "the ball mirrors nothing", "wipe it")


@pytest.fixture
def looks(monkeypatch, tmp_path):
    """The looks that were taken, each of which finds ``FINDING``."""
    taken = []

    def look(scene, source, *, quick):
        assert quick
        taken.append((scene, source))
        return [FINDING]

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(checkup, "check_up", look)
    return taken


@pytest.fixture
def frames(tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    for index in range(2):
        imageio.v3.imwrite(folder / f"{index:04d}.png", np.full((4, 6, 3), 40 * index, np.uint8))
    return folder


def test_the_same_set_up_is_looked_at_once(looks, frames):
    scene = load_scene("desk")
    first = quick_check.quick_check(scene, frames, [])
    again = quick_check.quick_check(load_scene("desk"), str(frames), [])
    assert first == again == quick_check.QuickCheck((FINDING,), True)
    assert len(looks) == 1


def test_a_change_is_looked_at_anew(looks, frames, tmp_path, monkeypatch):
    scene, mesh = load_scene("desk"), tmp_path / "mesh.ply"
    mesh.write_bytes(b"one")
    code = tmp_path / "package" / "checks"
    code.mkdir(parents=True)
    (code / "check.py").write_text("pass")
    monkeypatch.setattr(quick_check, "_PACKAGE", code.parent)

    def count():
        quick_check.quick_check(scene, frames, [mesh])
        return len(looks)

    assert [count(), count()] == [1, 1]
    os.utime(frames / "0001.png", ns=(1, 1))  # written anew, of the same size
    assert [count(), count()] == [2, 2]
    (frames / "0002.png").write_bytes((frames / "0001.png").read_bytes())
    assert [count(), count()] == [3, 3]
    mesh.write_bytes(b"another")
    assert [count(), count()] == [4, 4]
    (code / "check.py").write_text("pass  # changed")
    assert [count(), count()] == [5, 5]
    (probe,) = scene.probes
    scene = dataclasses.replace(scene, probes=(dataclasses.replace(probe, radius=2 * probe.radius),))
    assert [count(), count()] == [6, 6]
    assert len(list((tmp_path / "cache" / "warp_ar" / "checks").iterdir())) == 1, "files are left of each change"


@pytest.mark.parametrize("content", [b"", b"[]", b'{"key": 1}', b"\xff\xfe"])
def test_what_is_kept_may_be_damaged(looks, frames, tmp_path, content):
    scene = load_scene("desk")
    quick_check.quick_check(scene, frames, [])
    (kept,) = (tmp_path / "cache" / "warp_ar" / "checks").iterdir()
    kept.write_bytes(content)
    assert quick_check.quick_check(scene, frames, []).findings == (FINDING,)
    assert len(looks) == 2
    assert json.loads(kept.read_text())["ball_seen"]


def test_frames_of_a_device_are_not_kept(looks, tmp_path):
    for _ in range(2):
        assert not quick_check.quick_check(load_scene("desk"), 0, []).ball_seen
    assert [source for _, source in looks] == [None, None]
    assert not Path(tmp_path / "cache").exists()


@pytest.mark.parametrize("name", ["source.empty", "marker.unseen", "units.ball", "ball.unfound", "ball.outside"])
def test_a_ball_is_seen_only_where_it_was_looked_for(monkeypatch, tmp_path, frames, name):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(checkup, "check_up", lambda *_, **__: [Finding(name, "", "")])
    assert not quick_check.quick_check(load_scene("desk"), frames, []).ball_seen
