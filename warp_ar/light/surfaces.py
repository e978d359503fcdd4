"""Points on modelled surfaces, at which the frame measures the incident light."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from warp_ar.kernels.recovery.recover import SurfacePoint
from warp_ar.kernels.structs import struct_dtype
from warp_ar.light.config import CONFIG, Kind
from warp_ar.scene import Marker, Probe, Proxy, Scene
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.tracking.markers import pattern_of

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Surfaces:
    """Surface points of a scene, in the world's frame."""

    points: NDArray[Any]
    """Records of ``SurfacePoint``, (n,)."""
    surface: NDArray[np.int64]
    """Index of each point's surface, (n,)."""
    kinds: NDArray[np.int64]
    """``Kind`` of each surface, (surfaces,)."""
    groups: NDArray[np.int64]
    """Index of the object of each surface, (surfaces,); the faces of a box share it."""
    overlap: NDArray[np.float32]
    """Correlation, 0 to 1, of the texture at two points, (n, n)."""


class _Collector:
    def __init__(self) -> None:
        self.rows: list[tuple[Array, Array, Array, float]] = []
        self.surface: list[int] = []
        self.kinds: list[int] = []
        self.groups: list[int] = []

    def add(
        self, positions: Sequence[Array], normal: Array, tangent: Array, half: float, kind: Kind, group: int
    ) -> None:
        self.rows += [(position, normal, tangent, half) for position in positions]
        self.surface += [len(self.kinds)] * len(positions)
        self.kinds.append(kind)
        self.groups.append(group)

    def result(self) -> Surfaces:
        points = np.zeros(len(self.rows), struct_dtype(SurfacePoint))
        for column, name in enumerate(("position", "normal", "tangent", "half")):
            points[name] = [row[column] for row in self.rows]
        surface, kinds = np.array(self.surface), np.array(self.kinds)
        overlap = texture_overlap(points["position"], surface, kinds[surface])
        return Surfaces(points, surface, kinds, np.array(self.groups), overlap)


class _Known(NamedTuple):
    """Parts of a scene on which the points depend."""

    marker: Marker
    has_marker: bool
    probes: tuple[Probe, ...]
    proxies: tuple[Proxy, ...]


def find_surfaces(scene: Scene, *, card_only: bool = False) -> Surfaces:
    """Return points on all physical surfaces that the scene models: the printed card, planes and boxes.

    On the card, these are the centres of all cells, and points in its quiet zone (the white margin of the print). On
    planes, they are rings around each ball, where its shadow and reflection fall, and a grid around the origin, without
    the card's surroundings and boxes. On boxes, there are up to 5 x 5 points per face. If there are many planes or
    boxes, only those that look largest from the ball have points (``SurfaceConfig.planes``, ``boxes``); the others only
    occlude light.

    Args:
        scene: Scene with the surfaces.
        card_only: True to return only points of the card's paper and ink.
    """
    return _find_surfaces(_Known(scene.marker, scene.has_marker, scene.probes, scene.proxies), card_only)


@functools.lru_cache(maxsize=4)
def _find_surfaces(scene: _Known, card_only: bool) -> Surfaces:
    """Return the result of ``find_surfaces``, which is cached: edits of virtual objects do not change the arguments."""
    found = _Collector()
    pattern = pattern_of(scene.marker)
    cells, white, side = pattern.cells, pattern.white, pattern.side
    low, high = pattern.outline.min(axis=0)[:2], pattern.outline.max(axis=0)[:2]
    if scene.has_marker:
        z, x = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
        paper = [*cells[white], *_quiet_zone(low, high, side)]
        found.add(paper, z, x, 0.3 * side, Kind.CARD, 0)
        found.add(list(cells[~white]), z, x, 0.3 * side, Kind.INK, 1)
    if card_only:
        return found.result()
    config = CONFIG.surfaces
    planes, boxes = _largest(scene, "plane", config.planes), _largest(scene, "box", config.boxes)
    on_planes = {number: _plane_points(scene, scene.proxies[number], low, high) for number in planes}
    every = max(1, -(-sum(map(len, on_planes.values())) // config.plane_points))
    steps = int(np.clip(math.isqrt(config.box_points // (6 * max(len(boxes), 1))), 1, config.face_steps))
    for number, proxy in enumerate(scene.proxies):
        if number in planes:
            rotation = rotation_matrix(proxy.rotate)
            points = list(on_planes[number][::every])
            found.add(points, rotation[:, 2], rotation[:, 0], 0.004, Kind.PLANE, 2 + number)
        elif number in boxes:
            _add_box(found, proxy, steps, 2 + number)
    return found.result()


def _largest(scene: _Known, shape: str, most: int) -> set[int]:
    """Return the indices of the static proxies of a shape; if more than ``most``, those largest from the first ball."""
    # A proxy with a marker of its own may move, so that its points change from frame to frame.
    still = ((number, proxy) for number, proxy in enumerate(scene.proxies) if proxy.marker is None)
    own = [number for number, proxy in still if proxy.shape == shape]
    if len(own) <= most:
        return set(own)
    center = np.array(scene.probes[0].center)

    def apparent_size(number: int) -> float:
        proxy = scene.proxies[number]
        away = float(np.linalg.norm(np.array(proxy.at) - center))
        return float(np.linalg.norm(proxy.size)) / max(away, 1e-6)

    return set(sorted(own, key=apparent_size, reverse=True)[:most])


def _quiet_zone(low: Array, high: Array, side: float) -> Array:
    """Return points on the paper around the print, half a cell outside it, (32, 3).

    Args:
        low: Smallest x and y of the print, metres, (2,).
        high: Largest x and y of the print, metres, (2,).
        side: Side of a cell, metres.
    """
    along = np.linspace(0.0, 1.0, 8, endpoint=False)[:, None]
    corners = np.array([[low[0], high[1]], high, [high[0], low[1]], low]) + 0.5 * side * np.array(
        [[-1, 1], [1, 1], [1, -1], [-1, -1]]
    )
    ring = np.concatenate([a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    return np.column_stack([ring, np.zeros(len(ring))])


def _plane_points(scene: _Known, plane: Proxy, low: Array, high: Array) -> Array:
    """Return points on a plane outside the card and outside boxes, (n, 3).

    Args:
        scene: Scene with the card and the boxes.
        plane: The plane.
        low: Smallest x and y of the marker's print, metres, (2,).
        high: Largest x and y of the marker's print, metres, (2,).
    """
    rotation, at = rotation_matrix(plane.rotate), np.array(plane.at)
    half = 0.5 * np.array(plane.size)
    places = [np.stack(np.meshgrid(*2 * [np.arange(-0.45, 0.451, CONFIG.surfaces.grid)]), -1).reshape(-1, 2)]
    turn = np.arange(24) * np.pi / 12
    for probe in scene.probes:
        middle = (rotation.T @ (np.array(probe.center) - at))[:2]
        radii = probe.radius * np.geomspace(0.6, 7.0, 11)
        rings = radii[:, None, None] * np.stack([np.cos(turn), np.sin(turn)], -1)
        places.append(middle + rings.reshape(-1, 2))
    local = np.concatenate(places)
    local = local[(np.abs(local) < half).all(axis=1)]
    points: Array = at + np.column_stack([local, np.zeros(len(local))]) @ rotation.T
    margin = 0.3 * float((high - low).max())
    flat = np.abs(points[:, 2]) < 0.02
    card = flat & (points[:, :2] > low - margin).all(axis=1) & (points[:, :2] < high + margin).all(axis=1)
    card &= scene.has_marker
    return points[~card & ~_in_boxes(scene, points)]


def _add_box(found: _Collector, box: Proxy, steps: int, group: int) -> None:
    """Add ``steps`` x ``steps`` points on each face of a box."""
    rotation, at = rotation_matrix(box.rotate), np.array(box.at)
    half = 0.5 * np.array(box.size)
    middles = (np.arange(steps) + 0.5) / (0.5 * steps) - 1.0
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for sign in (-1.0, 1.0):
            face = np.zeros((steps**2, 3))
            face[:, axis] = sign * half[axis]
            face[:, u], face[:, v] = np.repeat(middles, steps) * half[u], np.tile(middles, steps) * half[v]
            size = 0.12 * float(min(half[u], half[v]))
            found.add(list(at + face @ rotation.T), sign * rotation[:, axis], rotation[:, u], size, Kind.FACE, group)


def _in_boxes(scene: _Known, points: Array) -> NDArray[np.bool_]:
    inside = np.zeros(len(points), bool)
    for proxy in scene.proxies:
        if proxy.shape == "box" and proxy.marker is None:
            local = (points - np.array(proxy.at)) @ rotation_matrix(proxy.rotate)
            inside |= (np.abs(local) < 0.5 * np.array(proxy.size) + 0.005).all(axis=1)
    return inside


def texture_overlap(
    positions: NDArray[Any], surface: NDArray[np.int64], kind: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Return the correlation, 0 to 1, of the texture at two points, (n, n); 0 without texture.

    Args:
        positions: Positions of the points, metres, (n, 3).
        surface: Index of each point's surface, (n,).
        kind: ``Kind`` of each point's surface, (n,).
    """
    overlap = np.zeros((len(surface), len(surface)), np.float32)
    for number in np.unique(surface):
        own = np.flatnonzero(surface == number)
        reach = CONFIG.surfaces.texture[kind[own[0]]]
        if reach > 0.0:
            at = positions[own].astype(float)
            overlap[np.ix_(own, own)] = np.exp(-np.linalg.norm(at[:, None] - at, axis=2) / reach)
    return overlap


def measured_noise(
    points: NDArray[Any], surface: NDArray[np.int64], kinds: NDArray[np.int64], light: Array, exact: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Return the relative standard deviation of the equations of each surface, from its points' scatter.

    The scatter is that of the logarithm of radiance about a quadratic function of the position on the surface, which
    approximates the falloff of an emitter's light. An even surface thereby has more weight than a textured one.

    Args:
        points: Records of ``SurfacePoint``, (n,).
        surface: Index of each point's surface, (n,).
        kinds: ``Kind`` of each surface, (surfaces,).
        light: pi times the radiance of each point, (n, 3).
        exact: True where the radiance is neither clipped nor too dark, (n, 3).

    Returns:
        Standard deviation, between ``least_noise`` and ``noise`` of the surface's kind, (surfaces,). It is not larger,
        because cast shadows increase the scatter although they are evidence. And the scatter, at least ``noise``,
        (surfaces,).
    """
    noise = np.array(CONFIG.surfaces.noise)[kinds]
    texture = noise.copy()
    for number in range(len(kinds)):
        own = np.flatnonzero((surface == number) & exact.all(axis=1))
        if len(own) < CONFIG.surfaces.scatter_points:
            continue
        at, normal, tangent = (points[name][own].astype(float) for name in ("position", "normal", "tangent"))
        places = np.column_stack([(at * axis).sum(axis=1) for axis in (tangent, np.cross(normal, tangent))])
        u, v = ((places - places.mean(axis=0)) / np.maximum(places.std(axis=0), 1e-9)).T
        terms = np.column_stack([np.ones(len(own)), u, v, u * u, u * v, v * v])
        logs = np.log(light[own]).mean(axis=1)
        weights = np.ones(len(own))
        for _ in range(CONFIG.surfaces.scatter_iterations):
            weighted = weights * terms.T
            course = np.linalg.solve(weighted @ terms + 1e-9 * len(own) * np.eye(terms.shape[1]), weighted @ logs)
            off = np.abs(logs - terms @ course)
            scatter = 1.4826 * float(np.median(off))
            weights = 1.0 / (1.0 + (off / (2.0 * scatter + 1e-6)) ** 2)
        scatter *= np.sqrt(len(own) / (len(own) - terms.shape[1]))
        texture[number] = max(scatter, noise[number])
        noise[number] = np.clip(scatter, CONFIG.surfaces.least_noise, noise[number])
    return noise, texture


def shared_errors(overlap: NDArray[np.float32], kind: NDArray[np.int64], seen: NDArray[np.bool_]) -> Array:
    """Return the number of equations that share one error, for each visible point.

    Args:
        overlap: Result of ``texture_overlap``, (n, n).
        kind: ``Kind`` of each point's surface, (n,).
        seen: Points with an equation, (n,).
    """
    return np.asarray(np.maximum(np.array(CONFIG.surfaces.shared)[kind], overlap @ seen.astype(np.float32))[seen])
