"""The table ``[dataset]`` of a job file, and the scene of each variation, drawn from a seed.

Objects, materials, lights and exposures have distributions. A variation's random numbers come from (seed, number of the
clip, number of the variation) alone: which worker draws it, and when, changes nothing. Objects stand on the receiver,
clear of each other, of what is modelled of the desk, of the mirror balls and of the marker's card, and hide the marker
from none of the clip's cameras.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError, UsageError
from warp_ar.scene import (
    Exposure,
    LambertMaterial,
    Light,
    Material,
    MetallicRoughnessMaterial,
    MirrorMaterial,
    Object,
    PhongMaterial,
    Pose,
    Proxy,
    Scene,
    dumps_scene,
    loads_scene,
)
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.mesh_cache import load_kept_mesh
from warp_ar.scene.shapes import torus_mesh
from warp_ar.scene.table import Table


class JobsError(UsageError):
    """A job file cannot be used."""


@dataclasses.dataclass(frozen=True)
class Span:
    """Numbers from which a value is drawn, each evenly: a list of lows and one of highs."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    def draw(self, random: np.random.Generator) -> tuple[float, ...]:
        """One value; its numbers are drawn in their order, also where low and high are one."""
        share = random.random(len(self.low))
        return tuple(a + float(t) * (b - a) for a, b, t in zip(self.low, self.high, share, strict=True))

    def draw_one(self, random: np.random.Generator) -> float:
        """One number."""
        return self.draw(random)[0]


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

    def span(self, key: str, default: Span | None, size: int = 1, *, low: float, high: float) -> Span:
        """A value that is drawn: a fixed one, or ``[lowest, highest]``.

        Args:
            key: The key.
            default: Where it is left out; None: it may not be.
            size: Numbers of the value.
            low: Least that a number may be.
            high: Most.
        """
        right = (
            f"expected {'a number' if size == 1 else f'{size} numbers'} from {low:g} to {high:g}, or [lowest, highest]"
        )
        value = self.data.get(key)
        if value is None:
            if default is None:
                self.fail(key, right)
            return default
        ends = value if size == 1 or (isinstance(value, list) and value and isinstance(value[0], list)) else [value]
        if size == 1:
            ends = [[end] for end in (ends if isinstance(ends, list) else [ends])]
        if len(ends) not in (1, 2) or any(not isinstance(end, list) or len(end) != size for end in ends):
            self.fail(key, right)
        numbers: npt.NDArray[Any] = np.array(ends, object)
        if not all(_is_number(n) and low <= n <= high for n in numbers.flat):
            self.fail(key, right)
        if any(a > b for a, b in zip(ends[0], ends[-1], strict=True)):
            self.fail(key, f"{right}, the lowest first")
        return Span(tuple(map(float, ends[0])), tuple(map(float, ends[-1])))


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


_KEYS = ("variations", "seed", "objects", "lights", "every", "region", "margin", "exposure", "object", "light")
_OBJECT_KEYS = (
    *("name", "shape", "file", "radius", "size", "major_radius", "minor_radius", "scale", "rotate", "turn", "rest"),
    *("weight", "material"),
)
_SHAPES = {
    "mesh": ("file",),
    "sphere": ("radius",),
    "box": ("size",),
    "torus": ("major_radius", "minor_radius"),
}
_MATERIALS: dict[str, tuple[type[Material], tuple[str, ...]]] = {
    "lambert": (LambertMaterial, ("base_color",)),
    "mirror": (MirrorMaterial, ("base_color",)),
    "metallic_roughness": (MetallicRoughnessMaterial, ("base_color", "metallic", "roughness")),
    "phong": (PhongMaterial, ("diffuse", "specular", "shininess")),
}
_COLORS = ("base_color", "diffuse", "specular")
_LIGHT_SPANS: dict[str, tuple[tuple[float, ...] | None, int, float, float]] = {
    "at": (None, 3, -100.0, 100.0),
    "target": ((0.0, 0.0, 0.0), 3, -100.0, 100.0),
    "color": ((1.0, 1.0, 1.0), 3, 0.0, 1e3),
    "intensity": ((1.0,), 1, 0.0, 1e6),
    "inner_angle": ((15.0,), 1, 0.0, 80.0),
    "outer_angle": ((8.0,), 1, 0.01, 9.0),
    "radius": ((0.0,), 1, 0.0, 10.0),
}
"""Default (None: there is none), numbers, least and most of each parameter of a light; drawn in this order."""
RESTS = ("upright", "any")
"""Ways in which an object stands: turned about the vertical alone, or any way up; its lowest point touches the desk."""
MOST = 64
"""Objects, or lights, of a picture."""


@dataclasses.dataclass(frozen=True)
class MaterialSpec:
    """A material whose numbers are drawn."""

    model: str
    spans: tuple[tuple[str, Span], ...]
    """Parameter and what it is drawn from."""

    def draw(self, random: np.random.Generator) -> Material:
        """One material."""
        values: dict[str, Any] = {}
        for name, span in self.spans:
            drawn = tuple(round(v, 6) for v in span.draw(random))
            values[name] = drawn if name in _COLORS else drawn[0]
        return _MATERIALS[self.model][0](**values)


@dataclasses.dataclass(frozen=True)
class ObjectSpec:
    """One kind of object; its number in the catalogue, from 1 on, is its label."""

    name: str
    item: Object
    """Shape, size and scale; it stands as ``item.rotate`` says before it is turned."""
    turn: Span
    """Degrees about the vertical."""
    rest: str
    """One of ``RESTS``."""
    weight: float
    """Weight with which it is chosen, against the others."""
    material: MaterialSpec


@dataclasses.dataclass(frozen=True)
class LightSpec:
    """One kind of virtual light."""

    kind: str
    weight: float
    spans: tuple[tuple[str, Span], ...]
    """Parameter and what it is drawn from; the outer angle is in degrees beyond the inner one."""

    def draw(self, random: np.random.Generator) -> Light:
        """Draw one light."""
        drawn = {name: tuple(round(v, 6) for v in span.draw(random)) for name, span in self.spans}
        at, target, color = (_vector(drawn[name]) for name in ("at", "target", "color"))
        intensity, inner, outer, radius = (
            drawn[name][0] for name in ("intensity", "inner_angle", "outer_angle", "radius")
        )
        if self.kind == "point":
            return Light("point", intensity, color, at=at, radius=radius)
        end = round(inner + outer, 6)
        return Light(
            *("spot", intensity, color), at=at, target=target, inner_angle=inner, outer_angle=end, radius=radius
        )


@dataclasses.dataclass(frozen=True)
class Dataset:
    """The values of ``[dataset]``."""

    variations: int
    """Of each clip."""
    seed: int
    objects: tuple[int, int]
    """Least and most objects of a picture."""
    lights: tuple[int, int]
    """Least and most virtual lights."""
    every: int
    """One of so many frames is written."""
    region: tuple[float, float, float, float] | None
    """x0, y0, x1, y1 in metres within which objects stand; None: the receiver, up to 0.25 m from the marker."""
    margin: float
    """Metres between objects, and from what is modelled of the desk."""
    exposure: Span
    """Scale of the exposure."""
    catalogue: tuple[ObjectSpec, ...]
    kinds_of_light: tuple[LightSpec, ...]


def read_dataset(label: str, folder: Path, data: object) -> Dataset:
    """``[dataset]`` of a job file.

    Raises:
        JobsError: A key is wrong or missing.
    """
    table = JobTable(label, folder, "dataset", data, _KEYS)
    entries = table.data.get("object")
    if not isinstance(entries, list) or not entries:
        table.fail("object", "expected at least one [[dataset.object]]")
    catalogue = tuple(
        _read_object(JobTable(label, folder, f"dataset.object[{index}]", entry, _OBJECT_KEYS), index)
        for index, entry in enumerate(entries)
    )
    if len({spec.name for spec in catalogue}) < len(catalogue):
        table.fail("object", "two have one name; each is a category of its own")
    entries = table.data.get("light", [])
    if not isinstance(entries, list):
        table.fail("light", "expected [[dataset.light]]")
    kinds = tuple(
        _read_light(JobTable(label, folder, f"dataset.light[{index}]", entry, ("kind", "weight", *_LIGHT_SPANS)))
        for index, entry in enumerate(entries)
    )
    region = table.data.get("region")
    if region is not None:
        spans = table.span("region", None, 4, low=-100, high=100)
        x0, y0, x1, y1 = spans.low
        if not (x0 < x1 and y0 < y1) or spans.low != spans.high:
            table.fail("region", "expected [x0, y0, x1, y1] in metres with x0 < x1 and y0 < y1")
        region = (x0, y0, x1, y1)
    lights = table.pair("lights", (1, 1) if kinds else (0, 0), low=0)
    objects = table.pair("objects", (1, 3), low=0)
    for key, (_, most) in (("objects", objects), ("lights", lights)):
        if most > MOST:
            table.fail(key, f"expected {MOST} at most")
    if lights[1] and not kinds:
        table.fail("lights", "expected at least one [[dataset.light]] to draw them from")
    return Dataset(
        variations=table.integer("variations", 1, low=1),
        seed=table.integer("seed", 0, low=0, high=2**63 - 1),
        objects=objects,
        lights=lights,
        every=table.integer("every", 1, low=1),
        region=region,
        margin=table.number("margin", 0.005, low=0.0, high=10.0),
        exposure=table.span("exposure", Span((1.0,), (1.0,)), low=0.01, high=16.0),
        catalogue=catalogue,
        kinds_of_light=kinds,
    )


def _read_object(table: JobTable, index: int) -> ObjectSpec:
    shape = table.choice("shape", _SHAPES, "mesh")
    table.only("shape", _SHAPES[shape], (key for keys in _SHAPES.values() for key in keys), default=shape)
    lengths: dict[str, Any] = {}
    for key in _SHAPES[shape]:
        if key == "file":
            lengths[key] = table.path(key)
            if lengths[key] is None or not lengths[key].is_file():
                table.fail(key, f"there is no mesh file {lengths[key]}")
        elif key == "size":
            lengths[key] = _fixed(table, key, 3, 1e-4, 10.0)
        else:
            lengths[key] = _fixed(table, key, 1, 1e-4, 10.0)[0]
    material = table.data.get("material", {"model": "metallic_roughness"})
    scale = table.number("scale", 1.0, low=1e-6, high=1e6)
    rotate = _vector(_fixed(table, "rotate", 3, -360.0, 360.0, (0.0, 0.0, 0.0)))
    try:
        item = Object(shape, scale=scale, rotate=rotate, **lengths)  # type: ignore[arg-type]
    except SceneError as error:
        table.fail("shape", str(error))
    return ObjectSpec(
        name=table.text("name", f"{shape}-{index + 1}" if item.file is None else item.file.stem),
        item=item,
        turn=table.span("turn", Span((0.0,), (360.0,)), low=-360.0, high=360.0),
        rest=table.choice("rest", RESTS, RESTS[0]),
        weight=table.number("weight", 1.0, low=0.0, high=1e6),
        material=_read_material(table, material),
    )


def _read_material(outer: JobTable, data: object) -> MaterialSpec:
    every = {name for _, names in _MATERIALS.values() for name in names}
    table = outer.inner("material", data, ("model", *sorted(every)))
    model = table.choice("model", _MATERIALS, "metallic_roughness")
    names = _MATERIALS[model][1]
    table.only("model", names, every, default=model)
    spans = []
    for name in names:
        default = getattr(_MATERIALS[model][0], name)
        first = default if isinstance(default, tuple) else (default,)
        high = 1e4 if name == "shininess" else 1.0
        spans.append((name, table.span(name, Span(first, first), len(first), low=0.0, high=high)))
    return MaterialSpec(model, tuple(spans))


def _read_light(table: JobTable) -> LightSpec:
    spans = tuple(
        (name, table.span(name, None if default is None else Span(default, default), size, low=low, high=high))
        for name, (default, size, low, high) in _LIGHT_SPANS.items()
    )
    weight = table.number("weight", 1.0, low=0.0, high=1e6)
    return LightSpec(table.choice("kind", ("spot", "point"), "spot"), weight, spans)


def _fixed(
    table: JobTable, key: str, size: int, low: float, high: float, default: tuple[float, ...] | None = None
) -> tuple[float, ...]:
    """Numbers that are not drawn: a label stands for one size."""
    span = table.span(key, None if default is None else Span(default, default), size, low=low, high=high)
    if span.low != span.high:
        table.fail(key, "expected one value: what is labelled alike has one size; make it two objects")
    return span.low


def _vector(values: tuple[float, ...]) -> tuple[float, float, float]:
    x, y, z = (round(v, 6) for v in values)
    return x, y, z


def check_dataset(label: str, dataset: Dataset, base: Scene) -> None:
    """See to it that scenes can be drawn: every object with the lows and the highs of its material, every light.

    Raises:
        JobsError: One makes no scene, or none may be chosen.
    """
    if dataset.objects[1] and not sum(spec.weight for spec in dataset.catalogue) > 0.0:
        raise JobsError(f"{label}: dataset.object: every weight is 0; one must be above")
    if dataset.lights[1] and not sum(spec.weight for spec in dataset.kinds_of_light) > 0.0:
        raise JobsError(f"{label}: dataset.light: every weight is 0; one must be above")
    for section, specs in (("object", dataset.catalogue), ("light", dataset.kinds_of_light)):
        for index, spec in enumerate(specs):
            for extreme in (_Extreme(0.0), _Extreme(math.nextafter(1.0, 0.0))):
                scene = dataclasses.replace(base, source=None, objects=(), lights=())
                if isinstance(spec, ObjectSpec):
                    made = dataclasses.replace(spec.item, material=spec.material.draw(extreme))
                    scene = dataclasses.replace(scene, objects=(made,))
                elif isinstance(spec, LightSpec):
                    scene = dataclasses.replace(scene, lights=(spec.draw(extreme),))
                try:
                    loads_scene(dumps_scene(scene), label)
                except SceneError as error:
                    told = str(error).replace(f"{section}[0]", f"dataset.{section}[{index}]")
                    raise JobsError(told) from error


class _Extreme(np.random.Generator):
    """Draws the same number always."""

    def __init__(self, value: float) -> None:
        super().__init__(np.random.PCG64(0))
        self._value = value

    def random(self, size: Any = None, *_: Any, **__: Any) -> Any:
        """As a generator's."""
        return np.full(size, self._value)


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
    """The first draws of a variation."""

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
    """Return the area on which objects may stand: the first level plane that is modelled, or the marker's."""
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
    zero = np.zeros(3)
    pixels: Any = cv2.projectPoints(camera, zero, zero, scene.camera.matrix(), np.array(scene.camera.distortion))[0]
    return np.asarray(pixels, np.float64).reshape(-1, 2)


def _box(points: Points) -> Points:
    """Corners of the box around points, (8, 3)."""
    low, high = points.min(0), points.max(0)
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


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
    corners = _box(points)
    for pose, seen in zip(poses, marker, strict=False):
        pixels = _project(scene, pose, corners)
        if pixels is None:
            return True
        if seen is not None and _overlap(_hull(pixels), _hull(seen)):
            return True
    return False
