"""Triangle meshes, their vertex normals, and rotations.

A mesh stays in its file's coordinates, in metres. glTF defines +Y as up, so its meshes are rotated to +Z up when they
are read. The other formats define no up axis and are not rotated.

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

from warp_ar.scene.materials import MeshMaterial

FloatArray = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int32]
ByteArray = npt.NDArray[np.uint8]

# A triangle whose doubled area is below this share of its longest edge squared has no reliable normal: float32 vertices
# on one line give 1e-16 in float64, and the thinnest sliver that float32 can represent gives 1e-7.
_ZERO_AREA: Final = 1e-12
_ROUNDING: Final = 1e-6
"""Length of a sum of unit vectors up to which it is rounding error."""


@dataclasses.dataclass(frozen=True, eq=False)
class Mesh:
    """Triangle mesh with unit vertex normals and, if the file has them, texture coordinates, colours and materials."""

    vertices: FloatArray
    """Positions in metres, (n, 3)."""
    faces: IntArray
    """Vertex indices, (m, 3), counter-clockwise seen from outside."""
    normals: FloatArray
    """Unit vertex normals, (n, 3)."""
    uvs: FloatArray | None = None
    """Texture coordinates, (n, 2): u to the right and v up in the picture, (0, 0) at its bottom left corner,
    repeating."""
    uvs_second: FloatArray | None = None
    """Second set of texture coordinates, (n, 2)."""
    colors: FloatArray | None = None
    """Factor of base colour and alpha at each vertex, (n, 4), linear."""
    tangents: FloatArray | None = None
    """Tangents, (n, 4): unit vector in the direction of growing u, perpendicular to the normal, and 1 or -1 for the
    sign of the bitangent."""
    triangle_materials: IntArray | None = None
    """Index into ``materials`` of each triangle, (m,); None: all triangles have the first material."""
    materials: tuple[MeshMaterial, ...] = ()
    """Materials of the file; empty if the file has none."""
    images: tuple[ByteArray, ...] = ()
    """Pictures that the materials refer to, each (h, w, 4) RGBA, row 0 at the top (v = 1)."""
    notes: tuple[str, ...] = ()
    """Names of contents of the file that are not shown."""

    @property
    def bounds(self) -> FloatArray:
        """Return the lowest and highest corner of the vertices' axis-aligned bounding box in metres, (2, 3)."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])


def rotation_matrix(rotate: Sequence[float]) -> npt.NDArray[np.float64]:
    """Return the rotation about the fixed x, then the fixed y, then the fixed z axis: R = Rz Ry Rx.

    Args:
        rotate: Angles about x, y and z in degrees.

    Returns:
        The matrix R, (3, 3), which maps a point p to R p.
    """
    (cx, sx), (cy, sy), (cz, sz) = ((math.cos(a), math.sin(a)) for a in map(math.radians, rotate))
    return np.array(
        [
            [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
            [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
            [-sy, cy * sx, cy * cx],
        ]
    )


def quaternion_matrix(quaternion: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the rotation matrix, (3, 3), of a unit quaternion (x, y, z, w)."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def placement(linear: Any, translation: Any) -> npt.NDArray[np.float64]:
    """Return the (4, 4) matrix, for column vectors, that maps x to linear x + translation."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, translation
    return matrix


def make_mesh(vertices: Any, faces: Any, normals: Any, uvs: Any = None, **others: Any) -> Mesh:
    """Return a mesh with contiguous single-precision arrays; ``others`` are further fields of ``Mesh``."""

    def single(values: Any) -> FloatArray | None:
        return None if values is None else np.ascontiguousarray(values, dtype=np.float32)

    for name in ("uvs_second", "colors", "tangents"):
        others[name] = single(others.get(name))
    if others.get("triangle_materials") is not None:
        others["triangle_materials"] = np.ascontiguousarray(others["triangle_materials"], dtype=np.int32)
    return Mesh(
        np.ascontiguousarray(vertices, dtype=np.float32),
        np.ascontiguousarray(faces, dtype=np.int32),
        np.ascontiguousarray(normals, dtype=np.float32),
        single(uvs),
        **others,
    )


def smooth_normals(vertices: npt.ArrayLike, faces: npt.ArrayLike) -> FloatArray:
    """Return vertex normals: means of the adjacent faces' normals, weighted by the faces' angles at the vertex [TW98].

    Unlike area weights, angle weights do not depend on how a polygon is cut into triangles. Vertices at the same
    position share one normal, so texture seams do not show in the shading. Triangles without area are ignored. Where
    the normals around a vertex cancel (a two-sided sheet), the vertex takes the normal of one face; a vertex without
    faces gets +z.

    Args:
        vertices: Positions, (n, 3).
        faces: Vertex indices, (m, 3).

    Returns:
        Unit normals, (n, 3).
    """
    corners = np.asarray(faces, dtype=np.int64)
    place = _places(np.asarray(vertices, dtype=np.float64))
    count = int(place.max(initial=-1)) + 1
    unit, angle, solid = _face_normals(vertices, corners)
    total, fallback = np.zeros((count, 3)), np.tile([0.0, 0.0, 1.0], (count, 1))
    for k in range(3):
        where = place[corners[solid, k]]
        fallback[where] = unit[solid]
        total += _sums(where, angle[solid, k, None] * unit[solid], count)
    result: FloatArray = unit_or(total, fallback, _ROUNDING)[place].astype(np.float32)
    return result


def _face_normals(vertices: npt.ArrayLike, corners: npt.NDArray[np.int64]) -> tuple[Any, Any, Any]:
    """Return unit normals of triangles (0 without area), corner angles, and a mask of triangles with area."""
    sides = np.asarray(vertices, dtype=np.float64)[corners]
    edges = np.roll(sides, -1, axis=1) - sides
    cross = np.cross(edges[:, 0], -edges[:, 2])
    area = np.linalg.norm(cross, axis=1)
    solid = area > _ZERO_AREA * (edges**2).sum(axis=2).max(axis=1, initial=0.0)
    unit = np.where(solid[:, None], cross / np.where(solid, area, 1.0)[:, None], 0.0)
    cosine = -(edges * np.roll(edges, 1, axis=1)).sum(axis=2)
    return unit, np.arctan2(area[:, None], cosine) * (np.linalg.norm(edges, axis=2) > 0.0), solid


def _sums(group: npt.NDArray[np.int64], values: npt.NDArray[Any], count: int) -> npt.NDArray[np.float64]:
    """Return the sum of vectors in each of ``count`` groups, (count, 3)."""
    return np.stack([np.bincount(group, values[:, axis], count) for axis in range(3)], axis=-1)


def unit_or(vectors: npt.NDArray[Any], other: npt.NDArray[Any] | float, least: float = 0.0) -> npt.NDArray[Any]:
    """Return ``vectors``, (n, 3), normalized; one that is not longer than ``least`` is replaced by ``other``."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    usable = np.isfinite(length) & (length > least)
    return np.where(usable, vectors / np.where(usable, length, 1.0), other)


def _places(points: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Return an index for each point, (n,), that is equal for points at equal positions."""
    order = np.lexsort(points.T)
    fresh = np.any(np.diff(points[order], axis=0, prepend=np.nan) != 0.0, axis=1)
    place = np.empty(len(points), dtype=np.int64)
    place[order] = np.cumsum(fresh) - 1
    return place


def creased_normals(
    vertices: npt.ArrayLike, faces: npt.ArrayLike, crease: float
) -> tuple[npt.NDArray[np.int64], FloatArray]:
    """Return normals that are smooth except at edges where the surface turns by more than ``crease``.

    Corners at one position are joined across every edge that turns less than ``crease``. Each group of joined corners
    takes the mean of its triangles' normals, weighted as in :func:`smooth_normals`. A box becomes flat, a ball smooth,
    and a cylinder's rim sharp.

    Args:
        vertices: Positions, (n, 3).
        faces: Vertex indices, (m, 3).
        crease: Angle in degrees from which on an edge is sharp.

    Returns:
        Original vertex of each corner, (3 m,), and unit normal of each corner, (3 m, 3); corner k of face f is 3 f + k.
    """
    corners = np.asarray(faces, dtype=np.int64)
    unit, angle, _ = _face_normals(vertices, corners)
    place = _places(np.asarray(vertices, dtype=np.float64))[corners]
    following = np.roll(place, -1, axis=1)
    ends = np.sort(np.stack([place.ravel(), following.ravel()], axis=1), axis=1)
    order = np.lexsort(ends.T)
    same = (ends[order][1:] == ends[order][:-1]).all(axis=1)
    first, second = order[:-1][same], order[1:][same]
    smooth = (unit[first // 3] * unit[second // 3]).sum(axis=1) > math.cos(math.radians(crease))
    # Two triangles of the same winding traverse their common edge in opposite directions.
    first, second = first[smooth], second[smooth]
    forward = place.ravel()[first] != place.ravel()[second]

    def after(corner: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        return corner - corner % 3 + (corner + 1) % 3

    start = np.where(forward, after(second), second)
    stop = np.where(forward, second, after(second))
    group = _joined(3 * len(corners), np.concatenate([first, after(first)]), np.concatenate([start, stop]))

    own = np.repeat(unit, 3, axis=0)
    total = _sums(group, angle.reshape(-1, 1) * own, 3 * len(corners))[group]
    fallback = np.where((own**2).sum(axis=1, keepdims=True) > 0.5, own, [0.0, 0.0, 1.0])
    normals: FloatArray = unit_or(total, fallback, _ROUNDING).astype(np.float32)
    return corners.ravel(), normals


def _joined(count: int, first: npt.NDArray[np.int64], second: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return the smallest item of each item's group, (count,); items ``first[k]`` and ``second[k]`` share a group."""
    label = np.arange(count)
    while True:
        lowest = np.minimum(label[first], label[second])
        fresh = label.copy()
        np.minimum.at(fresh, first, lowest)
        np.minimum.at(fresh, second, lowest)
        np.minimum.at(fresh, label[first], lowest)
        np.minimum.at(fresh, label[second], lowest)
        fresh = fresh[fresh]
        if np.array_equal(fresh, label):
            return label
        label = fresh


def tangent_frames(
    vertices: npt.ArrayLike, faces: npt.ArrayLike, normals: npt.ArrayLike, uvs: npt.ArrayLike
) -> tuple[npt.NDArray[np.int64], FloatArray]:
    """Return tangents for normal maps: directions of growing u, averaged at each vertex by angle.

    With edges p1, p2 and their differences of texture coordinates (u1, v1), (u2, v2), the surface's derivative by u is
    (v2 p1 - v1 p2) / (u1 v2 - u2 v1). A vertex between triangles with the picture and its mirror image gets one frame
    for each. Triangles whose texture coordinates span no area are ignored; a vertex that has only such triangles gets
    an arbitrary tangent.

    Args:
        vertices: Positions, (n, 3).
        faces: Vertex indices, (m, 3).
        normals: Unit vertex normals, (n, 3).
        uvs: Texture coordinates, (n, 2), v up.

    Returns:
        Original vertex of each corner, (3 m,), and tangent of each corner in the form of ``Mesh.tangents``, (3 m, 4).
    """
    points, texture = np.asarray(vertices, dtype=np.float64), np.asarray(uvs, dtype=np.float64)
    corners = np.asarray(faces, dtype=np.int64)
    p, t = points[corners], texture[corners]
    p1, p2, t1, t2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0], t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    area = t1[:, 0] * t2[:, 1] - t2[:, 0] * t1[:, 1]
    side = np.where(area < 0.0, -1.0, 1.0)
    along = side[:, None] * (t2[:, 1:] * p1 - t1[:, 1:] * p2)
    along = unit_or(along, 0.0)
    along[area == 0.0] = 0.0

    _, angle, _ = _face_normals(points, corners)
    key = (2 * corners + (side < 0.0)[:, None]).ravel()
    total = _sums(key, angle.reshape(-1, 1) * np.repeat(along, 3, axis=0), 2 * len(points))[key]
    normal = np.asarray(normals, dtype=np.float64)[corners.ravel()]
    flat = total - (total * normal).sum(axis=1, keepdims=True) * normal
    other = np.cross(normal, np.where(np.abs(normal[:, :1]) < 0.5, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    tangents = unit_or(flat, other, _ROUNDING)
    return corners.ravel(), np.concatenate([tangents, np.repeat(side, 3)[:, None]], axis=1).astype(np.float32)
