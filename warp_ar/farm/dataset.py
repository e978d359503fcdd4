"""Table ``[dataset]`` of a job file, and the random scene of each variation.

A variation is a copy of a clip with randomly drawn virtual objects and lights. Objects and lights are described as in
scene files. A number to be drawn is given as a span, ``[lowest, highest]``. The random numbers of a variation depend
only on (seed, index of the clip, index of the variation), not on the worker or on the time.

Objects stand on the receiver, the physical surface under them. They do not touch each other, other modelled surfaces,
the mirror balls or the marker's card. They do not occlude the marker in any of ``CAMERAS`` camera poses of the clip.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import numpy.typing as npt
from trimesh import transformations
from trimesh.bounds import corners

from warp_ar.errors import SceneError, UsageError
from warp_ar.output.shot import mesh_of
from warp_ar.scene import Exposure, Light, Object, Pose, Proxy, Scene
from warp_ar.scene.fields import Key, fields_of
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.pixel_rays import project
from warp_ar.scene.scene_files import SceneFiles
from warp_ar.scene.sections import SceneTable, read_light, read_object
from warp_ar.scene.table import Table
from warp_ar.tracking.markers import pattern_of


class JobsError(UsageError):
    """Error of a job file."""


class JobTable(Table):
    """Table of a job file."""

    error = JobsError

    def read(self, kind: Any, **given: Any) -> Any:
        """Return the dataclass of the table; ``given`` are values of fields that are not declared keys."""
        values = {name: self.admit(field) for name, field in fields_of(kind).items() if name in self}
        return kind(**values, **given)

    def path(self, key: str) -> Path | None:
        """Return the absolute path of a file or folder that is given relative to the job file; it need not exist."""
        if key not in self.data:
            return None
        return Path(self.folder / self.text(key)).absolute()

    def pair(self, key: str, default: tuple[int, int], *, low: int) -> tuple[int, int]:
        """Return two integers, the first no larger than the second."""
        value = self.data.get(key, list(default))
        whole = isinstance(value, list) and all(isinstance(n, int) and not isinstance(n, bool) for n in value)
        if not whole or len(value) != 2 or not low <= value[0] <= value[1]:
            self.fail(key, f"expected two whole numbers [least, most], {low} or more")
        return value[0], value[1]

    def span(self, key: str, default: tuple[float, float], *, low: float, high: float) -> tuple[float, float]:
        """Return the lowest and highest value of a drawn number; equal if it is fixed."""
        value = self.data.get(key, list(default))
        ends = value if _is_span(value) else [value, value]
        if not all(_is_number(end) and low <= end <= high for end in ends) or ends[0] > ends[1]:
            self.fail(key, f"expected a number from {low:g} to {high:g}, or [lowest, highest]")
        return ends[0], ends[1]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_span(value: object) -> bool:
    """Return True if a value is a pair of numbers, or a pair of lists of equally many numbers."""
    if not isinstance(value, list) or len(value) != 2:
        return False
    low, high = (end if isinstance(end, list) else [end] for end in value)
    return len(low) == len(high) and all(map(_is_number, (*low, *high)))


_KEYS = ("variations", "seed", "objects", "lights", "every", "region", "margin", "exposure", "object", "light")
_OWN_KEYS = ("name", "turn", "rest", "weight")
"""Keys of an object that objects of a scene do not have."""
_OBJECT_KEYS = ("shape", "file", "radius", "size", "major_radius", "minor_radius", "scale", "rotate", "material")
_LIGHT_KEYS = ("kind", "weight", "intensity", "color", *Light.USES["spot"])
RESTS = ("upright", "any")
"""Orientations of objects: rotated about the vertical only, or in any way; the lowest point touches the receiver."""
MOST = 64
"""Largest number of objects, and of lights, in a picture."""
Share = Callable[[tuple[int, ...]], Any]
"""Function that returns an array of numbers of a given shape; 0 stands for the lowest value of a span, 1 for the
highest."""


def draw(value: Any, share: Share) -> Any:
    """Return a table or value with each span replaced by a drawn value."""
    if isinstance(value, dict):
        return {key: draw(value[key], share) for key in sorted(value)}
    if not _is_span(value):
        return value
    low, high = np.array(value, float)
    return np.round(low + share(low.shape) * (high - low), 6).tolist()


@dataclasses.dataclass(frozen=True)
class Entry:
    """Kind of object or light, as a table that may contain spans."""

    source: JobTable
    """Table of the job file, for messages and paths."""
    data: Mapping[str, Any]
    """Content of the table, without keys that scenes do not have."""
    weight: float
    """Relative weight with which the kind is chosen."""

    def table(self, share: Share, kind: type) -> SceneTable:
        """Return the table with drawn values, in the form of a scene's table.

        Args:
            share: Source of random numbers.
            kind: Class whose fields are the allowed keys.
        """
        data = draw(dict(self.data), share)
        if "outer_angle" in data:  # the table gives the angle between inner and outer cone
            data["outer_angle"] = round(data["outer_angle"] + data.get("inner_angle", 0.0), 6)
        source = self.source
        return SceneTable(source.label, SceneFiles(source.folder), source.section, data, list(fields_of(kind)))

    def draw(self, share: Share) -> Any:
        """Draw one light.

        Raises:
            SceneError: The draw is not valid in a scene.
        """
        return read_light(self.table(share, Light))


@dataclasses.dataclass(frozen=True)
class ObjectSpec(Entry):
    """Kind of object; its index in the catalogue, counted from 1, is its label."""

    name: str
    """Name of the category."""
    turn: tuple[float, float]
    """Lowest and highest rotation about the vertical, degrees."""
    rest: str
    """One of ``RESTS``."""

    def draw(self, share: Share) -> Object:
        """Draw one object, in the orientation of the key ``rotate``, without the random rotation."""
        return read_object(self.table(share, Object))

    @functools.cached_property
    def item(self) -> Object:
        """Object of this kind for questions of shape, size and scale, which are the same in all draws."""
        return self.draw(np.zeros)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Dataset:
    """The values of ``[dataset]``."""

    variations: Annotated[int, Key(low=1)] = 1
    """Number of variations of each clip."""
    seed: Annotated[int, Key(low=0, high=2**63 - 1)] = 0
    """Seed of the random numbers."""
    objects: tuple[int, int]
    """Least and largest number of objects in a picture."""
    lights: tuple[int, int]
    """Least and largest number of virtual lights."""
    every: Annotated[int, Key(low=1)] = 1
    """Interval of written frames: 1 writes every frame."""
    region: Annotated[tuple[float, ...] | None, Key(sizes=(4,), low=-100.0, high=100.0)] = None
    """Area for objects as x0, y0, x1, y1 in metres; None: the receiver within 0.25 m of the marker."""
    margin: Annotated[float, Key(low=0.0, high=10.0)] = 0.005
    """Least horizontal distance in metres of an object from other objects, modelled surfaces, balls and the card."""
    exposure: tuple[float, float]
    """Lowest and highest factor of the simulated exposure (``Exposure.scale``)."""
    catalogue: tuple[ObjectSpec, ...]
    """Kinds of objects."""
    kinds_of_light: tuple[Entry, ...]
    """Kinds of virtual lights."""


def read_dataset(label: str, folder: Path, data: object) -> Dataset:
    """Return the table ``[dataset]`` of a job file.

    Args:
        label: Name of the job file in messages.
        folder: Folder of the job file.
        data: Content of the table.

    Raises:
        JobsError: A key is wrong or missing, or an object or a light is not valid in a scene.
    """
    table = JobTable(label, folder, "dataset", data, _KEYS)
    catalogue = tuple(map(_read_object, _entries(table, "object", (*_OWN_KEYS, *_OBJECT_KEYS))))
    if len({spec.name for spec in catalogue}) < len(catalogue):
        table.fail("object", "two have one name; each is a category of its own")
    kinds = tuple(map(_read_light, _entries(table, "light", _LIGHT_KEYS)))
    lights = table.pair("lights", (1, 1) if kinds else (0, 0), low=0)
    objects = table.pair("objects", (1, 3), low=0)
    specs: Sequence[Entry]
    for key, (_, most), specs in (("objects", objects, catalogue), ("lights", lights, kinds)):
        if most > MOST:
            table.fail(key, f"expected {MOST} at most")
        if most and not specs:
            table.fail(key, f"expected at least one [[dataset.{key[:-1]}]] to draw them from")
        if most and not sum(spec.weight for spec in specs) > 0.0:
            raise JobsError(f"{label}: dataset.{key[:-1]}: every weight is 0; one must be above")
    try:
        for spec in (*catalogue, *kinds):
            for extreme in (np.zeros, np.ones):
                spec.draw(extreme)
    except SceneError as error:
        raise JobsError(str(error)) from error
    exposure = table.span("exposure", (1.0, 1.0), low=0.01, high=16.0)
    dataset: Dataset = table.read(
        Dataset, objects=objects, lights=lights, exposure=exposure, catalogue=catalogue, kinds_of_light=kinds
    )
    region = dataset.region
    if region is not None and not (region[0] < region[2] and region[1] < region[3]):
        table.fail("region", "expected [x0, y0, x1, y1] in metres with x0 < x1 and y0 < y1")
    return dataset


def _entries(table: JobTable, key: str, keys: Sequence[str]) -> list[JobTable]:
    """Return the tables ``[[dataset.KEY]]`` with ``key`` for KEY; ``keys`` are the keys that they may have."""
    found = table.data.get(key, [])
    if not isinstance(found, list):
        table.fail(key, f"expected [[dataset.{key}]]")
    return [JobTable(table.label, table.folder, f"dataset.{key}[{n}]", entry, keys) for n, entry in enumerate(found)]


def _read_object(table: JobTable) -> ObjectSpec:
    data = {key: table.data[key] for key in _OBJECT_KEYS if key in table}
    for key, value in data.items():
        if key != "material" and _is_span(value):
            table.fail(key, "expected one value: what is labelled alike has one size; make it two objects")
    name = Path(str(data["file"])).stem if "file" in data else f"{data.get('shape')}-{table.section[15:-1]}"
    return ObjectSpec(
        table,
        data,
        _weight(table),
        name=table.text("name", name),
        turn=table.span("turn", (0.0, 360.0), low=-360.0, high=360.0),
        rest=table.choice("rest", RESTS, RESTS[0]),
    )


def _read_light(table: JobTable) -> Entry:
    table.choice("kind", ("point", "spot"))
    if "at" not in table:
        table.fail("at", "expected 3 numbers in metres, or [lowest, highest] of them")
    return Entry(table, {key: value for key, value in table.data.items() if key != "weight"}, _weight(table))


def _weight(table: JobTable) -> float:
    return table.number("weight", 1.0, low=0.0, high=1e6)


Points = npt.NDArray[np.float64]

TRIES = 200
"""Number of trial places for an object before it is left out."""
CAMERAS = 24
"""Largest number of evenly spaced camera poses of a clip for which the visibility of objects and marker is tested."""
CARD = 1.4
"""Side of the marker's card, relative to the marker's side; objects do not stand on the card."""
QUIET = 1.1
"""Side of the area that objects must not occlude, relative to the marker's side. It includes white around the
marker."""
REACH = 0.25
"""Distance from the marker in metres within which objects stand if the job file states no region."""
CHUNK = 5000
"""Number of variations that are sorted together."""


class NoPlace(Exception):
    """Error of a variation in which fewer objects than the least number could be placed."""


@dataclasses.dataclass(frozen=True)
class Drawn:
    """Scene of a variation."""

    scene: Scene
    kinds: tuple[int, ...]
    """Index in the catalogue, from 0 on, of each object of the scene."""


@dataclasses.dataclass(frozen=True)
class Receiver:
    """The area on which objects of a clip may stand."""

    height: float
    """Height z of the receiver in metres."""
    region: tuple[float, ...]
    """Area for objects as x0, y0, x1, y1 in metres."""
    taken: tuple[Points, ...]
    """Convex outlines of occupied areas on the receiver, (n, 2) each."""


def draw_variation(base: Scene, dataset: Dataset, clip: int, variation: int, poses: Sequence[Pose]) -> Drawn:
    """Draw the scene of one variation.

    Args:
        base: Scene of the clip with camera, marker and receiver; its objects and lights are replaced.
        dataset: Kinds of objects and lights to draw from.
        clip: Index of the clip.
        variation: Index of the variation.
        poses: Camera poses of the clip.

    Raises:
        NoPlace: Fewer objects than the least number fit.
    """
    kinds, lights, exposure, random = _draw_kinds(dataset, clip, variation)
    drawn = [dataset.kinds_of_light[kind].draw(random.random) for kind in lights]
    # Objects are in the catalogue's order, so that scenes with equal kinds share kernels and arrays.
    placed = _place(base, dataset, sorted(kinds), poses, random)
    if len(placed) < dataset.objects[0]:
        raise NoPlace(
            f"only {len(placed)} of {dataset.objects[0]} objects find a place in {TRIES} tries each: enlarge "
            "dataset.region, or lower dataset.objects or dataset.margin"
        )
    scene = dataclasses.replace(
        base, objects=tuple(item for _, item in placed), lights=tuple(drawn), exposure=Exposure(exposure)
    )
    return Drawn(scene, tuple(kind for kind, _ in placed))


def _draw_kinds(dataset: Dataset, clip: int, variation: int) -> tuple[list[int], list[int], float, np.random.Generator]:
    """Return indices of a variation's kinds of objects and of lights, its exposure, and a generator for more draws."""
    random = np.random.Generator(np.random.PCG64(np.random.SeedSequence([dataset.seed, clip, variation])))
    count = int(random.integers(dataset.objects[0], dataset.objects[1] + 1))
    light_count = int(random.integers(dataset.lights[0], dataset.lights[1] + 1))
    exposure = round(random.uniform(*dataset.exposure), 6)
    kinds = _choose(random, [spec.weight for spec in dataset.catalogue], count)
    return kinds, _choose(random, [spec.weight for spec in dataset.kinds_of_light], light_count), exposure, random


def in_kindred_order(dataset: Dataset, clip: int, count: int) -> Iterator[int]:
    """Yield the indices of a clip's variations, ordered so that variations with equal kinds are consecutive.

    Variations with equal kinds of objects and lights share a pipeline, which takes several times as long to build as a
    frame takes to light. They are sorted in chunks: 100,000 at once take 4 s, in which nothing is lit.

    Args:
        dataset: Kinds of objects and lights to draw from.
        clip: Index of the clip.
        count: Number of its variations.
    """

    def kinds(variation: int) -> tuple[list[int], list[str]]:
        found, lights, _, _ = _draw_kinds(dataset, clip, variation)
        return sorted(found), sorted(dataset.kinds_of_light[light].data["kind"] for light in lights)

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
    """Return objects at free places, each with the index of its kind; an object without a free place is left out.

    Args:
        base: Scene of the clip.
        dataset: Kinds of objects.
        kinds: Index in the catalogue of each object, in the order in which the objects are placed.
        poses: Camera poses of the clip.
        random: Generator of random numbers.
    """
    receiver = receiver_of(base, dataset)
    seen = [poses[i] for i in np.linspace(0, len(poses) - 1, min(CAMERAS, len(poses))).astype(int)] if poses else []
    quiet = QUIET * pattern_of(base.marker).outline
    marker = [_project(base, pose, quiet) for pose in seen] if base.has_marker else []
    taken = list(receiver.taken)
    placed: list[tuple[int, Object]] = []
    for kind in kinds:
        spec = dataset.catalogue[kind]
        drawn = spec.draw(random.random)
        local = drawn.scale * local_points(drawn)
        for _ in range(TRIES):
            item, points = _try(drawn, local, spec, receiver, random)
            outline = _inflated(_hull(points[:, :2]), dataset.margin)
            if any(_overlap(outline, other) for other in taken):
                continue
            if not _is_in_view(base, seen, points) or _hides(base, seen, marker, points):
                continue
            taken.append(_hull(points[:, :2]))
            placed.append((kind, item))
            break
    return placed


def _try(
    drawn: Object, local: Points, spec: ObjectSpec, receiver: Receiver, random: np.random.Generator
) -> tuple[Object, Points]:
    """Return an object at a random place of the region, resting on the receiver, and its points in the world.

    Args:
        drawn: The object, with its key ``rotate`` as orientation.
        local: Its scaled points before rotation and translation, (n, 3) metres.
        spec: Its kind.
        receiver: The area for objects.
        random: Generator of random numbers.
    """
    x0, y0, x1, y1 = receiver.region
    x, y = x0 + random.random() * (x1 - x0), y0 + random.random() * (y1 - y0)
    rotation = rotation_matrix((0.0, 0.0, random.uniform(*spec.turn))) @ rotation_matrix(drawn.rotate)
    if spec.rest == "any":
        rotation = rotation @ transformations.random_rotation_matrix(random.random(3))[:3, :3]
    a, b, c = (round(math.degrees(angle), 4) for angle in transformations.euler_from_matrix(rotation, "sxyz"))
    rotate = a, b, c
    points = local @ rotation_matrix(rotate).T
    z = receiver.height - float(points[:, 2].min())
    at = (round(float(x), 6), round(float(y), 6), round(z, 7))
    return dataclasses.replace(drawn, at=at, rotate=rotate), points + np.array(at)


def local_points(item: Object | Proxy) -> Points:
    """Return an object's vertices before scale, rotation and translation, (n, 3) metres."""
    return np.asarray(mesh_of(item).vertices, np.float64)


def receiver_of(scene: Scene, dataset: Dataset) -> Receiver:
    """Return the area for objects, on the scene's first horizontal plane, or without one on the marker's plane."""
    plane = next((p for p in scene.proxies if p.shape == "plane" and _is_level(p)), None)
    height = 0.0 if plane is None else plane.at[2]
    region = dataset.region
    if region is None:
        x, y, a, b = (0.0, 0.0, REACH, REACH) if plane is None else (*plane.at[:2], *(0.5 * s for s in plane.size))
        region = (max(x - a, -REACH), max(y - b, -REACH), min(x + a, REACH), min(y + b, REACH))
    others = [p for p in scene.proxies if not (p.shape == "plane" and _is_level(p))]
    taken = [_hull((local_points(p) @ rotation_matrix(p.rotate).T + np.array(p.at))[:, :2]) for p in others]
    circle = np.stack([np.cos(t := np.arange(32) * (np.pi / 16)), np.sin(t)], -1)
    taken += [_hull(circle * probe.radius + np.array(probe.center[:2])) for probe in scene.probes]
    if scene.has_marker:
        taken.append(_hull(CARD * pattern_of(scene.marker).outline[:, :2]))
    return Receiver(height, region, tuple(taken))


def _is_level(proxy: Proxy) -> bool:
    return bool(rotation_matrix(proxy.rotate)[2, 2] > 0.999)


def _hull(points: Points) -> Points:
    """Return the convex outline of points in a plane, (n, 2)."""
    return np.asarray(cv2.convexHull(np.ascontiguousarray(points, np.float32)).reshape(-1, 2), np.float64)


def _inflated(outline: Points, margin: float) -> Points:
    """Return a convex outline grown by at least ``margin``.

    The result is the Minkowski sum of the outline and an octagon around the circle of radius ``margin``.
    """
    turn = np.arange(8) * (np.pi / 4)
    octagon = np.stack([np.cos(turn), np.sin(turn)], -1) * (margin / np.cos(np.pi / 8))
    return _hull((outline[:, None, :] + octagon).reshape(-1, 2))


def _overlap(a: Points, b: Points) -> bool:
    """Return True if two convex outlines, (n, 2) each, overlap: no side of either outline separates them."""
    for outline, other in ((a, b), (b, a)):
        side = np.roll(outline, -1, 0) - outline
        normal = np.stack([side[:, 1], -side[:, 0]], -1)
        own, others = outline @ normal.T, other @ normal.T
        if ((own.max(0) < others.min(0)) | (others.max(0) < own.min(0))).any():
            return False
    return True


def _project(scene: Scene, pose: Pose, points: Points) -> Points | None:
    """Return the pixels of points in the world, (n, 2); None if a point is behind the camera."""
    camera = pose.apply(points)
    if camera[:, 2].min() <= 1e-3:
        return None
    return project(scene.camera, camera)


def _is_in_view(scene: Scene, poses: Sequence[Pose], points: Points) -> bool:
    """Return True if the centre of an object is in the picture for at least half of the poses."""
    if not poses:
        return True
    middle = 0.5 * (points.min(0) + points.max(0))[None]
    size = np.array([scene.camera.width, scene.camera.height])
    found = [_project(scene, pose, middle) for pose in poses]
    return sum(p is not None and bool(((p[0] >= 0) & (p[0] < size)).all()) for p in found) * 2 >= len(poses)


def _hides(scene: Scene, poses: Sequence[Pose], marker: Sequence[Points | None], points: Points) -> bool:
    """Return True if the box around an object may occlude the marker in one of the poses.

    Args:
        scene: Scene with the camera.
        poses: Camera poses.
        marker: Corners of the marker in pixels for each pose, (4, 2); None if it is behind the camera.
        points: Points of the object in the world, (n, 3).
    """
    box = corners(np.stack([points.min(0), points.max(0)]))
    for pose, seen in zip(poses, marker, strict=False):
        pixels = _project(scene, pose, box)
        if pixels is None:
            return True
        if seen is not None and _overlap(_hull(pixels), _hull(seen)):
            return True
    return False
