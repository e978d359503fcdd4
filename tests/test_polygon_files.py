"""Polygons of OBJ, PLY and OFF: areas and winding kept, and all that a file declares of colours arrives."""

from __future__ import annotations

import pathlib
import struct

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st
from PIL import Image

from warp_ar.scene.geometry import Mesh, rotation_matrix
from warp_ar.scene.materials import LambertMaterial, MeshMaterial
from warp_ar.scene.mesh_files import load_mesh
from warp_ar.scene.polygon_files import clip_ears

SINGLE = 2e-5
"""Rounding of areas of a few square metres in single precision."""


def srgb(value: np.ndarray) -> np.ndarray:
    value = np.asarray(value, float)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def star(radii: list[float]) -> np.ndarray:
    """A polygon around the origin with corners at these distances: concave wherever one is much nearer."""
    angle = np.arange(len(radii)) * 2 * np.pi / len(radii)
    return np.stack([radii * np.cos(angle), radii * np.sin(angle), 0 * angle], 1)


def area(points: np.ndarray) -> np.ndarray:
    """Vector area of a polygon."""
    return np.cross(points, np.roll(points, -1, 0)).sum(0) / 2


def normals(mesh: Mesh) -> np.ndarray:
    """Vector areas of triangles."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    return np.cross(b - a, c - a) / 2


def polygon_text(kind: str, points: np.ndarray) -> str:
    rows = "\n".join(" ".join(repr(float(x)) for x in row) for row in points)
    count, index = len(points), " ".join(map(str, range(len(points))))
    if kind == ".off":
        return f"OFF\n{count} 1 0\n{rows}\n{count} {index}\n"
    if kind == ".ply":
        head = "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\n"
        return head.format(count) + (
            f"element face 1\nproperty list uchar int vertex_index\nend_header\n{rows}\n{count} {index}\n"
        )
    lines = "".join(f"v {row}\n" for row in rows.split("\n"))
    return f"{lines}f {' '.join(str(-count + k) for k in range(count))}\n"


@pytest.mark.parametrize("kind", [".obj", ".ply", ".off"])
@hypothesis.settings(max_examples=25, deadline=None)
@hypothesis.given(
    st.lists(st.floats(0.2, 2.0), min_size=3, max_size=16),
    st.tuples(*[st.floats(-180.0, 180.0)] * 3),
    st.booleans(),
)
def test_area_and_winding_are_kept(
    tmp_path_factory: pytest.TempPathFactory, kind: str, radii: list[float], turn: tuple, backwards: bool
) -> None:
    points = star(radii) @ rotation_matrix(turn).T
    points = points[::-1] if backwards else points
    path = tmp_path_factory.mktemp("a") / f"a{kind}"
    path.write_text(polygon_text(kind, points))
    found, whole = normals(load_mesh(path)), area(points)
    along = found @ (whole / np.linalg.norm(whole))
    assert len(found) == len(points) - 2
    np.testing.assert_allclose(found.sum(0), whole, atol=SINGLE)
    assert along.sum() == pytest.approx(np.abs(along).sum(), abs=SINGLE)


def test_a_polygon_that_crosses_itself_ends() -> None:
    bow = np.array([(0, 0, 0), (1, 1, 0), (1, 0, 0), (0, 1, 0), (0.5, 2, 0), (0.2, -1, 0)], float)
    assert clip_ears(bow).shape == (4, 3)
    assert clip_ears(np.zeros((7, 3))).shape == (5, 3)


def ply(kind: str, vertices: list, faces: list, declared: str, of_faces: str, codes: tuple = ("", "")) -> bytes:
    """Return a PLY; ``codes``: of what stands behind places and behind indices, in binary."""
    head = f"ply\nformat {kind} 1.0\nelement vertex {len(vertices)}\nproperty float x\n"
    head += (
        "property float y\nproperty float z\n"
        + declared
        + f"element face {len(faces)}\nproperty list uchar int vertex_indices\n{of_faces}end_header\n"
    )
    if kind == "ascii":
        rows = [*vertices, *([len(index), *index, *more] for index, more in faces)]
        return (head + "\n".join(" ".join(map(str, row)) for row in rows) + "\n").encode()
    order = "<" if "little" in kind else ">"
    body = b"".join(struct.pack(order + "3f" + codes[0], *row) for row in vertices)
    for index, more in faces:
        body += struct.pack(f"{order}B{len(index)}i{codes[1]}", len(index), *index, *more)
    return head.encode() + body


SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize(("type_", "code", "white"), [("uchar", "B", 255), ("ushort", "H", 65535), ("float", "f", 1)])
@pytest.mark.parametrize(
    "names",
    [
        "red green blue",
        "diffuse_red diffuse_green diffuse_blue",
        "Red Green Blue",
        "r g b",
        "color_r color_g color_b",
        "ambient_red ambient_green ambient_blue",
    ],
)
@pytest.mark.parametrize("polygons", [[(0, 1, 2, 3)], [(0, 1, 2), (0, 2, 3)], [(0, 1, 2, 3), (1, 2, 0)]])
def test_colours_of_vertices_and_faces_of_a_ply(
    tmp_path: pathlib.Path, kind: str, type_: str, code: str, white: int, names: str, polygons: list
) -> None:
    said = [round(share * white, 6) if white == 1 else int(share * white) for share in (1.0, 0.4, 0.2)]
    linear = srgb(np.array(said) / white)
    declared = "".join(f"property {type_} {name}\n" for name in names.split())
    path = tmp_path / "a.ply"
    bare = [(index, ()) for index in polygons]
    path.write_bytes(ply(kind, [(*p, *said) for p in SQUARE], bare, declared, "", (3 * code, "")))
    np.testing.assert_allclose(load_mesh(path).colors[:, :3], [linear] * 4, atol=1e-6)
    path.write_bytes(ply(kind, SQUARE, [(index, said) for index in polygons], "", declared, ("", 3 * code)))
    colors = load_mesh(path).colors
    np.testing.assert_allclose(colors[:, :3], [linear] * len(colors), atol=1e-6)


@hypothesis.settings(max_examples=25, deadline=None)
@hypothesis.given(st.lists(st.lists(st.integers(3, 9), min_size=1, max_size=3), min_size=1, max_size=3), st.booleans())
def test_strips_of_a_ply_are_wound_alike(
    tmp_path_factory: pytest.TempPathFactory, rows: list[list[int]], backwards: bool
) -> None:
    """Strips in rows, several of them in a row, -1 between them; each is a ribbon of its own that faces +z."""
    points, lines = [], []
    for row in rows:
        strips = []
        for count in row:
            start, level = len(points), 2 * len(strips) + 10 * len(lines)
            corners = [(k // 2, level + k % 2, 0) for k in range(count)]
            points += corners
            strips.append([start + k for k in range(count)])
        lines.append([index for strip in strips for index in (*strip, -1)][: -1 if backwards else None])
    side = 1 if backwards else -1
    points = [(side * x, y, z) for x, y, z in points]
    path = tmp_path_factory.mktemp("s") / "a.ply"
    data = ply("ascii", points, [(line, ()) for line in lines], "", "").replace(b"element face", b"element tristrips")
    none = b"element face 0\nproperty list uchar int vertex_indices\nproperty uchar red\n"
    none += b"property uchar green\nproperty uchar blue\nelement tristrips"
    path.write_bytes(data.replace(b"element tristrips", none))
    found = normals(load_mesh(path))
    assert len(found) == sum(count - 2 for row in rows for count in row)
    np.testing.assert_allclose(found[:, 2], -side / 2)


@pytest.mark.parametrize("suffix", [".ply", ".off"])
@pytest.mark.parametrize("of_faces", [False, True])
@pytest.mark.parametrize(
    ("alphas", "shown"),
    [((255, 255), "opaque"), ((255, 51), "blend"), ((0, 0), "opaque"), ((0, 255), "blend"), ((1, 1), "opaque")],
)
def test_alpha_of_colours_is_shown(
    tmp_path: pathlib.Path, suffix: str, of_faces: bool, alphas: tuple, shown: str
) -> None:
    faces = [(0, 1, 2), (0, 2, 3)]
    own = [(255, 128, 0, alphas[k // 2]) for k in range(4)]
    path = tmp_path / f"a{suffix}"
    if suffix == ".ply":
        declared = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue", "alpha"))
        vertices = [(*p, *(() if of_faces else own[k])) for k, p in enumerate(SQUARE)]
        polygons = [(index, own[2 * k] if of_faces else ()) for k, index in enumerate(faces)]
        path.write_bytes(ply("ascii", vertices, polygons, "" if of_faces else declared, declared if of_faces else ""))
    else:
        rows = [(*p, *(() if of_faces else own[k])) for k, p in enumerate(SQUARE)]
        rows += [(3, *index, *(own[2 * k] if of_faces else ())) for k, index in enumerate(faces)]
        head = "OFF" if of_faces else "COFF"
        path.write_text("\n".join([head, "4 2 0", *(" ".join(map(str, row)) for row in rows)]))
    mesh = load_mesh(path)
    assert [material.alpha for material in mesh.materials or (MeshMaterial(),)] == [shown]
    told = {1.0} if shown == "opaque" else {alpha / 255 for alpha in alphas}
    np.testing.assert_allclose(sorted(set(mesh.colors[:, 3])), sorted(told), atol=1e-6)
    assert mesh.notes == (("alpha of colours, which is 0 everywhere",) if alphas == (0, 0) else ())


def test_each_face_of_a_ply_has_the_texture_of_its_number(tmp_path: pathlib.Path) -> None:
    for name, color in (("a", (255, 0, 0)), ("b", (0, 255, 0))):
        Image.new("RGB", (2, 2), color).save(tmp_path / f"{name}.png")
    said = "property list uchar float texcoord\nproperty int texnumber\n"
    faces = [((0, 1, 2), (6, 0, 0, 1, 0, 1, 1, 1)), ((0, 2, 3), (6, 0, 0, 1, 1, 0, 1, 0))]
    data = ply("ascii", SQUARE, faces, "", said)
    named = data.replace(b"element vertex", b"comment TextureFile a.png\ncomment TextureFile b.png\nelement vertex")
    (tmp_path / "a.ply").write_bytes(named)
    mesh = load_mesh(tmp_path / "a.ply")
    shown = {}
    for face, number in zip(mesh.faces, mesh.triangle_materials, strict=True):
        corners = frozenset(map(tuple, mesh.vertices[face, :2].astype(int).tolist()))
        shown[corners] = mesh.images[mesh.materials[number].base.image][0, 0, :3].tolist()
    assert shown == {
        frozenset({(0, 0), (1, 0), (1, 1)}): [0, 255, 0],
        frozenset({(0, 0), (1, 1), (0, 1)}): [255, 0, 0],
    }


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\n"


@pytest.mark.parametrize(
    "text",
    [
        "\ufeffmtllib a.mtl\n{}usemtl rot\u00e9\nf 1 2 3\n",
        "mtllib none.mtl a.mtl # both\n{}usemtl rot\u00e9 # comment\nf 1 2 3 # behind\n",
        "mtllib none.mtl\nmtllib a.mtl\n{}usemtl rot\u00e9\nf 1 2 \\\n 3\n",
        "mtllib .\\a.mtl\n{}usemtl rot\u00e9\nf -4 -3 -2\n",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_libraries_of_an_obj(tmp_path: pathlib.Path, text: str, encoding: str) -> None:
    if encoding == "latin-1" and text.startswith("\ufeff"):
        pytest.skip("a mark is UTF-8's")
    (tmp_path / "a.mtl").write_bytes("newmtl rot\u00e9\nKd 1 0 0 # red\nNs 3\n".encode(encoding))
    (tmp_path / "a.obj").write_bytes(text.format(TRIANGLE).encode(encoding))
    mesh = load_mesh(tmp_path / "a.obj")
    assert mesh.materials[0].surface.base_color == (1.0, 0.0, 0.0)
    assert len(mesh.faces) == 1
    assert [note for note in mesh.notes if "none.mtl" not in note] == []


def test_colours_of_an_obj_in_255_steps(tmp_path: pathlib.Path) -> None:
    rows = "".join(f"v {x} {y} 0 255 128 0\n" for x, y in ((0, 0), (1, 0), (0, 1)))
    (tmp_path / "a.obj").write_text(rows + "f 1 2 3\n")
    np.testing.assert_allclose(
        load_mesh(tmp_path / "a.obj").colors[:, :3], [srgb(np.array([1, 128 / 255, 0]))] * 3, atol=1e-6
    )


@pytest.mark.parametrize(
    ("head", "more", "face"),
    [
        ("OFF", "", "1.0 0.4 0.2"),
        ("OFF", "", "255 102 51 255"),
        ("COFF", "1.0 0.4 0.2 1.0", ""),
        ("COFF", "255 102 51", ""),
        ("CNOFF", "0 0 1 255 102 51 255", ""),
    ],
)
def test_colours_of_an_off(tmp_path: pathlib.Path, head: str, more: str, face: str) -> None:
    rows = "".join(f"{x} {y} {z} {more} # corner\n" for x, y, z in SQUARE)
    (tmp_path / "a.off").write_text(f"{head} 4 1 0\n{rows}4 0 1 2 3 {face}\n")
    np.testing.assert_allclose(load_mesh(tmp_path / "a.off").colors[:, :3] - srgb([1.0, 0.4, 0.2]), 0.0, atol=1e-6)


@pytest.mark.parametrize("kind", ["uchar", "ushort", "short", "int"])
@pytest.mark.parametrize("white", [255, 32767, 65535])
def test_colours_of_a_ply_by_the_white_of_their_type(tmp_path: pathlib.Path, kind: str, white: int) -> None:
    """Shorts of which none is above 255 are of 8 bits."""
    most = {"uchar": 255, "ushort": 65535, "short": 32767, "int": 65535}[kind]
    if (white > most) or (white, kind) in ((255, "ushort"), (32767, "ushort"), (32767, "int")):
        pytest.skip("no such values")
    colors = "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        f"{colors}element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        + "".join(f"{x} {y} 0 {white} 0 {white // 2}\n" for x, y in ((0, 0), (1, 0), (0, 1)))
        + "3 0 1 2\n"
    )
    found = load_mesh(tmp_path / "a.ply").colors
    np.testing.assert_allclose(found[:, :3], [(1.0, 0.0, 0.2122)] * 3, atol=2e-3)


@pytest.mark.parametrize("corners", [[3], [4], [3, 4, 5], [4, 3]])
def test_facets_of_an_stl_may_have_more_corners(tmp_path: pathlib.Path, corners: list[int]) -> None:
    """Each is a polygon of its own, wherever the one before ends; a byte-order mark may precede."""
    text = "solid a\n"
    for number, count in enumerate(corners):
        angles = 2 * np.pi * np.arange(count) / count
        lines = [f"vertex {np.cos(a):.9f} {np.sin(a):.9f} {number}" for a in angles]
        text += "facet normal 0 0 1\nouter loop\n" + "\n".join(lines) + "\nendloop\nendfacet\n"
    (tmp_path / "a.stl").write_text(text + "endsolid a\n", encoding="utf-8-sig")
    mesh = load_mesh(tmp_path / "a.stl")
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    areas = np.cross(b - a, c - a)[:, 2] / 2
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx(sum(n / 2 * np.sin(2 * np.pi / n) for n in corners), rel=1e-5)


def test_alpha_of_an_obj_and_a_lobe_without_width(tmp_path: pathlib.Path) -> None:
    """MeshLab writes Ks 1 and Ns 0 for all materials; that is no lobe which takes light from the diffuse colour."""
    (tmp_path / "a.mtl").write_text("newmtl a\nKd 0.75 0.5 0.25\nKs 1 1 1\nillum 2\nNs 0\nTf 1 1 1\nPc 0.0\n")
    corners = "v 0 0 0 1 0 0 0.5\nv 1 0 0 1 0 0 0.25\nv 0 1 0 1 0 0 1\n"
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{corners}usemtl a\nf 1 2 3\n")
    mesh = load_mesh(tmp_path / "a.obj")
    assert mesh.materials[0].surface == LambertMaterial((0.75, 0.5, 0.25))
    assert mesh.colors[:, 3].tolist() == [0.5, 0.25, 1.0]
    assert mesh.materials[0].alpha == "blend"
    assert mesh.notes == ()
