"""Float64 twins of ``kernels/rays/area_lights.py``, and closed forms of what areas send to a point."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

LEAST_SOLID_ANGLE, MOST_SOLID_ANGLE = 1.0e-2, 6.2
NEARLY = 1.0 - 1.0e-4


def unit(v: Array) -> Array:
    """Vectors of length 1."""
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def dot(a: Array, b: Array) -> Array:
    """Of the last axes, kept."""
    return (a * b).sum(axis=-1, keepdims=True)


def solid_angle(a: Array, b: Array, c: Array) -> Array:
    """Of triangles of unit directions, (n, 1), by the sum of their angles: another formula than the kernel's."""

    def corner(p: Array, q: Array, r: Array) -> Array:
        first, second = np.cross(p, q), np.cross(p, r)
        return np.arctan2(np.linalg.norm(np.cross(first, second), axis=-1, keepdims=True), dot(first, second))

    return corner(a, b, c) + corner(b, c, a) + corner(c, a, b) - np.pi


def sample_spherical_triangle(a: Array, b: Array, c: Array, angle: Array, u: Array, v: Array) -> Array:
    """[Arv95] as in the kernel's module, (n, 3); u and v are (n, 1)."""
    first, second = np.cross(a, b), np.cross(a, c)
    at_a = np.arctan2(np.linalg.norm(np.cross(first, second), axis=-1, keepdims=True), dot(first, second))
    s, t = np.sin(u * angle - at_a), np.cos(u * angle - at_a)
    p, q = t - np.cos(at_a), s + np.sin(at_a) * dot(a, b)
    cos_b = np.clip(((q * t - p * s) * np.cos(at_a) - q) / ((q * s + p * t) * np.sin(at_a)), -1.0, 1.0)
    toward_c = cos_b * a + np.sqrt(1.0 - cos_b**2) * unit(c - dot(c, a) * a)
    z = 1.0 - v * (1.0 - dot(toward_c, b))
    return unit(z * b + np.sqrt(1.0 - z**2) * unit(toward_c - dot(toward_c, b) * b))


def draw_on_triangle(corners: Array, points: Array, u: Array, v: Array) -> tuple[Array, Array, Array]:
    """Direction (n, 3), distance and solid angle (n, 1) that a place on a triangle (3, 3) stands for."""
    p, q, r = (corners[k] - points for k in range(3))
    across = np.cross(q - p, r - p)
    area = 0.5 * np.linalg.norm(across, axis=-1, keepdims=True)
    height = -dot(unit(across), p)
    angle = solid_angle(unit(p), unit(q), unit(r))
    by_angle = sample_spherical_triangle(unit(p), unit(q), unit(r), angle, u, v)
    root = np.sqrt(u)
    met = (1.0 - root) * p + root * (1.0 - v) * q + root * v * r
    far = np.linalg.norm(met, axis=-1, keepdims=True)
    spherical = (angle > LEAST_SOLID_ANGLE) & (angle < MOST_SOLID_ANGLE)
    wi = np.where(spherical, by_angle, met / far)
    distance = np.where(spherical, -height / dot(unit(across), by_angle), far)
    measure = np.where(spherical, angle, area * np.abs(height) / far**3)
    return wi, distance, measure


def polygon_irradiance(corners: Array, point: Array, normal: Array) -> float:
    """Irradiance by an even polygon of radiance 1, all of it before the surface (Lambert 1760): a sum over edges."""
    directions = unit(corners - point)
    total = 0.0
    for a, b in zip(directions, np.roll(directions, -1, axis=0), strict=True):
        total += np.arccos(np.clip(a @ b, -1.0, 1.0)) * float(unit(np.cross(a, b)) @ normal)
    return abs(0.5 * total)


def sphere_irradiance(radius: float, center: Array, point: Array, normal: Array) -> float:
    """Irradiance by a sphere of radiance 1, all of it before the surface: pi (r / d)^2 cos."""
    away = center - point
    square = float(away @ away)
    return float(np.pi * radius**2 / square * (away @ normal) / np.sqrt(square))


def disk_irradiance(radius: float, height: float, aside: float) -> float:
    """Irradiance of a plane by a disk of radiance 1 parallel to it, from ``aside`` of its axis (Foote 1915)."""
    square = radius**2 + height**2 + aside**2
    root = np.sqrt(square**2 - 4.0 * radius**2 * aside**2)
    return float(0.5 * np.pi * (1.0 - (height**2 + aside**2 - radius**2) / root))
