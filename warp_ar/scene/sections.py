"""Readers of scene file sections into their dataclasses, by the keys declared at the fields; see `fields`."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Self, TypeVar

from warp_ar.errors import warn_renamed
from warp_ar.files import is_file
from warp_ar.scene.calibration_file import load_calibration
from warp_ar.scene.description import (
    INTRINSICS,
    SIDES,
    AreaLight,
    Board,
    Camera,
    CharucoBoard,
    GridBoard,
    Light,
    Marker,
    Object,
    PoseKeys,
    PoseSpec,
    SourceSpec,
)
from warp_ar.scene.exif import camera_by_exif
from warp_ar.scene.fields import Field, FieldError, fields_of, not_used
from warp_ar.scene.materials import MATERIALS, Material
from warp_ar.scene.mesh_files import GLTF_SUFFIXES, MESH_SUFFIXES
from warp_ar.scene.messages import SMALLEST
from warp_ar.scene.pose_file import check_rotation, load_pose_file, pose_of_position, rotation_of_quaternion
from warp_ar.scene.scene_files import SceneFiles
from warp_ar.scene.table import Table
from warp_ar.srgb import TRANSFERS, is_formula

_T = TypeVar("_T")
_NOMINAL_SIZE: Final = (640, 480)
"""Size in pixels of a camera without calibration until the frames' size is known."""
_BOARDS: Final = (
    '"charuco COLUMNSxROWS SQUARE MARKER" or "grid COLUMNSxROWS MARKER GAP" with lengths in metres, such as '
    '"charuco 5x7 0.04 0.03"'
)


RENAMED: Final[dict[str, str]] = {}
"""Former names of keys with their section, such as ``object.material.model``, and their present names without it.

They work with a warning for one minor version."""


class SceneTable(Table):
    """One section (a TOML table) of a scene file."""

    world: Marker | None = None
    """Marker of the world frame, or None."""

    def __init__(self, label: str, files: SceneFiles, section: str, data: object, keys: Sequence[str]) -> None:
        """Check the keys; arguments are those of `Table`, but ``files`` resolves paths instead of a folder."""
        place = re.sub(r"\[\d+\]", "", section)
        if isinstance(data, dict):
            for old in [key for key in data if f"{place}.{key}" in RENAMED]:
                new = RENAMED[f"{place}.{old}"]
                warn_renamed(f"{label}: {section}.{old}", new, FutureWarning)
                data = {new if key == old else key: value for key, value in data.items()}
        super().__init__(label, files.folder, section, data, keys)
        self.files = files

    def inner(self, key: str, data: object, keys: Sequence[str]) -> Self:
        """Return the table under a key of this one."""
        return type(self)(self.label, self.files, self.name(key), data, keys)

    def resolve(self, key: str, right: str) -> Path:
        """Return a path with links resolved; its existence is not checked."""
        value = self.text(key, right=f"the path of {right}")
        try:
            path = self.files.resolve(value)
        except (OSError, RuntimeError, ValueError):  # too long, a loop of links, or a zero byte
            self.fail(key, f"expected the path of {right}; this cannot be one")
        if path is None:
            self.fail(
                key,
                f"expected {right}; no file of this name came with the scene; open a scene with its own "
                "files by python -m warp_ar.live, or drop a ZIP that holds them",
            )
        return path

    def file(self, key: str, right: str) -> Path:
        """Return the path of an existing file."""
        path = self.resolve(key, right)
        if not is_file(path):
            self.fail(key, f"no such file: {path}")
        return path


def read_fields(table: SceneTable, kind: type[_T], **given: Any) -> _T:
    """Return an instance of a dataclass with the values of a scene file's table.

    If the dataclass has ``USES``, its first field selects a variant, such as the shape of an object. ``USES`` lists the
    keys of each variant; other keys are refused.

    Args:
        table: The table; keys that it lacks keep the defaults of their fields.
        kind: The dataclass, whose fields declare the keys and which checks the values.
        given: Values of fields that are not read from the table, by the names of the fields.

    Raises:
        SceneError: A value is missing or not allowed.
    """
    every = fields_of(kind)
    uses: dict[str, tuple[str, ...]] = getattr(kind, "USES", {})
    unused: set[str] = set()
    if uses:
        selector = next(iter(every))
        chosen = given[selector] = table.choice(selector, uses)
        table.only(selector, uses)
        unused = not_used(uses, chosen)
        if "size" in uses[chosen]:
            key = dataclasses.replace(every["size"].key, sizes=(SIDES[chosen],), low=SMALLEST)
            given["size"] = table.admit(dataclasses.replace(every["size"], key=key))
    for name, field in every.items():
        needed = name not in unused and (field.key.required or field.default is dataclasses.MISSING)
        if name not in given and (name in table or needed):
            given[name] = read_value(table, field)
    try:
        return kind(**given)
    except FieldError as error:
        table.fail(error.key, error.right)


def read_value(table: SceneTable, field: Field) -> Any:
    """Read the value of a required key.

    Raises:
        SceneError: The value is missing or not allowed.
    """
    name, kind = field.name, field.kinds[0] if field.kinds else type(None)
    is_text = isinstance(table.data.get(name), str)
    match field.form:
        case "text" if is_text or int not in field.kinds:
            return table.text(name, right=field.key.right or "some text")
        case "text":
            return table.integer(name, low=0)
        case "path":
            path = table.file(name, field.key.right)
            if field.key.right == "a mesh" and path.suffix.lower() not in MESH_SUFFIXES:
                table.fail(name, f"unknown mesh format; use one of {', '.join(MESH_SUFFIXES)}")
            return path
        case "color" if is_text:
            return table.file(name, "a picture")
        case "table" if kind is Marker:
            return _own_marker(table)
        case "table" if kind is CharucoBoard:
            return _read_board(table)
        case "table" if kind in MATERIALS.values():
            return _read_material(table)
        case "table":
            return read_fields(table.inner(name, table.data[name], list(fields_of(kind))), kind)
        case "flag":
            return table.flag(name)
    return table.admit(field)


# ---- the camera ------------------------------------------------------------------------------------------------------


def read_camera(table: SceneTable, source: object = None) -> Camera:
    """Read ``[camera]``; ``source`` is the data of ``[source]``, whose first picture's EXIF may give the camera."""
    transfer = _read_transfer(table)
    way = next((key for key in ("calibration", "field_of_view") if key in table), None)
    if way is not None:
        for key in (*INTRINSICS, "field_of_view"):
            if key in table and key != way:
                table.fail(key, f"not used beside {way}; give one of the two")
    if table.data.get("calibration") == "exif":
        path = source.get("path") if isinstance(source, dict) else None
        if not isinstance(path, str):
            right = '"exif" reads the pictures of the scene: give [source] path; else a file or numbers'
            table.fail("calibration", right)
        pictures = SceneTable(table.label, table.files, "source", source, list(fields_of(SourceSpec)))
        return camera_by_exif(pictures.resolve("path", "pictures"), transfer)
    if way == "calibration":
        return load_calibration(table.file("calibration", "a calibration file"), transfer)
    if way == "field_of_view":
        return Camera.guessed(*_NOMINAL_SIZE, table.admit(fields_of(Camera)[way]), transfer)
    if not any(key in table for key in INTRINSICS):
        names = ", ".join(INTRINSICS[:6])
        right = f"give {names}, or field_of_view, or calibration with the path of OpenCV's YAML or JSON"
        table.fail("width", right)
    return read_fields(table, Camera, transfer=transfer)


def _read_transfer(table: SceneTable) -> str | Path:
    value = table.text("transfer", "srgb", right=TRANSFERS)
    if is_formula(value):
        return value
    path = table.resolve("transfer", TRANSFERS)
    if not is_file(path):
        table.fail("transfer", f"expected {TRANSFERS}; no such file: {path}")
    return path


def read_source(table: SceneTable) -> SourceSpec:
    """Read ``[source]``."""
    # The path's existence is checked when the source is opened, because another source may replace it.
    path = table.resolve("path", fields_of(SourceSpec)["path"].key.right) if "path" in table else None
    spec = read_fields(table, SourceSpec, path=path)
    if spec.camera is not None and not table.files.has_camera(spec.camera):
        table.fail("camera", "a scene from outside opens no capture device; start the program with --source")
    return spec


_POSES: Final = "expected R and t, quaternion and t (both camera_from_world), position and rotate, or file"


def read_pose(table: SceneTable) -> PoseSpec:
    """Read ``[pose]``."""
    ways = {"R": ("t",), "quaternion": ("t",), "position": ("rotate",), "file": ()}
    given = [key for key in ways if key in table]
    if len(given) != 1:
        table.fail(given[1] if given else "R", f"{given[0]} is given too; {_POSES}" if given else _POSES)
    way = given[0]

    def read(key: str) -> Any:
        return table.admit(dataclasses.replace(fields_of(PoseKeys)[key], optional=False))

    for key in table.data:
        if key != way and key not in ways[way]:
            table.fail(key, f"not used with {way}; {_POSES}")
    if way == "file":
        path = table.file("file", "poses: COLMAP's images, OpenTrackIO, USD, or JSON")
        return load_pose_file(path)
    if way == "position":
        rotate = read("rotate") if "rotate" in table else (0.0, 0.0, 0.0)
        return PoseSpec((pose_of_position(read("position"), rotate),))
    translation = read("t")
    if way == "R":
        rotation = read("R")
        if not check_rotation(rotation):
            table.fail("R", "expected a rotation matrix, 9 numbers row by row: camera_from_world, as OpenCV has it")
        return PoseSpec(((rotation, translation),))
    w, x, y, z = read("quaternion")
    if w == x == y == z == 0.0:
        table.fail("quaternion", "has no length; expected w, x, y, z as COLMAP has them")
    return PoseSpec(((rotation_of_quaternion(w, x, y, z), translation),))


# ---- what stands on the desk -----------------------------------------------------------------------------------------


def read_marker(table: SceneTable) -> Marker:
    """Read ``[marker]``."""
    if "board" not in table:
        return read_fields(table, Marker)
    for key in ("id", "size"):
        if key in table:
            table.fail(key, "not used beside board, which says its own sizes; remove one of the two")
    return read_fields(table, Marker, size=Marker.size)


def _own_marker(parent: SceneTable) -> Marker:
    """Return the marker to which a part of the scene is attached.

    The key holds a number (with the world marker's dictionary and size) or a table.
    """
    world, value = parent.world, parent.data["marker"]
    if isinstance(value, dict):
        given = {"dictionary": world.dictionary, **value} if world else value
        if world and world.board is None and "board" not in value:
            given = {"size": world.size, **given}
    elif world is None or world.board is not None or isinstance(value, bool) or not isinstance(value, int):
        right = 'a table such as { id = 7, size = 0.05 } or { board = "grid 2x2 0.03 0.01" }'
        parent.fail("marker", f"expected {right}" + (", or an id" if world and world.board is None else ""))
    else:
        given = {"dictionary": world.dictionary, "id": value, "size": world.size}
    own = read_marker(parent.inner("marker", given, [key for key in fields_of(Marker) if key != "white"]))
    if world is not None and own.dictionary == world.dictionary and (both := _ids(own) & _ids(world)):
        right = f"marker {min(both)} of {own.dictionary} is the world's own; use another id or dictionary"
        parent.fail("marker", right)
    return own


def _ids(marker: Marker) -> set[int]:
    """Return the ids, in its dictionary, of a marker or of a board's markers."""
    return {marker.id} if marker.board is None else set(range(marker.board.marker_count))


def _read_board(table: SceneTable) -> Board:
    words = table.text("board", right=_BOARDS).split()
    match = re.fullmatch(r"([0-9]{1,4})x([0-9]{1,4})", words[1]) if len(words) == 4 else None
    if match is None or words[0] not in ("charuco", "charuco-legacy", "grid"):
        table.fail("board", f"expected {_BOARDS}")
    columns, rows = int(match[1]), int(match[2])
    try:
        first, second = float(words[2]), float(words[3])
    except ValueError:
        first = second = math.nan
    try:
        if words[0] == "grid":
            return GridBoard(columns, rows, first, second)
        return CharucoBoard(columns, rows, first, second, words[0] == "charuco-legacy")
    except FieldError as error:
        table.fail("board", f"{error.key}: {error.right}; expected {_BOARDS}")


# ---- what is virtual -------------------------------------------------------------------------------------------------


def read_object(table: SceneTable) -> Object:
    """Read an ``[[object]]``."""
    _check_motion(table)
    item = read_fields(table, Object)
    if item.play is not None and (item.file is None or item.file.suffix.lower() not in GLTF_SUFFIXES):
        table.fail("play", f"plays an animation of a file; give one that ends in {' or '.join(GLTF_SUFFIXES)}")
    return item


def _read_material(parent: SceneTable) -> Material:
    uses = {model: tuple(fields_of(kind)) for model, kind in MATERIALS.items()}
    keys = dict.fromkeys(itertools.chain(["model"], *uses.values()))
    table = parent.inner("material", parent.data["material"], list(keys))
    model = table.choice("model", MATERIALS)
    table.only("model", uses)
    return read_fields(table, MATERIALS[model])


def _check_motion(table: SceneTable) -> None:
    motion = table.data.get("animate")
    if isinstance(motion, dict):
        inner = table.inner("animate", motion, list(motion))
        if "period" in inner and "sway" not in inner:
            inner.fail("period", "is the duration of a swing; give sway too, its excursion in metres")
        if "pivot" in inner and "turn" not in inner:
            inner.fail("pivot", "is the point to turn about; give turn too, in degrees per second")


def read_light(table: SceneTable) -> Light | AreaLight:
    """Read a ``[[light]]`` without ``file``."""
    uses: dict[str, tuple[str, ...]] = {**Light.USES, **AreaLight.USES}
    kind = table.choice("kind", uses)
    table.only("kind", uses)
    _check_motion(table)
    if kind in AreaLight.USES:
        return read_fields(table, AreaLight)
    if "target" in table and "direction" in table:
        table.fail("direction", "target is given too; expected exactly one of the two")
    if kind == "directional" and "direction" not in table:
        table.fail("direction", "expected the way the light travels, such as [0, 0, -1]")
    light = read_fields(table, Light)
    if light.kind == "spot" and light.target == light.at:
        table.fail("target", "is where the light itself is; move one of the two")
    return light
