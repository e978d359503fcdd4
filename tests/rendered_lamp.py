"""A desk with mirror balls under a lamp nearby, rendered in float64, and the light anywhere on it.

The lamp is a ball of one radiance above the desk's left half, the room behind it nearly dark: what a mirror ball shows
depends on where it stands. The desk is matt. Balls are not mirrored in each other, and throw no shadow.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ball = tuple[tuple[float, float, float], float, float]
"""Centre, radius, reflectance."""


@dataclasses.dataclass(frozen=True)
class Desk:
    """What there is; metres, the desk is z = 0."""

    lamp_at: tuple[float, float, float] = (-0.2, -0.15, 0.34)
    lamp_radius: float = 0.1
    lamp: float = 1.1
    albedo: tuple[float, float, float] = (0.5, 0.4, 0.3)
    room: tuple[float, float, float] = (0.04, 0.05, 0.07)


def _lamp_irradiance(desk: Desk, points: Array, normals: Array) -> Array:
    """Of a sphere above the horizon of a surface: pi L (R / d)^2 cos, (n,)."""
    toward = np.array(desk.lamp_at) - points
    squared = (toward * toward).sum(-1)
    cosine = (toward * normals).sum(-1) / np.sqrt(squared)
    return np.asarray(math.pi * desk.lamp * desk.lamp_radius**2 / squared * np.maximum(cosine, 0.0), float)


def radiance(desk: Desk, origins: Array, directions: Array) -> Array:
    """Linear RGB along rays (n, 3) of unit direction, balls left out."""
    o, d = np.broadcast_arrays(origins, directions)
    out = np.broadcast_to(np.array(desk.room), d.shape).copy()
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -o[:, 2] / d[:, 2]
    down = (d[:, 2] < 0.0) & (t > 0.0)
    points = o[down] + t[down, None] * d[down]
    up = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    direct = _lamp_irradiance(desk, points, up)
    out[down] = np.array(desk.albedo) / math.pi * (direct[:, None] + math.pi * np.array(desk.room))
    off = o - np.array(desk.lamp_at)
    along = (off * d).sum(-1)
    seen = (along < 0.0) & (along**2 - (off * off).sum(-1) + desk.lamp_radius**2 > 0.0)
    out[seen] = desk.lamp
    return out


def picture(desk: Desk, eye: Array, rays: Array, balls: list[Ball]) -> Array:
    """Linear RGB along rays (h, w, 3) from ``eye``, the nearest ball mirroring."""
    d = rays.reshape(-1, 3) / np.linalg.norm(rays.reshape(-1, 3), axis=-1, keepdims=True)
    out = radiance(desk, np.broadcast_to(eye, d.shape), d)
    nearest = np.full(len(d), np.inf)
    for center, radius, reflectance in balls:
        o = eye - np.array(center)
        along = d @ o
        under = along**2 - o @ o + radius**2
        t = -along - np.sqrt(np.maximum(under, 0.0))
        hit = (under > 0.0) & (t > 0.0) & (t < nearest)
        nearest[hit] = t[hit]
        points = eye + t[hit, None] * d[hit]
        n = (points - np.array(center)) / radius
        mirrored = d[hit] - 2.0 * (d[hit] * n).sum(-1, keepdims=True) * n
        out[hit] = reflectance * radiance(desk, points, mirrored)
    return out.reshape(rays.shape)


def irradiance(desk: Desk, points: Array, normals: Array, count: int = 2048) -> Array:
    """RGB that surfaces (n, 3) receive, (n, 3): the lamp in closed form, the rest by a cosine-weighted sum."""
    k = np.arange(count) + 0.5
    u, turn = k / count, k * math.pi * (3.0 - math.sqrt(5.0))
    local = np.column_stack([np.sqrt(u) * np.cos(turn), np.sqrt(u) * np.sin(turn), np.sqrt(1.0 - u)])
    dark = dataclasses.replace(desk, lamp_radius=0.0)
    out = np.empty_like(points)
    for index, (point, normal) in enumerate(zip(points, normals, strict=True)):
        x = np.cross(normal, [1.0, 0.0, 0.0] if abs(normal[0]) < 0.6 else [0.0, 1.0, 0.0])
        x /= np.linalg.norm(x)
        directions = local @ np.stack([x, np.cross(normal, x), normal])
        down = directions[:, 2] < 0.0
        rest = radiance(dark, np.broadcast_to(point, directions.shape), directions)
        # The desk under this point has the lamp's light, though the lamp itself is not among what is summed.
        rest[down] = radiance(desk, np.broadcast_to(point, directions[down].shape), directions[down])
        out[index] = math.pi * rest.mean(0)
    return out + _lamp_irradiance(desk, points, normals)[:, None]
