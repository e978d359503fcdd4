"""Trees of eight-wide nodes: what they hold, and that walking them finds what Warp's own trees find."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from warp_ar.kernels import wide_bvh
from warp_ar.kernels.wide_bvh import BLOCK, LEAF_BLOCKS, MOST_DEPTH, NODE_BLOCKS, STACK, WIDTH, build_wide_bvh
from warp_ar.scene.geometry import Mesh
from warp_ar.scene.ray_mesh import BOX_MARGIN, make_ray_mesh
from warp_ar.scene.shapes import torus_mesh

MARGIN = 1e-4
T_TOLERANCE = 1e-5
"""Where a ray meets a corner Warp goes on in float64; what a rounding of edge functions then does to t."""


@wp.kernel(enable_backward=False)
def walk_kernel(
    # In:
    mesh: wp.uint64,
    tree: wp.uint64,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    t_max: wp.float32,
    # Out:
    warp_out: wp.array[wp.vec4],
    warp_any_out: wp.array[wp.int32],
    wide_out: wp.array[wp.vec4],
    wide_any_out: wp.array[wp.int32],
):
    i = wp.tid()
    query = wp.mesh_query_ray(mesh, origins[i], directions[i], t_max)
    warp_out[i] = wp.vec4(t_max, 0.0, 0.0, -1.0)
    if query.result:
        warp_out[i] = wp.vec4(query.t, query.u, query.v, wp.float32(query.face))
    warp_any_out[i] = wp.where(wp.mesh_query_ray_anyhit(mesh, origins[i], directions[i], t_max), 1, 0)
    near = wide_bvh.walk_closest(tree, origins[i], directions[i], t_max)
    wide_out[i] = wp.vec4(near[0], near[1], near[2], wp.float32(wp.cast(near[3], wp.int32)))
    wide_any_out[i] = wp.where(wide_bvh.walk_any(tree, origins[i], directions[i], t_max), 1, 0)


def walk(corners, origins, directions, t_max=1e3, **building):
    """Closest hits (t, u, v, face) and whether there is any: by Warp's tree, by ours; NumPy."""
    faces = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    made = make_ray_mesh(Mesh(corners.reshape(-1, 3), faces, corners.reshape(-1, 3)), wp.get_device("cpu"))
    count = len(origins)
    with wp.ScopedDevice("cpu"), np.errstate(invalid="ignore", over="ignore"):
        moved = made.mesh.points.numpy().reshape(-1, 3, 3)
        tree = build_wide_bvh(moved, BOX_MARGIN * np.linalg.norm(made.half), **building) if building else made.tree
        rays = [np.asarray(origins - made.center, np.float32), np.asarray(directions, np.float32)]
        out = [wp.zeros(count, dtype=dtype) for dtype in (wp.vec4, wp.int32, wp.vec4, wp.int32)]
        inputs = [made.mesh.id, wp.uint64(tree.ptr), *(wp.array(values, dtype=wp.vec3) for values in rays), t_max]
        wp.launch(walk_kernel, count, inputs, out)
        return [array.numpy() for array in out]


def parse(corners, **building):
    """Depth of a tree, and the triangles of each leaf with the box that its node gives it; checks what must hold."""
    flat = build_wide_bvh(corners, MARGIN, **building).numpy()
    width = int(WIDTH)
    leaves, deepest, seen = [], 0, int(LEAF_BLOCKS)
    waiting = [(0, 1, np.full(3, -np.inf), np.full(3, np.inf))]
    while waiting:
        block, depth, low, high = waiting.pop()
        seen += int(NODE_BLOCKS)
        deepest = max(deepest, depth)
        node = flat[block * int(BLOCK) :][: int(NODE_BLOCKS * BLOCK)]
        lower, upper = node[: 3 * width].reshape(3, width).T, node[3 * width : 6 * width].reshape(3, width).T
        children = node[6 * width : 7 * width].view(np.int32)
        assert (lower[:, 0] <= upper[:, 0]).any()
        for child, own_low, own_high in zip(children, lower, upper, strict=True):
            if own_low[0] > own_high[0]:
                assert child == ~int(NODE_BLOCKS)
                continue
            assert (own_low >= low).all()
            assert (own_high <= high).all()
            if child >= 0:
                waiting.append((int(child), depth + 1, own_low, own_high))
                continue
            seen += int(LEAF_BLOCKS)
            leaf = flat[int(~child) * int(BLOCK) :][: int(LEAF_BLOCKS * BLOCK)]
            triangles = leaf[9 * width : 10 * width].view(np.int32)
            held = leaf[: 9 * width].reshape(3, 3, width).transpose(2, 0, 1)[triangles >= 0]
            triangles = triangles[triangles >= 0]
            assert len(triangles) > 0
            np.testing.assert_array_equal(held, corners[triangles])
            assert (held.min(axis=(0, 1)) - np.float32(MARGIN) == own_low).all()
            assert (held.max(axis=(0, 1)) + np.float32(MARGIN) == own_high).all()
            leaves.append(triangles)
    assert seen * int(BLOCK) == len(flat)
    np.testing.assert_array_equal(np.sort(np.concatenate(leaves)), np.arange(len(corners)))
    return deepest


def soup(count, seed=0, size=0.2):
    """Triangles anywhere in a unit cube."""
    rng = np.random.default_rng(seed)
    return (rng.random((count, 1, 3)) + size * rng.normal(size=(count, 3, 3))).astype(np.float32)


def shrinking(count):
    """Triangles each a hundredth smaller and closer to a corner than the last: a tree by area peels them off singly."""
    scale = 0.99 ** np.arange(count)[:, None, None]
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


@pytest.mark.parametrize("name", MESHES)
def test_every_triangle_is_in_one_leaf_and_in_its_boxes(name):
    """Boxes hold their children's, leaves the true corners, and no tree is deeper than the walk's stack allows."""
    assert parse(MESHES[name]) <= MOST_DEPTH + 10
    assert (int(WIDTH) - 1) * (MOST_DEPTH + 10) < STACK


@pytest.mark.parametrize("most_depth", [0, 2])
def test_parts_that_are_halved(most_depth):
    """From ``most_depth`` on a tree is as shallow as eighths make it, and rays find the same."""
    corners = MESHES["shrinking"]
    assert parse(corners, most_depth=most_depth) <= most_depth + np.ceil(np.log(len(corners) / 8) / np.log(8)) + 1
    assert parse(corners) > parse(corners, most_depth=most_depth)
    rays = rays_toward(corners, 5000)
    _, _, wide, wide_any = walk(corners, *rays)
    _, _, halved, halved_any = walk(corners, *rays, most_depth=most_depth)
    np.testing.assert_array_equal(halved[:, 0], wide[:, 0])
    np.testing.assert_array_equal(halved_any, wide_any)


@pytest.mark.parametrize("name", MESHES)
def test_rays_find_what_warp_finds(name):
    """The same arithmetic: to the last bit, but for rays through corners and where triangles are equally near."""
    corners = MESHES[name]
    origins, directions = rays_toward(corners, 20_000)
    warp, warp_any, wide, wide_any = walk(corners, origins, directions)
    found = warp[:, 3] >= 0
    np.testing.assert_allclose(wide[found, 0], warp[found, 0], rtol=T_TOLERANCE)
    np.testing.assert_array_equal(wide_any, wide[:, 3] >= 0)
    assert ((wide_any == 1) | (warp_any == 0)).all()
    assert name == "points" or found.mean() > 0.4
    if name not in ("coincident", "flat", "shrinking"):
        index = np.arange(len(origins))
        generic = (index % 8 > 0) & (index % 9 > 0)
        np.testing.assert_array_equal(wide[generic], warp[generic])


def test_t_max_ends_rays():
    """Nothing at t_max or beyond is met; what lies just before is."""
    corners = np.array([[[-1, -1, 2], [1, -1, 2], [0, 1, 2]]], np.float32)
    for t_max, met in ((2.0, False), (np.nextafter(np.float32(2), np.float32(3)), True), (1.0, False), (3.0, True)):
        _, _, wide, wide_any = walk(corners, [(0, 0, 0)], [(0, 0, 1)], t_max)
        assert bool(wide_any[0]) == met
        assert (wide[0, 3] >= 0) == met
        assert wide[0, 0] == (2.0 if met else np.float32(t_max))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e38, 1e-38, 0.0])
@pytest.mark.parametrize("where", ["origin", "direction"])
def test_rays_of_no_sense_end(value, where):
    """Whatever they are, they come to an end, and t is never NaN."""
    corners = MESHES["soup"]
    origins, directions = rays_toward(corners, 300)
    for axes in ([0], [1], [2], [0, 1, 2]):
        broken = {"origin": origins.copy(), "direction": directions.copy()}
        broken[where][:, axes] = value
        _, _, wide, wide_any = walk(corners, broken["origin"], broken["direction"])
        assert not np.isnan(wide[:, 0]).any()
        assert ((wide[:, 0] >= 0) & (wide[:, 0] <= 1e3)).all()
        if len(axes) == 3 and not np.isfinite(value):
            assert (wide_any == 0).all()
