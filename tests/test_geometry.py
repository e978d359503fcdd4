"""Meshes: primitives against closed forms, files of each format, and damaged ones."""

from __future__ import annotations

import math
import pathlib
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from warp_ar.errors import SceneError
from warp_ar.scene.geometry import Mesh, rotation_matrix, smooth_normals
from warp_ar.scene.mesh_files import load_mesh
from warp_ar.scene.shapes import box_mesh, silhouette_tolerance, sphere_mesh, torus_mesh
from warp_ar.scene.textures import load_texture

# A few float64 roundings of numbers up to one.
ROUNDING = 1e-14
# One float32 rounding of numbers up to one, and of their products.
SINGLE = 3e-7
# The mesh's own volume lies inside the smooth one's by about the tolerance over the radius; 0.4 % at desk sizes.
TESSELLATION = 0.004

TETRAHEDRON = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
TETRAHEDRON_FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


# --- Rotations --------------------------------------------------------------------------------------------------------


@given(st.tuples(*[st.floats(-720, 720)] * 3))
def test_rotation_is_scipys_extrinsic_xyz(rotate: tuple[float, float, float]) -> None:
    expected = Rotation.from_euler("xyz", rotate, degrees=True).as_matrix()  # small letters: fixed axes
    np.testing.assert_allclose(rotation_matrix(rotate), expected, atol=ROUNDING)


# --- Primitives -------------------------------------------------------------------------------------------------------


def edges_that_do_not_close(mesh: Mesh) -> int:
    """Directed edges, by position to the last bit, without their opposite: 0 for a closed surface wound one way."""
    _, place = np.unique(mesh.vertices + np.float32(0.0), axis=0, return_inverse=True)
    corners = place.ravel()[mesh.faces]
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    forward = {(int(a), int(b)) for a, b in edges}
    return len(edges) - len(forward) + sum((b, a) not in forward for a, b in forward)


def signed_volume(mesh: Mesh) -> float:
    """Positive where faces are counter-clockwise seen from outside."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return float(np.sum(a * np.cross(b, c)) / 6.0)


def areas(mesh: Mesh) -> Any:
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


PRIMITIVES = {
    "torus": (torus_mesh(0.045, 0.018), 2 * math.pi**2 * 0.045 * 0.018**2),
    "thin torus": (torus_mesh(0.1, 0.001, tolerance=2e-6), 2 * math.pi**2 * 0.1 * 0.001**2),
    "sphere": (sphere_mesh(0.03), 4 / 3 * math.pi * 0.03**3),
    "box": (box_mesh((0.1, 0.2, 0.3)), 0.006),
}


@pytest.mark.parametrize("name", PRIMITIVES)
def test_primitives_are_closed_and_wound_outward(name: str) -> None:
    mesh, volume = PRIMITIVES[name]
    assert edges_that_do_not_close(mesh) == 0
    assert signed_volume(mesh) == pytest.approx(volume, rel=TESSELLATION)
    assert areas(mesh).min() > 0.0
    assert (mesh.vertices.dtype, mesh.faces.dtype, mesh.normals.dtype) == (np.float32, np.int32, np.float32)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=SINGLE)
    assert mesh.uvs is not None
    assert mesh.uvs.shape == (len(mesh.vertices), 2)
    assert mesh.uvs.min() == 0.0
    assert mesh.uvs.max() == 1.0


def test_torus_lies_on_its_equation_with_exact_normals() -> None:
    mesh = torus_mesh(0.045, 0.018)
    x, y, z = mesh.vertices.T.astype(np.float64)
    ring = np.hypot(x, y)
    np.testing.assert_allclose(np.hypot(ring - 0.045, z), 0.018, atol=0.063 * SINGLE)
    gradient = np.stack([(ring - 0.045) * x / ring, (ring - 0.045) * y / ring, z], axis=-1) / 0.018
    np.testing.assert_allclose(mesh.normals, gradient, atol=1e-5)  # float32 positions, divided by the tube's radius


def test_sphere_lies_on_its_equation_with_exact_normals() -> None:
    mesh = sphere_mesh(0.03)
    np.testing.assert_allclose(mesh.vertices, 0.03 * mesh.normals, atol=0.03 * SINGLE)
    np.testing.assert_array_equal(mesh.bounds[:, 2], np.float32([-0.03, 0.03]))


@pytest.mark.parametrize(("major", "minor"), [(0.045, 0.018), (0.2, 0.1), (5.0, 0.5), (0.01, 0.001)])
def test_no_point_of_a_torus_triangle_is_further_inside_than_the_tolerance(major: float, minor: float) -> None:
    tolerance = silhouette_tolerance(major + minor)
    mesh = torus_mesh(major, minor)
    weights = np.random.default_rng(1).dirichlet((1, 1, 1), size=20)
    weights[0] = 1 / 3
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    for weight in [*weights, (0.5, 0.5, 0.0), (0.0, 0.5, 0.5), (0.5, 0.0, 0.5)]:
        x, y, z = np.einsum("k,nkd->dn", weight, corners)
        gap = np.abs(np.hypot(np.hypot(x, y) - major, z) - minor)
        assert gap.max() <= tolerance


def test_box_faces_are_flat_and_carry_upright_textures() -> None:
    mesh = box_mesh((0.2, 0.4, 0.6))
    np.testing.assert_allclose(mesh.bounds, [[-0.1, -0.2, -0.3], [0.1, 0.2, 0.3]], atol=SINGLE)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    flat = np.cross(b - a, c - a)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    for k in range(3):
        np.testing.assert_allclose(mesh.normals[mesh.faces[:, k]], flat, atol=SINGLE)
    assert mesh.uvs is not None
    for face in mesh.faces:  # mirrored textures would have negative area
        p, q, r = mesh.uvs[face]
        assert np.cross([*(q - p), 0], [*(r - p), 0])[2] > 0


# --- Vertex normals ---------------------------------------------------------------------------------------------------


def test_normals_of_a_cube_point_along_its_diagonals() -> None:
    """Weights by angle: the diagonals of the faces, which weights by area or count would show, leave no trace."""
    cube = trimesh.creation.box()
    normals = smooth_normals(cube.vertices, cube.faces)
    np.testing.assert_allclose(normals, np.sign(cube.vertices) / math.sqrt(3), atol=SINGLE)


def test_vertices_at_one_position_share_a_normal() -> None:
    vertices = np.concatenate([TETRAHEDRON, TETRAHEDRON, -0.0 * TETRAHEDRON[:1]])
    faces = TETRAHEDRON_FACES.copy()
    faces[2:] += 4
    together = smooth_normals(TETRAHEDRON, TETRAHEDRON_FACES)
    apart = smooth_normals(vertices, faces)
    np.testing.assert_allclose(apart[:4], together, atol=SINGLE)
    np.testing.assert_allclose(apart[4:8], together, atol=SINGLE)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_degenerate_triangles_have_no_say(scale: float) -> None:
    faces = np.array([*TETRAHEDRON_FACES, [0, 0, 1], [2, 2, 2], [0, 1, 4], [1, 4, 5]])
    vertices = scale * np.array([*TETRAHEDRON, [0.3, 0, 0], [0.7, 0, 0], [9, 9, 9]])  # 4 and 5 on an edge, 6 in no face
    normals = smooth_normals(vertices, faces)
    np.testing.assert_allclose(normals[:4], smooth_normals(TETRAHEDRON, TETRAHEDRON_FACES), atol=SINGLE)
    np.testing.assert_array_equal(normals[4:], [[0, 0, 1]] * 3)


@settings(deadline=None)
@given(st.data())
def test_normals_are_always_unit(data: st.DataObject) -> None:
    count = data.draw(st.integers(1, 12))
    numbers = st.floats(-1e9, 1e9, width=32) | st.sampled_from([0.0, -0.0, 1.0, 1e-30, 1e9])
    vertices = np.array(data.draw(st.lists(st.tuples(numbers, numbers, numbers), min_size=count, max_size=count)))
    index = st.integers(0, count - 1)
    faces = np.array(data.draw(st.lists(st.tuples(index, index, index), min_size=1, max_size=20)))
    normals = smooth_normals(vertices, faces)
    np.testing.assert_allclose(np.linalg.norm(normals.astype(np.float64), axis=1), 1.0, atol=SINGLE)


# --- Files ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb", ".stl", ".off"])
def test_every_format(tmp_path: pathlib.Path, suffix: str) -> None:
    path = tmp_path / f"tetrahedron{suffix}"
    trimesh.Trimesh(TETRAHEDRON, TETRAHEDRON_FACES, process=False).export(path)
    mesh = load_mesh(path)
    assert signed_volume(mesh) == pytest.approx(1 / 6, rel=1e-5)
    assert edges_that_do_not_close(mesh) == 0
    if suffix == ".ply":
        expected = smooth_normals(mesh.vertices, mesh.faces)
    else:  # its edges turn by more than the crease, and glTF's normals are flat where there are none
        a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
        flat = np.cross(b - a, c - a)
        expected = np.zeros_like(mesh.vertices)
        expected[mesh.faces] = (flat / np.linalg.norm(flat, axis=1, keepdims=True))[:, None]
    np.testing.assert_allclose(mesh.normals, expected, atol=1e-3 if suffix == ".obj" else SINGLE)


def test_normals_of_the_file_are_kept_and_made_unit(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "leaning.obj"
    path.write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 3 0 4\nvn 0 0 0\nvn 0 2 0\nf 1//1 2//2 3//3\n"  # the second one has no length
    )
    np.testing.assert_allclose(load_mesh(path).normals, [[0.6, 0, 0.8], [0, 0, 1], [0, 1, 0]], atol=SINGLE)


OBJ = "mtllib a.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"


def test_obj_finds_its_texture_or_says_which_is_missing(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text(OBJ)
    mesh = load_mesh(path)  # coordinates but no material: nothing is made up
    assert not mesh.images
    assert mesh.uvs is not None
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd wood.png\n")
    with pytest.raises(SceneError, match=r"/wood\.png, which it names, is not there"):
        load_mesh(path)
    (tmp_path / "wood.png").write_bytes(b"hello")
    with pytest.raises(SceneError, match=r"wood\.png, which it names, cannot be decoded"):
        load_mesh(path)
    Image.new("RGB", (2, 3), (1, 2, 3)).save(tmp_path / "wood.png")
    np.testing.assert_array_equal(load_mesh(path).images[0], np.full((3, 2, 4), (1, 2, 3, 255)))
    (tmp_path / "wood.png").write_bytes((tmp_path / "wood.png").read_bytes()[:45])
    with pytest.raises(SceneError):
        load_mesh(path)


def test_textures_come_as_rgb(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "texture.png"
    cv2.imwrite(str(path), np.array([[[0, 0, 255, 128], [255, 0, 0, 128]]], dtype=np.uint8))  # BGRA
    np.testing.assert_array_equal(load_texture(path), [[[255, 0, 0], [0, 0, 255]]])
    cv2.imwrite(str(path), np.array([[65535, 0]], dtype=np.uint16))
    np.testing.assert_array_equal(load_texture(path), [[[255, 255, 255], [0, 0, 0]]])


# --- Damage -----------------------------------------------------------------------------------------------------------

PLY = (
    "ply\nformat ascii 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
    "element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("model.fbx", "", r"unknown mesh format '\.fbx'; use one of \.ply, \.obj"),
        ("points.ply", PLY.format(vertices=1, faces=0) + "0 0 0\n", r"holds no triangle"),
        (
            "range.ply",
            PLY.format(vertices=3, faces=1) + "0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n",
            r"vertex index 7; there are 3",
        ),
        ("huge.obj", "v 0 0 0\nv 1e39 0 0\nv 0 1 0\nf 1 2 3\n", r"vertex 1 is .*must be finite"),
    ],
)
def test_damaged_files(tmp_path: pathlib.Path, name: str, content: str, message: str) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(SceneError, match=message) as caught:
        load_mesh(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert len(str(caught.value).splitlines()) == 1
