"""Key tables of scene files: every key that the reader knows is listed, and every example is read."""

from __future__ import annotations

import dataclasses
import tomllib

import pytest

from warp_ar.scene import loads_scene
from warp_ar.scene.description import SCHEMA
from warp_ar.scene.fields import Field, fields_of
from warp_ar.scene.key_tables import SECTIONS, Key, keys
from warp_ar.scene.materials import MATERIALS
from warp_ar.scene.scene_files import SceneFiles
from warp_ar.scene.sections import SceneTable, read_value

KEYS = list(keys())


@pytest.fixture
def folder(tmp_path):
    """The files that examples name."""
    triangle = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    triangle += "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    (tmp_path / "table.ply").write_text(triangle)
    matrix = "!!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n  data: [640, 0, 319.5, 0, 640, 239.5, 0, 0, 1]\n"
    calibration = f"%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: {matrix}"
    (tmp_path / "camera.yml").write_text(calibration)
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0.0 0.1 0.6 1 a.png\n")
    for name in ("light.exr", "picture.png", "watch.glb", "frames"):
        (tmp_path / name).write_bytes(b"read when it is needed")
    return tmp_path


def fields_of_key(key: Key) -> list[Field]:
    """The fields that a key of the reference stands for; none of what is no field of a dataclass."""
    kinds = next((section.kinds for section in SECTIONS if section.name == key.section), ())
    return [fields_of(kind)[key.name] for kind in kinds if key.name in fields_of(kind)]


@pytest.mark.parametrize(
    "key", [key for key in KEYS if fields_of_key(key)], ids=lambda key: f"{key.section}.{key.name}"
)
def test_example_is_read(key, folder):
    value = tomllib.loads(f"v = {key.example}")["v"]
    for field in fields_of_key(key):
        if field.form == "word" and value not in field.words:
            continue  # that of another kind of light
        table = SceneTable("scene", SceneFiles(folder), key.section, {key.name: value}, [key.name])
        found = read_value(table, field)
        if isinstance(value, str) and not isinstance(found, str):
            assert str(found).endswith(value)  # a path is resolved
        elif not isinstance(value, dict):
            assert found == (tuple(value) if isinstance(value, list) else value)
        if not field.key.required and field.default not in (None, dataclasses.MISSING):
            assert field.admit(field.default) == field.default


def test_keys_beside_the_fields_are_read(folder):
    text = "schema = 1\n[camera]\ncalibration = {}\n"
    examples = {(key.section, key.name): key.example for key in KEYS if not fields_of_key(key)}
    assert loads_scene(text.format(examples["camera", "calibration"]), folder / "scene.toml").camera.fx == 640.0
    assert tomllib.loads(f"v = {examples['object.material', 'model']}")["v"] in MATERIALS
    assert examples["", "schema"] == str(SCHEMA)


def test_reference_has_all_fields():
    fields = {
        (section.name, field.name)
        for section in SECTIONS
        for kind in section.kinds
        for field in dataclasses.fields(kind)
    }
    assert fields - {(key.section, key.name) for key in KEYS} == {("object", "mesh")}
