"""A room with a mirror ball on a table, rendered in float64: photographs whose light, ball and camera are known.

The room is a box with textured walls, lamps and a window; rays are traced to it from where they start, so that near
walls shift as they do in a real room. The table scatters the room's irradiance; the ball stands on it, or on a stand.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
from numpy.typing import NDArray

from warp_ar.calibration.card import PAPERS, draw_card
from warp_ar.tracking import card_layout

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Room:
    """What stands where; metres, the table's top is z = 0 and the ball's foot is the origin."""

    seed: int = 0
    half: tuple[float, float, float] = (2.2, 1.8, 1.7)
    floor: float = -0.75
    table: tuple[float, float] = (0.5, 0.4)
    radius: float = 0.04
    lift: float = 0.0
    """Height of the ball's lowest point above the table: that of its stand."""
    reflectance: float = 0.8
    lamp: float = 40.0
    window: float = 6.0
    wall: float = 0.5
    card: bool = False
    """The printed card on the table, with the ball on its cross."""

    @property
    def center(self) -> Array:
        """The ball's centre."""
        return np.array([0.0, 0.0, self.lift + self.radius])


def _noise(seed: int, u: Array, v: Array) -> Array:
    """Smooth noise, 0 to 1, with a grain of about one unit."""
    grid = np.random.default_rng(seed).random((64, 64))
    i, j = np.floor(v).astype(int), np.floor(u).astype(int)
    a, b = v - i, u - j
    top = grid[i % 64, j % 64] * (1 - b) + grid[i % 64, (j + 1) % 64] * b
    low = grid[(i + 1) % 64, j % 64] * (1 - b) + grid[(i + 1) % 64, (j + 1) % 64] * b
    return np.asarray(top * (1 - a) + low * a, float)


def room_radiance(room: Room, origin: Array, direction: Array) -> Array:
    """Linear RGB that arrives along rays from the room's walls, (n, 3)."""
    hx, hy, top = room.half
    lo, hi = np.array([-hx, -hy, room.floor]), np.array([hx, hy, top])
    with np.errstate(divide="ignore", invalid="ignore"):
        far = np.where(direction > 0, (hi - origin) / direction, (lo - origin) / direction)
    far = np.where(np.isfinite(far), far, 1e9)
    axis = far.argmin(1)
    p = origin + far[np.arange(len(far)), axis][:, None] * direction
    side = direction[np.arange(len(far)), axis] > 0
    u = np.where(axis == 0, p[:, 1], p[:, 0])
    v = np.where(axis == 2, p[:, 1], p[:, 2])
    face = 2 * axis + side
    tint = np.random.default_rng(room.seed + 5).uniform(0.5, 1.0, (6, 3))[face]
    grain = 0.6 + 0.5 * _noise(room.seed + 1, 3 * u + 7 * face, 3 * v) + 0.2 * _noise(room.seed + 2, 23 * u, 23 * v)
    shelf = np.where((np.sin(5 * u) > 0.6) & (np.sin(9 * v + face) > 0.2), 0.25, 1.0)
    light = room.wall * tint * (grain * shelf)[:, None] * np.where(axis == 2, 0.7, 1.0)[:, None]
    ceiling = (axis == 2) & side
    lamps = ceiling & (np.abs(np.mod(u, 1.6) - 0.8) < 0.12) & (np.abs(np.mod(v, 1.8) - 0.9) < 0.3)
    light = np.where(lamps[:, None], room.lamp * np.array([1.0, 0.9, 0.75]), light)
    window = (axis == 1) & side & (np.abs(u - 0.5) < 0.5) & (np.abs(v - 0.5) < 0.4)
    bars = (np.abs(np.mod(u, 0.5) - 0.25) < 0.02) | (np.abs(v - 0.5) < 0.02)
    return np.where((window & ~bars)[:, None], room.window * np.array([0.8, 0.95, 1.2]), light)


def _scene_radiance(room: Room, origin: Array, direction: Array, irradiance: Array) -> Array:
    """What a ray that misses the ball shows: the stand, the table, the room."""
    out = room_radiance(room, origin, direction)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -origin[:, 2] / direction[:, 2]
    p = origin + np.where(np.isfinite(t), t, 0.0)[:, None] * direction
    on = (t > 1e-9) & np.isfinite(t) & (np.abs(p[:, 0]) < room.table[0]) & (np.abs(p[:, 1]) < room.table[1])
    wood = (
        0.25
        + 0.3 * _noise(room.seed + 3, 60 * p[:, 0], 9 * p[:, 1])
        + 0.1 * _noise(room.seed + 4, 500 * p[:, 0], 70 * p[:, 1])
    )
    near = np.hypot(p[:, 0], p[:, 1]) / room.radius
    open_sky = 1.0 - 0.7 / (1.0 + near**2)
    paint = wood[:, None] * np.array([0.9, 0.65, 0.45])
    if room.card:
        card = _card_reflectance(np.where(on[:, None], p, 1e3))
        paint = np.where(np.isnan(card)[:, None], paint, card[:, None])
    table = paint * open_sky[:, None] * irradiance / math.pi
    out = np.where(on[:, None], table, out)
    if room.lift > 0.0:
        # A cylinder, half as wide as the ball.
        r = 0.5 * room.radius
        a = (direction[:, :2] ** 2).sum(1)
        b = (origin[:, :2] * direction[:, :2]).sum(1)
        disc = b * b - a * ((origin[:, :2] ** 2).sum(1) - r * r)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = (-b - np.sqrt(np.maximum(disc, 0.0))) / a
        z = origin[:, 2] + s * direction[:, 2]
        hit = (disc > 0) & (s > 1e-9) & (z > 0) & (z < room.lift + 0.3 * room.radius)
        out = np.where(hit[:, None], 0.03 * irradiance / math.pi, out)
    return out


@functools.cache
def _sheet(per_metre: int = 4000) -> tuple[NDArray[np.uint8], int]:
    """The card's print, 255 where it is white, and pixels per metre."""
    size = tuple(length / 1e3 for length in PAPERS["a4"])
    return card_layout.draw_page(size, per_metre, draw_card(card_layout.CARD_MARKER, per_metre)), per_metre


def _card_reflectance(p: Array) -> Array:
    """Reflectance of the card at points of the table, NaN beside it; its board lies before the ball."""
    page, scale = _sheet()
    middle = np.array([page.shape[1] / 2, scale * card_layout.board_top(page.shape[0] / scale)])
    x, y = np.moveaxis(middle + scale * (p[..., :2] + card_layout.BALL_PLACE) * (1, -1), -1, 0)
    on = (x >= 0) & (x < page.shape[1]) & (y >= 0) & (y < page.shape[0])
    ink = page[np.where(on, y, 0).astype(int), np.where(on, x, 0).astype(int)]
    return np.where(on, 0.05 + 0.8 * ink / 255.0, np.nan)


def table_irradiance(room: Room, count: int = 4096) -> Array:
    """Irradiance (3,) on the table, without the ball."""
    rng = np.random.default_rng(9)
    u, v = rng.random(count), 2 * np.pi * rng.random(count)
    d = np.column_stack([np.sqrt(u) * np.cos(v), np.sqrt(u) * np.sin(v), np.sqrt(1 - u)])
    return math.pi * room_radiance(room, np.tile([0.0, 0.0, 1e-3], (count, 1)), d).mean(0)


def radiance_along(room: Room, origin: Array, direction: Array, irradiance: Array) -> Array:
    """Linear RGB along rays (n, 3) from points (n, 3), the ball among what they can meet."""
    o = origin - room.center
    b = (o * direction).sum(1)
    disc = b * b - (o * o).sum(1) + room.radius**2
    t = -b - np.sqrt(np.maximum(disc, 0.0))
    hit = (disc > 0) & (t > 0)
    out = np.empty_like(direction)
    out[~hit] = _scene_radiance(room, origin[~hit], direction[~hit], irradiance)
    p = origin[hit] + t[hit, None] * direction[hit]
    n = (p - room.center) / room.radius
    d = direction[hit]
    r = d - 2 * (d * n).sum(1)[:, None] * n
    out[hit] = room.reflectance * _scene_radiance(room, p, r, irradiance)
    return out


def look_at(eye: Array, target: Array, roll: float = 0.0) -> tuple[Array, Array]:
    """(R, t), camera_from_world, of a camera at ``eye``; OpenCV's axes; ``roll`` in degrees."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    c, s = math.cos(math.radians(roll)), math.sin(math.radians(roll))
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ rotation
    return rotation, -rotation @ eye


def render(
    room: Room, matrix: Array, pose: tuple[Array, Array], size: tuple[int, int], samples: int = 3, band: int = 64
) -> NDArray[np.float32]:
    """Linear photograph, (height, width, 3), box-filtered over pixels."""
    width, height = size
    rotation, translation = pose
    eye = -rotation.T @ translation
    irradiance = table_irradiance(room)
    sub = (np.arange(samples) + 0.5) / samples - 0.5
    out = np.empty((height, width, 3), np.float32)
    for top in range(0, height, band):
        rows = np.arange(top, min(top + band, height))
        y = (rows[:, None] + sub).reshape(-1)
        x = (np.arange(width)[:, None] + sub).reshape(-1)
        gx, gy = np.meshgrid((x - matrix[0, 2]) / matrix[0, 0], (y - matrix[1, 2]) / matrix[1, 1])
        d = np.stack([gx, gy, np.ones_like(gx)], -1).reshape(-1, 3)
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        light = radiance_along(room, np.broadcast_to(eye, d.shape), d @ rotation, irradiance)
        out[rows] = light.reshape(len(rows), samples, width, samples, 3).mean((1, 3))
    return out


def true_environment(room: Room, height: int = 64, samples: int = 3) -> Array:
    """Latlong light at the ball's centre, (height, 2 height, 3), as the scene format has it."""
    n = height * samples
    theta = (np.arange(n) + 0.5) * math.pi / n
    phi = (np.arange(2 * n) + 0.5) * math.pi / n - math.pi
    t, p = np.meshgrid(theta, phi, indexing="ij")
    d = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], -1).reshape(-1, 3)
    light = _scene_radiance(room, np.broadcast_to(room.center, d.shape), d, table_irradiance(room))
    return light.reshape(height, samples, 2 * height, samples, 3).mean((1, 3))
