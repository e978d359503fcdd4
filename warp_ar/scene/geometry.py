"""Triangle meshes, their vertex normals, and rotations.

A mesh is in its own coordinates as a file has them, in metres; no axis is flipped. glTF is y-up, the world of a scene
is z-up: a glTF model is stood upright with ``rotate = [90, 0, 0]``.

References:
    [TW98] Thuermer and Wuethrich, "Computing Vertex Normals from Polygonal Facets", J. of Graphics Tools 3(1), 1998.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int32]
ByteArray = npt.NDArray[np.uint8]

# A triangle whose doubled area is below this share of its longest edge squared has no direction worth the name: float32
# vertices on one line come out at 1e-16 in float64, and the thinnest sliver that float32 can hold on purpose at 1e-7.
_ZERO_AREA: Final = 1e-12


@dataclasses.dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with unit vertex normals and, where the file has them, texture coordinates and a texture."""

    vertices: FloatArray
    """Positions in metres, (n, 3)."""
    faces: IntArray
    """Vertex indices, (m, 3), counter-clockwise seen from outside."""
    normals: FloatArray
    """Unit vertex normals, (n, 3)."""
    uvs: FloatArray | None = None
    """Texture coordinates, (n, 2): u to the right, v up the picture, (0, 0) at its bottom left corner; they repeat."""
    texture: ByteArray | None = None
    """Base colour, (h, w, 3) RGB, sRGB-encoded, row 0 at the top (v = 1)."""

    @property
    def bounds(self) -> FloatArray:
        """Lowest and highest corner of the axis-aligned box around the vertices in metres, (2, 3)."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])


def rotation_matrix(rotate: Sequence[float]) -> npt.NDArray[np.float64]:
    """Rotation about the fixed x, then the fixed y, then the fixed z axis: R = Rz Ry Rx.

    Args:
        rotate: Angles about x, y and z in degrees.

    Returns:
        The matrix R, (3, 3); a point p turns to R p.
    """
    (cx, sx), (cy, sy), (cz, sz) = ((math.cos(a), math.sin(a)) for a in map(math.radians, rotate))
    return np.array(
        [
            [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
            [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
            [-sy, cy * sx, cy * cx],
        ]
    )


def make_mesh(vertices: Any, faces: Any, normals: Any, uvs: Any = None, texture: ByteArray | None = None) -> Mesh:
    """A mesh of single-precision arrays that lie tightly in memory."""
    return Mesh(
        np.ascontiguousarray(vertices, dtype=np.float32),
        np.ascontiguousarray(faces, dtype=np.int32),
        np.ascontiguousarray(normals, dtype=np.float32),
        None if uvs is None else np.ascontiguousarray(uvs, dtype=np.float32),
        texture,
    )


def smooth_normals(vertices: npt.ArrayLike, faces: npt.ArrayLike) -> FloatArray:
    """Vertex normals as the mean of the adjacent faces' normals, weighted by the corners' angles [TW98].

    Angles, unlike areas, do not depend on how a face is cut into triangles. Vertices at one position share one normal,
    so that no seam of the texture shows in the shading. Triangles without area have no say. Where the faces around a
    vertex cancel (a sheet with two sides), it takes the normal of one of them; a vertex of no face gets +z.

    Args:
        vertices: Positions, (n, 3).
        faces: Vertex indices, (m, 3).

    Returns:
        Unit normals, (n, 3).
    """
    points = np.asarray(vertices, dtype=np.float64)
    corners = np.asarray(faces, dtype=np.int64)
    order = np.lexsort(points.T)
    fresh = np.any(np.diff(points[order], axis=0, prepend=np.nan) != 0.0, axis=1)
    place = np.empty(len(points), dtype=np.int64)
    place[order] = np.cumsum(fresh) - 1
    count = int(fresh.sum())

    a, b, c = (points[corners[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1)
    longest = np.max([np.sum((q - p) ** 2, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    solid = area > _ZERO_AREA * longest
    a, b, c, area, corners = a[solid], b[solid], c[solid], area[solid], corners[solid]
    face_normals = cross[solid] / area[:, None]

    total, fallback = np.zeros((count, 3)), np.tile([0.0, 0.0, 1.0], (count, 1))
    for k, (p, q, r) in enumerate(((a, b, c), (b, c, a), (c, a, b))):
        angle = np.arctan2(area, np.sum((q - p) * (r - p), axis=1))
        where = place[corners[:, k]]
        fallback[where] = face_normals
        for axis in range(3):
            total[:, axis] += np.bincount(where, weights=angle * face_normals[:, axis], minlength=count)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    normals = np.where(length > 1e-6, total / np.maximum(length, 1e-6), fallback)  # an angle's sum of 1e-6 is rounding
    result: FloatArray = normals[place].astype(np.float32)
    return result
