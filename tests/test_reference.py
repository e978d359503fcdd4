"""The reference of scene files: every key that the reader knows is listed, and every example is read."""

from __future__ import annotations

import dataclasses
import re
import tomllib

import numpy as np
import pytest

from warp_ar.errors import SceneError
from warp_ar.scene import loads_scene
from warp_ar.scene.description import SCHEMA
from warp_ar.scene.reference import SECTIONS, Key, as_markdown, keys

KEYS = list(keys())
INTRINSICS = "width = 640\nheight = 480\nfx = 640.0\nfy = 640.0\ncx = 319.5\ncy = 239.5"


@pytest.fixture
def folder(tmp_path):
    """The files that examples name."""
    (tmp_path / "frames").mkdir()
    triangle = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    triangle += "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    (tmp_path / "table.ply").write_text(triangle)
    matrix = "!!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n  data: [640, 0, 319.5, 0, 640, 239.5, 0, 0, 1]\n"
    calibration = f"%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: {matrix}"
    (tmp_path / "camera.yml").write_text(calibration)
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0.0 0.1 0.6 1 a.png\n")
    for name in ("light.exr", "picture.png", "watch.glb"):
        (tmp_path / name).write_bytes(b"read when it is needed")
    return tmp_path


def example_scene(key: Key) -> str:
    """A whole scene file in which ``key`` has its example's value."""
    lines = [f"schema = {SCHEMA}"]
    if not key.section:
        lines = [f"{key.name} = {key.example}"] + lines * (key.name != "schema")
    sections = {section.name: section for section in SECTIONS}
    if key.section != "camera":
        lines += ["[camera]", INTRINSICS]
    if key.section not in ("", "marker"):
        lines += ["[marker]", "size = 0.08"]
    if key.section == "object.play":
        lines += ["[[object]]", 'shape = "mesh"', 'file = "watch.glb"']
    elif key.section.startswith("object."):
        lines += ["[[object]]", 'shape = "sphere"', "radius = 0.03"]
    if key.section.startswith("proxy."):
        lines += ["[[proxy]]", 'shape = "plane"', "size = [1.6, 1.2]"]
    if key.section:
        lines += [f"[[{key.section}]]" if sections[key.section].several else f"[{key.section}]", key.beside]
        lines += [f"{key.name} = {key.example}"]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("key", KEYS, ids=lambda key: f"{key.section}.{key.name}")
def test_example_is_read(key, folder):
    text = example_scene(key)
    scene = loads_scene(text, folder / "scene.toml")
    value = tomllib.loads(f"v = {key.example}")["v"]
    value = tuple(value) if isinstance(value, list) else value
    part = scene
    if key.section == "pose":
        # Every way to give it becomes R and t.
        assert np.isfinite(scene.pose.at(0)[0]).all()
        return
    if key.section == "light" and key.name in ("file", "scale", "rotate", "axes"):
        assert str(getattr(scene.captured, key.name)).endswith(value if isinstance(value, str) else str(value))
        return
    if key.section == "light" and not scene.lights:
        # A light with an extent is an object that emits.
        item = scene.objects[0]
        found = getattr(item, key.name, None) or getattr(item.material, key.name)
        assert str(found).endswith(value) if isinstance(value, str) else found == value
        return
    for name in filter(None, key.section.split(".")):
        plural = {"probe": "probes", "proxy": "proxies", "object": "objects", "light": "lights"}.get(name, name)
        part = getattr(part, plural)
        part = part[0] if isinstance(part, tuple) else part
    found = getattr(part, key.name, None)
    if isinstance(value, str) and not isinstance(found, str):
        # A path is resolved, a board parsed, a model and a calibration become objects.
        assert found is None or str(found).endswith(value) or value in str(found)
    elif not isinstance(value, dict):
        assert found == value


def test_reader_knows_no_other_keys(folder):
    """The reader lists its keys in the message about an unknown one; all of them are in the reference."""
    for section in SECTIONS:
        key = next(key for key in KEYS if key.section == section.name)
        text = example_scene(
            dataclasses.replace(key, name="nonsense", beside=key.beside + f"\n{key.name} = {key.example}")
        )
        with pytest.raises(SceneError, match="unknown key"):
            loads_scene(text, folder / "scene.toml")
    fields = {
        (section.name, field.name)
        for section in SECTIONS
        for kind in section.kinds
        for field in dataclasses.fields(kind)
    }
    assert fields - {(key.section, key.name) for key in KEYS} == {("object", "mesh")}


@pytest.mark.parametrize("key", [key for key in KEYS if key.section], ids=lambda key: f"{key.section}.{key.name}")
def test_required_keys_are_required(key, folder):
    """Without it the reader complains exactly where the reference says "required"."""
    text = example_scene(key).replace(f"\n{key.name} = {key.example}\n", "\n")
    if key.default == "required" and key.section != "object.material":
        with pytest.raises(SceneError):
            loads_scene(text, folder / "scene.toml")


def test_page_has_a_row_for_every_key():
    page = as_markdown()
    assert len(re.findall(r"^- `", page, flags=re.M)) == len(KEYS)
    assert all(key.meaning and key.unit and key.default for key in KEYS)
