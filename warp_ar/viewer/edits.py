"""Scenes as the page edits them; every change is checked as a scene file is.

Animations of glTF files are chosen, started, held and made faster without a jump of the pose.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

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
    MirrorMaterial,
    Object,
    PhongMaterial,
    Play,
    Probe,
    Proxy,
    Scene,
    dumps_scene,
    loads_scene,
)
from warp_ar.scene.mesh_files import GLTF_SUFFIXES, animations_of
from warp_ar.scene.object_materials import file_stamp, mesh_of, moving_mesh_of
from warp_ar.stages import STAGES
from warp_ar.stages.quality import Quality
from warp_ar.tracking.card_layout import RINGS, SHEET, ball_center
from warp_ar.viewer.protocol import EFFECTS, Command

NONE = -1
"""Number of no animation: everything stands as the file's nodes do."""
_DIGITS = 4
"""Of seconds that the page sets, in scene files: a tenth of a millisecond."""


def names_of(item: Object) -> tuple[str, ...]:
    """Names of the animations of an object's file, by number; one without a name is told by its number."""
    if item.file is None or item.mesh is not None or item.file.suffix.lower() not in GLTF_SUFFIXES:
        return ()
    return _names(item.file, file_stamp(item.file))


@functools.lru_cache(maxsize=64)
def _names(path: Path, stamp: tuple[int, int]) -> tuple[str, ...]:
    try:
        return tuple(name or f"Animation {number}" for number, name in enumerate(animations_of(path)))
    except SceneError:
        return ()  # the scene that shows the object says what is wrong


def play_record(item: Object) -> dict[str, Any]:
    """What the page shows of an object's animations."""
    names = names_of(item)
    if not names:
        return {}
    play = item.play
    if play is None:
        return {"animations": names, "animation": NONE, "speed": Play.speed, "loop": Play.loop, "paused": False}
    number = names.index(play.animation) if isinstance(play.animation, str) else play.animation
    shown = {"speed": play.speed, "loop": play.loop, "paused": play.paused}
    return {"animations": names, "animation": number, **shown}


def set_play(item: Object, key: str, value: float, seconds: float) -> Object:
    """The object with one value of its animation changed; its pose at that moment stays.

    Args:
        item: An object with a glTF file.
        key: ``animation``: its number, ``NONE`` for none, which begins at once; ``speed``; ``loop``; ``paused``: 0 goes
            on from the pose that is held, or anew if that is the last one.
        value: Number or flag.
        seconds: Of the frame that is shown, since the first.

    Raises:
        UsageError: The object's file has no such animation, or it plays none.
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
"""Objects, lights or proxies in a scene that the page may add to."""
RULER: Final = 0.1
"""Metres that each ruler of the card has in a print at true scale."""
_SCALES: Final = (0.5, 1.5)
"""What a ruler may measure over what it should: beyond that it was read wrong."""

_LISTS: Final = {"object": "objects", "light": "lights", "proxy": "proxies", "probe": "probes"}
# No key that names a file is among them.
_KEYS: Final[Mapping[str, tuple[str, ...]]] = {
    "object": ("at", "rotate", "scale", "radius", "size", "major_radius", "minor_radius"),
    "light": ("at", "target", "direction", "color", "intensity", "inner_angle", "outer_angle", "radius"),
    "proxy": ("at", "rotate", "size"),
    "probe": ("center", "radius", "reflectance"),
    "exposure": ("scale",),
    "marker": ("dictionary", "id", "size"),
}
_MATERIAL_KEYS: Final = (
    "base_color",
    "diffuse",
    "specular",
    "shininess",
    "metallic",
    "roughness",
    "color",
    "intensity",
)
_MODELS: Final[Mapping[str, type[Material]]] = {
    "lambert": LambertMaterial,
    "phong": PhongMaterial,
    "metallic_roughness": MetallicRoughnessMaterial,
    "mirror": MirrorMaterial,
    "emissive": EmissiveMaterial,
    "file": FileMaterial,
}
_PLANE, _BOX = Proxy("plane", size=(0.2, 0.15)), Proxy("box", at=(0.12, -0.08, 0.03), size=(0.06, 0.06, 0.06))
_NEW: Final[Mapping[str, Object | Light]] = {
    "sphere": Object("sphere", radius=0.03, at=(0.12, -0.08, 0.03), material=MetallicRoughnessMaterial()),
    "box": Object("box", size=(0.05, 0.05, 0.05), at=(0.12, -0.08, 0.025), material=LambertMaterial()),
    "torus": Object(
        "torus",
        major_radius=0.03,
        minor_radius=0.011,
        at=(0.12, -0.08, 0.011),
        material=MetallicRoughnessMaterial((1.0, 0.77, 0.34), 1.0, 0.25),
    ),
    "point": Light("point", 0.12, at=(0.05, -0.05, 0.2)),
    "spot": Light("spot", 1.0, at=(0.0, -0.1, 0.35), target=(0.05, 0.05, 0.0), inner_angle=12.0, outer_angle=20.0),
    "directional": Light("directional", 0.6, direction=(0.4, 0.5, -1.0)),
}


def checked(scene: Scene) -> Scene:
    """The scene as its file would be read.

    Raises:
        SceneError: The file would be refused.
    """
    return dataclasses.replace(loads_scene(dumps_scene(scene)), path=scene.path)


def use_card(scene: Scene, radius: float, ruler: float) -> Scene:
    """The scene with the printed card as its marker and a mirror ball on the card's cross.

    Args:
        scene: The scene; its balls go, its objects and lights stay, and it gets a table if it has none. Where its
            marker was another one, walls and boxes go as well: they stood around that marker.
        radius: Of the ball, metres.
        ruler: What the print's rulers of 100 mm measure, metres.

    Raises:
        UsageError: The radius is no ball's that stands on the card, or the ruler was read wrong.
    """
    largest = 1.25 * max(RINGS)
    if not 0.005 <= radius <= largest:
        raise UsageError(f"the ball's radius is {1e3 * radius:g} mm; expected 5 to {1e3 * largest:g} mm")
    scale = ruler / RULER
    if not _SCALES[0] <= scale <= _SCALES[1]:
        low, high = (1e3 * RULER * bound for bound in _SCALES)
        raise UsageError(f"the print's ruler measures {1e3 * ruler:g} mm; expected {low:g} to {high:g} mm")
    made = SHEET.board
    assert isinstance(made, CharucoBoard)
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
            marker=dataclasses.replace(SHEET, board=board),
            probes=(ball,),
            proxies=kept if has_table else (*kept, Proxy("plane", size=(1.6, 1.2))),
        )
    )


def card_ruler(scene: Scene) -> float | None:
    """What the rulers of the scene's printed card measure, metres; None where its marker is another one."""
    scale = card_scale(scene.marker)
    return None if scale is None else RULER * scale


def set_value(scene: Scene, part: str, index: int, key: str, value: Any) -> Scene:
    """The scene with one key of one part changed.

    Args:
        scene: The scene.
        part: ``object``, ``light``, ``proxy``, ``probe``, ``exposure`` or ``marker``.
        index: Which one.
        key: A key of the scene file's section, or of its material.
        value: A number, a tuple of numbers or a word.

    Raises:
        UsageError: There is no such part, or it has no such key that could be edited.
        SceneError: The scene file would refuse the value.
    """
    if part in ("exposure", "marker"):
        section = dataclasses.replace(getattr(scene, part), **{_key(part, key): value})
        if part == "marker" and key in ("id", "size"):
            section = dataclasses.replace(section, board=None)  # a marker of its own instead of a board's
        changed: dict[str, Any] = {part: section}
        return checked(dataclasses.replace(scene, **changed))
    items = list(getattr(scene, _LISTS[part]))
    if index >= len(items):
        raise UsageError(f"{part} {index}: the scene has {len(items)}")
    item = items[index]
    if isinstance(item, Object) and (key == "model" or key in _MATERIAL_KEYS):
        items[index] = dataclasses.replace(item, material=_material(_shown_material(item), key, value))
    else:
        changes = {_key(part, key): value}
        if part == "light" and key in ("target", "direction"):
            changes["direction" if key == "target" else "target"] = None
        items[index] = dataclasses.replace(item, **changes)
    return _with_list(scene, part, tuple(items))


def _with_list(scene: Scene, part: str, items: tuple[Any, ...]) -> Scene:
    changed: dict[str, Any] = {_LISTS[part]: items}
    return checked(dataclasses.replace(scene, **changed))


def _key(part: str, key: str) -> str:
    if key not in _KEYS[part]:
        raise UsageError(f"{part}: key {key!r} cannot be edited; expected {', '.join(_KEYS[part])}")
    return key


def _shown_material(item: Object) -> Material:
    """An object's material; what has no file is chalk where no material is given."""
    return LambertMaterial() if isinstance(item.material, FileMaterial) and item.shape != "mesh" else item.material


def _material(material: Material, key: str, value: Any) -> Material:
    if key == "model":
        if value not in _MODELS:
            raise UsageError(f"material: model {value!r}; expected {', '.join(_MODELS)}")
        if value == "file":
            return FileMaterial()
        first = iter(vars(material).values())  # of every model but the file's own its colour
        color: Any = next(first, LambertMaterial.base_color)
        made: Any = _MODELS[value]
        if made is EmissiveMaterial and isinstance(color, Path):
            color = EmissiveMaterial.color
        return cast(Material, made(color))
    if key not in vars(material):
        raise UsageError(f"material: {type(material).__name__} has no {key}; expected {', '.join(vars(material))}")
    color_like = isinstance(vars(material)[key], tuple | Path)
    if color_like != isinstance(value, tuple):
        raise UsageError(f"material: {key} takes {'a colour' if color_like else 'a number'}")
    return dataclasses.replace(material, **{key: value})


def add_part(scene: Scene, part: str, kind: str) -> Scene:
    """The scene with a new object, light or proxy of ``kind``."""
    if part == "proxy":
        return add_item(scene, part, _PLANE if kind == "plane" else _BOX)
    return add_item(scene, part, _NEW[kind])


def add_item(scene: Scene, part: str, item: Object | Light | Proxy) -> Scene:
    """The scene with one object, light or proxy more.

    Raises:
        UsageError: It has as many as it may have.
        SceneError: The scene file would refuse it.
    """
    items = getattr(scene, _LISTS[part])
    if len(items) >= MOST_PARTS:
        raise UsageError(f"{len(items)} are in the scene already; {MOST_PARTS} at most: take one away first")
    return _with_list(scene, part, (*items, item))


def remove_part(scene: Scene, part: str, index: int) -> Scene:
    """The scene without one object, light or proxy.

    Args:
        scene: The scene.
        part: "object", "light" or "proxy".
        index: Which of them, counted from 0.

    Raises:
        UsageError: It has not as many.
    """
    items = getattr(scene, _LISTS[part])
    if index >= len(items):
        raise UsageError(f"{part} {index}: the scene has {len(items)}")
    return _with_list(scene, part, items[:index] + items[index + 1 :])


@dataclasses.dataclass(frozen=True)
class Wanted:
    """What the viewers want to see."""

    scene: Scene
    """The scene, edited."""
    quality: Quality
    """The preset."""
    off: frozenset[str] = frozenset()
    """Effects that are switched off."""
    hidden: frozenset[tuple[str, int]] = frozenset()
    """(part, index) of objects, lights and proxies that are hidden."""
    methods: tuple[tuple[str, str], ...] = ()
    """(stage, method) that differ from the preset's."""
    cameras: tuple[Camera, ...] = ()
    """Cameras that were calibrated, one for each size of frames, instead of the scene's."""

    def camera_of(self, size: tuple[int, int]) -> Camera | None:
        """The calibrated camera of frames of a size; None where none was calibrated."""
        return next((camera for camera in self.cameras if (camera.width, camera.height) == size), None)

    def with_camera(self, camera: Camera) -> Wanted:
        """With a calibrated camera for frames of its size."""
        others = (own for own in self.cameras if (own.width, own.height) != (camera.width, camera.height))
        return dataclasses.replace(self, cameras=(*others, camera))

    def shown_scene(self) -> Scene:
        """The scene without what is hidden or switched off: the one that a file of this picture holds."""
        scene = self.scene

        def seen(part: str, effect: str) -> tuple[Any, ...]:
            items = getattr(scene, _LISTS[part])
            return tuple(x for i, x in enumerate(items) if effect not in self.off and (part, i) not in self.hidden)

        return dataclasses.replace(
            scene,
            objects=seen("object", "objects"),
            lights=seen("light", "lights"),
            probes=seen("probe", "environment"),
            proxies=seen("proxy", "receiver"),
            exposure=Exposure() if "exposure" in self.off else scene.exposure,
        )

    def shown_quality(self) -> Quality:
        """The quality without what is switched off."""
        methods = dict(self.methods)
        if "relief" in self.off:
            methods["relight"] = "flat"
        if "environment_shadow" in self.off:
            methods["environment_shadow"] = "none"
        return self.quality.with_methods(**methods) if methods else self.quality

    def without_part(self, part: str, index: int) -> Wanted:
        """With one object, light or proxy removed; what is hidden stays hidden."""
        hidden = {(t, i - (t == part and i > index)) for t, i in self.hidden if (t, i) != (part, index)}
        return dataclasses.replace(self, scene=remove_part(self.scene, part, index), hidden=frozenset(hidden))

    def with_part_shown(self, part: str, index: int, on: bool) -> Wanted:
        """With one object, light or proxy shown or hidden."""
        item = {(part, index)}
        return dataclasses.replace(self, hidden=self.hidden - item if on else self.hidden | item)

    def with_method(self, stage: str, method: str) -> Wanted:
        """With a stage on another method than the preset's; an empty name goes back.

        Raises:
            UsageError: There is no such stage or method.
        """
        known = {kind.name: kind.methods for kind in STAGES}
        if stage not in known or (method and method not in known[stage]):
            raise UsageError(f"stage {stage!r} has no method {method!r}")
        methods = {**dict(self.methods), stage: method}
        return dataclasses.replace(self, methods=tuple(sorted((s, r) for s, r in methods.items() if r)))

    def with_effect(self, name: str, on: bool) -> Wanted:
        """With an effect switched."""
        return dataclasses.replace(self, off=self.off - {name} if on else self.off | {name})


def beside(scene: Scene, folder: Path) -> Scene:
    """Return the scene with files in a folder named as if they lay beside its own file."""

    def named(path: Any) -> Any:
        return Path(path.name) if isinstance(path, Path) and path.is_relative_to(folder) else path

    captured = scene.captured
    return dataclasses.replace(
        scene,
        camera=dataclasses.replace(scene.camera, transfer=named(scene.camera.transfer)),
        objects=tuple(dataclasses.replace(item, file=named(item.file)) for item in scene.objects),
        captured=None if captured is None else dataclasses.replace(captured, file=named(captured.file)),
    )


def set_animation(scene: Scene, index: int, key: str, value: float, seconds: float) -> Scene:
    """The scene with one value of an object's animation changed; arguments as those of ``set_play``.

    Raises:
        SceneError: As ``set_play``.
        UsageError: There is no such object.
    """
    if index >= len(scene.objects):
        raise UsageError(f"object {index}: the scene has {len(scene.objects)}")
    items = list(scene.objects)
    items[index] = set_play(items[index], key, value, seconds)
    return _with_list(scene, "object", tuple(items))


Edit = Callable[[Wanted], Wanted]


def make_edit(command: Command, original: Wanted, seconds: float = 0.0) -> tuple[Edit, str] | None:
    """Return the edit that a command asks for, and its name in words; None if the command is no edit.

    Args:
        command: Command of a page.
        original: The scene before any edit.
        seconds: Time of the newest frame since the first.
    """
    fields = command.fields
    part, index = fields.get("part", "object"), fields.get("index", 0)
    words = _named(part, index)

    def of_scene(change: Callable[..., Scene], *arguments: Any) -> Edit:
        return lambda w: dataclasses.replace(w, scene=change(w.scene, *arguments))

    match command.type:
        case "set":
            return of_scene(set_value, *fields.values()), f"set {fields['key']} of {words}"
        case "animate":
            what = "pause" if fields["key"] == "paused" else fields["key"]
            return of_scene(set_animation, *fields.values(), seconds), f"set the {what} of {words}"
        case "add":
            return of_scene(add_part, *fields.values()), f"add {fields['kind']}"
        case "remove":
            return lambda w: w.without_part(**fields), f"remove {words}"
        case "show":
            return lambda w: w.with_part_shown(**fields), f"{'show' if fields['on'] else 'hide'} {words}"
        case "effect":
            name = fields["name"].replace("_", " ")
            return lambda w: w.with_effect(**fields), f"switch {name} {'on' if fields['on'] else 'off'}"
        case "method":
            return lambda w: w.with_method(**fields), f"choose the method of {fields['stage'].replace('_', ' ')}"
        case "card":
            return of_scene(use_card, *fields.values()), "use the printed card"
        case "reset":
            return lambda w: dataclasses.replace(original, quality=w.quality, cameras=w.cameras), "undo all edits"
    return None


def _named(part: str, index: int) -> str:
    """A part in words."""
    names = {"object": "object", "light": "light", "proxy": "shape", "probe": "mirror ball"}
    return f"{names[part]} {index + 1}" if part in names else f"the {part}"


def wanted_record(wanted: Wanted) -> dict[str, Any]:
    """What the page needs to know of a scene, as plain data; of files only their names."""
    scene = wanted.scene

    def plain(item: Any) -> dict[str, Any]:
        fields = {key: value.name if isinstance(value, Path) else value for key, value in vars(item).items()}
        return {
            key: value for key, value in fields.items() if isinstance(value, str | int | float | tuple) or value is None
        }

    def part(kind: str, index: int, item: Any) -> dict[str, Any]:
        record = {**plain(item), "visible": (kind, index) not in wanted.hidden}
        record["animated"] = not isinstance(item, Proxy) and item.animate is not None
        if isinstance(item, Object):
            material = _shown_material(item)
            model = next(name for name, made in _MODELS.items() if isinstance(material, made))
            record["material"] = {"model": model, **plain(material)}
            record["reach"] = _reach(item)
            record |= play_record(item)
        return record

    marker, ruler = scene.marker, card_ruler(scene)
    return {
        "name": scene.name,
        "objects": [part("object", i, item) for i, item in enumerate(scene.objects)],
        "lights": [part("light", i, item) for i, item in enumerate(scene.lights)],
        "proxies": [part("proxy", i, item) for i, item in enumerate(scene.proxies)],
        "probes": [plain(item) for item in scene.probes],
        "captured": None if scene.captured is None else scene.captured.file.name,
        "exposure": scene.exposure.scale,
        "marker": {
            "dictionary": marker.dictionary,
            "id": marker.id,
            "size": marker.size,
            "board": None if marker.board is None else str(marker.board),
            "ruler": None if ruler is None else round(ruler, 6),
        },
        "effects": {name: name not in wanted.off for name in EFFECTS},
        "quality": wanted.quality.name,
        "methods": dict(wanted.methods),
    }


def _reach(item: Object) -> float:
    """Radius in metres of a circle on the ground around an object, about its size."""
    if item.shape == "mesh":
        mesh = mesh_of(item)
        assert mesh is not None
        return item.scale * float(np.abs(mesh.bounds)[:, :2].mean())
    if item.shape in ("box", "rect"):
        return item.scale * 0.5 * float(np.hypot(item.size[0], item.size[1]))
    return item.scale * (item.radius + item.major_radius + item.minor_radius + 0.5 * item.length)
