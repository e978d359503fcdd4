"""Rays through a mesh by the tree of a ``wp.Mesh``: what Warp's own queries find, at no more than their rounding."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from tests.test_wide_bvh import MESHES, T_TOLERANCE, rays_toward
from warp_ar.kernels.mesh_walk import find_closest_face, meets_any_face
from warp_ar.scene.geometry import Mesh
from warp_ar.scene.ray_mesh import make_ray_mesh

UV_TOLERANCE = 2e-5
"""Weights of a triangle that a ray grazes are products of differences over a small one."""


@wp.kernel(enable_backward=False)
def walk_kernel(
    # In:
    mesh: wp.uint64,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    t_max: wp.float32,
    # Out:
    warp_out: wp.array[wp.vec4],
    warp_any_out: wp.array[wp.int32],
    ours_out: wp.array[wp.vec4],
    ours_any_out: wp.array[wp.int32],
):
    i = wp.tid()
    query = wp.mesh_query_ray(mesh, origins[i], directions[i], t_max)
    warp_out[i] = wp.vec4(t_max, 0.0, 0.0, -1.0)
    if query.result:
        warp_out[i] = wp.vec4(query.t, query.u, query.v, wp.float32(query.face))
    warp_any_out[i] = wp.where(wp.mesh_query_ray_anyhit(mesh, origins[i], directions[i], t_max), 1, 0)
    near = find_closest_face(mesh, origins[i], directions[i], t_max)
    ours_out[i] = wp.vec4(near[0], near[1], near[2], wp.float32(wp.cast(near[3], wp.int32)))
    ours_any_out[i] = wp.where(meets_any_face(mesh, origins[i], directions[i], t_max), 1, 0)


def walk(corners, origins, directions, device, t_max=1e3):
    """Closest hits (t, u, v, face) and whether there is any: by Warp's queries, by ours; NumPy."""
    faces = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    made = make_ray_mesh(Mesh(corners.reshape(-1, 3), faces, corners.reshape(-1, 3)), wp.get_device(device))
    count = len(origins)
    with wp.ScopedDevice(device), np.errstate(invalid="ignore", over="ignore"):
        rays = [np.asarray(origins - made.center, np.float32), np.asarray(directions, np.float32)]
        out = [wp.zeros(count, dtype=dtype) for dtype in (wp.vec4, wp.int32, wp.vec4, wp.int32)]
        inputs = [made.mesh.id, *(wp.array(values, dtype=wp.vec3) for values in rays), t_max]
        wp.launch(walk_kernel, count, inputs, out)
        return [array.numpy() for array in out]


@pytest.mark.parametrize("name", MESHES)
def test_rays_find_what_warp_finds(name, device):
    """Where triangles are equally near, another of them may be found; at a corner Warp goes on in float64."""
    corners = MESHES[name]
    origins, directions = rays_toward(corners, 20_000)
    warp, warp_any, ours, ours_any = walk(corners, origins, directions, device)
    found = warp[:, 3] >= 0
    np.testing.assert_allclose(ours[found, 0], warp[found, 0], rtol=T_TOLERANCE)
    np.testing.assert_array_equal(ours_any, ours[:, 3] >= 0)
    assert ((ours_any == 1) | (warp_any == 0)).all()
    assert name == "points" or found.mean() > 0.4
    index = np.arange(len(origins))
    same = found & (ours[:, 3] == warp[:, 3]) & (index % 9 > 0)
    if name not in ("coincident", "flat", "shrinking", "points"):
        assert same[index % 9 > 0].sum() > 0.95 * found[index % 9 > 0].sum()
        np.testing.assert_allclose(ours[same, 1:3], warp[same, 1:3], atol=UV_TOLERANCE)


def test_no_ray_slips_through_a_closed_mesh(device):
    """From inside a torus every ray meets it, toward corners and edges too."""
    corners = MESHES["torus"]
    rng = np.random.default_rng(3)
    angles = rng.uniform(0.0, 2.0 * np.pi, 30_000)
    origins = 0.3 * np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
    chosen = corners[rng.integers(len(corners), size=len(angles))]
    weights = rng.dirichlet([1, 1, 1], len(angles))
    weights[::3] = (1, 0, 0)
    weights[1::3] = (0.5, 0.5, 0)
    directions = np.einsum("nk,nkc->nc", weights, chosen) - origins
    _, _, ours, ours_any = walk(corners, origins.astype(np.float32), directions.astype(np.float32), device)
    assert (ours_any == 1).all()
    assert (ours[:, 3] >= 0).all()


def test_t_max_ends_rays(device):
    """Nothing at t_max or beyond is met; what lies just before is."""
    corners = np.array([[[-1, -1, 2], [1, -1, 2], [0, 1, 2]]], np.float32)
    for t_max, met in ((2.0, False), (np.nextafter(np.float32(2), np.float32(3)), True), (1.0, False), (3.0, True)):
        _, _, ours, ours_any = walk(corners, [(0, 0, 0)], [(0, 0, 1)], device, t_max)
        assert bool(ours_any[0]) == met
        assert (ours[0, 3] >= 0) == met
        assert ours[0, 0] == (2.0 if met else np.float32(t_max))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e38, 1e-38, 0.0])
@pytest.mark.parametrize("where", ["origin", "direction"])
def test_rays_of_no_sense_end(value, where, device):
    """Whatever they are, they come to an end, and t is never NaN."""
    corners = MESHES["soup"]
    origins, directions = rays_toward(corners, 300)
    for axes in ([0], [1], [2], [0, 1, 2]):
        broken = {"origin": origins.copy(), "direction": directions.copy()}
        broken[where][:, axes] = value
        _, _, ours, _ = walk(corners, broken["origin"], broken["direction"], device)
        assert not np.isnan(ours[:, 0]).any()
        assert ((ours[:, 0] >= 0) & (ours[:, 0] <= 1e3)).all()
