"""Simple shapes and materials for the bundled clips, as dictionaries of Mitsuba."""

from __future__ import annotations

import itertools
import pathlib
from typing import Any

import cv2
import mitsuba as mi
import numpy as np
from make_teapot import write_ply

Dict = dict[str, Any]


def turned(at: tuple[float, ...] = (0, 0, 0), turn: float = 0.0, size: Any = 1.0) -> mi.ScalarTransform4f:
    """Return the transform that scales by ``size``, turns about z by ``turn`` degrees, and moves to ``at``."""
    t = mi.ScalarTransform4f()
    return t.translate(list(at)) @ t.rotate([0, 0, 1], turn) @ t.scale(size)


def box(at: tuple[float, ...], size: tuple[float, ...], bsdf: Dict, turn: float = 0.0) -> Dict:
    return {"type": "cube", "to_world": turned(at, turn, [s / 2 for s in size]), "bsdf": bsdf}


def ball(at: tuple[float, ...], radius: float, bsdf: Dict) -> Dict:
    return {"type": "sphere", "center": list(at), "radius": radius, "bsdf": bsdf}


def quad(center: Any, right: Any, up: Any, **rest: Any) -> Dict:
    """Return a rectangle with the half sides ``right`` and ``up``; it faces along their cross product."""
    right, up = np.array(right, float), np.array(up, float)
    normal = np.cross(right, up)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, up, normal / np.linalg.norm(normal), np.array(center, float)], -1)
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f(matrix), **rest}


def grid_mesh(folder: pathlib.Path, name: str, point: np.ndarray, bsdf: Dict, to_world: Any = None) -> Dict:
    """Return a smooth-shaded mesh over a grid of points ``(rows, columns, 3)``, whose last column joins its first."""
    rows, columns = point.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    nxt = np.roll(index, -1, 1)
    a, b, c, d = index[:-1].ravel(), index[1:].ravel(), nxt[1:].ravel(), nxt[:-1].ravel()
    triangles = np.concatenate([np.stack([a, d, c], -1), np.stack([a, c, b], -1)])
    flat = point.reshape(-1, 3)
    corner = np.cross(flat[triangles[:, 1]] - flat[triangles[:, 0]], flat[triangles[:, 2]] - flat[triangles[:, 0]])
    normal = np.zeros_like(flat)
    for k in range(3):
        np.add.at(normal, triangles[:, k], corner)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    path = folder / f"{name}.ply"
    write_ply(path, flat, normal, triangles)
    shape = {"type": "ply", "filename": str(path), "bsdf": {"type": "twosided", "bsdf": bsdf}}
    return shape | ({"to_world": to_world} if to_world is not None else {})


def lathe(profile: list[tuple[float, float]], sides: int = 48, repeat: int = 4) -> np.ndarray:
    """Return points of a profile of (radius, height) turned about z: ``repeat`` per piece, two close to its ends."""
    points = np.array(profile, float)
    steps = [points[0]]
    for a, b in itertools.pairwise(points):
        edge = min(0.1, 0.0006 / max(float(np.linalg.norm(b - a)), 1e-9))
        steps += [a + (b - a) * t for t in (edge, *np.linspace(0, 1, repeat)[1:-1], 1 - edge)]
    radius, height = np.array([*steps, points[-1]]).T
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.concatenate(
        [radius[:, None, None] * ring, np.broadcast_to(height[:, None, None], (len(radius), sides, 1))], -1
    )


def spline(points: list[tuple[float, ...]], steps: int = 24) -> np.ndarray:
    """Return points of the Catmull-Rom curve through ``points``, ``(n, 3)``."""
    p = np.array(points, float)
    p = np.concatenate([2 * p[:1] - p[1:2], p, 2 * p[-1:] - p[-2:-1]])
    t = np.linspace(0, 1, steps, endpoint=False)[:, None]
    spans = [
        0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        for a, b, c, d in zip(p[:-3], p[1:-2], p[2:-1], p[3:], strict=True)
    ]
    return np.concatenate([*spans, p[-2:-1]])


def tube(path: np.ndarray, radius: float, sides: int = 16) -> np.ndarray:
    """Return the points of a tube's rings along ``path`` ``(n, 3)``; a point closes each end."""
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    side = np.cross(along, np.where(np.abs(along[:, 2:3]) > 0.9, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]]))
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    up = np.cross(side, along)
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * up[:, None]
    rings = path[:, None] - radius * ring
    cap = lambda k: np.broadcast_to(path[k], (1, sides, 3))  # noqa: E731
    return np.concatenate([cap(0), rings, cap(-1)])


def rgb(value: Any) -> Dict:
    return {"type": "rgb", "value": [float(v) for v in np.broadcast_to(value, 3)]}


def matte(color: Any) -> Dict:
    return {"type": "diffuse", "reflectance": color if isinstance(color, dict) else rgb(color)}


def glossy(color: Any, roughness: float, metallic: float = 0.0, specular: float = 0.5) -> Dict:
    color = color if isinstance(color, dict) else rgb(color)
    return {
        "type": "principled",
        "base_color": color,
        "roughness": roughness,
        "metallic": metallic,
        "specular": specular,
    }


def mirror(color: Any) -> Dict:
    return {"type": "conductor", "material": "none", "specular_reflectance": rgb(color)}


def texture(image: np.ndarray, filtering: str = "bilinear") -> Dict:
    """Return Mitsuba's texture of a linear RGB image; row 0 is at the top of the quad that it covers."""
    data = mi.Bitmap(np.ascontiguousarray(image[::-1], np.float32))
    return {"type": "bitmap", "bitmap": data, "raw": True, "filter_type": filtering, "wrap_mode": "clamp"}


def noise(rng: np.random.Generator, height: int, width: int, cells: tuple[int, int], octaves: int = 4) -> np.ndarray:
    """Return a sum of ever finer smooth noise, about -1 to 1; ``cells`` is the coarsest grid (rows, columns)."""
    total = np.zeros((height, width), np.float32)
    for k in range(octaves):
        shape = (min(cells[0] << k, height) + 1, min(cells[1] << k, width) + 1)
        coarse = rng.uniform(-1, 1, shape).astype(np.float32)
        total += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC) / 2**k
    return total
