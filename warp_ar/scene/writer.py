"""Conversion of a scene to the text of a scene file."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import tomlkit

from warp_ar.declared import checked
from warp_ar.errors import SceneError
from warp_ar.scene.description import INTRINSICS, Board, Marker, PoseSpec, Scene
from warp_ar.scene.fields import fields_of, not_used
from warp_ar.scene.materials import MATERIALS


@checked
def dumps_scene(scene: Scene, folder: str | Path | None = None) -> str:
    """Return a scene as TOML that :func:`loads_scene` reads into an equal scene.

    Args:
        scene: The scene.
        folder: Folder where the text will be saved. Paths inside it are written relative to it, others as absolute
            paths. None: all paths are absolute.

    Returns:
        The text. A camera read from a calibration file is written as its numbers.

    Raises:
        SceneError: An object's mesh is in memory alone.
    """
    base = None if folder is None else Path(folder).resolve()
    if any(item.mesh is not None for item in scene.objects):
        raise SceneError("object: a mesh in memory cannot be written; export it, and give the object its file")
    own = ("field_of_view",) if scene.camera.field_of_view is not None else INTRINSICS
    sections: dict[str, Any] = {
        "camera": _table(scene.camera, base, (*own, "transfer")),
        "source": _table(scene.source, base),
        "marker": _table(scene.marker, base) if scene.has_marker else None,
        "pose": _table(scene.pose, base, ("R", "t")),
        "probe": [_table(item, base) for item in scene.probes],
        "proxy": [_table(item, base) for item in scene.proxies],
        "object": [_table(item, base) for item in scene.objects],
        "light": [_table(item, base) for item in (*scene.lights, scene.captured) if item is not None],
        "exposure": _table(scene.exposure, base),
    }
    given = {name: value for name, value in sections.items() if value}
    return tomlkit.dumps({"schema": scene.schema, "name": scene.name, **given})


def _table(item: Any, base: Path | None, keys: Iterable[str] = ()) -> dict[str, Any]:
    """Return the keys of a dataclass with their values, without keys that its kind does not use; empty for None."""
    if item is None:
        return {}
    if isinstance(item, PoseSpec):
        values = {"file": item.file} if item.file is not None else dict(zip(keys, item.poses[0], strict=True))
        return {key: _value(value, base) for key, value in values.items()}
    names = list(keys) or list(fields_of(type(item)))
    if isinstance(item, Marker):
        gone = {"board"} if item.board is None else {"id", "size"}
        names = [name for name in names if name not in gone | ({"turn"} if not item.turn else set())]
    if uses := getattr(item, "USES", None):
        unused = not_used(uses, getattr(item, names[0]))
        names = [name for name in names if name not in unused]
    values = {name: _value(getattr(item, name), base) for name in names}
    model = next(({"model": name} for name, kind in MATERIALS.items() if type(item) is kind), {})
    return {**model, **{name: value for name, value in values.items() if value is not None}}


def _value(item: Any, base: Path | None) -> Any:
    """Return a value as a TOML value; paths inside ``base`` are relative to it."""
    if isinstance(item, Path):
        return (item.relative_to(base) if base and item.is_relative_to(base) else item).as_posix()
    if isinstance(item, Board):
        return str(item)
    if isinstance(item, tuple):
        return [_value(entry, base) for entry in item]
    if isinstance(item, Marker):  # only the world's marker has a measured white
        return {key: value for key, value in _table(item, base).items() if key != "white"}
    return _table(item, base) if dataclasses.is_dataclass(item) else item
