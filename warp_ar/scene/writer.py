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
    writer = _Writer(None if folder is None else Path(folder).resolve())
    lines = [f"schema = {scene.schema}", f"name = {writer.value(scene.name)}"]
    lines += [*writer.frames(scene), *writer.physical(scene), *writer.virtual(scene)]
    lines += ["", "[exposure]", *writer.table(scene.exposure, ("scale",))]
    return "\n".join(lines) + "\n"


class _Writer:
    """Lines of a scene file, section by section."""

    def __init__(self, base: Path | None) -> None:
        self.base = base

    def value(self, item: Any) -> str:
        return _value(item, self.base)

    def table(self, item: Any, keys: Iterable[str]) -> list[str]:
        """Lines of the keys that have a value."""
        entries = ((key, getattr(item, key)) for key in keys)
        return [f"{key} = {self.value(entry)}" for key, entry in entries if entry is not None]

    def animation(self, item: Object | Light) -> list[str]:
        if item.animate is None:
            return []
        fields = {key: getattr(item.animate, key) for key in keys_of(Animation)}
        return [f"animate = {self.value({key: entry for key, entry in fields.items() if entry is not None})}"]

    def own_marker(self, item: Object | Light | Proxy | Probe) -> list[str]:
        if item.marker is None:
            return []
        own = item.marker
        fields = {"id": own.id, "size": own.size} if own.board is None else {"board": own.board}
        return [f"marker = {self.value({'dictionary': own.dictionary, **fields})}"]

    def frames(self, scene: Scene) -> list[str]:
        """Camera, source, marker and pose."""
        guessed = scene.camera.field_of_view is not None
        own = ("field_of_view",) if guessed else INTRINSICS
        lines = ["", "[camera]", *self.table(scene.camera, (*own, "transfer"))]
        if scene.source is not None:
            lines += ["", "[source]", *self.table(scene.source, keys_of(SourceSpec))]
        keys: tuple[str, ...] = ("dictionary", "id", "size", "white")
        if scene.marker.board is not None:
            keys = ("dictionary", "board", "white")
        if scene.has_marker:
            lines += ["", "[marker]", *self.table(scene.marker, keys)]
        if scene.pose is not None:
            lines += ["", "[pose]", *_pose_lines(scene.pose, self.value)]
        return lines

    def physical(self, scene: Scene) -> list[str]:
        """Mirror balls and proxies."""
        lines: list[str] = []
        for probe in scene.probes:
            lines += ["", "[[probe]]", *self.table(probe, ("center", "radius", "reflectance")), *self.own_marker(probe)]
        for proxy in scene.proxies:
            lines += ["", "[[proxy]]", *self.table(proxy, ("shape", "at", "rotate", *PROXY_KEYS[proxy.shape]))]
            lines += self.own_marker(proxy)
            if proxy.material is not None:
                lines += ["", "[proxy.material]", *self.table(proxy.material, keys_of(ProxyMaterial))]
        return lines

    def virtual(self, scene: Scene) -> list[str]:
        """Objects and lights, the captured one last."""
        lines: list[str] = []
        for item in scene.objects:
            if item.mesh is not None:
                raise SceneError("object: a mesh in memory cannot be written; export it, and give the object its file")
            model = next(name for name, kind in MATERIALS.items() if isinstance(item.material, kind))
            lines += ["", "[[object]]", *self.table(item, ("shape", *OBJECT_KEYS[item.shape], "at", "rotate", "scale"))]
            lines += self.animation(item)
            if item.play is not None:
                lines += [f"play = {self.value({key: getattr(item.play, key) for key in keys_of(Play)})}"]
            lines += self.own_marker(item)
            keys = keys_of(type(item.material))
            lines += ["", "[object.material]", f"model = {self.value(model)}", *self.table(item.material, keys)]
        for light in scene.lights:
            lines += ["", "[[light]]", *self.table(light, ("kind", *LIGHT_KEYS[light.kind], "color", "intensity"))]
            lines += [*self.animation(light), *self.own_marker(light)]
        if scene.captured is not None:
            lines += ["", "[[light]]", *self.table(scene.captured, keys_of(CapturedLight))]
        return lines


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
