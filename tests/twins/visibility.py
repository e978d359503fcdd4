"""Float64 twins of ``shapes.py``, ``trace.py`` and ``visibility.py``: brute force over shapes and triangles."""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass
class Body:
    """A shape in double precision."""

    kind: str
    rotation: np.ndarray
    position: np.ndarray
    scale: float
    extent: np.ndarray
    triangles: np.ndarray | None = None


def intersect_sphere(radius, origin, direction):
    """Smallest positive t per ray, infinity if none."""
    a = np.sum(direction * direction, -1)
    b = np.sum(origin * direction, -1)
    c = np.sum(origin * origin, -1) - radius**2
    root = np.sqrt(np.where(b * b - a * c < 0, np.nan, b * b - a * c))
    roots = np.stack([(-b - root) / a, (-b + root) / a])
    return np.where(roots > 0, roots, np.inf).min(0)


def intersect_box(half, origin, direction):
    """Smallest positive t per ray, infinity if none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.stack([(-half - origin) / direction, (half - origin) / direction])
    parallel_inside = (direction == 0) & (np.abs(origin) <= half)
    near = np.where(parallel_inside, -np.inf, t.min(0))
    far = np.where(parallel_inside, np.inf, t.max(0))
    near, far = np.max(near, -1), np.min(far, -1)
    t = np.where(near > 0, near, far)
    return np.where((near <= far) & (t > 0), t, np.inf)


def intersect_plane(half, origin, direction):
    """Positive t on the rectangle, infinity if none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -origin[:, 2] / direction[:, 2]
        p = origin + t[:, None] * direction
    inside = (np.abs(p[:, 0]) <= half[0]) & (np.abs(p[:, 1]) <= half[1]) & (t > 0)
    return np.where(inside, t, np.inf)


def intersect_triangles(triangles, origin, direction):
    """Smallest positive t per ray over all triangles (Moeller and Trumbore), and which triangle."""
    best, face = np.full(len(origin), np.inf), np.full(len(origin), -1)
    for index, (a, b, c) in enumerate(triangles):
        e1, e2 = b - a, c - a
        p = np.cross(direction, e2)
        det = p @ e1
        with np.errstate(divide="ignore", invalid="ignore"):
            s = origin - a
            u = np.sum(s * p, -1) / det
            q = np.cross(s, e1)
            v = np.sum(direction * q, -1) / det
            t = q @ e2 / det
        hit = (det != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < best)
        best[hit], face[hit] = t[hit], index
    return best, face


def closest(bodies: list[Body], origin: np.ndarray, direction: np.ndarray):
    """Smallest t, index of the body (-1 for none) and outward geometric normal of every ray."""
    best = np.full(len(origin), np.inf)
    which = np.full(len(origin), -1)
    normal = np.zeros_like(origin)
    for index, body in enumerate(bodies):
        o = (origin - body.position) @ body.rotation / body.scale
        d = direction @ body.rotation / body.scale
        if body.kind == "sphere":
            t = intersect_sphere(body.extent[0], o, d)
        elif body.kind == "box":
            t = intersect_box(body.extent, o, d)
        elif body.kind == "plane":
            t = intersect_plane(body.extent, o, d)
        else:
            t, face = intersect_triangles(body.triangles, o, d)
        hit = t < best
        p = o[hit] + t[hit, None] * d[hit]
        if body.kind == "sphere":
            local = p / np.linalg.norm(p, axis=-1, keepdims=True)
        elif body.kind == "box":
            axis = np.argmax(np.abs(p) - body.extent, -1)
            local = np.zeros_like(p)
            local[np.arange(len(p)), axis] = np.sign(p[np.arange(len(p)), axis])
        elif body.kind == "plane":
            local = np.broadcast_to([0.0, 0.0, 1.0], p.shape)
        else:
            a, b, c = (body.triangles[face[hit], k] for k in range(3))
            local = np.cross(b - a, c - a)
            local /= np.linalg.norm(local, axis=-1, keepdims=True)
        normal[hit] = local @ body.rotation.T
        best[hit], which[hit] = t[hit], index
    return best, which, normal
