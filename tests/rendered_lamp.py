"""A desk with mirror balls under a lamp nearby, rendered in float64, and the light anywhere on it.

The lamp is a ball of one radiance above the desk's left half, the room behind it nearly dark: what a mirror ball shows
depends on where it stands. The desk is matt, and a printed card may lie at the origin. Balls are not mirrored in each
other, here as in what is taken to be true, and throw the lamp's shadow and mirror the lamp onto the desk only where a
desk is told of them.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import cv2
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
    card: float = 0.0
    """Side of the black square of marker 0 of DICT_4X4_50; 0: there is no card."""
    white: float = 0.85
    ink: float = 0.04
    balls: tuple[Ball, ...] = ()
    """What stands between lamp and desk."""


SHADOW = 64
"""Points of the lamp that a shadow is found by: a share of it is known to a hundredth."""
PAPER = 1.5
"""Side of the card's paper, over that of its black square."""


@functools.cache
def _print() -> NDArray[np.uint8]:
    pattern = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 0, 120)
    return np.pad(np.asarray(pattern, np.uint8), 30, constant_values=255)


def _albedo(desk: Desk, points: Array) -> Array:
    """Of the desk and the card on it, (n, 3)."""
    out = np.broadcast_to(np.array(desk.albedo), points.shape).copy()
    half = 0.5 * PAPER * desk.card
    on = np.abs(points[:, :2]).max(-1) < half
    cells = len(_print())
    j, i = ((0.5 * (s * points[on, k] / max(half, 1e-9) + 1.0) * cells).astype(int) for k, s in ((0, 1), (1, -1)))
    out[on] = np.where(_print()[np.minimum(i, cells - 1), np.minimum(j, cells - 1)] > 0, desk.white, desk.ink)[:, None]
    return out


def _lit_share(desk: Desk, points: Array) -> Array:
    """Share of the lamp that points of the desk see past the balls, (n,)."""
    seen = np.ones((len(points), SHADOW), bool)
    k = np.arange(SHADOW) + 0.5
    ring, turn = np.sqrt(k / SHADOW), k * math.pi * (3.0 - math.sqrt(5.0))
    # The disk that the lamp is from below; from the side it is a little too narrow.
    lamp = np.array(desk.lamp_at) + desk.lamp_radius * np.column_stack(
        [ring * np.cos(turn), ring * np.sin(turn), 0 * k]
    )
    for center, radius, _ in desk.balls:
        # Only what lies near the line from the lamp through the ball.
        away, toward = points - np.array(desk.lamp_at), np.array(center) - np.array(desk.lamp_at)
        along = away @ toward / (toward @ toward)
        near = np.flatnonzero(
            np.linalg.norm(away - along[:, None] * toward, axis=-1) < (radius + desk.lamp_radius) * (1.0 + 2.0 * along)
        )
        d = lamp - points[near, None]
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        b = ((np.array(center) - points[near, None]) * d).sum(-1)
        square = ((np.array(center) - points[near]) ** 2).sum(-1)[:, None]
        seen[near] &= (b < 0.0) | (square - b * b > radius**2)
    return np.asarray(seen.mean(-1), float)


def _lamp_irradiance(desk: Desk, points: Array, normals: Array) -> Array:
    """Of a sphere above the horizon of a surface: pi L (R / d)^2 cos, (n,)."""
    toward = np.array(desk.lamp_at) - points
    squared = (toward * toward).sum(-1)
    cosine = (toward * normals).sum(-1) / np.sqrt(squared)
    return np.asarray(math.pi * desk.lamp * desk.lamp_radius**2 / squared * np.maximum(cosine, 0.0), float)


def mirrored_irradiance(desk: Desk, points: Array) -> Array:
    """Of the desk at points (n, 3) by the lamp's light that balls mirror, the lamp small: a point, (n,).

    In the plane through lamp L, ball C and point, angles at C from CL: a ray leaves L at alpha(phi), meets the ball of
    radius R at phi, its angle of incidence i = phi + alpha, and goes on toward psi = 2 phi + alpha. It passes the point
    (rho, theta), where rho sin(psi - theta) = R sin i. With s from ball to point the flux of a tube of rays is spread
    over rho sin(theta) (R cos(i) + s (2 + alpha')) dphi, where alpha' = R (D cos(phi) - R) / (D^2 + R^2 - 2 D R
    cos(phi)) is dalpha/dphi and D = |CL|: irradiance of a surface that faces the ray is

        I sin(alpha) alpha' / (rho sin(theta) (R cos(i) + s (2 + alpha'))).
    """
    out = np.zeros(len(points))
    for center, radius, reflectance in desk.balls:
        to_lamp, to_point = np.array(desk.lamp_at) - np.array(center), points - np.array(center)
        far, rho = float(np.linalg.norm(to_lamp)), np.linalg.norm(to_point, axis=-1)
        axis = to_lamp / far
        across = to_point - np.outer(to_point @ axis, axis)
        theta = np.arctan2(np.maximum(np.linalg.norm(across, axis=-1), 1e-9 * radius), to_point @ axis)
        across /= np.linalg.norm(across, axis=-1, keepdims=True) + 1e-30

        def leaving(phi: Array, far: float = far, radius: float = radius) -> Array:
            """Angle alpha."""
            return np.arctan2(radius * np.sin(phi), far - radius * np.cos(phi))

        grazing = math.acos(radius / far)
        low, high = np.zeros(len(points)), np.minimum(theta, grazing)
        for _ in range(50):  # psi grows with phi; the mirrored ray of phi = 0 passes on the axis' side
            middle = 0.5 * (low + high)
            incidence = middle + leaving(middle)
            inside = rho * np.sin(np.minimum(theta - incidence - middle, 0.5 * math.pi)) > -radius * np.sin(incidence)
            low, high = np.where(inside, middle, low), np.where(inside, high, middle)
        phi = 0.5 * (low + high)
        alpha = leaving(phi)
        incidence = phi + alpha
        place = radius * (np.cos(phi)[:, None] * axis + np.sin(phi)[:, None] * across)
        ray = to_point - place
        s = np.linalg.norm(ray, axis=-1)
        turned = radius * (far * np.cos(phi) - radius) / (far**2 + radius**2 - 2.0 * far * radius * np.cos(phi))
        width = rho * np.sin(theta) * (radius * np.cos(incidence) + s * (2.0 + turned))
        intensity = reflectance * desk.lamp * math.pi * desk.lamp_radius**2
        shown = (rho > radius) & (phi < grazing - 1e-6)
        # The other root of the equation, behind the ball, is no ray.
        shown &= (ray * place).sum(-1) > 0.0
        given = intensity * np.sin(alpha) * turned / width * np.maximum(-ray[:, 2] / s, 0.0)
        out[shown] += given[shown]
    return out


def radiance(desk: Desk, origins: Array, directions: Array) -> Array:
    """Linear RGB along rays (n, 3) of unit direction, balls left out."""
    o, d = np.broadcast_arrays(origins, directions)
    out = np.broadcast_to(np.array(desk.room), d.shape).copy()
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -o[:, 2] / d[:, 2]
    down = (d[:, 2] < 0.0) & (t > 0.0)
    points = o[down] + t[down, None] * d[down]
    up = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    direct = _lamp_irradiance(desk, points, up) * _lit_share(desk, points) + mirrored_irradiance(desk, points)
    out[down] = _albedo(desk, points) / math.pi * (direct[:, None] + math.pi * np.array(desk.room))
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
