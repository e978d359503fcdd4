"""Edits of a scene by the page; each edited scene is checked by the rules of scene files.

Animations of glTF files can be chosen, started, paused and accelerated without a jump of the pose.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import numpy as np
import numpy.typing as npt

from warp_ar.checks.check_print import card_scale
from warp_ar.errors import SceneError, UsageError
from warp_ar.scene import (
    Camera,
    CharucoBoard,
    EmissiveMaterial,
    Exposure,
    FileMaterial,
    LambertMaterial,
    Light,
    Material,
    MetallicRoughnessMaterial,
    Object,
    Play,
    Probe,
    Proxy,
    Scene,
    dumps_scene,
    loads_scene,
)
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.scene.materials import MATERIALS
from warp_ar.scene.mesh_files import GLTF_SUFFIXES, animations_of
from warp_ar.scene.object_materials import mesh_of, moving_mesh_of
from warp_ar.scene.scene_files import files_of
from warp_ar.scene.textures import file_stamp
from warp_ar.stages import STAGES
from warp_ar.stages.quality import Quality
from warp_ar.tracking.card_layout import CARD_BOARD, CARD_MARKER, RINGS, ball_center
from warp_ar.viewer.protocol import EFFECTS, Command

_T = TypeVar("_T")

NONE = -1
"""Index for no animation: nodes keep the file's static transforms."""
_LIGHT_REACH, _STEP, _GOLDEN, _PLACES = 0.03, 0.02, 2.399963, 400
"""Search for a free place: radius kept around a light, m; spiral step, m; spiral angle, rad; number of places tried."""
_DIGITS = 4
"""Decimal places of times, seconds, that the page writes into scene files."""


def names_of(item: Object) -> tuple[str, ...]:
    """Return the names of the animations in an object's file, in order; an unnamed one is called by its number."""
    if item.file is None or item.mesh is not None or item.file.suffix.lower() not in GLTF_SUFFIXES:
        return ()
    return _names(item.file, file_stamp(item.file))


@functools.lru_cache(maxsize=64)
def _names(path: Path, stamp: tuple[int, int]) -> tuple[str, ...]:
    try:
        return tuple(name or f"Animation {number}" for number, name in enumerate(animations_of(path)))
    except SceneError:
        return ()  # the error is reported when the scene is loaded


def play_record(item: Object) -> dict[str, Any]:
    """Return the record of an object's animations for the page."""
    names = names_of(item)
    if not names:
        return {}
    play = item.play or Play()
    number = names.index(play.animation) if isinstance(play.animation, str) else play.animation
    number = NONE if item.play is None else number
    return {"animations": names, "animation": number, "speed": play.speed, "loop": play.loop, "paused": play.paused}


def set_play(item: Object, key: str, value: float, seconds: float) -> Object:
    """Return the object with one value of its animation changed, without a jump of its present pose.

    Args:
        item: An object with a glTF file.
        key: ``animation`` starts an animation by its number, or ends it with ``NONE``. ``speed`` and ``loop`` change
            the playback. ``paused`` = 0 continues from the held pose, or restarts a finished animation.
        value: Number or flag.
        seconds: Time of the shown frame since the first frame.

    Raises:
        UsageError: The object's file has no such animation, or the object plays no animation.
    """
    names = names_of(item)
    if key == "animation":
        number = int(value)
        if not NONE <= number < len(names):
            raise UsageError(f"animation {number}: the file has {len(names)}, counted from 0")
        begun = Play(animation=number, start=round(seconds, _DIGITS))
        return dataclasses.replace(item, play=None if number == NONE else begun)
    moving = moving_mesh_of(item)
    if item.play is None or moving is None:
        raise UsageError("the object plays no animation: choose one first")
    at = item.play.time_at(seconds, moving.duration)
    if key == "paused" and not value and not item.play.loop and at >= moving.duration:
        at = 0.0
    changed: Any = value if key == "speed" else bool(value)
    held = dataclasses.replace(item.play, offset=round(at, _DIGITS), start=round(seconds, _DIGITS))
    return dataclasses.replace(item, play=dataclasses.replace(held, **{key: changed}))


MOST_PARTS: Final = 16
"""Largest number of objects (or lights, or proxies) to which the page can add."""
RULER: Final = 0.1
"""Length of each ruler on the printed card at true scale, metres."""
_SCALES: Final = (0.5, 1.5)
"""Smallest and largest accepted ratio of a ruler's measured to nominal length; beyond, it was misread."""

_LISTS: Final = {"object": "objects", "light": "lights", "proxy": "proxies", "probe": "probes"}
_KEYS: Final = {
    *("at", "rotate", "scale", "radius", "size", "major_radius", "minor_radius", "target", "direction", "color"),
    *("intensity", "inner_angle", "outer_angle", "dictionary", "id"),
    *("model", "base_color", "diffuse", "specular", "shininess", "metallic", "roughness"),
}
"""Keys of parts and materials that the page may set. None of them names a file."""
NEW: Final[Mapping[tuple[str, str], Object | Light]] = {
    ("object", "sphere"): Object("sphere", radius=0.03, at=(0.12, -0.08, 0.03), material=MetallicRoughnessMaterial()),
    ("object", "box"): Object("box", size=(0.05, 0.05, 0.05), at=(0.12, -0.08, 0.025), material=LambertMaterial()),
    ("object", "torus"): Object(
        "torus",
        major_radius=0.03,
        minor_radius=0.011,
        at=(0.12, -0.08, 0.011),
        material=MetallicRoughnessMaterial((1.0, 0.77, 0.34), 1.0, 0.25),
    ),
    ("light", "point"): Light("point", 0.12, at=(0.05, -0.05, 0.2)),
    ("light", "spot"): Light(
        "spot", 1.0, at=(0.0, -0.1, 0.35), target=(0.05, 0.05, 0.0), inner_angle=12.0, outer_angle=20.0
    ),
    ("light", "directional"): Light("directional", 0.6, direction=(0.4, 0.5, -1.0)),
}


def checked(scene: Scene) -> Scene:
    """Write the scene as a scene file, read that again, and return the result.

    Raises:
        SceneError: The reader refuses the file.
    """
    return dataclasses.replace(loads_scene(dumps_scene(scene)), path=scene.path)


def use_card(scene: Scene, radius: float, ruler: float) -> Scene:
    """Return the scene with the printed card as its marker and a mirror ball on the card's cross.

    Args:
        scene: The scene. Its objects and lights are kept, its balls are replaced, and a table is added if it has none.
            If it had another marker, its walls and boxes are removed, as their places refer to that marker.
        radius: Radius of the ball, metres.
        ruler: Measured length of the print's rulers of 100 mm, metres.

    Raises:
        UsageError: The ball does not fit the card, or the ruler's length is implausible.
    """
    largest = 1.25 * max(RINGS)
    if not 0.005 <= radius <= largest:
        raise UsageError(f"the ball's radius is {1e3 * radius:g} mm; expected 5 to {1e3 * largest:g} mm")
    scale = ruler / RULER
    if not _SCALES[0] <= scale <= _SCALES[1]:
        low, high = (1e3 * RULER * bound for bound in _SCALES)
        raise UsageError(f"the print's ruler measures {1e3 * ruler:g} mm; expected {low:g} to {high:g} mm")
    made = CARD_BOARD
    lengths = (round(made.square_length * scale, 7), round(made.marker_length * scale, 7))
    board = CharucoBoard(made.columns, made.rows, *lengths)
    x, y, _ = ball_center(radius)
    center = (round(x * scale, 5), round(y * scale, 5), radius)
    ball = dataclasses.replace(scene.probes[0], center=center, radius=radius) if scene.probes else Probe(center, radius)
    kept = scene.proxies
    if card_ruler(scene) is None:
        kept = tuple(proxy for proxy in kept if proxy.shape == "plane" and not any(proxy.rotate))
    has_table = any(proxy.shape == "plane" for proxy in kept)
    return checked(
        dataclasses.replace(
            scene,
            marker=dataclasses.replace(CARD_MARKER, board=board),
            probes=(ball,),
            proxies=kept if has_table else (*kept, Proxy("plane", size=(1.6, 1.2))),
        )
    )


def card_ruler(scene: Scene) -> float | None:
    """Return the length of the rulers on the scene's printed card, metres; None if its marker is no printed card."""
    scale = card_scale(scene.marker)
    return None if scale is None else RULER * scale


def _items(scene: Scene, part: str, index: int) -> list[Any]:
    """Return a new list of the scene's objects, lights, proxies or balls.

    Raises:
        UsageError: The list has no item of that index.
    """
    items = list(getattr(scene, _LISTS[part]))
    if index >= len(items):
        raise UsageError(f"{part} {index}: the scene has {len(items)}")
    return items


def set_value(scene: Scene, part: str, index: int, key: str, value: Any) -> Scene:
    """Return the scene with one key of one part changed.

    Args:
        scene: The scene.
        part: ``object``, ``light``, ``proxy``, ``exposure`` or ``marker``.
        index: Number of the part.
        key: Key of the part's section in a scene file, or of its material.
        value: A number, a tuple of numbers or a word.

    Raises:
        UsageError: The scene has no such part, or the part has no such editable key.
        SceneError: The value is not valid in a scene file.
    """
    items = _items(scene, part, index) if part in _LISTS else []
    item = items[index] if items else getattr(scene, part)
    if key not in _KEYS or not (hasattr(item, key) or isinstance(item, Object)):
        right = ", ".join(sorted(_KEYS & vars(item).keys()))
        raise UsageError(f"{part}: key {key!r} cannot be edited; expected {right}")
    if not hasattr(item, key):
        changes: dict[str, Any] = {"material": _material(_shown_material(item), key, value)}
    else:
        changes = {key: value}
        if key in ("target", "direction"):
            changes["direction" if key == "target" else "target"] = None
        if part == "marker" and key in ("id", "size"):
            changes["board"] = None  # a single marker replaces the board
    made: Any = dataclasses.replace(item, **changes)
    return _replaced(scene, part, index, made) if items else checked(dataclasses.replace(scene, **{part: made}))


def _replaced(scene: Scene, part: str, index: int, *made: Any) -> Scene:
    """Return the scene with one item of a list replaced by the given items, or removed if none are given."""
    items = _items(scene, part, index)
    items[index : index + 1] = made
    lists: dict[str, Any] = {_LISTS[part]: tuple(items)}
    return checked(dataclasses.replace(scene, **lists))


def _shown_material(item: Object) -> Material:
    """Return an object's material: the default Lambertian if it has neither a material nor a file."""
    return LambertMaterial() if isinstance(item.material, FileMaterial) and item.shape != "mesh" else item.material


def _material(material: Material, key: str, value: Any) -> Material:
    if key == "model":
        if value not in MATERIALS:
            raise UsageError(f"material: model {value!r}; expected {', '.join(MATERIALS)}")
        if value == "file":
            return FileMaterial()
        first = iter(vars(material).values())  # the colour, which all models but ``file`` declare first
        color: Any = next(first, LambertMaterial.base_color)
        made: Any = MATERIALS[value]
        if made is EmissiveMaterial and isinstance(color, Path):
            color = EmissiveMaterial.color
        return cast(Material, made(color))
    if key not in vars(material):
        right = ", ".join(sorted(_KEYS & vars(material).keys()))
        raise UsageError(f"material: {type(material).__name__} has no {key}; expected {right}")
    return dataclasses.replace(material, **{key: value})


def add_part(scene: Scene, part: str, kind: str) -> Scene:
    """Return the scene with a new object or light of ``kind``; meshes are dropped files, and proxies are outlined.

    Raises:
        UsageError: There is no such kind, or the scene has ``MOST_PARTS`` already.
    """
    if (part, kind) not in NEW:
        raise UsageError(f"add {part} {kind[:40]!r}: expected one of {', '.join(map(' '.join, NEW))}")
    return add_item(scene, part, NEW[part, kind])


def add_item(scene: Scene, part: str, item: Object | Light | Proxy) -> Scene:
    """Return the scene with one more object, light or proxy; a new object or light is moved to a free place.

    Raises:
        UsageError: The scene has ``MOST_PARTS`` of them already.
        SceneError: The item is not valid in a scene file.
    """
    items = getattr(scene, _LISTS[part])
    if len(items) >= MOST_PARTS:
        raise UsageError(f"{len(items)} are in the scene already; {MOST_PARTS} at most: take one away first")
    lists: dict[str, Any] = {_LISTS[part]: (*items, _apart(scene, item))}
    return checked(dataclasses.replace(scene, **lists))


def set_animation(scene: Scene, index: int, key: str, value: float, seconds: float) -> Scene:
    """Return the scene with one value of an object's animation changed; see ``set_play`` for the arguments.

    Raises:
        SceneError: The object is not valid in a scene file.
        UsageError: The scene has no such object, or ``set_play`` refuses the value.
    """
    item = _items(scene, "object", index)[index]
    return _replaced(scene, "object", index, set_play(item, key, value, seconds))


@dataclasses.dataclass(frozen=True)
class Wanted:
    """State that viewers want to see."""

    scene: Scene
    """Edited scene."""
    quality: Quality
    """Preset, or the quality chosen under a budget."""
    off: frozenset[str] = frozenset()
    """Effects that are switched off."""
    hidden: frozenset[tuple[str, int]] = frozenset()
    """(part, index) of hidden objects, lights and proxies."""
    methods: tuple[tuple[str, str], ...] = ()
    """(stage, method) pairs that replace the preset's methods."""
    cameras: tuple[Camera, ...] = ()
    """Cameras calibrated on the page, at most one per frame size; each replaces the scene's camera."""
    materials: tuple[tuple[int, Material], ...] = ()
    """(object's index, material) from before each change of a material's model, newest last."""

    def camera_of(self, size: tuple[int, int]) -> Camera | None:
        """Return the calibrated camera for frames of a size, (width, height); None if none was calibrated."""
        return next((camera for camera in self.cameras if (camera.width, camera.height) == size), None)

    def with_scene(self, **changes: Any) -> Wanted:
        """Return this state with fields of its scene replaced."""
        return dataclasses.replace(self, scene=dataclasses.replace(self.scene, **changes))

    def with_camera(self, camera: Camera) -> Wanted:
        """Return this state with a calibrated camera for frames of the camera's size."""
        others = (own for own in self.cameras if (own.width, own.height) != (camera.width, camera.height))
        return dataclasses.replace(self, cameras=(*others, camera))

    def shown_scene(self) -> Scene:
        """Return the scene without hidden parts and switched-off effects, as the picture shows it and files save it."""
        effects = {"object": "objects", "light": "lights", "probe": "environment", "proxy": "receiver"}
        lists: dict[str, Any] = {}
        for part, effect in effects.items():
            items = [] if effect in self.off else enumerate(getattr(self.scene, _LISTS[part]))
            lists[_LISTS[part]] = tuple(item for index, item in items if (part, index) not in self.hidden)
        exposure = Exposure() if "exposure" in self.off else self.scene.exposure
        return dataclasses.replace(self.scene, **lists, exposure=exposure)

    def shown_quality(self) -> Quality:
        """Return the quality with the chosen methods, and without the methods of switched-off effects."""
        methods = dict(self.methods)
        if "relief" in self.off:
            methods["relight"] = "flat"
        if "environment_shadow" in self.off:
            methods["environment_shadow"] = "none"
        return self.quality.with_methods(**methods) if methods else self.quality

    def without_part(self, part: str, index: int) -> Wanted:
        """Return this state with one object, light or proxy removed; other hidden parts stay hidden."""
        hidden = frozenset((t, i - (t == part and i > index)) for t, i in self.hidden if (t, i) != (part, index))
        return dataclasses.replace(self, scene=_replaced(self.scene, part, index), hidden=hidden, materials=())

    def with_value(self, part: str, index: int, key: str, value: Any) -> Wanted:
        """Return this state with one value changed.

        A change of a material's model restores the object's last material of that model, if it had one.
        """
        scene = set_value(self.scene, part, index, key, value)
        if part != "object" or key != "model":
            return dataclasses.replace(self, scene=scene)
        item, made = self.scene.objects[index], scene.objects[index]
        kept = (*self.materials[-MOST_PARTS:], (index, _shown_material(item)))
        had = (old for number, old in reversed(kept) if number == index and type(old) is type(made.material))
        made = dataclasses.replace(made, material=next(had, made.material))
        return dataclasses.replace(self, scene=_replaced(scene, "object", index, made), materials=kept)

    def with_part_shown(self, part: str, index: int, on: bool) -> Wanted:
        """Return this state with one object, light or proxy shown or hidden."""
        item = {(part, index)}
        return dataclasses.replace(self, hidden=self.hidden - item if on else self.hidden | item)

    def with_method(self, stage: str, method: str) -> Wanted:
        """Return this state with a chosen method for one stage; an empty name restores the preset's method.

        Raises:
            UsageError: The stage or the method does not exist.
        """
        known = {kind.name: kind.methods for kind in STAGES}
        if stage not in known or (method and method not in known[stage]):
            raise UsageError(f"stage {stage!r} has no method {method!r}")
        methods = {**dict(self.methods), stage: method}
        return dataclasses.replace(self, methods=tuple(sorted((s, r) for s, r in methods.items() if r)))

    def with_effect(self, name: str, on: bool) -> Wanted:
        """Return this state with an effect switched on or off."""
        return dataclasses.replace(self, off=self.off - {name} if on else self.off | {name})


Edit = Callable[[Wanted], Wanted]


def make_edit(command: Command, original: Wanted, seconds: float = 0.0) -> tuple[Edit, str] | None:
    """Return the edit of a command and its label; None if the command is not an edit.

    Args:
        command: Command of a page.
        original: State before any edit, to which ``reset`` returns.
        seconds: Time of the newest frame since the first.
    """
    fields = command.fields
    part, index, key, on = (fields.get(name) for name in ("part", "index", "key", "on"))
    names = {None: "object", "object": "object", "light": "light", "proxy": "shape"}
    words = f"{names[part]} {(index or 0) + 1}" if part in names else f"the {part}"

    def of_scene(change: Callable[..., Scene], *more: Any) -> Edit:
        return lambda w: dataclasses.replace(w, scene=change(w.scene, *fields.values(), *more))

    edits: dict[str, tuple[Edit, str]] = {
        "set": (lambda w: w.with_value(**fields), f"set {key} of {words}"),
        "animate": (of_scene(set_animation, seconds), f"set the {'pause' if key == 'paused' else key} of {words}"),
        "add": (of_scene(add_part), f"add {fields.get('kind')}"),
        "duplicate": (of_scene(duplicate_part), f"duplicate {words}"),
        "snap": (of_scene(snap_object), f"set {words} on the desk"),
        "remove": (lambda w: w.without_part(**fields), f"remove {words}"),
        "show": (lambda w: w.with_part_shown(**fields), f"{'show' if on else 'hide'} {words}"),
        "effect": (lambda w: w.with_effect(**fields), f"switch {fields.get('name')} {'on' if on else 'off'}"),
        "method": (lambda w: w.with_method(**fields), f"choose the method of {fields.get('stage')}"),
        "card": (of_scene(use_card), "use the printed card"),
        "reset": (lambda w: dataclasses.replace(original, quality=w.quality, cameras=w.cameras), "undo all edits"),
    }
    edit, label = edits.get(command.type, (None, ""))
    return None if edit is None else (edit, label.replace("_", " "))


def moved(value: _T, place: Callable[[Path], Path]) -> _T:
    """Return a scene, or a part of one, with each file path replaced by ``place(path)``."""
    if isinstance(value, Path):
        return cast(_T, place(value))
    if isinstance(value, tuple) and list(files_of(value)):
        return cast(_T, tuple(moved(item, place) for item in value))
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return value
    fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value) if field.init}
    changes = {name: new for name, old in fields.items() if (new := moved(old, place)) is not old}
    return dataclasses.replace(value, **changes)


def with_bare_names(scene: Scene, folder: Path) -> Scene:
    """Return the scene with the paths of files in ``folder`` shortened to their names."""
    return moved(scene, lambda path: Path(path.name) if path.is_relative_to(folder) else path)


def wanted_record(wanted: Wanted) -> dict[str, Any]:
    """Return the state as plain data for the page; files are given by name without their folders."""
    scene = wanted.scene

    def plain(item: Any) -> dict[str, Any]:
        fields = {key: value.name if isinstance(value, Path) else value for key, value in vars(item).items()}
        return {key: value for key, value in fields.items() if isinstance(value, str | int | float | tuple | None)}

    def part(kind: str, index: int, item: Any) -> dict[str, Any]:
        record = {**plain(item), "visible": (kind, index) not in wanted.hidden}
        if isinstance(item, Object):
            material = _shown_material(item)
            model = next(name for name, made in MATERIALS.items() if isinstance(material, made))
            record["material"] = {"model": model, **plain(material)}
            record["reach"] = _reach(item)
            record |= play_record(item)
        return record

    marker, ruler = scene.marker, card_ruler(scene)
    return {
        "name": scene.name,
        **{name: [part(kind, *one) for one in enumerate(getattr(scene, name))] for kind, name in _LISTS.items()},
        "captured": None if scene.captured is None else scene.captured.file.name,
        "exposure": scene.exposure.scale,
        "marker": {
            **plain(marker),
            "board": None if marker.board is None else str(marker.board),
            "ruler": None if ruler is None else round(ruler, 6),
        },
        "effects": {name: name not in wanted.off for name in EFFECTS},
        "quality": wanted.quality.name,
    }


def _box(item: Object) -> npt.NDArray[np.float64]:
    """Return the corners, (2, 3), of an object's bounding box before its rotation and translation, metres."""
    if (mesh := mesh_of(item)) is not None:
        return item.scale * mesh.bounds.astype(np.float64)
    wide = item.radius + item.major_radius + item.minor_radius
    tall = {"sphere": item.radius, "disk": 0.0}.get(item.shape, item.minor_radius + 0.5 * item.length)
    half = 0.5 * np.array([*item.size, 0.0])[:3] if any(item.size) else np.array([wide, wide, tall])
    return item.scale * np.array([-half, half])


def _reach(item: Object) -> float:
    """Return the mean horizontal extent of an object from its origin, metres."""
    return float(np.abs(_box(item)[:, :2]).mean())


def _spot(item: Any) -> tuple[npt.NDArray[np.float64], float]:
    """Return a circle on the desk that an object, light or ball occupies: its centre, (2,), and its radius, metres."""
    if isinstance(item, Probe):
        return np.array(item.center[:2]), item.radius
    if isinstance(item, Light):
        return np.array(item.at[:2]), _LIGHT_REACH
    low, high = _box(item)
    middle = rotation_matrix(item.rotate) @ (0.5 * (low + high))
    return (middle + item.at)[:2], 0.25 * float((high - low)[:2].sum())


def _apart(scene: Scene, item: Any) -> Any:
    """Return a new object or light, moved along a spiral until it overlaps no other."""
    if isinstance(item, Proxy) or (isinstance(item, Light) and item.kind == "directional"):
        return item  # a proxy must stay on the surface that it models, and a directional light has no place
    alike = scene.lights if isinstance(item, Light) else (*scene.objects, *scene.probes)
    taken, (place, reach) = [_spot(one) for one in alike], _spot(item)
    for step in range(_PLACES):
        angle = _GOLDEN * step
        moved = _STEP * math.sqrt(step) * np.array([math.cos(angle), math.sin(angle)])
        if all(math.dist(place + moved, other) >= reach + far for other, far in taken):
            x, y = (round(float(value), 5) for value in moved + item.at[:2])
            return dataclasses.replace(item, at=(x, y, item.at[2]))
    return item


def duplicate_part(scene: Scene, part: str, index: int) -> Scene:
    """Return the scene with a copy of an object, light or proxy beside the original."""
    return add_item(scene, part, _items(scene, part, index)[index])


def snap_object(scene: Scene, index: int) -> Scene:
    """Return the scene with an object moved vertically until its lowest point lies in the marker's plane."""
    item = _items(scene, "object", index)[index]
    mesh = mesh_of(item)
    points = np.array(list(itertools.product(*_box(item).T))) if mesh is None else item.scale * mesh.vertices
    lowest = float((points @ rotation_matrix(item.rotate)[2]).min())
    return set_value(scene, "object", index, "at", (*item.at[:2], round(-lowest, 5)))
