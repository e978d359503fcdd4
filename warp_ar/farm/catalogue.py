"""What a data set is drawn from: objects, materials, lights and exposures, each with its distribution."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np

from warp_ar.errors import SceneError
from warp_ar.farm.tables import JobsError, JobTable, Span
from warp_ar.scene import (
    LambertMaterial,
    Light,
    Material,
    MetallicRoughnessMaterial,
    MirrorMaterial,
    Object,
    PhongMaterial,
    Scene,
    dumps_scene,
    loads_scene,
)

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
_LIGHT_KEYS = ("kind", "weight", "at", "target", "color", "intensity", "inner_angle", "outer_angle", "radius")
RESTS = ("upright", "any")
"""How an object stands: turned about the vertical alone, or any way up; its lowest point touches the desk."""
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
    """How often it is chosen, against the others."""
    material: MaterialSpec


@dataclasses.dataclass(frozen=True)
class LightSpec:
    """One kind of virtual light."""

    kind: str
    weight: float
    at: Span
    target: Span
    color: Span
    intensity: Span
    inner_angle: Span
    outer_angle: Span
    """Degrees beyond the inner angle."""
    radius: Span

    def draw(self, random: np.random.Generator) -> Light:
        """One light."""
        at, target, color = (_vector(span.draw(random)) for span in (self.at, self.target, self.color))
        intensity, inner, outer, radius = (
            round(span.draw_one(random), 6)
            for span in (self.intensity, self.inner_angle, self.outer_angle, self.radius)
        )
        if self.kind == "point":
            return Light("point", intensity, color, at=at, radius=radius)
        return Light(
            *("spot", intensity, color),
            at=at,
            target=target,
            inner_angle=inner,
            outer_angle=round(inner + outer, 6),
            radius=radius,
        )


@dataclasses.dataclass(frozen=True)
class Dataset:
    """What ``[dataset]`` says."""

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
        _read_light(JobTable(label, folder, f"dataset.light[{index}]", entry, _LIGHT_KEYS))
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
    item = Object(
        shape,  # type: ignore[arg-type]
        scale=table.number("scale", 1.0, low=1e-6, high=1e6),
        rotate=_vector(_fixed(table, "rotate", 3, -360.0, 360.0, (0.0, 0.0, 0.0))),
        **lengths,
    )
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
    kind = table.choice("kind", ("spot", "point"), "spot")

    def fixed(*values: float) -> Span:
        return Span(values, values)

    return LightSpec(
        kind=kind,
        weight=table.number("weight", 1.0, low=0.0, high=1e6),
        at=table.span("at", None, 3, low=-100.0, high=100.0),
        target=table.span("target", fixed(0.0, 0.0, 0.0), 3, low=-100.0, high=100.0),
        color=table.span("color", fixed(1.0, 1.0, 1.0), 3, low=0.0, high=1e3),
        intensity=table.span("intensity", fixed(1.0), low=0.0, high=1e6),
        inner_angle=table.span("inner_angle", fixed(15.0), low=0.0, high=80.0),
        outer_angle=table.span("outer_angle", fixed(8.0), low=0.01, high=9.0),
        radius=table.span("radius", fixed(0.0), low=0.0, high=10.0),
    )


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
