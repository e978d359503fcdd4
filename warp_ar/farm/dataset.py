"""The table ``[dataset]`` of a job file, and the scene of each variation, drawn from a seed.

Objects and lights are those of scene files, in which numbers that are drawn stand as spans, ``[lowest, highest]``. A
variation's random numbers come from (seed, number of the clip, number of the variation) alone: which worker draws it,
and when, changes nothing. Objects stand on the receiver, clear of each other, of what is modelled of the desk, of the
mirror balls and of the marker's card, and hide the marker from none of the clip's cameras.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from trimesh import transformations
from trimesh.bounds import corners

from warp_ar.errors import SceneError, UsageError
from warp_ar.output.shot import mesh_of
from warp_ar.scene import Exposure, Light, Object, Pose, Proxy, Scene
from warp_ar.scene.fields import fields_of
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.pixel_rays import project
from warp_ar.scene.scene_files import SceneFiles
from warp_ar.scene.sections import SceneTable, read_light, read_object
from warp_ar.scene.table import Table


class JobsError(UsageError):
    """A job file cannot be used."""


class JobTable(Table):
    """One table of a job file."""

    error = JobsError

    def path(self, key: str) -> Path | None:
        """A file or folder, relative to the job file; whether it is there is not asked."""
        if key not in self.data:
            return None
        value = self.text(key)
        if "\0" in value:
            self.fail(key, "expected a path; this cannot be one")
        return Path(self.folder / value).absolute()

    def pair(self, key: str, default: tuple[int, int], *, low: int) -> tuple[int, int]:
        """Two whole numbers, the first no more than the second."""
        value = self.data.get(key, list(default))
        whole = isinstance(value, list) and all(isinstance(n, int) and not isinstance(n, bool) for n in value)
        if not whole or len(value) != 2 or not low <= value[0] <= value[1]:
            self.fail(key, f"expected two whole numbers [least, most], {low} or more")
        return value[0], value[1]

    def span(self, key: str, default: tuple[float, float], *, low: float, high: float) -> tuple[float, float]:
        """Lowest and highest of a number that is drawn; they are one where it is fixed."""
        value = self.data.get(key, list(default))
        ends = value if _is_span(value) else [value, value]
        if not all(_is_number(end) and low <= end <= high for end in ends) or ends[0] > ends[1]:
            self.fail(key, f"expected a number from {low:g} to {high:g}, or [lowest, highest]")
        return ends[0], ends[1]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_span(value: object) -> bool:
    """Return whether a value is two numbers, or two lists of as many numbers."""
    if not isinstance(value, list) or len(value) != 2:
        return False
    low, high = (end if isinstance(end, list) else [end] for end in value)
    return len(low) == len(high) and all(map(_is_number, (*low, *high)))


_KEYS = ("variations", "seed", "objects", "lights", "every", "region", "margin", "exposure", "object", "light")
_OWN_KEYS = ("name", "turn", "rest", "weight")
"""Keys of an object, or a light, that are none of a scene's."""
_OBJECT_KEYS = ("shape", "file", "radius", "size", "major_radius", "minor_radius", "scale", "rotate", "material")
_LIGHT_KEYS = ("kind", "weight", "intensity", "color", *Light.USES["spot"])
_LIGHT_DEFAULTS: Mapping[str, Mapping[str, Any]] = {
    "point": {"intensity": 1.0},
    "spot": {"intensity": 1.0, "target": [0.0, 0.0, 0.0], "inner_angle": 15.0, "outer_angle": 8.0},
}
RESTS = ("upright", "any")
"""Ways in which an object stands: turned about the vertical alone, or any way up; its lowest point touches the desk."""
MOST = 64
"""Largest number of objects, and of lights, in a picture."""
Share = Callable[[tuple[int, ...]], Any]
"""Function from an array's shape to an array of random numbers from 0 (lowest) to 1 (highest)."""


def draw(value: Any, share: Share) -> Any:
    """Return a table or a value of one, with a drawn value in place of each span."""
    if isinstance(value, dict):
        return {key: draw(value[key], share) for key in sorted(value)}
    if not _is_span(value):
        return value
    low, high = np.array(value, float)
    return np.round(low + share(low.shape) * (high - low), 6).tolist()


@dataclasses.dataclass(frozen=True)
class Entry:
    """One kind of object or light: its table, with spans in it."""

    label: str
    folder: Path
    section: str
    """Name of the table."""
    data: Mapping[str, Any]
    weight: float
    """Weight with which it is chosen, against the others."""

    def table(self, share: Share, kind: type) -> SceneTable:
        """Return a draw as a table of a scene."""
        data = draw(dict(self.data), share)
        if "outer_angle" in data:  # beyond the inner one
            data["outer_angle"] = round(data["outer_angle"] + data.get("inner_angle", 0.0), 6)
        return SceneTable(self.label, SceneFiles(self.folder), self.section, data, list(fields_of(kind)))

    def draw(self, share: Share) -> Any:
        """Draw one light.

        Raises:
            SceneError: It is none of a scene.
        """
        return read_light(self.table(share, Light))


@dataclasses.dataclass(frozen=True)
class ObjectSpec(Entry):
    """One kind of object; its number in the catalogue, from 1 on, is its label."""

    name: str
    turn: tuple[float, float]
    """Lowest and highest degrees about the vertical."""
    rest: str
    """One of ``RESTS``."""

    def draw(self, share: Share) -> Object:
        """Draw one object; it stands as ``rotate`` says before it is turned."""
        return read_object(self.table(share, Object))

    @functools.cached_property
    def item(self) -> Object:
        """An object of this kind: shape, size and scale are those of all."""
        return self.draw(np.zeros)


@dataclasses.dataclass(frozen=True)
class Dataset:
    """The values of ``[dataset]``."""

    variations: int
    """Variations of each clip."""
    seed: int
    objects: tuple[int, int]
    """Least and most objects of a picture."""
    lights: tuple[int, int]
    """Least and most virtual lights."""
    every: int
    """One of so many frames is written."""
    region: tuple[float, ...] | None
    """x0, y0, x1, y1 in metres within which objects stand; None: the receiver, up to 0.25 m from the marker."""
    margin: float
    """Metres between objects, and from what is modelled of the desk."""
    exposure: tuple[float, float]
    """Lowest and highest scale of the exposure."""
    catalogue: tuple[ObjectSpec, ...]
    kinds_of_light: tuple[Entry, ...]


def read_dataset(label: str, folder: Path, data: object) -> Dataset:
    """``[dataset]`` of a job file.

    Raises:
        JobsError: A key is wrong or missing, or an object or a light makes no scene.
    """
    table = JobTable(label, folder, "dataset", data, _KEYS)
    catalogue = tuple(map(_read_object, _entries(table, "object", (*_OWN_KEYS, *_OBJECT_KEYS))))
    if not catalogue:
        table.fail("object", "expected at least one [[dataset.object]]")
    if len({spec.name for spec in catalogue}) < len(catalogue):
        table.fail("object", "two have one name; each is a category of its own")
    kinds = tuple(map(_read_light, _entries(table, "light", _LIGHT_KEYS)))
    region = table.vector("region", sizes=(4,), low=-100.0, high=100.0) if "region" in table else None
    if region is not None and not (region[0] < region[2] and region[1] < region[3]):
        table.fail("region", "expected [x0, y0, x1, y1] in metres with x0 < x1 and y0 < y1")
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
    return Dataset(
        variations=table.integer("variations", 1, low=1),
        seed=table.integer("seed", 0, low=0, high=2**63 - 1),
        objects=objects,
        lights=lights,
        every=table.integer("every", 1, low=1),
        region=region,
        margin=table.number("margin", 0.005, low=0.0, high=10.0),
        exposure=table.span("exposure", (1.0, 1.0), low=0.01, high=16.0),
        catalogue=catalogue,
        kinds_of_light=kinds,
    )


def _entries(table: JobTable, key: str, keys: Sequence[str]) -> list[JobTable]:
    """Return the tables of an array of tables."""
    found = table.data.get(key, [])
    if not isinstance(found, list):
        table.fail(key, f"expected [[dataset.{key}]]")
    return [JobTable(table.label, table.folder, f"dataset.{key}[{n}]", entry, keys) for n, entry in enumerate(found)]


def _read_object(table: JobTable) -> ObjectSpec:
    data = {"shape": "mesh", "material": {}, **{key: table.data[key] for key in _OBJECT_KEYS if key in table}}
    material = data["material"]
    if isinstance(material, dict):
        data["material"] = {"model": "metallic_roughness", **material}
    for key, value in data.items():
        if key != "material" and _is_span(value):
            table.fail(key, "expected one value: what is labelled alike has one size; make it two objects")
    name = Path(data["file"]).stem if isinstance(data.get("file"), str) else f"{data['shape']}-{table.section[15:-1]}"
    return ObjectSpec(
        **_entry(table, data),
        name=table.text("name", name),
        turn=table.span("turn", (0.0, 360.0), low=-360.0, high=360.0),
        rest=table.choice("rest", RESTS, RESTS[0]),
    )


def _read_light(table: JobTable) -> Entry:
    kind = table.choice("kind", _LIGHT_DEFAULTS, "spot")
    if "at" not in table:
        table.fail("at", "expected 3 numbers in metres, or [lowest, highest] of them")
    given = {key: value for key, value in table.data.items() if key != "weight"}
    return Entry(**_entry(table, {**_LIGHT_DEFAULTS[kind], **given, "kind": kind}))


def _entry(table: JobTable, data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of ``Entry``."""
    weight = table.number("weight", 1.0, low=0.0, high=1e6)
    return {"label": table.label, "folder": table.folder, "section": table.section, "data": data, "weight": weight}


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
    """The area on which objects of a clip may stand."""

    height: float
    """z of the receiver in metres."""
    region: tuple[float, ...]
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
    kinds, lights, exposure, random = _draw_kinds(dataset, clip, variation)
    drawn = [dataset.kinds_of_light[kind].draw(random.random) for kind in lights]
    # In the catalogue's order: scenes of the same kinds then share their kernels and their arrays.
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
    """First draws of a variation: its objects and lights, by their numbers; exposure; a generator for what is next."""
    random = np.random.Generator(np.random.PCG64(np.random.SeedSequence([dataset.seed, clip, variation])))
    count = int(random.integers(dataset.objects[0], dataset.objects[1] + 1))
    light_count = int(random.integers(dataset.lights[0], dataset.lights[1] + 1))
    exposure = round(random.uniform(*dataset.exposure), 6)
    kinds = _choose(random, [spec.weight for spec in dataset.catalogue], count)
    return kinds, _choose(random, [spec.weight for spec in dataset.kinds_of_light], light_count), exposure, random


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
    """Objects of these kinds where there is room; the larger kinds do not go first, so that all are treated alike."""
    receiver = receiver_of(base, dataset)
    seen = [poses[i] for i in np.linspace(0, len(poses) - 1, min(CAMERAS, len(poses))).astype(int)] if poses else []
    marker = [_project(base, pose, _marker_corners(base)) for pose in seen] if base.has_marker else []
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
    """An object somewhere in the region, resting on the receiver, and its points in the world."""
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
    """Return points with the same convex hull as an object before scale, turn and place, (n, 3) in metres."""
    return np.asarray(mesh_of(item).vertices, np.float64)


def receiver_of(scene: Scene, dataset: Dataset) -> Receiver:
    """Return the area on which objects may stand: the first level plane that is modelled, or the marker's."""
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
        taken.append(_hull(CARD * _marker_corners(scene)[:, :2] / QUIET))
    return Receiver(height, region, tuple(taken))


def _is_level(proxy: Proxy) -> bool:
    return bool(rotation_matrix(proxy.rotate)[2, 2] > 0.999)


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
    """Return whether two convex outlines overlap: no side of either separates them."""
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
    return project(scene.camera, camera)


def _is_in_view(scene: Scene, poses: Sequence[Pose], points: Points) -> bool:
    """Return whether the middle of an object is in the picture of at least half of the cameras."""
    if not poses:
        return True
    middle = 0.5 * (points.min(0) + points.max(0))[None]
    size = np.array([scene.camera.width, scene.camera.height])
    found = [_project(scene, pose, middle) for pose in poses]
    return sum(p is not None and bool(((p[0] >= 0) & (p[0] < size)).all()) for p in found) * 2 >= len(poses)


def _hides(scene: Scene, poses: Sequence[Pose], marker: Sequence[Points | None], points: Points) -> bool:
    """Return whether an object, taken for the box around it, may hide the marker from one of the cameras."""
    box = corners(np.stack([points.min(0), points.max(0)]))
    for pose, seen in zip(poses, marker, strict=False):
        pixels = _project(scene, pose, box)
        if pixels is None:
            return True
        if seen is not None and _overlap(_hull(pixels), _hull(seen)):
            return True
    return False
