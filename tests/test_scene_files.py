"""Scenes from outside name no file but those that came with them, whatever key names it."""

from __future__ import annotations

import dataclasses
import pathlib
import typing

import pytest
import trimesh

from warp_ar.errors import SceneError
from warp_ar.scene import Scene, load_scene, loads_scene
from warp_ar.scene.scene_files import SceneFiles, files_of

HEAD = "schema = 1\n[camera]\nfield_of_view = 60\n"
MARKER = "[marker]\nsize = 0.1\n"
OBJECT = MARKER + '[[object]]\nshape = "sphere"\nradius = 0.1\nmaterial = {{ model = '
CASES = {
    ("Camera", "transfer"): 'transfer = "{}"',
    ("SourceSpec", "path"): '[source]\npath = "{}"',
    ("Proxy", "file"): MARKER + '[[proxy]]\nshape = "mesh"\nfile = "{}"',
    ("Object", "file"): MARKER + '[[object]]\nshape = "mesh"\nfile = "{}"',
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
    + MARKER
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
