"""Sections of a scene file, read into their dataclasses by the keys that the fields declare; see `fields`."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Self, TypeVar

import cv2

from warp_ar.files import is_file
from warp_ar.scene.calibration_file import load_calibration
from warp_ar.scene.description import (
    INTRINSICS,
    SIDES,
    TURNS,
    AreaLight,
    Board,
    Camera,
    CharucoBoard,
    Exposure,
    GridBoard,
    Light,
    Marker,
    Object,
    PoseSpec,
    Probe,
    Proxy,
    SourceSpec,
)
from warp_ar.scene.exif import camera_by_exif
from warp_ar.scene.fields import Field, fields_of, not_used
from warp_ar.scene.materials import MATERIALS, Material
from warp_ar.scene.mesh_files import GLTF_SUFFIXES, MESH_SUFFIXES
from warp_ar.scene.messages import LARGEST, SMALLEST
from warp_ar.scene.pose_file import check_rotation, load_pose_file, pose_of_position, rotation_of_quaternion
from warp_ar.scene.scene_files import SceneFiles
from warp_ar.scene.table import MISSING, MOST, Table

_T = TypeVar("_T")
_SOURCES: Final = ("path", "camera", "synthetic")
_TRANSFERS: Final = '"srgb", "linear", "gamma:2.2" or the path of a measured response'
_NOMINAL_SIZE: Final = (640, 480)
"""Pixels of a guessed camera until its frames' size is known."""
_BOARDS: Final = (
    '"charuco COLUMNSxROWS SQUARE MARKER" or "grid COLUMNSxROWS MARKER GAP" with lengths in metres, such as '
    '"charuco 5x7 0.04 0.03"'
)
_DICTIONARIES: Final = {name: int(getattr(cv2.aruco, name)) for name in dir(cv2.aruco) if name.startswith("DICT_")}


class SceneTable(Table):
    """One table of a scene file."""

    world: Marker | None = None
    """The world's marker, if there is one."""

    def __init__(self, label: str, files: SceneFiles, section: str, data: object, keys: Sequence[str]) -> None:
        """Check the keys; arguments and errors as those of `Table`, with the resolver of paths for the folder."""
        super().__init__(label, files.folder, section, data, keys)
        self.files = files

    def inner(self, key: str, data: object, keys: Sequence[str]) -> Self:
        """Return a table within this one: the value of a key."""
        return type(self)(self.label, self.files, self.name(key), data, keys)

    def find(self, text: str) -> Path | None:
        """Return the path that a text names; None if this scene must not name it."""
        return self.files.resolve(text)


def read_fields(table: SceneTable, kind: type[_T], **given: Any) -> _T:
    """Read a table into its dataclass.

    Args:
        table: The table; keys that the kind of thing does not use are refused.
        kind: The dataclass.
        given: Values of fields that are read elsewhere.

    Raises:
        SceneError: A value is missing or cannot be.
    """
    every = fields_of(kind)
    uses: dict[str, tuple[str, ...]] = getattr(kind, "USES", {})
    unused: set[str] = set()
    if uses:
        selector = next(iter(every))
        chosen = table.choice(selector, uses)
        given[selector] = chosen
        table.only(selector, uses[chosen], (key for keys in uses.values() for key in keys))
        unused = not_used(uses, chosen)
        if "size" in uses[chosen]:
            given["size"] = _numbers(table, every["size"], (SIDES[chosen],))
    for name, field in every.items():
        if (name not in given and name not in unused and (name in table or field.key.required)) or (
            field.default is MISSING and name not in given
        ):
            given[name] = _read(table, field)
    return kind(**given)


def _read(table: SceneTable, field: Field) -> Any:
    """Read the value of a key, which must be there."""
    name, key = field.name, field.key
    match field.form:
        case "number":
            return table.number(name, low=key.low, high=key.high, unit=_unit(field))
        case "integer":
            return table.integer(name, low=round(max(key.low, 0)), high=round(min(key.high, MOST)))
        case "flag":
            return table.flag(name)
        case "text":
            return table.text(name, right=key.right or "some text")
        case "word":
            return table.choice(name, field.words)
        case "path":
            return table.file(name, key.right) if "mesh" not in key.right else _mesh_path(table)
        case "color" if isinstance(table.data[name], str):
            return table.file(name, "a picture")
        case "color" if not isinstance(table.data[name], list):
            table.fail(name, "expected a list of 3 numbers from 0 to 1, or the path of a texture")
        case "table":
            keys = list(fields_of(field.kind))
            return read_fields(table.inner(name, table.data[name], keys), field.kind)
    return _numbers(table, field, key.sizes)


def _numbers(table: SceneTable, field: Field, sizes: tuple[int, ...]) -> tuple[float, ...]:
    return table.vector(field.name, sizes=sizes, low=field.key.low, high=field.key.high, unit=_unit(field))


def _unit(field: Field) -> str:
    """Return a unit as messages name it; ranges are said anyway."""
    return field.key.unit if field.key.unit in ("metres", "degrees", "pixels", "seconds", "frames per second") else ""


def _grey(table: SceneTable, field: Field) -> dict[str, Any]:
    """Return a reflectance for which one number may stand."""
    key = field.key
    if field.name not in table or isinstance(table.data[field.name], list):
        return {}
    return {field.name: (table.number(field.name, low=key.low, high=key.high),) * 3}


# ---- the camera ------------------------------------------------------------------------------------------------------


def read_camera(table: SceneTable, source: object = None) -> Camera:
    """Read ``[camera]``; ``source`` is the data of ``[source]``, whose first picture may tell the camera."""
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
        return Camera.guessed(*_NOMINAL_SIZE, _read(table, fields_of(Camera)[way]), transfer)
    if not any(key in table for key in INTRINSICS):
        names = ", ".join(INTRINSICS[:6])
        right = f"give {names}, or field_of_view, or calibration with the path of OpenCV's YAML or JSON"
        table.fail("width", right)
    return read_fields(table, Camera, transfer=transfer)


def _read_transfer(table: SceneTable) -> str | Path:
    value = table.text("transfer", "srgb", right=_TRANSFERS)
    if value in ("srgb", "linear"):
        return value
    if value.startswith("gamma:"):
        try:
            gamma = float(value.removeprefix("gamma:"))
        except ValueError:
            gamma = math.nan
        if not 0.1 <= gamma <= 10.0:
            table.fail("transfer", 'expected a gamma from 0.1 to 10, such as "gamma:2.2"')
        return value
    path = table.resolve("transfer", _TRANSFERS)
    if not is_file(path):
        table.fail("transfer", f"expected {_TRANSFERS}; no such file: {path}")
    return path


def read_source(table: SceneTable) -> SourceSpec:
    """Read ``[source]``."""
    given = [key for key in _SOURCES if key in table]
    if len(given) != 1:
        also = f"{given[0]} is given too; " if given else ""
        table.fail(given[1] if given else "path", f"{also}expected exactly one of path, camera and synthetic")
    # Whether the path is there is asked when the source is opened: another source may stand in for it.
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
    for key in table.data:
        if key != way and key not in ways[way]:
            table.fail(key, f"not used with {way}; {_POSES}")
    if way == "file":
        path = table.file("file", "poses: COLMAP's images, OpenTrackIO, USD, or JSON")
        return load_pose_file(path)
    if way == "position":
        rotate = table.vec3("rotate", (0.0, 0.0, 0.0), unit="degrees")
        return PoseSpec((pose_of_position(table.vec3("position", unit="metres"), rotate),))
    translation = table.vec3("t", unit="metres")
    if way == "R":
        rotation = table.vector("R", sizes=(9,))
        if not check_rotation(rotation):
            table.fail("R", "expected a rotation matrix, 9 numbers row by row: camera_from_world, as OpenCV has it")
        return PoseSpec(((rotation, translation),))
    w, x, y, z = table.vector("quaternion", sizes=(4,), low=-1e6, high=1e6)
    if w == x == y == z == 0.0:
        table.fail("quaternion", "has no length; expected w, x, y, z as COLMAP has them")
    return PoseSpec(((rotation_of_quaternion(w, x, y, z), translation),))


def read_exposure(table: SceneTable) -> Exposure:
    """Read ``[exposure]``."""
    if table.data.get("scale") == "auto":
        return Exposure("auto")
    if isinstance(table.data.get("scale"), str):
        table.fail("scale", 'expected a number, 0 or more, or "auto"')
    return read_fields(table, Exposure)


# ---- what stands on the desk -----------------------------------------------------------------------------------------


def read_marker(table: SceneTable) -> Marker:
    """Read ``[marker]``."""
    dictionary = table.choice("dictionary", _DICTIONARIES, Marker.dictionary)
    count = len(cv2.aruco.getPredefinedDictionary(_DICTIONARIES[dictionary]).bytesList)
    if table.data.get("turn", 0) not in TURNS:
        table.fail("turn", "expected 0, 90, 180 or 270 degrees")
    if "board" not in table:
        number = table.integer("id", Marker.id, low=0, high=count - 1)
        return read_fields(table, Marker, dictionary=dictionary, id=number)
    for key in ("id", "size"):
        if key in table:
            table.fail(key, "not used beside board, which says its own sizes; remove one of the two")
    board = _read_board(table)
    if board.marker_count > count:
        table.fail("board", f"needs {board.marker_count} markers; {dictionary} has {count}")
    return read_fields(table, Marker, dictionary=dictionary, board=board, size=Marker.size)


def _own_marker(parent: SceneTable) -> dict[str, Any]:
    """Return the marker that something rides on: a number, of the world's dictionary and size, or a table."""
    if "marker" not in parent:
        return {}
    world, value = parent.world, parent.data["marker"]
    if isinstance(value, dict):
        given = {"dictionary": world.dictionary, **value} if world else value
        if world and world.board is None and "board" not in value:
            given = {"size": world.size, **given}
        keys = [key for key in fields_of(Marker) if key != "white"]
        own = read_marker(parent.inner("marker", given, keys))
    elif world is None or world.board is not None or isinstance(value, bool) or not isinstance(value, int):
        right = 'a table such as { id = 7, size = 0.05 } or { board = "grid 2x2 0.03 0.01" }'
        parent.fail("marker", f"expected {right}" + (", or an id" if world and world.board is None else ""))
    else:
        count = len(cv2.aruco.getPredefinedDictionary(_DICTIONARIES[world.dictionary]).bytesList)
        own = Marker(world.dictionary, parent.integer("marker", low=0, high=count - 1), world.size)
    if world is not None and own.dictionary == world.dictionary and (both := _ids(own) & _ids(world)):
        right = f"marker {min(both)} of {own.dictionary} is the world's own; use another id or dictionary"
        parent.fail("marker", right)
    return {"marker": own}


def _ids(marker: Marker) -> set[int]:
    """Return the numbers in its dictionary that a marker or board shows."""
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
    if not (SMALLEST <= first <= LARGEST and SMALLEST <= second <= LARGEST):
        table.fail("board", f"lengths must be above 0 and finite; expected {_BOARDS}")
    if words[0] == "grid":
        if columns < 1 or rows < 1:
            table.fail("board", "a grid has at least 1x1 markers")
        return GridBoard(columns, rows, first, second)
    if columns < 2 or rows < 2:
        table.fail("board", "a ChArUco board has at least 2x2 squares")
    if second >= first:
        table.fail("board", "a marker must be smaller than its square; the square's length comes first")
    return CharucoBoard(columns, rows, first, second, words[0] == "charuco-legacy")


def read_probe(table: SceneTable) -> Probe:
    """Read a ``[[probe]]``."""
    return read_fields(table, Probe, **_grey(table, fields_of(Probe)["reflectance"]), **_own_marker(table))


def read_proxy(table: SceneTable) -> Proxy:
    """Read a ``[[proxy]]``."""
    given = _own_marker(table)
    if "material" in table:
        field = fields_of(Proxy)["material"]
        inner = table.inner("material", table.data["material"], list(fields_of(field.kind)))
        given["material"] = read_fields(inner, field.kind, **_grey(inner, fields_of(field.kind)["reflectance"]))
    return read_fields(table, Proxy, **given)


def _mesh_path(table: SceneTable) -> Path:
    path = table.file("file", "a mesh")
    if path.suffix.lower() not in MESH_SUFFIXES:
        table.fail("file", f"unknown mesh format; use one of {', '.join(MESH_SUFFIXES)}")
    return path


# ---- what is virtual -------------------------------------------------------------------------------------------------


def read_object(table: SceneTable) -> Object:
    """Read an ``[[object]]``."""
    _check_motion(table)
    given = _own_marker(table)
    if "material" in table:
        given["material"] = _read_material(table)
    if "play" in table:
        plays = table.data.get("shape") == "mesh" and _mesh_path(table).suffix.lower() in GLTF_SUFFIXES
        if not plays:
            table.fail("play", f"plays an animation of a file; give one that ends in {' or '.join(GLTF_SUFFIXES)}")
        play = fields_of(Object)["play"].kind
        inner = table.inner("play", table.data["play"], list(fields_of(play)))
        number = {}
        if "animation" in inner and not isinstance(inner.data["animation"], str):
            number = {"animation": inner.integer("animation", low=0)}
        given["play"] = read_fields(inner, play, **number)
    if table.data.get("shape") == "torus":
        major, minor = table.length("major_radius"), table.length("minor_radius")
        if minor >= major:
            table.fail("minor_radius", f"must be below major_radius ({major:g}), else the torus has no hole")
    return read_fields(table, Object, **given)


def _read_material(parent: SceneTable) -> Material:
    names = {model: tuple(fields_of(kind)) for model, kind in MATERIALS.items()}
    every = list(dict.fromkeys(key for keys in names.values() for key in keys))
    table = parent.inner("material", parent.data["material"], ["model", *every])
    model = table.choice("model", MATERIALS)
    table.only("model", names[model], every)
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
    """Read a ``[[light]]`` that is virtual."""
    uses: dict[str, tuple[str, ...]] = {**Light.USES, **AreaLight.USES}
    kind = table.choice("kind", uses)
    table.only("kind", uses[kind], (key for keys in uses.values() for key in keys))
    _check_motion(table)
    given = _own_marker(table)
    if kind in AreaLight.USES:
        return read_fields(table, AreaLight, **given)
    if "target" in table:
        if "direction" in table:
            table.fail("direction", "target is given too; expected exactly one of the two")
        if table.vec3("target", unit="metres") == table.vec3("at", unit="metres"):
            table.fail("target", "is where the light itself is; move one of the two")
    elif kind != "point":
        if kind == "spot" and "direction" not in table:
            table.fail("target", "a spot light needs a target (a point) or a direction")
        if not any(abs(component) >= SMALLEST for component in table.vec3("direction")):
            table.fail("direction", "has no length; expected the way the light travels, such as [0, 0, -1]")
    light = read_fields(table, Light, **given)
    if light.inner_angle > light.outer_angle:
        table.fail("inner_angle", f"must not be above outer_angle ({light.outer_angle:g})")
    if not any(term >= SMALLEST for term in light.attenuation):
        table.fail("attenuation", "is zero everywhere; expected constant, linear and quadratic term, such as [0, 0, 1]")
    return light
