"""Reader of scene files, schema 1: TOML into frozen dataclasses, with errors that state allowed values.

Units are metres and degrees; colours are linear RGB. The world frame is the marker's frame: origin at the centre of the
marker or board, x to the right and y up on the printed page, z out of the page. Paths are relative to the scene file. A
missing key has its field's default. All sections except ``[camera]`` are optional, but ``[marker]`` or ``[pose]`` is
needed as soon as anything is placed in the world.

Constructors apply the same checks to values given in Python; ``loads_scene(dumps_scene(scene))`` checks a whole scene.
"""

from __future__ import annotations

import importlib.resources
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final, TypeVar

from warp_ar.declared import checked
from warp_ar.errors import SceneError, reason
from warp_ar.files import is_file, is_folder, limits, parse_toml, read_text, too_much
from warp_ar.scene import sections
from warp_ar.scene.description import (
    INTRINSICS,
    SCHEMA,
    AreaLight,
    CapturedLight,
    Exposure,
    Light,
    Marker,
    Object,
    PoseKeys,
    Probe,
    Proxy,
    Scene,
    SourceSpec,
)
from warp_ar.scene.fields import fields_of
from warp_ar.scene.messages import nearest
from warp_ar.scene.scene_files import SceneFiles
from warp_ar.scene.sections import SceneTable, read_fields

_TOP_KEYS: Final = ("schema", "name")
_SECTIONS: Final = ("camera", "source", "marker", "probe", "proxy", "object", "light", "pose", "exposure")
_T = TypeVar("_T")
FRAMES: Final = frozenset(
    {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".heic", ".mp4", ".mov", ".mkv", ".avi", ".webm"}
)
"""Suffixes of pictures and videos, which are taken for frames and not for a scene."""
FRAMES_GO: Final = "; frames go to --source"
"""Hint in messages if frames were named as a scene."""


def bundled_scenes() -> dict[str, Path]:
    """Return the files of the bundled scenes by name, sorted by name."""
    folder = Path(str(importlib.resources.files("warp_ar.scenes")))
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def _scene_in(folder: Path) -> Path:
    """Return the only scene file of a folder.

    Raises:
        SceneError: The folder holds no scene file, or several.
    """
    try:
        found = sorted(path for path in folder.glob("[!.]*.toml") if is_file(path))
    except OSError as error:
        raise SceneError(f"{folder}: cannot be read: {reason(error)}") from error
    if len(found) != 1:
        names = ", ".join(path.name for path in found[:4]) or f"none{FRAMES_GO}"
        raise SceneError(f"{folder}: expected a folder with one scene file, NAME.toml; it has {names}")
    return found[0]


@checked
def load_scene(path_or_name: str | os.PathLike[str], files: SceneFiles | None = None) -> Scene:
    """Read a scene file.

    Args:
        path_or_name: A file, a folder that holds one, or the name of a bundled scene.
        files: Files that the scene may refer to, if it is untrusted; default: any file.

    Raises:
        SceneError: The scene does not exist or is invalid; one line names file, key, value and allowed values.
    """
    path, bundled = Path(path_or_name), bundled_scenes()
    # A folder of frames may have the name of a bundled scene.
    if str(path_or_name) and str(path_or_name) not in bundled and is_folder(path):
        path = _scene_in(path)
    if not is_file(path):
        if str(path_or_name) not in bundled:
            hint = nearest(str(path_or_name), bundled)
            raise SceneError(f"{path}: no such scene; expected a file, or a bundled scene ({hint})")
        path = bundled[str(path_or_name)]
    if path.suffix.lower() in FRAMES:
        raise SceneError(f"{path} is no scene; expected a scene file{FRAMES_GO}")
    return loads_scene(read_text(path, SceneError, expected="TOML"), path, files)


def _check_top(top: SceneTable, data: dict[str, Any], label: str) -> None:
    """Check the keys that are required in every scene file."""
    if "schema" not in top:
        top.fail("schema", f"expected schema = {SCHEMA} at the top of the file")
    if top.data["schema"] is True or top.data["schema"] != SCHEMA:
        top.fail("schema", f"this program reads schema {SCHEMA}")
    if "camera" not in data:
        names = ", ".join(INTRINSICS[:6])
        raise SceneError(f"{label}: [camera] is missing: give {names}, calibration or field_of_view")


def _split_lights(lights: Any, label: str) -> tuple[Any, tuple[str, Any] | None]:
    """Return the virtual lights of ``[[light]]``, and the captured light with its name in messages, or None."""
    captured: list[tuple[str, Any]] = []
    if isinstance(lights, dict) and "file" in lights:
        lights, captured = [], [("light", lights)]
    elif isinstance(lights, list):
        named = [(f"light[{i}]", item) for i, item in enumerate(lights) if isinstance(item, dict) and "file" in item]
        captured = [(name, item) for name, item in named if "kind" not in item]
        lights = [item for item in lights if all(item is not other for _, other in captured)]
    if len(captured) > 1:
        raise SceneError(f"{label}: {captured[1][0]}.file: a scene has one captured light; {captured[0][0]} is one too")
    return lights, captured[0] if captured else None


class _Sections:
    """Reader of a scene file's sections, one by one."""

    def __init__(self, data: dict[str, Any], label: str, files: SceneFiles) -> None:
        self.data, self.label, self.files = data, label, files
        self.marker: Marker | None = self.one("marker", fields_of(Marker), sections.read_marker)

    def one(self, section: str, keys: Iterable[str], read: Callable[[SceneTable], _T]) -> _T | None:
        """Read a section that occurs at most once; None if it is missing."""
        if section not in self.data:
            return None
        return read(SceneTable(self.label, self.files, section, self.data[section], list(keys)))

    def many(
        self, section: str, keys: Iterable[str], read: Callable[[SceneTable], _T], *, single: bool = False
    ) -> tuple[_T, ...]:
        """Read a section that may occur several times; with ``single``, ``[section]`` also counts as one."""
        known = list(keys)

        def placed(name: str, item: Any) -> _T:
            table = SceneTable(self.label, self.files, name, item, known)
            table.world = self.marker
            return read(table)

        value = self.data.get(section, [])
        if single and isinstance(value, dict):
            return (placed(section, value),)
        if not isinstance(value, list):
            right = f"there may be several: write [[{section}]] instead of [{section}]"
            raise SceneError(f"{self.label}: {section}: {right}")
        if len(value) > limits().scene_entries:
            raise SceneError(too_much(self.label, len(value), f"[[{section}]] tables", "scene_entries"))
        return tuple(placed(f"{section}[{i}]", item) for i, item in enumerate(value))

    def check_placed(self) -> None:
        """Check that a scene with placed parts has a marker or poses.

        Raises:
            SceneError: There is neither a marker nor a pose.
        """
        placed = [section for section in ("probe", "proxy", "object", "light") if self.data.get(section)]
        if placed and "marker" not in self.data and "pose" not in self.data:
            raise SceneError(
                f"{self.label}: [marker] is missing: [{placed[0]}] has its place in the marker's frame; give its size, "
                "or the camera's [pose]"
            )


@checked
def loads_scene(text: str, path: str | Path | None = None, files: SceneFiles | None = None) -> Scene:
    """Read a scene from text.

    Args:
        text: TOML.
        path: Path of the file that contains the text: errors name it, and relative paths start in its folder. Default:
            the current folder.
        files: Files that the scene may refer to, if it is untrusted, and the folder where relative paths start.

    Raises:
        SceneError: The scene is invalid; one line names file, key, value and allowed values.
    """
    path = None if path is None else Path(path)
    label = "scene" if path is None else str(path)
    files = files or SceneFiles(Path.cwd() if path is None else path.parent.resolve())
    data = parse_toml(text, label, SceneError)
    own = {key: data[key] for key in data if key not in _SECTIONS}
    top = SceneTable(label, files, "", own, (*_TOP_KEYS, *_SECTIONS))
    _check_top(top, data, label)
    lights, captured = _split_lights(data.get("light", []), label)
    read = _Sections({**data, "light": lights}, label, files)
    light_keys = {**fields_of(Light), **fields_of(AreaLight)}
    shining = read.many("light", light_keys, sections.read_light)
    emitting = tuple(light.as_object() for light in shining if isinstance(light, AreaLight))
    objects = read.many("object", fields_of(Object), sections.read_object)
    camera_keys = (*INTRINSICS, "transfer", "calibration", "field_of_view")
    camera = read.one("camera", camera_keys, lambda table: sections.read_camera(table, data.get("source")))
    assert camera is not None  # ``_check_top`` has checked it
    own_light = None
    if captured is not None:
        table = SceneTable(label, files, *captured, list(fields_of(CapturedLight)))
        own_light = read_fields(table, CapturedLight)
    scene = Scene(
        schema=SCHEMA,
        name=top.text("name", "scene" if path is None else path.stem),
        camera=camera,
        source=read.one("source", fields_of(SourceSpec), sections.read_source),
        marker=read.marker or Marker(),
        probes=read.many("probe", fields_of(Probe), lambda table: read_fields(table, Probe), single=True),
        proxies=read.many("proxy", fields_of(Proxy), lambda table: read_fields(table, Proxy)),
        objects=objects + emitting,
        lights=tuple(light for light in shining if isinstance(light, Light)),
        captured=own_light,
        pose=read.one("pose", fields_of(PoseKeys), sections.read_pose),
        has_marker="marker" in data or "pose" not in data,
        exposure=read.one("exposure", fields_of(Exposure), lambda table: read_fields(table, Exposure)) or Exposure(),
        path=path,
    )
    read.check_placed()
    return scene
