"""A scene as the text of a scene file."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from warp_ar.errors import SceneError
from warp_ar.scene.description import (
    Animation,
    Board,
    CapturedLight,
    Light,
    Object,
    Play,
    PoseSpec,
    Probe,
    Proxy,
    ProxyMaterial,
    Scene,
    SourceSpec,
)
from warp_ar.scene.keys import INTRINSICS, LIGHT_KEYS, MATERIALS, OBJECT_KEYS, PROXY_KEYS, keys_of


def dumps_scene(scene: Scene, folder: str | Path | None = None) -> str:
    """Write a scene as TOML that :func:`loads_scene` turns into an equal one.

    Args:
        scene: The scene.
        folder: Where the text will be saved: paths to objects inside it are written relative to it, all others, and
            without it all paths, in full.

    Returns:
        The text. A camera read from a calibration file is written as its numbers.
    """
    base = None if folder is None else Path(folder).resolve()

    def value(item: Any) -> str:
        return _value(item, base)

    def table(item: Any, keys: Iterable[str]) -> list[str]:
        """Lines of the keys that have a value."""
        entries = ((key, getattr(item, key)) for key in keys)
        return [f"{key} = {value(entry)}" for key, entry in entries if entry is not None]

    def animation(item: Object | Light) -> list[str]:
        if item.animate is None:
            return []
        fields = {key: getattr(item.animate, key) for key in keys_of(Animation)}
        return [f"animate = {value({key: entry for key, entry in fields.items() if entry is not None})}"]

    def own_marker(item: Object | Light | Proxy | Probe) -> list[str]:
        if item.marker is None:
            return []
        own = item.marker
        fields = {"id": own.id, "size": own.size} if own.board is None else {"board": own.board}
        return [f"marker = {value({'dictionary': own.dictionary, **fields})}"]

    lines = [f"schema = {scene.schema}", f"name = {value(scene.name)}"]
    guessed = scene.camera.field_of_view is not None
    lines += ["", "[camera]", *table(scene.camera, (*(("field_of_view",) if guessed else INTRINSICS), "transfer"))]
    if scene.source is not None:
        lines += ["", "[source]", *table(scene.source, keys_of(SourceSpec))]
    keys = ("dictionary", "id", "size", "white") if scene.marker.board is None else ("dictionary", "board", "white")
    if scene.has_marker:
        lines += ["", "[marker]", *table(scene.marker, keys)]
    if scene.pose is not None:
        lines += ["", "[pose]", *_pose_lines(scene.pose, value)]
    for probe in scene.probes:
        lines += ["", "[[probe]]", *table(probe, ("center", "radius", "reflectance")), *own_marker(probe)]
    for proxy in scene.proxies:
        lines += ["", "[[proxy]]", *table(proxy, ("shape", "at", "rotate", *PROXY_KEYS[proxy.shape]))]
        lines += own_marker(proxy)
        if proxy.material is not None:
            lines += ["", "[proxy.material]", *table(proxy.material, keys_of(ProxyMaterial))]
    for item in scene.objects:
        if item.mesh is not None:
            raise SceneError("object: a mesh in memory cannot be written; export it, and give the object its file")
        model = next(name for name, kind in MATERIALS.items() if isinstance(item.material, kind))
        lines += ["", "[[object]]", *table(item, ("shape", *OBJECT_KEYS[item.shape], "at", "rotate", "scale"))]
        lines += animation(item)
        if item.play is not None:
            lines += [f"play = {value({key: getattr(item.play, key) for key in keys_of(Play)})}"]
        lines += own_marker(item)
        lines += [
            "",
            "[object.material]",
            f"model = {value(model)}",
            *table(item.material, keys_of(type(item.material))),
        ]
    for light in scene.lights:
        lines += ["", "[[light]]", *table(light, ("kind", *LIGHT_KEYS[light.kind], "color", "intensity"))]
        lines += [*animation(light), *own_marker(light)]
    if scene.captured is not None:
        lines += ["", "[[light]]", *table(scene.captured, keys_of(CapturedLight))]
    lines += ["", "[exposure]", *table(scene.exposure, ("scale",))]
    return "\n".join(lines) + "\n"


def _value(item: Any, base: Path | None) -> str:
    """A value as TOML; paths inside ``base`` are relative to it."""
    if isinstance(item, Path):
        item = (item.relative_to(base) if base and item.is_relative_to(base) else item).as_posix()
    if isinstance(item, bool):
        return str(item).lower()
    if isinstance(item, str):
        return json.dumps(item, ensure_ascii=False).replace("\x7f", "\\u007F")  # TOML, unlike JSON, escapes DEL
    if isinstance(item, Board):
        return _value(str(item), base)
    if isinstance(item, Mapping):
        return "{ " + ", ".join(f"{key} = {_value(entry, base)}" for key, entry in item.items()) + " }"
    if isinstance(item, tuple):
        return "[" + ", ".join(_value(entry, base) for entry in item) + "]"
    return repr(float(item)) if isinstance(item, float) else repr(item)  # NumPy's say their type


def _pose_lines(spec: PoseSpec, value: Callable[[Any], str]) -> list[str]:
    """Keys of ``[pose]``: the file that poses are from, or the only one."""
    if spec.file is not None:
        return [f"file = {value(spec.file)}"]
    rotation, translation = spec.poses[0]
    return [f"R = {value(rotation)}", f"t = {value(translation)}"]
