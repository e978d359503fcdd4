"""Rays through meshes by a walk of this program's, beside Warp's own queries: for walks on CPU and on CUDA."""

from __future__ import annotations

import functools

import numpy as np
import warp as wp

from warp_ar.scene.geometry import Mesh
from warp_ar.scene.ray_mesh import make_ray_mesh
from warp_ar.scene.shapes import torus_mesh

T_TOLERANCE = 1e-5
"""Where a ray meets a corner Warp goes on in float64; what a rounding of edge functions then does to t."""
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
def make_walk_kernel(closest: wp.Function, meets_any: wp.Function) -> wp.Kernel:
    """What rays meet by Warp's queries, and by two functions of a tree's address, origin, direction and t_max."""

    @wp.kernel(module="unique", enable_backward=False)
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
        ours_out: wp.array[wp.vec4],
        ours_any_out: wp.array[wp.int32],
    ):
        i = wp.tid()
        query = wp.mesh_query_ray(mesh, origins[i], directions[i], t_max)
        warp_out[i] = wp.vec4(t_max, 0.0, 0.0, -1.0)
        if query.result:
            warp_out[i] = wp.vec4(query.t, query.u, query.v, wp.float32(query.face))
        warp_any_out[i] = wp.where(wp.mesh_query_ray_anyhit(mesh, origins[i], directions[i], t_max), 1, 0)
        near = closest(tree, origins[i], directions[i], t_max)
        ours_out[i] = wp.vec4(near[0], near[1], near[2], wp.float32(wp.cast(near[3], wp.int32)))
        ours_any_out[i] = wp.where(meets_any(tree, origins[i], directions[i], t_max), 1, 0)

    return walk_kernel


def launch_walk(kernel, mesh, tree, origins, directions, device, t_max):
    """Closest hits (t, u, v, face) and whether there is any: by Warp's queries, by ours; NumPy.

    Origins are those of the mesh.
    """
    count = len(origins)
    with wp.ScopedDevice(device), np.errstate(invalid="ignore", over="ignore"):
        rays = [wp.array(np.asarray(values, np.float32), dtype=wp.vec3) for values in (origins, directions)]
        out = [wp.zeros(count, dtype=dtype) for dtype in (wp.vec4, wp.int32, wp.vec4, wp.int32)]
        wp.launch(kernel, count, [mesh.id, wp.uint64(tree), *rays, t_max], out)
        return [array.numpy() for array in out]


def check_t_max(walk):
    """Nothing at t_max or beyond is met; what lies just before is.

    Args:
        walk: Of corners, origins, directions and t_max, gives what ``launch_walk`` does.
    """
    corners = np.array([[[-1, -1, 2], [1, -1, 2], [0, 1, 2]]], np.float32)
    for t_max, met in ((2.0, False), (np.nextafter(np.float32(2), np.float32(3)), True), (1.0, False), (3.0, True)):
        _, _, ours, ours_any = walk(corners, [(0, 0, 0)], [(0, 0, 1)], t_max)
        assert bool(ours_any[0]) == met
        assert (ours[0, 3] >= 0) == met
        assert ours[0, 0] == (2.0 if met else np.float32(t_max))


def check_senseless(walk, value, where):
    """Rays with such a value come to an end, and t is never NaN.

    Args:
        walk: As for ``check_t_max``.
        value: Of one axis, and of all.
        where: ``origin`` or ``direction``.

    Returns:
        Whether each ray meets anything where all axes have the value, (n,).
    """
    corners = MESHES["soup"]
    origins, directions = rays_toward(corners, 300)
    for axes in ([0], [1], [2], [0, 1, 2]):
        broken = {"origin": origins.copy(), "direction": directions.copy()}
        broken[where][:, axes] = value
        _, _, ours, ours_any = walk(corners, broken["origin"], broken["direction"], T_MAX)
        assert not np.isnan(ours[:, 0]).any()
        assert ((ours[:, 0] >= 0) & (ours[:, 0] <= T_MAX)).all()
    return ours_any
