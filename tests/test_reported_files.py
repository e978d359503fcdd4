"""Small files that users of other tools met, each with the value that is right: one test or more for every one."""

from __future__ import annotations

import json
import pathlib
import struct

import numpy as np
import pytest
from PIL import Image

from warp_ar import environment
from warp_ar.light.captured import Light
from warp_ar.light.latlong_axes import from_axes
from warp_ar.output.environment_file import read_environment
from warp_ar.scene.exif import camera_by_exif
from warp_ar.scene.geometry import Mesh
from warp_ar.scene.mesh_files import load_mesh
from warp_ar.scene.textures import decode_rgba


@pytest.fixture
def cases(shared: pathlib.Path) -> pathlib.Path:
    folder = shared / "cases"
    if not folder.is_dir():
        pytest.skip("needs ../shared/cases")
    return folder


def test_environment_exr_nan_window(cases: pathlib.Path, tmp_path: pathlib.Path) -> None:
    folder, out = cases / "environment_exr_nan_window", tmp_path / "x.json"
    assert environment.main([str(folder / "nan.exr"), "--output", str(out)]) == 0
    json.loads(out.read_text(), parse_constant=lambda word: pytest.fail(word))
    cropped = read_environment(folder / "cropped_window.exr")
    assert cropped.shape == (8, 16, 3)
    assert not cropped[[0, 1, 6, 7]].any()
    assert cropped[2:6].any()


def test_light_exr_axes(cases: pathlib.Path) -> None:
    path = cases / "light_exr_axes" / "envmap_latlong.exr"
    np.testing.assert_array_equal(Light.load(path).radiance, from_axes(Light.load(path, "z-up").radiance, "y-up"))


def test_light_exr_chromaticities(cases: pathlib.Path) -> None:
    found = Light.load(cases / "light_exr_chromaticities" / "own_acescg.exr").radiance
    # The file's AP1 has five digits.
    np.testing.assert_allclose(found.reshape(-1, 3).max(0), (1.0, 0.0, 0.0), atol=2e-4)


def areas(mesh: Mesh) -> np.ndarray:
    """Signed areas of the triangles of a mesh in the x, y plane."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    return np.cross(b - a, c - a)[:, 2] / 2


def test_vertex_colours_beside_a_material(cases: pathlib.Path) -> None:
    mesh = load_mesh(cases / "mesh_colours_lost" / "vcm2.obj")
    np.testing.assert_allclose(mesh.colors[:, :3], [(0.21404, 0.0, 1.0)] * 3, atol=1e-5)
    assert mesh.materials[0].surface.base_color == (1.0, 1.0, 1.0)


def test_an_stl_in_capitals_and_a_ply_with_lists_of_texture_coordinates(cases: pathlib.Path) -> None:
    assert areas(load_mesh(cases / "mesh_colours_lost" / "upper.stl")) == pytest.approx([0.5])
    mesh = load_mesh(cases / "mesh_colours_lost" / "wedge_quad.ply")
    assert areas(mesh) == pytest.approx([0.5, 0.5, 0.5])
    assert mesh.materials[0].base is not None
    corners = {(*mesh.vertices[v, :2].tolist(), *mesh.uvs[v].tolist()) for v in mesh.faces.ravel()}
    assert {(0, 0, 0, 0), (1, 0, 1, 0), (1, 1, 1, 1), (0, 1, 0, 1), (1, 0, 0, 0), (2, 0, 1, 0), (1, 1, 0, 1)} == corners


@pytest.mark.parametrize("depth", [1, 2, 4, 8, 16])
def test_a_transparent_grey_of_a_png(depth: int) -> None:
    import io
    import zlib

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    white = (1 << depth) - 1
    rows = [
        int(f"{0:0{depth}b}{white:0{depth}b}".ljust(-(-2 * depth // 8) * 8, "0"), 2).to_bytes(-(-2 * depth // 8), "big")
    ]
    header = struct.pack(">IIBBBBB", 2, 1, depth, 0, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"tRNS", struct.pack(">H", white))
    data += chunk(b"IDAT", zlib.compress(b"\0" + rows[0])) + chunk(b"IEND", b"")
    found = decode_rgba(data, "a.png")
    assert found.tolist() == [[[0, 0, 0, 255], [255, 255, 255, 0]]]
    if depth == 8:
        assert found.tolist() == np.asarray(Image.open(io.BytesIO(data)).convert("RGBA")).tolist()


def test_focal_length_of_tags_that_contradict_each_other(cases: pathlib.Path) -> None:
    assert camera_by_exif(cases / "exif_focal_length" / "resized_tags_rewritten.jpg").fx == pytest.approx(
        2553, rel=0.01
    )
