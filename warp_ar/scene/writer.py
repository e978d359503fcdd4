"""A scene as the text of a scene file."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from warp_ar.errors import SceneError
from warp_ar.scene.description import INTRINSICS, Board, Marker, PoseSpec, Scene
from warp_ar.scene.fields import fields_of, not_used
from warp_ar.scene.materials import MATERIALS


def dumps_scene(scene: Scene, folder: str | Path | None = None) -> str:
    """Write a scene as TOML that :func:`loads_scene` turns into an equal one.

    Args:
        scene: The scene.
        folder: Where the text will be saved: paths to objects inside it are written relative to it, all others, and
            without it all paths, in full.

    Returns:
        The text. A camera read from a calibration file is written as its numbers.

    Raises:
        SceneError: An object's mesh is in memory alone.
    """
    base = None if folder is None else Path(folder).resolve()
    if any(item.mesh is not None for item in scene.objects):
        raise SceneError("object: a mesh in memory cannot be written; export it, and give the object its file")
    own = ("field_of_view",) if scene.camera.field_of_view is not None else INTRINSICS
    entries: list[tuple[str, Any, Iterable[str] | None]] = [("[camera]", scene.camera, (*own, "transfer"))]
    entries += [("[source]", scene.source, None)] * (scene.source is not None)
    entries += [("[marker]", scene.marker, _marker_keys(scene.marker))] * scene.has_marker
    entries += [("[pose]", scene.pose, ())] * (scene.pose is not None)
    for section, items in (("probe", scene.probes), ("proxy", scene.proxies), ("object", scene.objects)):
        entries += [(f"[[{section}]]", item, None) for item in items]
    entries += [("[[light]]", item, None) for item in (*scene.lights, scene.captured) if item is not None]
    entries += [("[exposure]", scene.exposure, None)]
    lines = [f"schema = {scene.schema}", f"name = {_value(scene.name, base)}"]
    for head, item, keys in entries:
        lines += ["", head, *_table(item, keys, base)]
    return "\n".join(lines) + "\n"


def _table(item: Any, keys: Iterable[str] | None, base: Path | None) -> list[str]:
    """Return the lines of a section and of the tables below it."""
    if isinstance(item, PoseSpec):
        rotation, translation = item.poses[0]
        given: dict[str, Any] = {"R": rotation, "t": translation} if item.file is None else {"file": item.file}
        return [f"{key} = {_value(value, base)}" for key, value in given.items()]
    values = _values(item, keys)
    material = values.pop("material", None)
    lines = [f"{key} = {_value(value, base)}" for key, value in values.items()]
    if material is not None:
        section = "object" if type(material) in MATERIALS.values() else "proxy"
        model = next((name for name, kind in MATERIALS.items() if isinstance(material, kind)), None)
        lines += ["", f"[{section}.material]", *([] if model is None else [f"model = {_value(model, base)}"])]
        lines += _table(material, None, base)
    return lines


def _values(item: Any, keys: Iterable[str] | None = None) -> dict[str, Any]:
    """Return what a dataclass gives for its keys, without those that its kind does not use."""
    if keys is None and isinstance(item, Marker):
        keys = [key for key in _marker_keys(item) if key != "white"]
    names = list(fields_of(type(item))) if keys is None else list(keys)
    if uses := getattr(item, "USES", None):
        unused = not_used(uses, getattr(item, names[0]))
        names = [name for name in names if name not in unused]
    return {name: value for name in names if (value := getattr(item, name)) is not None}


def _marker_keys(marker: Marker) -> tuple[str, ...]:
    own = ("id", "size") if marker.board is None else ("board",)
    return ("dictionary", *own, "white", *(("turn",) if marker.turn else ()))


def _value(item: Any, base: Path | None) -> str:
    """Return a value as TOML; paths inside ``base`` are relative to it."""
    if isinstance(item, Path):
        item = (item.relative_to(base) if base and item.is_relative_to(base) else item).as_posix()
    if isinstance(item, bool):
        return str(item).lower()
    if isinstance(item, str):
        return json.dumps(item, ensure_ascii=False).replace("\x7f", "\\u007F")  # TOML, unlike JSON, escapes DEL
    if isinstance(item, Board):
        return _value(str(item), base)
    if isinstance(item, tuple):
        return "[" + ", ".join(_value(entry, base) for entry in item) + "]"
    if hasattr(item, "__dataclass_fields__"):
        item = _values(item)
    if isinstance(item, Mapping):
        return "{ " + ", ".join(f"{key} = {_value(entry, base)}" for key, entry in item.items()) + " }"
    return repr(float(item)) if isinstance(item, float) else repr(item)  # NumPy's say their type
