"""Objects placed by a 4x4 matrix."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh

from warp_ar.errors import SceneError
from warp_ar.scene import Object, object_at, object_from_trimesh
from warp_ar.scene.object_materials import mesh_of
from warp_ar.scene.ray_mesh import make_mesh, mesh_key

BALL = Object("sphere", radius=0.03)
WEDGE = object_from_trimesh(trimesh.creation.cylinder(radius=0.5, height=2.0, sections=7))
SHEAR = np.array([[1.0, 0.6, 0, 0], [0, 0.8, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
SINGLE = 1e-6


def placed(item: Object) -> np.ndarray:
    """Return the matrix by which the renderer places an object."""
    matrix = np.eye(4)
    rotation, matrix[:3, 3] = item.pose_at(0.0)
    matrix[:3, :3] = item.scale * rotation
    return matrix


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return rotation * np.sign(np.linalg.det(rotation))


def test_similarities_come_back() -> None:
    rng = np.random.default_rng(43)
    upright = [np.array([[0.0, 0.6, 0.8], [0.0, 0.8, -0.6], [-1.0, 0.0, 0.0]]), np.eye(3)]
    upright.append(upright[0] @ np.diag([-1.0, 1.0, -1.0]))
    for index in range(200):
        matrix = np.eye(4)
        matrix[:3, :3] = upright[index] if index < len(upright) else random_rotation(rng)
        matrix[:3, :3] *= np.exp(rng.uniform(-3.0, 3.0))
        matrix[:3, 3] = rng.normal(size=3)
        for item in (BALL, WEDGE):
            np.testing.assert_allclose(placed(object_at(item, matrix)), matrix, atol=SINGLE)


@pytest.mark.parametrize("mirrored", [1.0, -1.0])
def test_a_mesh_takes_any_affine_transform(mirrored: float) -> None:
    """Its vertices and normals go where the matrix sends them, and its triangles face outwards."""
    rng = np.random.default_rng(44)
    plain = mesh_of(WEDGE)
    for _ in range(50):
        matrix = np.eye(4)
        matrix[:3] = np.exp(rng.uniform(-5.0, 5.0)) * rng.normal(size=(3, 4))
        matrix[:3, :3] *= mirrored * np.sign(np.linalg.det(matrix[:3, :3]))
        item = object_at(WEDGE, matrix)
        mesh, own = mesh_of(item), placed(item)
        assert make_mesh(mesh_key(item)) is mesh
        size = np.abs(matrix[:3]).max()
        shown, expected = (m.vertices @ p[:3, :3].T + p[:3, 3] for m, p in ((mesh, own), (plain, matrix)))
        np.testing.assert_allclose(shown, expected, atol=4.0 * SINGLE * size)
        normals = plain.normals @ np.linalg.inv(matrix[:3, :3])
        turned = mesh.normals @ own[:3, :3].T
        cosines = (normals * turned).sum(axis=1) / np.linalg.norm(normals, axis=1) / np.linalg.norm(turned, axis=1)
        assert cosines.min() > 1.0 - 1e-4
        a, b, c = np.moveaxis(mesh.vertices[mesh.faces].astype(float), 1, 0)
        assert ((np.cross(b - a, c - a) * mesh.normals[mesh.faces[:, 0]]).sum(axis=1) > 0.0).all()


def test_a_stretch_that_stays_is_applied_once() -> None:
    rng = np.random.default_rng(45)
    item = object_at(WEDGE, SHEAR)
    first = mesh_of(item)
    for _ in range(100):
        moved = np.eye(4)
        moved[:3, :3] = 3.0 * random_rotation(rng)
        item = object_at(item, (moved @ SHEAR).astype(np.float32))
        assert mesh_of(item) is first
    assert mesh_of(object_at(item, np.eye(4))) is mesh_of(WEDGE)
    assert object_at(BALL, np.eye(4)) == BALL


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(3), "expected a 4x4"),
        ("lamp", "expected a 4x4"),
        (np.full((4, 4), np.nan), "finite"),
        (np.eye(4) + np.eye(4, k=-3), "last column"),
        (np.diag([1.0, 1.0, 0.0, 1.0]), "flattens"),
        (np.diag([0.0, 0.0, 0.0, 1.0]), "flattens"),
        (np.diag([1e200, 1e200, 1e200, 1.0]), "scale = 1e.200"),
        (np.diag([1.0, 1.0, 2.0, 1.0]), "stretch = .*: expected a mesh"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "a sphere has one scale for all"),
        (SHEAR, "stretch = .*: expected a mesh"),
    ],
)
def test_what_cannot_be_is_refused(matrix: object, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        object_at(BALL, matrix)


def test_a_flat_stretch_is_refused() -> None:
    with pytest.raises(SceneError, match=r"Object: stretch = .*: flattens; expected an invertible matrix"):
        dataclasses.replace(WEDGE, stretch=(1, 0, 0, 0, 1, 0, 0, 0, 0))
