"""Triangle meshes of torus, sphere, box, rect, disk and tube, with exact normals and camera-dependent resolution."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from warp_ar.scene.geometry import Mesh, make_mesh

NEAREST: Final = 0.4
"""Assumed smallest viewing distance in metres; objects larger than this are viewed from at least their own extent."""
UNSEEN: Final = 0.1 / 1000.0
"""Allowed silhouette error: 0.1 pixels, divided by a focal length of 1000 pixels."""


def silhouette_tolerance(extent: float) -> float:
    """Return the largest gap in metres between a curved surface and its triangles that stays invisible.

    ``extent`` is its radius.

    A gap g at distance d moves the silhouette by focal g / d pixels.
    """
    return UNSEEN * max(NEAREST, extent)


def _segments(radius: float, gap: float) -> int:
    """Return the number of segments of a circle whose chords stay within ``gap`` of it.

    The chord of a segment of angle 2 pi / n is farthest from its arc at its middle, by the sagitta r (1 - cos(pi / n));
    solved for n: n = pi / acos(1 - gap / r). At least 24, so that the shading of tiny objects stays smooth.
    """
    return max(24, math.ceil(math.pi / math.acos(1.0 - gap / radius))) if gap < radius else 24


def torus_mesh(major_radius: float, minor_radius: float, tolerance: float | None = None) -> Mesh:
    """Return the mesh of a torus around the z axis, centred at the origin.

    Args:
        major_radius: Distance of the tube's centre from the axis in metres.
        minor_radius: Radius of the tube in metres.
        tolerance: Largest gap between triangles and surface in metres; default: :func:`silhouette_tolerance` of the
            whole torus. Divide it by the scale at which the mesh is used.

    Returns:
        The mesh; u runs around the axis from +x through +y, v around the tube from its outermost circle through +z.
    """
    outer = major_radius + minor_radius
    gap = 0.5 * (silhouette_tolerance(outer) if tolerance is None else tolerance)  # half per circle: gaps add up
    columns, rows = _segments(outer, gap), _segments(minor_radius, gap)
    u, v, faces = _grid(columns, rows)
    # Both copies of the seam use the same angle, so that they agree to the last bit and no ray passes between them.
    phi, psi = (2 * np.pi) * (u % 1.0), (2 * np.pi) * (v % 1.0)
    normals = np.stack([np.cos(phi) * np.cos(psi), np.sin(phi) * np.cos(psi), np.sin(psi)], axis=-1)
    centers = major_radius * np.stack([np.cos(phi), np.sin(phi), np.zeros_like(phi)], axis=-1)
    return make_mesh(centers + minor_radius * normals, faces, normals, np.stack([u, v], axis=-1))


def sphere_mesh(radius: float, tolerance: float | None = None) -> Mesh:
    """Return the mesh of a sphere centred at the origin.

    Args:
        radius: Radius in metres.
        tolerance: Largest gap between triangles and surface in metres; default: :func:`silhouette_tolerance`.

    Returns:
        The mesh; u runs around the z axis from -x through -y, +x and +y as in a latlong map, v from -z to +z.
    """
    gap = 0.5 * (silhouette_tolerance(radius) if tolerance is None else tolerance)
    columns = _segments(radius, gap)
    rows = (columns + 1) // 2
    u, v, faces = _grid(columns, rows)
    # The first and last row are the poles: of the two triangles of a cell there, the one with two corners at the pole
    # is dropped.
    cell = np.arange(len(faces)) // 2
    first = np.arange(len(faces)) % 2 == 0
    faces = faces[~((cell < columns) & first) & ~((cell >= (rows - 1) * columns) & ~first)]
    phi, theta = (2 * np.pi) * ((u % 1.0) - 0.5), np.pi * (1.0 - v)
    sin_theta = np.where((v == 0.0) | (v == 1.0), 0.0, np.sin(theta))
    normals = np.stack([sin_theta * np.cos(phi), sin_theta * np.sin(phi), np.cos(theta)], axis=-1)
    return make_mesh(radius * normals, faces, normals, np.stack([u, v], axis=-1))


def box_mesh(size: Sequence[float]) -> Mesh:
    """Return the mesh of an axis-aligned box centred at the origin, with flat faces.

    Args:
        size: Lengths along x, y and z in metres.

    Returns:
        The mesh: 24 vertices, 12 triangles, every face with texture coordinates from 0 to 1.
    """
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    vertices, normals = np.empty((6, 4, 3)), np.zeros((6, 4, 3))
    for axis in range(3):
        right, up = (axis + 1) % 3, (axis + 2) % 3
        for side, sign in enumerate((-1.0, 1.0)):
            face = vertices[2 * axis + side]
            face[:, axis], face[:, right], face[:, up] = sign, sign * corners[:, 0], corners[:, 1]
            normals[2 * axis + side, :, axis] = sign
    faces = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(6)[:, None, None]
    half = 0.5 * np.asarray(size, dtype=np.float64)
    return make_mesh(
        (half * vertices).reshape(-1, 3),
        faces.reshape(-1, 3),
        normals.reshape(-1, 3),
        np.tile(0.5 + 0.5 * corners, (6, 1)),
    )


def rect_mesh(size: Sequence[float], cells: int = 1) -> Mesh:
    """Return the mesh of a rectangle in the xy plane that faces +z, centred at the origin.

    Args:
        size: Lengths along x and y in metres.
        cells: Number of cells along each side; each cell is two triangles.

    Returns:
        The mesh; u runs along x, v along y.
    """
    u, v, faces = _grid(cells, cells)
    vertices = np.stack([(u - 0.5) * size[0], (v - 0.5) * size[1], np.zeros_like(u)], axis=-1)
    return make_mesh(vertices, faces, np.tile([0.0, 0.0, 1.0], (len(u), 1)), np.stack([u, v], axis=-1))


def disk_mesh(radius: float, tolerance: float | None = None) -> Mesh:
    """Return the mesh of a disk in the xy plane that faces +z, centred at the origin.

    Args:
        radius: Radius in metres.
        tolerance: Largest gap between triangles and circle in metres; default: :func:`silhouette_tolerance`.

    Returns:
        The mesh; texture coordinates from 0 to 1 span the square around the disk.
    """
    count = _segments(radius, silhouette_tolerance(radius) if tolerance is None else tolerance)
    phi = 2.0 * np.pi * np.arange(count) / count
    rim = np.stack([np.cos(phi), np.sin(phi), np.zeros(count)], axis=-1)
    vertices = np.concatenate([np.zeros((1, 3)), rim])
    k = np.arange(count)
    faces = np.stack([np.zeros(count, int), 1 + k, 1 + (k + 1) % count], axis=-1)
    normals = np.tile([0.0, 0.0, 1.0], (count + 1, 1))
    return make_mesh(radius * vertices, faces, normals, 0.5 + 0.5 * vertices[:, :2])


def tube_mesh(radius: float, length: float, tolerance: float | None = None) -> Mesh:
    """Return the mesh of a cylinder's side around the z axis, centred at the origin, with open ends.

    Args:
        radius: Radius in metres.
        length: Length along z in metres.
        tolerance: Largest gap between triangles and cylinder in metres; default: :func:`silhouette_tolerance`.

    Returns:
        The mesh; u runs around the axis from +x through +y, v along it.
    """
    count = _segments(radius, silhouette_tolerance(radius) if tolerance is None else tolerance)
    u, v, faces = _grid(count, 1)
    phi = 2.0 * np.pi * (u % 1.0)
    normals = np.stack([np.cos(phi), np.sin(phi), np.zeros_like(phi)], axis=-1)
    vertices = radius * normals
    vertices[:, 2] = length * (v - 0.5)
    return make_mesh(vertices, faces, normals, np.stack([u, v], axis=-1))


def _grid(columns: int, rows: int) -> tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]]:
    """Return u and v of a grid's (rows + 1) x (columns + 1) vertices, and its faces, two triangles per cell."""
    v, u = np.meshgrid(np.arange(rows + 1) / rows, np.arange(columns + 1) / columns, indexing="ij")
    a = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    b, c, d = a + 1, a + columns + 2, a + columns + 1
    return u.ravel(), v.ravel(), np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
