"""Scene files, schema 1: TOML read into frozen dataclasses, with errors that say what would be right.

Metres, degrees, linear RGB. The world is the marker's frame: origin at the marker's (or board's) centre, x right, y up
the printed page, z out of the page. Paths are relative to the scene file. What a file leaves out has the default of its
field; sections other than ``[camera]`` are optional, and ``[marker]`` must be there as soon as anything has a place in
the world. Sections are read by ``read_camera``, ``read_physical`` and ``read_virtual``.

A scene built or changed in Python is checked by ``loads_scene(dumps_scene(scene))``.
"""

from __future__ import annotations

import importlib.resources
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

from warp_ar.errors import SceneError, reason
from warp_ar.files import is_file, is_folder, parse_toml, read_text
from warp_ar.scene.description import (
    SCHEMA,
    AreaLight,
    Camera,
    CapturedLight,
    Exposure,
    Light,
    Marker,
    Object,
    Probe,
    Proxy,
    Scene,
    SourceSpec,
)
from warp_ar.scene.keys import IN_MEMORY, INTRINSICS, keys_of
from warp_ar.scene.messages import nearest
from warp_ar.scene.read_camera import POSE_KEYS, read_camera, read_exposure, read_pose, read_source
from warp_ar.scene.read_physical import read_captured, read_marker, read_probe, read_proxy
from warp_ar.scene.read_virtual import read_light, read_object
from warp_ar.scene.scene_files import SceneFiles
from warp_ar.scene.scene_table import SceneTable

_TOP_KEYS: Final = ("schema", "name")
_SECTIONS: Final = ("camera", "source", "marker", "probe", "proxy", "object", "light", "pose", "exposure")
_T = TypeVar("_T")
FRAMES: Final = frozenset(
    {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".heic", ".mp4", ".mov", ".mkv", ".avi", ".webm"}
)
"""Endings of what is taken for frames, not for a scene."""
FRAMES_GO: Final = "; frames go to --source"
"""What to say where frames may have been named as a scene."""


def bundled_scenes() -> dict[str, Path]:
    """The scenes that come with the program: name to file, in order of name."""
    folder = Path(str(importlib.resources.files("warp_ar.scenes")))
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def _scene_in(folder: Path) -> Path:
    """The one scene file of a folder.

    Raises:
        SceneError: It holds none, or several.
    """
    try:
        found = sorted(path for path in folder.glob("*.toml") if is_file(path))
    except OSError as error:
        raise SceneError(f"{folder}: cannot be read: {reason(error)}") from error
    if len(found) != 1:
        names = ", ".join(path.name for path in found[:4]) or f"none{FRAMES_GO}"
        raise SceneError(f"{folder}: expected a folder with one scene file, NAME.toml; it has {names}")
    return found[0]


def _desks_beside(path: Path) -> list[str]:
    """Folders with a scene beside a path that is not there, as one would write them."""
    try:
        beside = sorted(folder for folder in path.parent.iterdir() if is_folder(folder))[:200]
        return [str(folder) for folder in beside if any(folder.glob("*.toml"))]
    except (OSError, ValueError):
        return []


def load_scene(path_or_name: str | Path, files: SceneFiles | None = None) -> Scene:
    """Read a scene file.

    Args:
        path_or_name: A file, a folder that holds one, or the name of a bundled scene.
        files: Files that it may name, of a scene from outside; all if left out.

    Raises:
        SceneError: No such scene, or something in it is wrong; one line names file, key, value and what would be right.
    """
    path, bundled = Path(path_or_name), bundled_scenes()
    # A folder of frames may have a bundled scene's name.
    if str(path_or_name) and str(path_or_name) not in bundled and is_folder(path):
        path = _scene_in(path)
    if not is_file(path):
        if str(path_or_name) not in bundled:
            known = [*_desks_beside(path), *bundled]
            hint = f"a file, or a bundled scene ({nearest(str(path_or_name), known)})" if known else "a scene file"
            raise SceneError(f"{path}: no such scene; expected {hint}")
        path = bundled[str(path_or_name)]
    if path.suffix.lower() in FRAMES:
        raise SceneError(f"{path} is no scene; expected a scene file{FRAMES_GO}")
    return loads_scene(read_text(path, SceneError, expected="TOML"), path, files)


def _check_top(top: SceneTable, data: dict[str, Any], label: str) -> None:
    """What every scene file must have."""
    if "schema" not in top:
        top.fail("schema", f"expected schema = {SCHEMA} at the top of the file")
    if top.data["schema"] is True or top.data["schema"] != SCHEMA:
        top.fail("schema", f"this program reads schema {SCHEMA}")
    if "camera" not in data:
        names = ", ".join(INTRINSICS[:6])
        raise SceneError(f"{label}: [camera] is missing: give {names}, calibration or field_of_view")


def _split_lights(lights: Any, label: str) -> tuple[Any, tuple[str, Any] | None]:
    """Virtual lights, and the captured one with its name in messages, which share a section."""
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
    """The sections of a scene file, read one by one."""

    def __init__(self, data: dict[str, Any], label: str, files: SceneFiles) -> None:
        self.data, self.label, self.files = data, label, files
        self.marker: Marker | None = self.one("marker", keys_of(Marker), read_marker)

    def table(self, section: str, data: Any, keys: Sequence[str]) -> SceneTable:
        return SceneTable(self.label, self.files, section, data, keys)

    def one(self, section: str, keys: Sequence[str], read: Callable[[SceneTable], _T]) -> _T | None:
        """What a section says that stands once; None without it."""
        return read(self.table(section, self.data[section], keys)) if section in self.data else None

    def many(
        self, section: str, keys: Sequence[str], read: Callable[[SceneTable], _T], *, single: bool = False
    ) -> tuple[_T, ...]:
        """What a section says that may stand several times; if ``single``, ``[section]`` is one."""

        def placed(name: str, item: Any) -> _T:
            table = self.table(name, item, keys)
            table.world = self.marker
            return read(table)

        value = self.data.get(section, [])
        if single and isinstance(value, dict):
            return (placed(section, value),)
        if not isinstance(value, list):
            right = f"there may be several: write [[{section}]] instead of [{section}]"
            raise SceneError(f"{self.label}: {section}: {right}")
        return tuple(placed(f"{section}[{i}]", item) for i, item in enumerate(value))

    def camera(self) -> Camera:
        """``[camera]``, which may ask the first picture of ``[source]``."""
        keys = (*INTRINSICS, "transfer", "calibration", "field_of_view")
        camera = self.one("camera", keys, lambda table: read_camera(table, self.data.get("source")))
        assert camera is not None  # ``_check_top`` has asked
        return camera

    def objects(self) -> tuple[Object, ...]:
        """``[[object]]``, without the keys that only a program can give."""
        return self.many("object", [key for key in keys_of(Object) if ("object", key) not in IN_MEMORY], read_object)

    def check_placed(self) -> None:
        """Whatever has a place in the world needs a world.

        Raises:
            SceneError: There is neither a marker nor a pose.
        """
        placed = [section for section in ("probe", "proxy", "object", "light") if self.data.get(section)]
        if placed and "marker" not in self.data and "pose" not in self.data:
            raise SceneError(
                f"{self.label}: [marker] is missing: [{placed[0]}] has its place in the marker's frame; give its size, "
                "or the camera's [pose]"
            )


def loads_scene(text: str, path: str | Path | None = None, files: SceneFiles | None = None) -> Scene:
    """Read a scene from text.

    Args:
        text: TOML.
        path: The file that the text stands for: named in errors, and its folder is where relative paths start. Without
            it they start at the current folder.
        files: Files that it may name, of a scene from outside, and the folder where relative paths start.

    Raises:
        SceneError: As :func:`load_scene`.
    """
    path = None if path is None else Path(path)
    label = "scene" if path is None else str(path)
    files = files or SceneFiles(Path.cwd() if path is None else path.parent.resolve())
    data = parse_toml(text, label, SceneError)
    own = {key: data[key] for key in data if key not in _SECTIONS}
    top = SceneTable(label, files, "", own, (*_TOP_KEYS, *_SECTIONS))
    _check_top(top, data, label)
    lights, captured = _split_lights(data.get("light", []), label)
    sections = _Sections({**data, "light": lights}, label, files)
    shining = sections.many("light", keys_of(Light, AreaLight), read_light)
    emitting = tuple(light.as_object() for light in shining if isinstance(light, AreaLight))
    objects = sections.objects()
    scene = Scene(
        schema=SCHEMA,
        name=top.text("name", "scene" if path is None else path.stem),
        camera=sections.camera(),
        source=sections.one("source", keys_of(SourceSpec), read_source),
        marker=sections.marker or Marker(),
        probes=sections.many("probe", keys_of(Probe), read_probe, single=True),
        proxies=sections.many("proxy", keys_of(Proxy), read_proxy),
        objects=objects + emitting,
        lights=tuple(light for light in shining if isinstance(light, Light)),
        captured=None if captured is None else read_captured(sections.table(*captured, keys_of(CapturedLight))),
        pose=sections.one("pose", POSE_KEYS, read_pose),
        has_marker="marker" in data or "pose" not in data,
        exposure=sections.one("exposure", keys_of(Exposure), read_exposure) or Exposure(),
        path=path,
    )
    sections.check_placed()
    return scene
