"""Meshes that are kept between runs: the same values, anew when a file changes, never in the way."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from warp_ar.errors import SceneError
from warp_ar.scene import mesh_cache
from warp_ar.scene.mesh_cache import load_kept_mesh
from warp_ar.scene.mesh_files import load_mesh


@pytest.fixture(autouse=True)
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "warp_ar" / "meshes"


def write(path: Path, scale: float = 1.0) -> Path:
    ball = trimesh.creation.icosphere(subdivisions=1, radius=scale)
    if path.suffix == ".glb":  # with a material of every field
        picture = Image.new("RGBA", (2, 3), (1, 2, 3, 100))
        names = ("baseColor", "metallicRoughness", "normal", "occlusion", "emissive")
        material = trimesh.visual.material.PBRMaterial(
            name="all", alphaMode="MASK", emissiveFactor=[0.5, 0, 0], **{f"{name}Texture": picture for name in names}
        )
        uv = np.abs(ball.vertices[:, :2])
        ball.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    ball.export(path)
    return path


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".glb"])
def test_a_kept_mesh_is_the_same(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str) -> None:
    path = write(tmp_path / f"ball{suffix}")
    expected = load_mesh(path)
    first = load_kept_mesh(path)
    assert len(list(cache.iterdir())) == 1
    monkeypatch.setattr(mesh_cache.mesh_files, "load_mesh", lambda path: pytest.fail("the file was read again"))
    for mesh in (first, load_kept_mesh(path)):
        for field in dataclasses.fields(expected):
            value, kept = getattr(expected, field.name), getattr(mesh, field.name)
            assert (value is None) == (kept is None)
            if field.name in ("materials", "notes"):
                assert kept == value
            elif field.name == "images":
                assert [image.tobytes() for image in kept] == [image.tobytes() for image in value]
            elif value is not None:
                assert kept.dtype == value.dtype
                np.testing.assert_array_equal(kept, value)


def test_another_file_of_the_name_is_read(tmp_path: Path) -> None:
    path = write(tmp_path / "ball.ply")
    small = load_kept_mesh(path)
    write(path, 2.0)
    np.testing.assert_allclose(load_kept_mesh(path).bounds, 2.0 * small.bounds, rtol=1e-6)


def test_a_damaged_cache_and_a_full_disk_are_no_errors(cache: Path, tmp_path: Path) -> None:
    path = write(tmp_path / "ball.ply")
    expected = load_kept_mesh(path).vertices
    (kept,) = cache.iterdir()
    kept.write_bytes(b"PK not an archive")
    np.testing.assert_array_equal(load_kept_mesh(path).vertices, expected)
    kept.unlink()
    cache.rmdir()
    cache.write_text("a file where the folder should be")
    np.testing.assert_array_equal(load_kept_mesh(path).vertices, expected)


def test_errors_are_those_of_reading(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="no such mesh file"):
        load_kept_mesh(tmp_path / "none.ply")
    (tmp_path / "bad.ply").write_text("nothing")
    with pytest.raises(SceneError, match=r"bad\.ply"):
        load_kept_mesh(tmp_path / "bad.ply")
