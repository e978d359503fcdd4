"""Renderer of a table with a mirror ball, boxes, lamps and an environment, in NumPy alone, independent of the program.

The light comes from an environment at infinity and from small spheres. Surfaces are Lambertian. ``World.irradiance``
sums the light that they receive: from lamps, and from 2,048 directions, in each of which the environment, the table, a
box, or a reflection in the ball is visible. Table and boxes are lit by ``BOUNCES`` interreflections. A picture is
traced with one reflection in the ball.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
COARSE = (32, 64)
"""Rows and columns of the map of directions from which surfaces are lit."""
FINE = (256, 512)
"""Rows and columns of the environment map that pictures show."""
BOUNCES = 2
"""Number of interreflections between surfaces."""
REMAP_MOST = 30_000
"""Largest number of rows that ``cv2.remap`` accepts."""


def latlong_directions(rows: int, columns: int) -> tuple[Array, Array]:
    """Return unit directions (rows, columns, 3) and solid angles (rows, columns) of a latlong map's texels.

    Row 0 is near +z; the middle columns are toward +x.
    """
    theta = (np.arange(rows) + 0.5) / rows * np.pi
    phi = ((np.arange(columns) + 0.5) / columns * 2.0 - 1.0) * np.pi
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    d = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    return d, np.sin(theta) * (np.pi / rows) * (2.0 * np.pi / columns)


def sample(image: NDArray[np.float32], x: Array, y: Array, border: int = cv2.BORDER_REPLICATE) -> Array:
    """Return bilinear samples of an image at pixel coordinates (k,), (k, channels)."""
    at = [np.asarray(v, np.float32).reshape(-1, 1) for v in (x, y)]
    parts = [
        cv2.remap(image, at[0][i : i + REMAP_MOST], at[1][i : i + REMAP_MOST], cv2.INTER_LINEAR, borderMode=border)
        for i in range(0, len(at[0]), REMAP_MOST)
    ]
    return np.concatenate(parts).reshape(len(at[0]), -1).astype(float)


def look_up(environment: NDArray[np.float32], d: Array) -> Array:
    """Return the radiance of an environment from directions (k, 3), (k, 3)."""
    rows, columns = environment.shape[:2]
    y = np.clip(np.arccos(np.clip(d[:, 2], -1.0, 1.0)) / np.pi * rows - 0.5, 0.0, rows - 1.0)
    x = (np.arctan2(d[:, 1], d[:, 0]) / np.pi + 1.0) / 2.0 * columns + 0.5
    return sample(np.concatenate([environment[:, -1:], environment, environment[:, :1]], 1), x, y)


def sphere_distance(center: Array, radius: float, origin: Array, d: Array) -> Array:
    """Return the distance along rays with unit directions d to a sphere that they enter; infinite if they miss it."""
    to_center = center - origin
    along = (to_center * d).sum(-1)
    within = radius**2 - (to_center**2).sum(-1) + along**2
    t = along - np.sqrt(np.maximum(within, 0.0))
    return np.where((within > 0.0) & (t > 1e-5), t, np.inf)


@dataclasses.dataclass
class Block:
    """Box that stands on the table."""

    at: Array
    """Centre, metres, (3,)."""
    size: Array
    """Sides, metres, (3,)."""
    turn: float
    """Rotation about the vertical, degrees."""
    color: Array
    """Reflectance, RGB."""
    modelled: bool
    """True if the scene file contains the box."""

    @property
    def rotation(self) -> Array:
        """``world_from_block``."""
        c, s = np.cos(np.radians(self.turn)), np.sin(np.radians(self.turn))
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def distance(self, origin: Array, d: Array) -> tuple[Array, NDArray[np.int64]]:
        """Return the distance along rays to the box, infinite if they miss it, and the index of the face they hit."""
        o, d = (origin - self.at) @ self.rotation, d @ self.rotation
        inverse = 1.0 / np.where(np.abs(d) < 1e-9, 1e-9, d)
        a, b = (-self.size / 2 - o) * inverse, (self.size / 2 - o) * inverse
        # NumPy reduces over an axis of length three several times as slowly as over three separate arrays.
        low, high = (tuple(np.moveaxis(both(a, b), -1, 0)) for both in (np.minimum, np.maximum))
        enters = np.maximum(np.maximum(low[0], low[1]), low[2])
        leaves = np.minimum(np.minimum(high[0], high[1]), high[2])
        axis = np.where(low[0] == enters, 0, np.where(low[1] == enters, 1, 2))
        toward = np.where(axis == 0, d[..., 0], np.where(axis == 1, d[..., 1], d[..., 2]))
        hit = (enters < leaves) & (enters > 1e-5)
        return np.where(hit, enters, np.inf), axis * 2 + (toward < 0.0)


@dataclasses.dataclass
class Bulb:
    """Lamp: a sphere that emits light."""

    at: Array
    """Centre, metres, (3,)."""
    radius: float
    """Radius, metres."""
    radiance: Array
    """Radiance, RGB."""


@dataclasses.dataclass
class Card:
    """Printed marker at the origin."""

    print: NDArray[np.uint8]
    """Picture of the print; 0 is ink."""
    half: float
    """Half the side of the card, metres."""
    white: Array
    """Reflectance of the paper, RGB."""
    ink: float
    """Reflectance of ink."""


class World:
    """Table at z = 0 with all objects on it and its environment; radiance is in the environment's units."""

    def __init__(
        self,
        environment: NDArray[np.float32],
        ball: tuple[Array, float, float],
        blocks: list[Block],
        bulbs: list[Bulb],
        table: tuple[NDArray[np.float32], Array],
        card: Card | None,
    ) -> None:
        """Compute the light that surfaces receive.

        Args:
            environment: Latlong radiance, of the size ``FINE``.
            ball: Centre, radius and reflectance.
            blocks: Boxes.
            bulbs: Lamps.
            table: Reflectance of the table, a square picture, and half its sides in metres, (2,).
            card: Card on the table, or None.
        """
        self.environment, self.blocks, self.bulbs, self.card = environment, blocks, bulbs, card
        self.center, self.radius, self.reflectance = ball
        self.texture, self.half = table
        d, area = latlong_directions(*FINE)
        rows, columns = COARSE

        def coarse(image: Array) -> Array:
            return (
                image.reshape(rows, FINE[0] // rows, columns, FINE[1] // columns, -1)
                .sum((1, 3))
                .reshape(rows * columns, -1)
            )

        self.area = coarse(area[..., None])[:, 0]
        self.radiance = coarse(environment * area[..., None]) / self.area[:, None]
        bright = coarse(d * ((environment.mean(-1) + 1e-6) * area)[..., None])
        self.direction = bright / np.linalg.norm(bright, axis=1, keepdims=True)
        self.small = self.radiance.reshape(rows, columns, 3).astype(np.float32)
        self._choose_lines()
        lines = [len(line) for line in self.lines]
        self.table_light = np.zeros((lines[1], lines[0], 3), np.float32)
        self.faces = [[np.zeros((5, 5, 3), np.float32)] * 6 for _ in blocks]
        for _ in range(BOUNCES + 1):
            self.bounced = self.texture.mean((0, 1)) * self.table_light.mean((0, 1)) / np.pi
            table = self._light_table()
            self.faces = [[self._light_face(block, face) for face in range(6)] for block in blocks]
            self.table_light = table

    def _choose_lines(self) -> None:
        """Choose the lines of a grid on which the table's light is computed; they are closer around the ball."""
        far = np.geomspace(0.012, 2.0, 16)
        near, even = np.concatenate([-far[::-1], [0.0], far]), np.arange(-0.4, 0.41, 0.05)
        self.lines = [
            np.unique(np.round(np.concatenate([np.clip(near + self.center[k], -2.4, 2.4), even]), 3)) for k in (0, 1)
        ]

    def _light_table(self) -> NDArray[np.float32]:
        """Return the irradiance of the table at the points of its grid."""
        grid = np.stack(np.meshgrid(*self.lines, indexing="xy"), -1)
        points = np.concatenate([grid, np.full((*grid.shape[:2], 1), 1e-4)], -1)
        lit = self.irradiance(points.reshape(-1, 3), np.array([0.0, 0.0, 1.0]))
        return lit.reshape(*grid.shape[:2], 3).astype(np.float32)

    def _light_face(self, block: Block, face: int) -> NDArray[np.float32]:
        """Return the irradiance at 5 x 5 points of a block's face."""
        axis, sign = face // 2, 1.0 if face % 2 else -1.0
        u, v = (axis + 1) % 3, (axis + 2) % 3
        steps = (np.arange(5) + 0.5) / 5 - 0.5
        local = np.zeros((5, 5, 3))
        local[..., axis] = sign * (block.size[axis] / 2 + 1e-4)
        local[..., u], local[..., v] = steps[:, None] * block.size[u], steps[None] * block.size[v]
        normal = sign * np.eye(3)[axis]
        lit = self.irradiance(local.reshape(-1, 3) @ block.rotation.T + block.at, block.rotation @ normal)
        return lit.reshape(5, 5, 3).astype(np.float32)

    def irradiance(self, points: Array, normal: Array) -> Array:
        """Return the irradiance at points (k, 3) with a common normal, (k, 3)."""
        cosine = self.direction @ normal
        use = cosine > 0.0
        weight = (self.area * cosine)[use]
        result = np.concatenate(
            [
                (self._arriving(points[low : low + 400, None], self.direction[None, use], use) * weight[:, None]).sum(1)
                for low in range(0, len(points), 400)
            ]
        )
        for bulb in self.bulbs:
            ray = bulb.at - points
            away = np.linalg.norm(ray, axis=1)
            d = ray / away[:, None]
            seen = sphere_distance(self.center, self.radius, points, d) > away
            for block in self.blocks:
                seen &= block.distance(points, d)[0] > away
            share = np.maximum(d @ normal, 0.0) * seen * np.pi * bulb.radius**2 / away**2
            result += share[:, None] * bulb.radiance
        return result

    def _arriving(self, origin: Array, d: Array, use: NDArray[np.bool_]) -> Array:
        """Return the radiance that arrives at points from the coarse directions ``use``, (points, directions, 3).

        Args:
            origin: Points, (points, 1, 3).
            d: Unit directions, (1, directions, 3).
            use: Mask of these directions among all coarse ones.
        """
        shape = (len(origin), d.shape[1])
        radiance = np.broadcast_to(self.radiance[use], (*shape, 3)).copy()
        nearest = np.full(shape, np.inf)
        down = d[..., 2] < -1e-3
        t = np.where(down, -origin[..., 2] / np.where(down, d[..., 2], -1.0), np.inf)
        at = origin + np.where(np.isfinite(t), t, 0.0)[..., None] * d
        on = np.isfinite(t) & (np.abs(at[..., :2]) < self.half).all(-1)
        if on.any():
            radiance[on], nearest[on] = self._table_radiance(at[on]), t[on]
        for block, faces in zip(self.blocks, self.faces, strict=True):
            t, face = block.distance(origin, d)
            on = t < nearest
            if on.any():
                o, v = np.broadcast_to(origin, radiance.shape)[on], np.broadcast_to(d, radiance.shape)[on]
                radiance[on] = _face_radiance(block, faces, o + t[on][:, None] * v, face[on])
            nearest = np.where(on, t, nearest)
        t = sphere_distance(self.center, self.radius, origin, d)
        on = t < nearest
        if on.any():
            o, v = np.broadcast_to(origin, radiance.shape)[on], np.broadcast_to(d, radiance.shape)[on]
            normal = (o + t[on][:, None] * v - self.center) / self.radius
            mirrored = v - 2.0 * (v * normal).sum(-1, keepdims=True) * normal
            thrown = look_up(self.small, mirrored)
            thrown[mirrored[:, 2] < 0.0] = 0.7 * self.bounced
            radiance[on] = self.reflectance * thrown
        return radiance

    def trace(self, origin: Array, d: Array, *, ball: bool = True) -> Array:
        """Return the radiance along rays with unit directions d (k, 3), (k, 3); the ball is visible if ``ball``."""
        origin = np.broadcast_to(origin, d.shape)
        radiance, nearest = look_up(self.environment, d), np.full(len(d), np.inf)
        for bulb in self.bulbs:
            t = sphere_distance(bulb.at, bulb.radius, origin, d)
            radiance[t < nearest] = bulb.radiance
            nearest = np.minimum(t, nearest)
        self._trace_table(origin, d, radiance, nearest)
        for block, faces in zip(self.blocks, self.faces, strict=True):
            t, face = block.distance(origin, d)
            on = np.flatnonzero(t < nearest)
            nearest[on] = t[on]
            radiance[on] = _face_radiance(block, faces, origin[on] + t[on][:, None] * d[on], face[on])
        if ball:
            t = sphere_distance(self.center, self.radius, origin, d)
            on = t < nearest
            at = origin[on] + t[on][:, None] * d[on]
            normal = (at - self.center) / self.radius
            mirrored = d[on] - 2.0 * (d[on] * normal).sum(-1, keepdims=True) * normal
            if on.any():
                radiance[on] = self.reflectance * self.trace(at, mirrored, ball=False)
        return radiance

    def _trace_table(self, origin: Array, d: Array, radiance: Array, nearest: Array) -> None:
        """Update radiance and distance of the rays that meet the table first."""
        down = d[:, 2] < -1e-6
        t = np.where(down, -origin[:, 2] / np.where(down, d[:, 2], -1.0), np.inf)
        at = origin + np.where(np.isfinite(t), t, 0.0)[:, None] * d
        on = (t < nearest) & (np.abs(at[:, :2]) < self.half).all(-1)
        if not on.any():
            return
        radiance[on] = self._table_radiance(at[on])
        nearest[on] = t[on]

    def _table_radiance(self, at: Array) -> Array:
        """Return the radiance of points on the table, (k, 3)."""
        x, y = (np.interp(at[:, k], self.lines[k], np.arange(len(self.lines[k]))) for k in (0, 1))
        return np.asarray(sample(self.table_light, x, y) * self._table_reflectance(at) / np.pi)

    def _table_reflectance(self, at: Array) -> Array:
        """Return the reflectance of points on the table or on its card, (k, 3)."""
        size = len(self.texture)
        place = (at[:, :2] / (2.0 * self.half) + 0.5) * size
        result = sample(self.texture, place[:, 0], place[:, 1], cv2.BORDER_REFLECT)
        if self.card is not None:
            on = np.abs(at[:, :2]).max(-1) < self.card.half
            cells = len(self.card.print)
            j, i = (
                np.clip((s * at[on, k] / self.card.half + 1) / 2 * cells, 0, cells - 1) for k, s in ((0, 1), (1, -1))
            )
            white = self.card.print[i.astype(int), j.astype(int)] > 0
            result[on] = np.where(white[:, None], self.card.white, self.card.ink)
        return result


def _face_radiance(block: Block, faces: list[NDArray[np.float32]], at: Array, face: NDArray[np.int64]) -> Array:
    """Return the radiance that points on a block's faces reflect, (k, 3): interpolated irradiance times albedo / pi.

    Args:
        block: The block, a box.
        faces: Irradiance at 5 x 5 points of each of its six faces.
        at: The points, (k, 3).
        face: Index of each point's face, (k,).
    """
    place = 5.0 * ((at - block.at) @ block.rotation / block.size + 0.5) - 0.5
    result = np.zeros((len(at), 3))
    for number in range(6):
        own = face == number
        if own.any():
            u, v = (number // 2 + 1) % 3, (number // 2 + 2) % 3
            result[own] = sample(faces[number], place[own, v], place[own, u]) * block.color / np.pi
    return result
