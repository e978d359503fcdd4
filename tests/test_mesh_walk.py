"""Rays through a mesh by the tree of a ``wp.Mesh``: what Warp's own queries find, at no more than their rounding."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import warp as wp

from warp_ar.kernels.rays.mesh_walk import STACK, find_closest_face, meets_any_face
from warp_ar.scene.geometry import Mesh
from warp_ar.scene.ray_mesh import BVH_CONSTRUCTOR, BVH_LEAF_SIZES, make_ray_mesh
from warp_ar.scene.shapes import torus_mesh

T_TOLERANCE = 1e-5
"""Where a ray meets a corner Warp goes on in float64; what a rounding of edge functions then does to t."""
UV_TOLERANCE = 2e-5
"""Weights of a triangle that a ray grazes are products of differences over a small one."""
CHAIN = 90
"""Triangles of which each is half as large as the one before: a tree by area takes off one or two after another."""
LARGEST = 2.0**30
"""Side of the first; products of the last one's sides are still in float32's range."""
T_MAX = 1e3
"""Of rays, unless a test says otherwise."""


def soup(count, seed=0, size=0.2):
    """Triangles anywhere in a unit cube."""
    rng = np.random.default_rng(seed)
    return (rng.random((count, 1, 3)) + size * rng.normal(size=(count, 3, 3))).astype(np.float32)


def shrinking(count, ratio=0.99):
    """Triangles each smaller by a ratio and closer to a corner: a tree by area peels them off singly."""
    scale = ratio ** np.arange(count)[:, None, None]
    return (scale * np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1.5]])).astype(np.float32)


def rays_toward(corners, count, seed=1):
    """Origins around, directions to points on triangles; every eighth along an axis, every ninth at a corner."""
    rng = np.random.default_rng(seed)
    chosen = corners[rng.integers(len(corners), size=count)]
    weights = rng.dirichlet([1, 1, 1], count)
    weights[::9] = (1, 0, 0)
    targets = np.einsum("nk,nkc->nc", weights, chosen)
    middle, spread = corners.mean(axis=(0, 1)), np.ptp(corners, axis=(0, 1)).max()
    origins = middle + 2.0 * spread * rng.normal(size=(count, 3))
    directions = targets - origins
    axis = rng.integers(3, size=count)
    along = np.eye(3)[axis] * np.where(rng.random(count) < 0.5, -spread, spread)[:, None]
    origins[::8], directions[::8] = (targets - 3 * along)[::8], along[::8]
    return origins.astype(np.float32), directions.astype(np.float32)


MESHES = {
    "one": soup(1),
    "seven": soup(7),
    "eight": soup(8),
    "nine": soup(9),
    "sixty-five": soup(65),
    "soup": soup(3000, size=0.05),
    "overlapping": soup(500, size=2.0),
    "torus": torus_mesh(0.3, 0.12, 1e-3).vertices[torus_mesh(0.3, 0.12, 1e-3).faces].astype(np.float32),
    "shrinking": shrinking(1500),
    "coincident": np.repeat(soup(3), 400, axis=0),
    "flat": soup(300) * np.float32([1, 1, 0]),
    "points": np.repeat(soup(100)[:, :1], 3, axis=1),
}
"""Corners of triangles, (n, 3, 3), by name."""


def ray_mesh(corners, device):
    """Triangles as the program makes them ready for rays."""
    faces = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    return make_ray_mesh(Mesh(corners.reshape(-1, 3), faces, corners.reshape(-1, 3)), wp.get_device(device))


@functools.cache
def make_walk_kernel() -> wp.Kernel:
    """What rays meet by Warp's queries, and by ours."""

    @wp.kernel(module="unique", enable_backward=False)
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

    return walk_kernel


def walk_through(mesh, origins, directions, device, t_max=T_MAX):
    """Closest hits (t, u, v, face) and whether there is any: by Warp's queries, by ours; NumPy.

    Origins are those of the mesh.
    """
    count = len(origins)
    with wp.ScopedDevice(device), np.errstate(invalid="ignore", over="ignore"):
        rays = [wp.array(np.asarray(values, np.float32), dtype=wp.vec3) for values in (origins, directions)]
        out = [wp.zeros(count, dtype=dtype) for dtype in (wp.vec4, wp.int32, wp.vec4, wp.int32)]
        wp.launch(make_walk_kernel(), count, [mesh.id, *rays, t_max], out)
        return [array.numpy() for array in out]


def walk(device, corners, origins, directions, t_max=T_MAX):
    """The same, of triangles as the program makes them ready."""
    made = ray_mesh(corners, device)
    return walk_through(made.mesh, np.asarray(origins) - made.center, directions, device, t_max)


def bare_mesh(corners, device):
    """Triangles by the tree that CUDA devices have, on any device, and without a margin."""
    points = wp.array(np.asarray(corners, np.float32).reshape(-1, 3), dtype=wp.vec3, device=device)
    indices = wp.array(np.arange(3 * len(corners), dtype=np.int32), dtype=wp.int32, device=device)
    leaf_size = BVH_LEAF_SIZES["cuda"]
    return wp.Mesh(points=points, indices=indices, bvh_constructor=BVH_CONSTRUCTOR, bvh_leaf_size=leaf_size)


@pytest.mark.parametrize("name", MESHES)
def test_rays_find_what_warp_finds(name, device):
    """Where triangles are equally near, another of them may be found; at a corner Warp goes on in float64."""
    corners = MESHES[name]
    origins, directions = rays_toward(corners, 20_000)
    warp, warp_any, ours, ours_any = walk(device, corners, origins, directions)
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


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("zero", [0.0, -0.0, 1e-42, -1e-42])
def test_no_ray_slips_between_boxes_that_touch(axis, zero, device):
    """A ray along an axis, in the plane in which two boxes without a margin touch, is in one of the two.

    1 / 0 times a distance of 0 would be no number, and the ray in neither.
    """
    square = np.array([[[0, 0, 1], [1, 0, 1], [1, 1, 1]], [[0, 0, 1], [1, 1, 1], [0, 1, 1]]])
    corners = np.concatenate([square, square - [1, 0, 0]])
    origins = np.array([[0.0, 0.3, 0.0], [0.0, 0.5, 0.0], [0.0, 0.9, -2.0]])
    directions = np.array([[zero, 0.0, 1.0]] * 3)
    corners, origins, directions = (np.roll(values, axis, axis=-1) for values in (corners, origins, directions))
    _, _, ours, ours_any = walk_through(bare_mesh(corners, device), origins, directions, device)
    np.testing.assert_array_equal(ours[:, 0], [1.0, 1.0, 3.0])
    assert (ours_any == 1).all()


@functools.cache
def make_depth_kernel():
    """Levels of a mesh's tree, as its builder counted them."""

    @wp.func_native("return wp::mesh_get(mesh_id).bvh.max_depth;")
    def depth_of(mesh_id: wp.uint64) -> wp.int32: ...

    @wp.kernel(module="unique", enable_backward=False)
    def read_depth_kernel(mesh: wp.uint64, depth_out: wp.array[wp.int32]):
        depth_out[0] = depth_of(mesh)

    return read_depth_kernel


def test_the_deepest_tree_fits_the_stack(device):
    """Warp ends a tree where its own stack would end, so as many nodes wait here: each triangle is found all the same.

    A ray passes through the boxes of all triangles and misses all of them but one.
    """
    scale = LARGEST * 0.5 ** np.arange(CHAIN)[:, None, None]
    corners = scale * np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.5]])
    origins, directions = np.zeros((1, 3)), np.array([[0.9, 0.9, 1.4]])
    depth = wp.zeros(1, dtype=wp.int32, device=device)
    for number in range(CHAIN):
        mirrored = corners.copy()
        mirrored[number, 0] = scale[number, 0] * np.array([1.0, 1.0, 1.5])
        mesh = bare_mesh(mirrored, device)
        wp.launch(make_depth_kernel(), 1, [mesh.id], [depth], device=device)
        assert int(depth.numpy()[0]) == STACK - 1
        _, _, ours, ours_any = walk_through(mesh, origins, directions, device, 4.0 * LARGEST)
        assert ours[0, 3] == number
        assert ours_any[0] == 1


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e38, 1e-38, 0.0])
@pytest.mark.parametrize("where", ["origin", "direction"])
def test_rays_of_no_sense_end(value, where, device):
    """Whatever they are, they come to an end, and t is never NaN."""
    corners = MESHES["soup"]
    origins, directions = rays_toward(corners, 300)
    for axes in ([0], [1], [2], [0, 1, 2]):
        broken = {"origin": origins.copy(), "direction": directions.copy()}
        broken[where][:, axes] = value
        _, _, ours, _ = walk(device, corners, broken["origin"], broken["direction"])
        assert not np.isnan(ours[:, 0]).any()
        assert ((ours[:, 0] >= 0) & (ours[:, 0] <= T_MAX)).all()
