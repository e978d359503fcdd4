"""Tessellate Newell's teapot into ``meshes/teapot.ply``.

    python scenes/make_teapot.py [--segments 8]

The body, lid and bottom of the teapot are surfaces of revolution in the published data: every ring of control points is
a quarter circle with the factor 0.56. So a profile of (radius, height), turned by `QUARTER`, holds all of them. The
handle and the spout are mirror images in y = 0 and are given as one half each. The table below is in Newell's units, z
up and the bottom at z = 0; the mesh keeps them (the pot is 3.15 high and 6.43 long) and a scene scales it. The lid is
widened until it meets the rim: in the data a gap of 0.1 shows the empty inside.

References:
    [Newell75] M. Newell, The Utilization of Procedure Models in Digital Image Synthesis, PhD thesis, Utah.
    [Crow87] F. Crow, The Origins of the Teapot, IEEE Computer Graphics and Applications 7(1), pp. 8-19.
"""

from __future__ import annotations

import argparse
import pathlib

import numpy as np

HERE = pathlib.Path(__file__).resolve().parent

QUARTER = np.array([[1.0, 0.0], [1.0, 0.56], [0.56, 1.0], [0.0, 1.0]])
"""Control points of Newell's quarter circle."""

LID_FIT = 1.4 / 1.3
"""Radius of the rim over that of the lid."""

PROFILES = {  # (radius, height) of four control points each
    "rim": [(1.4, 2.4), (1.3375, 2.53125), (1.4375, 2.53125), (1.5, 2.4)],
    "shoulder": [(1.5, 2.4), (1.75, 1.875), (2.0, 1.35), (2.0, 0.9)],
    "belly": [(2.0, 0.9), (2.0, 0.45), (1.5, 0.225), (1.5, 0.15)],
    "bottom": [(1.5, 0.15), (1.5, 0.075), (1.425, 0.0), (0.0, 0.0)],
    "setting": [(0.0, 3.15), (0.8, 3.15), (0.0, 2.85), (0.2, 2.7)],
    "lid": [(0.2, 2.7), (0.4, 2.55), (1.3, 2.55), (1.3, 2.4)],
}

# Four rows of control points along the part: (x, z) on the seam y = 0, the half width, (x, z) on the other seam.
HALVES = {
    "handle, upper": [
        ((-1.6, 2.025), 0.3, (-1.5, 2.25)),
        ((-2.3, 2.025), 0.3, (-2.5, 2.25)),
        ((-2.7, 2.025), 0.3, (-3.0, 2.25)),
        ((-2.7, 1.8), 0.3, (-3.0, 1.8)),
    ],
    "handle, lower": [
        ((-2.7, 1.8), 0.3, (-3.0, 1.8)),
        ((-2.7, 1.575), 0.3, (-3.0, 1.35)),
        ((-2.5, 1.125), 0.3, (-2.65, 0.9375)),
        ((-2.0, 0.9), 0.3, (-1.9, 0.6)),
    ],
    "spout, lower": [
        ((1.7, 1.425), 0.66, (1.7, 0.6)),
        ((2.6, 1.425), 0.66, (3.1, 0.825)),
        ((2.3, 2.1), 0.25, (2.4, 2.025)),
        ((2.7, 2.4), 0.25, (3.3, 2.4)),
    ],
    "spout, upper": [
        ((2.7, 2.4), 0.25, (3.3, 2.4)),
        ((2.8, 2.475), 0.25, (3.525, 2.49375)),
        ((2.9, 2.475), 0.15, (3.45, 2.5125)),
        ((2.8, 2.4), 0.15, (3.2, 2.4)),
    ],
}


def patches() -> list[np.ndarray]:
    """Return control points of the 32 patches, each ``(4, 4, 3)``: first index along the part, second around it."""
    found = []
    for name, profile in PROFILES.items():
        fit = LID_FIT if name in ("setting", "lid") else 1.0
        for turn in range(4):
            rotation = np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), turn)
            ring = QUARTER @ rotation.T
            found.append(np.array([[(*(r * fit * p), z) for p in ring] for r, z in profile]))
    for rows in HALVES.values():
        for side in (-1.0, 1.0):
            found.append(
                np.array(
                    [
                        [(x0, 0.0, z0), (x0, side * w, z0), (x1, side * w, z1), (x1, 0.0, z1)]
                        for (x0, z0), w, (x1, z1) in rows
                    ]
                )
            )
    return found


def bernstein(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return cubic Bernstein polynomials at ``t`` ``(n,)`` and their derivatives, each ``(n, 4)``."""
    s = 1.0 - t
    value = np.stack([s**3, 3 * s * s * t, 3 * s * t * t, t**3], -1)
    slope = np.stack([-3 * s * s, 3 * s * s - 6 * s * t, 6 * s * t - 3 * t * t, 3 * t * t], -1)
    return value, slope


def tessellate(patch: np.ndarray, segments: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points ``(n, n, 3)``, unit normals ``(n, n, 3)`` and triangles ``(m, 3)`` of one patch, n = segments + 1.

    The normal is the cross product of the two tangents. Where a patch is pinched to a point one tangent vanishes; its
    direction just beside the point is the limit, so tangents are taken a hair inside the patch.
    """
    grid = np.linspace(0.0, 1.0, segments + 1)
    inside = np.clip(grid, 1e-4, 1.0 - 1e-4)
    value, _ = bernstein(grid)
    near, slope = bernstein(inside)
    point = np.einsum("ui,vj,ijk->uvk", value, value, patch)
    along = np.einsum("ui,vj,ijk->uvk", slope, near, patch)
    around = np.einsum("ui,vj,ijk->uvk", near, slope, patch)
    normal = np.cross(along, around)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    index = np.arange((segments + 1) ** 2).reshape(segments + 1, segments + 1)
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    return point, normal, np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])


def outward(point: np.ndarray, name: str) -> np.ndarray:
    """Return a direction out of the solid near ``point``: away from the axis of the part ``name``."""
    if name.startswith(("handle", "spout")):
        middle = point.mean(axis=1, keepdims=True)  # the part is a tube: its axis lies amid each ring's half
        middle[..., 1] = 0.0
        return point - middle
    if name == "rim":
        return np.broadcast_to([0.0, 0.0, 1.0], point.shape)
    if name == "bottom":
        return np.broadcast_to([0.0, 0.0, -1.0], point.shape)
    return point - np.array([0.0, 0.0, 1.5])


def teapot(segments: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices ``(v, 3)``, normals ``(v, 3)`` and triangles ``(t, 3)``, facing outward, none of zero area."""
    names = [name for name in PROFILES for _ in range(4)] + [name for name in HALVES for _ in range(2)]
    points, normals, triangles, count = [], [], [], 0
    for name, patch in zip(names, patches(), strict=True):
        point, normal, index = tessellate(patch, segments)
        if np.mean(np.einsum("uvk,uvk->uv", normal, outward(point, name))) < 0.0:
            normal, index = -normal, index[:, ::-1]
        points.append(point.reshape(-1, 3))
        normals.append(normal.reshape(-1, 3))
        triangles.append(index + count)
        count += len(points[-1])
    point, normal, index = np.concatenate(points), np.concatenate(normals), np.concatenate(triangles)
    # Weld what lies at one place with one normal (seams between patches); creases such as the lid's edge stay apart.
    key = np.round(np.concatenate([point * 1e4, normal * 50.0], -1)).astype(np.int64)
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    point, normal, index = point[first], normal[first], inverse.reshape(-1)[index]
    area = np.linalg.norm(
        np.cross(point[index[:, 1]] - point[index[:, 0]], point[index[:, 2]] - point[index[:, 0]]), axis=-1
    )
    return point, normal, index[area > 1e-9]


def write_ply(path: pathlib.Path, point: np.ndarray, normal: np.ndarray, triangles: np.ndarray) -> None:
    """Write a binary PLY with vertex normals."""
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment Newell's teapot, made by make_teapot.py\n"
        f"element vertex {len(point)}\n"
        + "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
        + f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(triangles), dtype=[("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, triangles
    path.write_bytes(header.encode() + np.concatenate([point, normal], -1).astype("<f4").tobytes() + faces.tobytes())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--segments", type=int, default=8, help="steps along each edge of a patch (default 8)")
    parser.add_argument("--out", type=pathlib.Path, default=HERE / "meshes" / "teapot.ply")
    options = parser.parse_args()
    point, normal, triangles = teapot(options.segments)
    write_ply(options.out, point, normal, triangles)
    print(f"{options.out}: {len(point)} vertices, {len(triangles)} triangles")


if __name__ == "__main__":
    main()
