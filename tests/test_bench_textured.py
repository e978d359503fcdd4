"""The files that the bench of textures is measured with."""

from __future__ import annotations

import pathlib

import numpy as np

from bench.bench_textured import ROLES, make_pictures, torus_grid, write_torus
from warp_ar.scene.mesh_files import load_mesh


def test_a_torus_has_its_triangles_and_four_pictures(tmp_path: pathlib.Path) -> None:
    grid = torus_grid(5000)
    mesh = load_mesh(write_torus(tmp_path / "torus.glb", grid, (0.8, 0.6, 0.5), make_pictures(32, 0)))
    assert len(mesh.faces) >= 5000
    # Outward, as the normals are: else its back would be lit.
    corners = mesh.vertices[mesh.faces].astype(float)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((across * mesh.normals[mesh.faces].mean(axis=1)).sum(axis=1) > 0.0).all()
    (material,) = mesh.materials
    used = (material.base, material.metallic_roughness, material.normal, material.occlusion)
    assert [use is not None and use.image for use in used] == [0, 1, 2, 3]
    assert len(mesh.images) == len(ROLES)
    bare = load_mesh(write_torus(tmp_path / "bare.glb", grid, (0.8, 0.6, 0.5), {}))
    assert len(bare.faces) == len(mesh.faces)
    assert len(bare.images) == 0
