"""Files that are dropped onto the picture: they land on the desk, or are refused with a reason."""

from __future__ import annotations

import dataclasses
import io
import json
import zipfile

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from tests.gltf_files import Gltf
from tests.test_pipeline import make_scene
from warp_ar.errors import SinkError, UsageError, WarpArError
from warp_ar.light.captured import Light
from warp_ar.scene import SourceSpec, dumps_scene, load_scene
from warp_ar.scene.mesh_files import load_mesh
from warp_ar.scene.scene_files import files_of
from warp_ar.stages.quality import PRESETS
from warp_ar.viewer import edits, uploads
from warp_ar.viewer.edits import Wanted
from warp_ar.viewer.uploads import DroppedFiles, pack_scene, unpack_scene

pytestmark = pytest.mark.slow


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
        item = made.objects[-1]
        low, high = np.asarray(load_mesh(item.file).bounds) * item.scale + item.at
        assert low[2] == pytest.approx(0.0, abs=1e-4), "it floats, or is sunk"
        assert high[2] == pytest.approx(tall, abs=1e-3)
        assert (low + high)[:2] / 2 == pytest.approx(uploads.PLACE, abs=1e-3)
        assert label == f"drop my box.{kind}"
        assert units in words
        assert "12 triangles" in words
        assert edits.checked(made) == made
    assert edits.wanted_record(make(wanted))["objects"][-1]["file"].endswith("my_box.stl")


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
    saved = dumps_scene(dataclasses.replace(edits.with_bare_names(after.scene, tmp_path), path=None))
    assert str(tmp_path) not in saved


def test_a_saved_scene_with_dropped_meshes_is_taken_again(files, wanted, tmp_path):
    """By the session that saved it; two meshes of one name stay two."""
    for size in (0.05, 0.08):
        make, _, _ = files.take("my box.glb", trimesh.creation.box((size,) * 3).export(file_type="glb"), wanted)
        wanted = make(wanted)
    saved = dumps_scene(dataclasses.replace(edits.with_bare_names(wanted.scene, tmp_path), path=None))
    make, _, _ = files.take("scene.toml", saved.encode(), wanted)
    again = make(wanted).scene.objects
    assert [item.file for item in again] == [item.file for item in wanted.scene.objects]
    assert len({item.file for item in again if item.file is not None}) == 2


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
        with pytest.raises(WarpArError, match="no file of this name came with the scene"):
            files.take("desk.toml", spoiled.encode(), shown)
    with pytest.raises(WarpArError, match="no file of this name came with the scene"):
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
    monkeypatch.setattr(uploads, "MOST_TRIANGLES", 11)
    with pytest.raises(UsageError, match="12 triangles; at most 11"):
        files.take("box.ply", box(0.1, 0.1, 0.1), wanted)
    monkeypatch.undo()
    monkeypatch.setattr(uploads, "MOST_FILES", 1)
    files.take("box.ply", box(0.1, 0.1, 0.1), wanted)
    with pytest.raises(UsageError, match="1 files were dropped already"):
        files.take("box.ply", box(0.1, 0.1, 0.1), wanted)


def textured(folder):
    """A glTF that names a buffer and, in a folder beside it, a texture with a space in its name."""
    made = trimesh.creation.box((0.1, 0.06, 0.2))
    coordinates = np.random.default_rng(0).random((len(made.vertices), 2))
    picture = Image.fromarray(np.full((4, 4, 3), (200, 30, 30), np.uint8))
    made.visual = trimesh.visual.TextureVisuals(coordinates, image=picture)
    for name, data in trimesh.Scene(made).export(file_type="gltf").items():
        (folder / name).write_bytes(data)
    text = json.loads((folder / "model.gltf").read_text())
    (folder / "my maps").mkdir()
    picture.save(folder / "my maps" / "red 1.png")
    text["images"] = [{"uri": "my%20maps/red%201.png"}]
    (folder / "model.gltf").write_text(json.dumps(text))
    return folder / "model.gltf"


@pytest.fixture
def bundle(files, wanted, tmp_path):
    """A scene with a dropped mesh, one that names other files, and captured light; and its ZIP."""
    for name, data in (("my box.ply", box(0.1, 0.06, 0.2)), ("tower.glb", box(0.05, 0.2, 0.05, kind="glb"))):
        wanted = files.take(name, data, wanted)[0](wanted)
    light = Light(np.random.default_rng(0).random((8, 16, 3)).astype(np.float32), np.ones((8, 16), np.float32))
    light.save(tmp_path / "own.exr")
    wanted = files.take("own.exr", (tmp_path / "own.exr").read_bytes(), wanted)[0](wanted)
    (tmp_path / "elsewhere").mkdir()
    item = dataclasses.replace(wanted.scene.objects[-1], file=textured(tmp_path / "elsewhere"))
    scene = dataclasses.replace(wanted.scene, objects=(*wanted.scene.objects, item), source=SourceSpec(tmp_path))
    return scene, pack_scene(scene)


def same(found, scene):
    assert [item.at for item in found.objects] == [item.at for item in scene.objects]
    for one, other in zip(found.objects, scene.objects, strict=True):
        if other.file is not None:
            assert np.array_equal(load_mesh(one.file).vertices, load_mesh(other.file).vertices)
    assert load_mesh(found.objects[-1].file).images, "the texture stayed behind"
    assert np.array_equal(Light.load(found.captured.file).radiance, Light.load(scene.captured.file).radiance)


def test_a_scene_is_saved_with_its_files_and_loads_elsewhere(bundle, tmp_path, tmp_path_factory):
    scene, data = bundle
    there = tmp_path_factory.mktemp("there")
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        file.extractall(there)
    found = load_scene(there)
    same(found, scene)
    assert all(path.is_relative_to(there) for path in files_of(dataclasses.replace(found, path=None)))
    assert str(tmp_path) not in (there / "scene.toml").read_text()
    assert found.source is None


def test_such_a_scene_is_dropped_onto_another_page(bundle, tmp_path_factory):
    scene, data = bundle
    own = tmp_path_factory.mktemp("own")
    shown = Wanted(make_scene(), PRESETS["low"])
    make, label, _ = DroppedFiles(own).take("desk.zip", data, shown)
    same(make(shown).scene, scene)
    assert label == "open desk.zip"
    # Saved from there it is the same again.
    assert len(pack_scene(make(shown).scene)) == pytest.approx(len(data), rel=0.02)


def naming(uri):
    """A GLB whose colour is a picture elsewhere."""
    made = Gltf()
    made.node(made.square(made.material(pbrMetallicRoughness={"baseColorTexture": {"index": 0}})))
    made.tree |= {"images": [{"uri": uri}], "textures": [{"source": 0}]}
    return made


@pytest.mark.parametrize("place", ["{0}/secret.png", "../secret.png", "../drop/../secret.png"])
def test_a_mesh_names_no_file_of_this_machine(wanted, tmp_path, place):
    """What is there is refused in the words for what is not, dropped alone or in a ZIP."""
    Image.fromarray(np.full((4, 4, 3), 77, np.uint8)).save(tmp_path / "secret.png")
    own = tmp_path / "drop"
    own.mkdir()
    files, path, uri = DroppedFiles(own), tmp_path / "made.glb", place.format(tmp_path)
    alone = naming(uri).save(path).read_bytes()
    absent = naming(uri.replace("secret", "nothing")).save(path).read_bytes()
    # In the ZIP it lies two folders deeper.
    inside = naming(uri if uri.startswith("/") else f"../../{uri}").save(path).read_bytes()
    zipped = packed(**{"scene.toml": SCENE_OF_ONE, "00__made.glb": inside})
    for name, data in (("made.glb", alone), ("made.glb", absent), ("a.zip", zipped)):
        with pytest.raises(UsageError, match="does not come with it") as caught:
            files.take(name, data, wanted)
        assert str(own) not in str(caught.value)
        assert list(own.iterdir()) == [], "what was refused was kept"
    # From the machine's own folders the same file is read.
    assert load_mesh(naming("secret.png").save(path)).images[0][0, 0, 0] == 77
    (tmp_path / "red.mtl").write_text("newmtl a\nKd 1 0 0\n")
    text = f"mtllib {tmp_path}/red.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    make, _, words = files.take("made.obj", text.encode(), wanted)
    assert "red.mtl, which is not there" in words
    assert load_mesh(make(wanted).scene.objects[-1].file).materials == ()


SCENE_OF_ONE = """schema = 1
[camera]
width = 64
height = 48
fx = 64.0
fy = 64.0
cx = 31.5
cy = 23.5
[marker]
size = 0.08
[[object]]
shape = "mesh"
file = "00/made.glb"
"""


def packed(**members):
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in members.items():
            file.writestr(name.replace("__", "/"), data)
    return made.getvalue()


def test_hidden_files_of_a_zip_are_left_out(tmp_path):
    scene, hidden = "schema = 1\n[camera]\nfield_of_view = 60\n", b"\0\5\x16\7"
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as file:
        for name in ("scene.toml", "__MACOSX/._scene.toml", ".DS_Store", "00/._a.ply"):
            file.writestr(name, scene if name == "scene.toml" else hidden)
    path = unpack_scene("desk.zip", made.getvalue(), tmp_path, 1 << 20)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("members", "said"),
    [
        ({"other.toml": "schema = 1"}, "holds no scene.toml"),
        ({"scene.toml": "schema = 1", "..__evil.ply": "x"}, "no file that a scene may name"),
        ({"scene.toml": "schema = 1", "run.sh": "x"}, "run.sh is no file"),
        ({"scene.toml": "schema = 1", "big.bin": bytes(1 << 27)}, "unpacks to 128 MB; at most 64 MB"),
        ({"scene.toml": 'schema = 1\n[camera]\nfield_of_view = 60\ntransfer = "id_rsa"'}, "no file of this name"),
        ({"scene.toml": 'schema = 1\n[camera]\nfield_of_view = 60\n[source]\npath = ".."'}, "no file of this name"),
        ({"scene.toml": "schema = 9"}, "desk.zip"),
    ],
)
def test_zips_of_others_are_refused(files, wanted, tmp_path, members, said):
    with pytest.raises(WarpArError, match=said) as caught:
        files.take("desk.zip", packed(**members), wanted)
    assert str(tmp_path) not in str(caught.value)
    assert list(tmp_path.iterdir()) == [], "what was refused was kept"


def raw_zip(*names):
    """A ZIP of a scene and of small members by any name."""
    return packed(**{"scene.toml": SCENE_OF_ONE}, **dict.fromkeys(names, b"x" * 50))


def corrupt():
    """A ZIP whose compressed bytes are no deflate stream; its directory is in order."""
    data = bytearray(packed(**{"scene.toml": SCENE_OF_ONE * 20}))
    data[len(b"scene.toml") + 30 : len(b"scene.toml") + 60] = b"\xff" * 30
    return bytes(data)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (corrupt(), "no ZIP that can be unpacked"),
        (raw_zip("a.bin", "a.bin__b.bin"), "no ZIP that can be unpacked"),
        (raw_zip("n" * 300 + ".bin"), "is no file that a scene may name"),
        (raw_zip("__".join(["folder"] * 700) + ".bin"), "is no file that a scene may name"),
        (raw_zip("__".join(["d"] * 2000) + ".bin"), "is no file that a scene may name"),
    ],
    ids=["deflate", "both", "name", "path", "levels"],
)
def test_zips_that_no_folder_can_hold_are_refused(files, wanted, tmp_path, data, said):
    with pytest.raises(UsageError, match=said):
        files.take("desk.zip", data, wanted)
    assert list(tmp_path.iterdir()) == [], "what was refused was kept"


@pytest.mark.parametrize(
    "error", [RuntimeError("broken"), MemoryError(), RecursionError(), OSError(28, "No space left")]
)
def test_nothing_is_kept_whatever_goes_wrong(files, wanted, tmp_path, monkeypatch, error):
    monkeypatch.setattr(uploads, "load_mesh", lambda path: (_ for _ in ()).throw(error))
    for _ in range(uploads.MOST_FILES + 1):
        with pytest.raises(SinkError if isinstance(error, OSError) else type(error)):
            files.take("box.ply", box(0.1, 0.1, 0.1), wanted)
        assert list(tmp_path.iterdir()) == []
    monkeypatch.undo()
    files.take("box.ply", box(0.1, 0.1, 0.1), wanted)


def test_all_files_together_have_a_limit(files, wanted, tmp_path, monkeypatch):
    data = box(0.1, 0.1, 0.1)
    monkeypatch.setattr(uploads, "MOST_KEPT_BYTES", 2 * len(data))
    for _ in range(2):
        files.take("box.ply", data, wanted)
    with pytest.raises(UsageError, match="MB would be kept"):
        files.take("box.ply", data, wanted)
    bomb = packed(**{"scene.toml": SCENE_OF_ONE.partition("[[object]]")[0], "big.bin": bytes(1 << 20)})
    monkeypatch.setattr(uploads, "MOST_KEPT_BYTES", 2 * len(data) + len(bomb))
    with pytest.raises(UsageError, match="would be kept"):
        files.take("bomb.zip", bomb, wanted)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["00", "01"]


def test_what_is_no_zip_is_refused(wanted, bundle, tmp_path_factory):
    _, data = bundle
    files = DroppedFiles(tmp_path_factory.mktemp("own"))
    for spoiled in (b"PK", b"", data[:300], data[:-400]):
        with pytest.raises(UsageError, match="no ZIP that can be unpacked"):
            files.take("desk.zip", spoiled, wanted)
