"""Trees of eight-wide nodes: what they hold, and that walking them finds what Warp's own trees find."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from tests.mesh_rays_rig import (
    MESHES,
    T_MAX,
    T_TOLERANCE,
    check_senseless,
    check_t_max,
    launch_walk,
    make_walk_kernel,
    ray_mesh,
    rays_toward,
)
from warp_ar.kernels.rays import wide_bvh
from warp_ar.kernels.rays.wide_bvh import (
    BLOCK,
    LEAF_BLOCKS,
    MOST_DEPTH,
    NODE_BLOCKS,
    STACK,
    WIDTH,
    build_wide_bvh,
    refit_wide_bvh,
)
from warp_ar.scene.ray_mesh import BOX_MARGIN

MARGIN = 1e-4


def build(corners, margin, rest=None, **building):
    """Build a tree over triangles; if they stood at ``rest`` before, over those, and have it follow them."""
    tree = build_wide_bvh(corners if rest is None else rest, margin, **building)
    if rest is not None:
        refit_wide_bvh(tree, wp.array(corners.reshape(-1, 3), dtype=wp.vec3, device="cpu"), margin)
    return tree


def walk(corners, origins, directions, t_max=T_MAX, **building):
    """Closest hits (t, u, v, face) and whether there is any: by Warp's tree, by ours; NumPy."""
    made = ray_mesh(corners, "cpu")
    moved = made.mesh.points.numpy().reshape(-1, 3, 3)
    tree = build(moved, BOX_MARGIN * np.linalg.norm(made.half), **building) if building else made.tree
    kernel = make_walk_kernel(wide_bvh.walk_closest, wide_bvh.walk_any)
    return launch_walk(kernel, made.mesh, tree.ptr, np.asarray(origins) - made.center, directions, "cpu", t_max)


def parse(corners, **building):
    """Depth of a tree, and the triangles of each leaf with the box that its node gives it; checks what must hold."""
    flat = build(corners, MARGIN, **building).numpy()
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
def test_a_tree_follows_triangles_that_move(name):
    """However far they are from where it was built: it holds them as a new one does, and rays meet the same."""
    corners = MESHES[name]
    rest = np.random.default_rng(5).normal(size=corners.shape).astype(np.float32)
    parse(corners, rest=rest)
    rays = rays_toward(corners, 5000)
    _, _, wide, wide_any = walk(corners, *rays)
    _, _, followed, followed_any = walk(corners, *rays, rest=rest)
    np.testing.assert_array_equal(followed[:, 0], wide[:, 0])
    np.testing.assert_array_equal(followed_any, wide_any)


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
    check_t_max(walk)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e38, 1e-38, 0.0])
@pytest.mark.parametrize("where", ["origin", "direction"])
def test_rays_of_no_sense_end(value, where):
    """Whatever they are, they come to an end, and t is never NaN."""
    met = check_senseless(walk, value, where)
    if not np.isfinite(value):
        assert (met == 0).all()
