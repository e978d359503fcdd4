"""Small files that users of other tools met, each with the value that is right."""

from __future__ import annotations

import pathlib
import struct

import numpy as np
import pytest
from PIL import Image

from warp_ar.scene.geometry import Mesh
from warp_ar.scene.mesh_files import load_mesh
from warp_ar.scene.textures import decode_rgba


@pytest.fixture
def cases(shared: pathlib.Path) -> pathlib.Path:
    folder = shared / "cases"
    if not folder.is_dir():
        pytest.skip("needs ../shared/cases")
    return folder


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
