"""Files that are dropped onto the picture: they land on the desk, or are refused with a reason."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
import trimesh

from tests.test_pipeline import make_scene
from warp_ar.errors import UsageError, WarpArError
from warp_ar.light.captured import Light
from warp_ar.scene import dumps_scene, load_scene
from warp_ar.scene.mesh_files import load_mesh
from warp_ar.stages.quality import PRESETS
from warp_ar.viewer import dropped, edits
from warp_ar.viewer.dropped import DroppedFiles
from warp_ar.viewer.edits import Wanted


@pytest.fixture
def wanted():
    return Wanted(make_scene(), PRESETS["low"])


@pytest.fixture
def files(tmp_path):
    return DroppedFiles(tmp_path)


def box(*sides, kind="ply"):
    made = trimesh.creation.box(sides)
    made.apply_translation((3.0, -2.0, 5.0))
    data = made.export(file_type=kind)
    return data if isinstance(data, bytes) else data.encode()


@pytest.mark.parametrize(
    ("sides", "tall", "units"),
    [((0.1, 0.06, 0.2), 0.2, "metres"), ((100.0, 60.0, 200.0), 0.2, "millimetres"), ((9.0, 6.0, 3.0), 0.04, "own")],
)
def test_a_mesh_lands_on_the_desk_at_a_sensible_size(files, wanted, sides, tall, units):
    for kind in ("ply", "obj", "stl"):
        make, label, words = files.take(f"my box.{kind}", box(*sides, kind=kind), wanted)
        made = make(wanted).scene
        thing = made.objects[-1]
        low, high = np.asarray(load_mesh(thing.file).bounds) * thing.scale + thing.at
        assert low[2] == pytest.approx(0.0, abs=1e-4), "it floats, or is sunk"
        assert high[2] == pytest.approx(tall, abs=1e-3)
        assert (low + high)[:2] / 2 == pytest.approx(dropped.PLACE, abs=1e-3)
        assert label == f"drop my box.{kind}"
        assert units in words
        assert "12 triangles" in words
        assert edits.checked(made) == made
    assert edits.wanted_record(make(wanted))["objects"][-1]["file"].endswith("my_box.stl")


def test_gltf_stands_upright(files, wanted):
    """Its +Y is up: what is tall along y is tall on the desk."""
    data = trimesh.creation.box((0.05, 0.2, 0.05)).export(file_type="glb")
    make, _, _ = files.take("tower.glb", data, wanted)
    thing = make(wanted).scene.objects[-1]
    low, high = np.asarray(load_mesh(thing.file).bounds) * thing.scale
    assert high[2] - low[2] == pytest.approx(0.2, abs=1e-3)


def test_captured_light_stands_for_the_balls(files, wanted, tmp_path):
    light = Light(np.random.default_rng(0).random((8, 16, 3)).astype(np.float32), np.ones((8, 16), np.float32))
    light.save(tmp_path / "own.exr")
    make, label, words = files.take("own.exr", (tmp_path / "own.exr").read_bytes(), wanted)
    after = make(wanted)
    assert np.array_equal(Light.load(after.scene.captured.file).radiance, light.radiance)
    assert label == "light by own.exr"
    assert "16x8" in words
    assert edits.wanted_record(after)["captured"].endswith("own.exr")
    assert "/" not in edits.wanted_record(after)["captured"]
    # What was dropped is saved beside the scene, by its name alone.
    saved = dumps_scene(dataclasses.replace(edits.beside(after.scene, tmp_path), path=None))
    assert str(tmp_path) not in saved


def test_a_radiance_picture_is_light_seen_from_inside(files, wanted):
    picture = np.full((8, 16, 3), 0.25, np.float32)
    picture[:, 10] = 4.0  # right of the centre, which is +x: toward -y
    data = cv2.imencode(".hdr", picture)[1].tobytes()
    make, _, _ = files.take("sky.hdr", data, wanted)
    found = Light.load(make(wanted).scene.captured.file).radiance
    assert found[4].mean(-1).argmax() == 5


def test_a_scene_is_shown_and_names_no_file_of_this_machine(files, wanted):
    scene = load_scene("desk")
    text = dumps_scene(dataclasses.replace(make_scene(), name="dropped"))
    make, label, _ = files.take("other.toml", text.encode(), wanted)
    assert make(wanted).scene.name == "dropped"
    assert label == "open other.toml"
    # Its own files a scene may name again, others not.
    shown = Wanted(scene, PRESETS["low"])
    own = dumps_scene(dataclasses.replace(scene, path=None))
    assert files.take("desk.toml", own.encode(), shown)[0](shown).scene.objects == scene.objects
    for spoiled in (own.replace("teapot", "secret"), own.replace("meshes", "..")):
        with pytest.raises(UsageError, match="names the file"):
            files.take("desk.toml", spoiled.encode(), shown)
    with pytest.raises(UsageError, match="names the file"):
        files.take("desk.toml", own.encode(), wanted)


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("run.exe", b"MZ", "run.exe: expected a file that ends in .ply"),
        ("bad.ply", b"ply\nnonsense", "bad.ply"),
        ("bad.glb", b"glTF" + bytes(40), "bad.glb"),
        ("bad.exr", b"v/1\x01", "bad.exr"),
        ("bad.hdr", b"#?RADIANCE\n\n-Y 8 +X 16\n", "damaged"),
        ("bomb.hdr", b"#?RADIANCE\n\n-Y 999999 +X 999999\n", "pixels"),
        ("square.hdr", cv2.imencode(".hdr", np.ones((8, 8, 3), np.float32))[1].tobytes(), "twice as wide"),
        ("bad.toml", b"\xff", "bad.toml: not valid TOML"),
        ("../../etc/bad\x1b[31m.toml", b"schema = 9", r"bad__?31m.toml"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(files, wanted, tmp_path, name, data, said):
    with pytest.raises(WarpArError, match=said) as caught:
        files.take(name, data, wanted)
    message = str(caught.value)
    assert "\n" not in message
    assert "\x1b" not in message
    assert str(tmp_path) not in message, "where files are kept is nobody's business"
    assert list(tmp_path.glob("*.ply")) + list(tmp_path.glob("*.exr")) == []


def test_limits_are_said(files, wanted, monkeypatch):
    monkeypatch.setattr(dropped, "MOST_TRIANGLES", 11)
    with pytest.raises(UsageError, match="12 triangles; at most 11"):
        files.take("box.ply", box(0.1, 0.1, 0.1), wanted)
    monkeypatch.setattr(dropped, "MOST_BYTES", 50)
    with pytest.raises(UsageError, match="bytes; at most 50"):
        files.take("box.ply", box(0.1, 0.1, 0.1), wanted)
    monkeypatch.undo()
    monkeypatch.setattr(dropped, "MOST_FILES", 1)
    files.take("box.ply", box(0.1, 0.1, 0.1), wanted)
    with pytest.raises(UsageError, match="1 files were dropped already"):
        files.take("box.ply", box(0.1, 0.1, 0.1), wanted)
