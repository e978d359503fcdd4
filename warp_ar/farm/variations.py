"""One variation of a clip: what stands on its desk, and what lights it, drawn from a seed.

A variation's random numbers come from (seed, number of the clip, number of the variation) alone: which worker draws it,
and when, changes nothing. Objects stand on the receiver, clear of each other, of what is modelled of the desk, of the
mirror balls and of the marker's card, and hide the marker from none of the clip's cameras.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.farm.catalogue import Dataset, ObjectSpec
from warp_ar.scene import Exposure, Object, Pose, Proxy, Scene
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.mesh_cache import load_kept_mesh
from warp_ar.scene.shapes import torus_mesh

Points = npt.NDArray[np.float64]

TRIES = 200
"""Places that are tried for an object before it is left out."""
CAMERAS = 24
"""Poses of a clip, evenly spread, from which the marker must be seen."""
CARD = 1.4
"""Side of the marker's card over the marker's own: objects do not stand on its white."""
QUIET = 1.1
"""The same of what must be seen: the white next to the marker."""
REACH = 0.25
"""Metres from the marker within which objects stand where the job file names no region."""

CHUNK = 5000
"""Variations that are put in order at once: 0.2 s of the driver's time."""


class NoPlace(Exception):
    """Fewer objects than asked for found a place."""


@dataclasses.dataclass(frozen=True)
class Drawn:
    """A variation."""

    scene: Scene
    kinds: tuple[int, ...]
    """Number in the catalogue, from 0 on, of each object of the scene."""


@dataclasses.dataclass(frozen=True)
class Receiver:
    """Where objects of a clip may stand."""

    height: float
    """z of the receiver in metres."""
    region: tuple[float, float, float, float]
    """x0, y0, x1, y1 in metres."""
    taken: tuple[Points, ...]
    """Convex outlines on the receiver, (n, 2) each, that nothing may stand on."""


def draw_variation(base: Scene, dataset: Dataset, clip: int, variation: int, poses: Sequence[Pose]) -> Drawn:
    """Draw the scene of one variation.

    Args:
        base: The clip's scene: camera, marker, receiver; its own objects and lights are left out.
        dataset: What to draw from.
        clip: Number of the clip.
        variation: Number of the variation.
        poses: Of the clip's cameras.

    Raises:
        NoPlace: Fewer objects than the least number fit.
    """
    chosen = _draw_kinds(dataset, clip, variation)
    random = chosen.random
    drawn = [dataset.kinds_of_light[kind].draw(random) for kind in chosen.lights]
    # In the catalogue's order: scenes of the same kinds then share their kernels and their arrays.
    placed = _place(base, dataset, sorted(chosen.kinds), poses, random)
    if len(placed) < dataset.objects[0]:
        raise NoPlace(
            f"only {len(placed)} of {dataset.objects[0]} objects find a place in {TRIES} tries each: enlarge "
            "dataset.region, or lower dataset.objects or dataset.margin"
        )
    scene = dataclasses.replace(
        base, objects=tuple(item for _, item in placed), lights=tuple(drawn), exposure=Exposure(chosen.exposure)
    )
    return Drawn(scene, tuple(kind for kind, _ in placed))


@dataclasses.dataclass(frozen=True)
class _Chosen:
    """What is drawn first of a variation."""

    kinds: list[int]
    """Of its objects, numbers in the catalogue; some may find no place."""
    lights: list[int]
    """Of its lights, numbers in their list."""
    exposure: float
    random: np.random.Generator
    """For what is drawn next."""


def _draw_kinds(dataset: Dataset, clip: int, variation: int) -> _Chosen:
    random = np.random.Generator(np.random.PCG64(np.random.SeedSequence([dataset.seed, clip, variation])))
    count = int(random.integers(dataset.objects[0], dataset.objects[1] + 1))
    light_count = int(random.integers(dataset.lights[0], dataset.lights[1] + 1))
    exposure = round(dataset.exposure.draw_one(random), 6)
    kinds = _choose(random, [spec.weight for spec in dataset.catalogue], count)
    lights = _choose(random, [spec.weight for spec in dataset.kinds_of_light], light_count)
    return _Chosen(kinds, lights, exposure, random)


def in_kindred_order(dataset: Dataset, clip: int, count: int) -> Iterator[int]:
    """Numbers of a clip's variations, those of the same kinds of objects and lights one after another.

    These share a pipeline, whose making takes several times as long as a frame. They are looked at ``CHUNK`` at a time,
    so that a data set of any size begins at once.

    Args:
        dataset: What to draw from.
        clip: Number of the clip.
        count: Of its variations.
    """

    def kinds(variation: int) -> tuple[list[int], list[str]]:
        chosen = _draw_kinds(dataset, clip, variation)
        return sorted(chosen.kinds), sorted(dataset.kinds_of_light[light].kind for light in chosen.lights)

    for first in range(0, count, CHUNK):
        yield from sorted(range(first, min(first + CHUNK, count)), key=kinds)


def _choose(random: np.random.Generator, weights: Sequence[float], count: int) -> list[int]:
    if not count:
        return []
    share = np.cumsum(weights) / np.sum(weights)
    return [int(k) for k in np.searchsorted(share, random.random(count), side="right")]


def _place(
    base: Scene, dataset: Dataset, kinds: Sequence[int], poses: Sequence[Pose], random: np.random.Generator
) -> list[tuple[int, Object]]:
    """Objects of these kinds where there is room; the larger kinds do not go first, so that all are treated alike."""
    receiver = receiver_of(base, dataset)
    seen = [poses[i] for i in np.linspace(0, len(poses) - 1, min(CAMERAS, len(poses))).astype(int)] if poses else []
    marker = [_project(base, pose, _marker_corners(base)) for pose in seen] if base.has_marker else []
    taken = list(receiver.taken)
    placed: list[tuple[int, Object]] = []
    for kind in kinds:
        spec = dataset.catalogue[kind]
        material = spec.material.draw(random)
        for _ in range(TRIES):
            item, points = _try(spec, receiver, random)
            outline = _inflated(_hull(points[:, :2]), dataset.margin)
            if any(_overlap(outline, other) for other in taken):
                continue
            if not _is_in_view(base, seen, points) or _hides(base, seen, marker, points):
                continue
            taken.append(_hull(points[:, :2]))
            placed.append((kind, dataclasses.replace(item, material=material)))
            break
    return placed


def _try(spec: ObjectSpec, receiver: Receiver, random: np.random.Generator) -> tuple[Object, Points]:
    """An object somewhere in the region, resting on the receiver, and its points in the world."""
    x0, y0, x1, y1 = receiver.region
    x, y = x0 + random.random() * (x1 - x0), y0 + random.random() * (y1 - y0)
    turn = spec.turn.draw_one(random)
    rotation = rotation_matrix((0.0, 0.0, turn)) @ rotation_matrix(spec.item.rotate)
    if spec.rest == "any":
        rotation = rotation @ _random_rotation(random)
    rotate = _angles(rotation)
    points = spec.item.scale * local_points(spec.item) @ rotation_matrix(rotate).T
    z = receiver.height - float(points[:, 2].min())
    at = (round(float(x), 6), round(float(y), 6), round(z, 7))
    return dataclasses.replace(spec.item, at=at, rotate=rotate), points + np.array(at)


def _random_rotation(random: np.random.Generator) -> Points:
    """Any rotation, all equally likely: a unit quaternion of four normal numbers."""
    w, x, y, z = (q := random.standard_normal(4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _angles(rotation: Points) -> tuple[float, float, float]:
    """Degrees about the fixed x, then y, then z axis, as ``rotation_matrix`` takes them, to a ten-thousandth."""
    y = -np.arcsin(np.clip(rotation[2, 0], -1.0, 1.0))
    if abs(rotation[2, 0]) < 1.0 - 1e-12:
        x, z = np.arctan2(rotation[2, 1], rotation[2, 2]), np.arctan2(rotation[1, 0], rotation[0, 0])
    else:  # x and z turn about one axis
        x, z = 0.0, np.arctan2(-rotation[0, 1], rotation[1, 1])
    a, b, c = (round(float(np.degrees(angle)), 4) for angle in (x, y, z))
    return a, b, c


@functools.lru_cache(maxsize=256)
def _points_of(shape: str, file: Path | None, lengths: tuple[float, ...]) -> Points:
    if shape == "mesh":
        assert file is not None
        return np.asarray(load_kept_mesh(file).vertices, np.float64)
    if shape == "torus":
        return np.asarray(torus_mesh(*lengths).vertices, np.float64)
    if shape == "box":
        return np.array([[a, b, c] for a in (-0.5, 0.5) for b in (-0.5, 0.5) for c in (-0.5, 0.5)]) * lengths
    # Both poles and the equator are among them, so that it rests on its lowest point whatever its turn.
    theta, phi = np.meshgrid(np.linspace(0, np.pi, 33), np.arange(64) * (np.pi / 32))
    sphere = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    return np.asarray(lengths[0] * sphere.reshape(-1, 3))


def local_points(item: Object) -> Points:
    """Points whose hull is that of an object before scale, turn and place, (n, 3) in metres."""
    lengths = {"mesh": (), "torus": (item.major_radius, item.minor_radius), "box": item.size, "sphere": (item.radius,)}
    if item.shape == "sphere":
        return _points_of("sphere", None, (item.radius,))
    return _points_of(item.shape, item.file, lengths[item.shape])


def receiver_of(scene: Scene, dataset: Dataset) -> Receiver:
    """Where objects may stand: on the first level plane that is modelled, or at the marker's height."""
    plane = next((p for p in scene.proxies if p.shape == "plane" and _is_level(p)), None)
    height = 0.0 if plane is None else plane.at[2]
    region = dataset.region
    if region is None:
        x, y, a, b = (0.0, 0.0, REACH, REACH) if plane is None else (*plane.at[:2], *(0.5 * s for s in plane.size))
        region = (max(x - a, -REACH), max(y - b, -REACH), min(x + a, REACH), min(y + b, REACH))
    taken = [_hull(_proxy_points(p)[:, :2]) for p in scene.proxies if not (p.shape == "plane" and _is_level(p))]
    circle = np.stack([np.cos(t := np.arange(32) * (np.pi / 16)), np.sin(t)], -1)
    taken += [_hull(circle * probe.radius + np.array(probe.center[:2])) for probe in scene.probes]
    if scene.has_marker:
        taken.append(_hull(CARD * _marker_corners(scene)[:, :2] / QUIET))
    return Receiver(height, region, tuple(taken))


def _is_level(proxy: Proxy) -> bool:
    return bool(rotation_matrix(proxy.rotate)[2, 2] > 0.999)


def _proxy_points(proxy: Proxy) -> Points:
    if proxy.shape == "mesh":
        assert proxy.file is not None
        local = np.asarray(load_kept_mesh(proxy.file).vertices, np.float64)
    else:
        local = _points_of("box", None, (*proxy.size, 0.0)[:3])
    return np.asarray(local @ rotation_matrix(proxy.rotate).T + np.array(proxy.at))


def _marker_corners(scene: Scene) -> Points:
    """Corners of the marker or board with the white next to it, (4, 3)."""
    board = scene.marker.board
    width, height = (scene.marker.size, scene.marker.size) if board is None else board.size
    corners = np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
    return np.asarray(0.5 * QUIET * corners * (width, height, 0.0))


def _hull(points: Points) -> Points:
    """Convex outline of points of a plane, (n, 2)."""
    return np.asarray(cv2.convexHull(np.ascontiguousarray(points, np.float32)).reshape(-1, 2), np.float64)


def _inflated(outline: Points, margin: float) -> Points:
    """Outline that is further out by at least ``margin``: a sum with an octagon around its circle."""
    turn = np.arange(8) * (np.pi / 4)
    octagon = np.stack([np.cos(turn), np.sin(turn)], -1) * (margin / np.cos(np.pi / 8))
    return _hull((outline[:, None, :] + octagon).reshape(-1, 2))


def _overlap(a: Points, b: Points) -> bool:
    """Whether two convex outlines overlap: no side of either separates them."""
    for outline, other in ((a, b), (b, a)):
        side = np.roll(outline, -1, 0) - outline
        normal = np.stack([side[:, 1], -side[:, 0]], -1)
        own, others = outline @ normal.T, other @ normal.T
        if ((own.max(0) < others.min(0)) | (others.max(0) < own.min(0))).any():
            return False
    return True


def _project(scene: Scene, pose: Pose, points: Points) -> Points | None:
    """Pixels of points of the world, (n, 2); None where one is not before the camera."""
    camera = pose.apply(points)
    if camera[:, 2].min() <= 1e-3:
        return None
    zero = np.zeros(3)
    pixels: Any = cv2.projectPoints(camera, zero, zero, scene.camera.matrix(), np.array(scene.camera.distortion))[0]
    return np.asarray(pixels, np.float64).reshape(-1, 2)


def _box(points: Points) -> Points:
    """Corners of the box around points, (8, 3)."""
    low, high = points.min(0), points.max(0)
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


def _is_in_view(scene: Scene, poses: Sequence[Pose], points: Points) -> bool:
    """Whether the middle of an object is in the picture of at least half of the cameras."""
    if not poses:
        return True
    middle = 0.5 * (points.min(0) + points.max(0))[None]
    size = np.array([scene.camera.width, scene.camera.height])
    found = [_project(scene, pose, middle) for pose in poses]
    return sum(p is not None and bool(((p[0] >= 0) & (p[0] < size)).all()) for p in found) * 2 >= len(poses)


def _hides(scene: Scene, poses: Sequence[Pose], marker: Sequence[Points | None], points: Points) -> bool:
    """Whether an object, taken for the box around it, may hide the marker from one of the cameras."""
    corners = _box(points)
    for pose, seen in zip(poses, marker, strict=False):
        pixels = _project(scene, pose, corners)
        if pixels is None:
            return True
        if seen is not None and _overlap(_hull(pixels), _hull(seen)):
            return True
    return False
