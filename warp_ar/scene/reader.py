"""Scene files, schema 1: TOML read into frozen dataclasses, with errors that say what would be right.

Metres, degrees, linear RGB. The world is the marker's frame: origin at the marker's (or board's) centre, x right, y up
the printed page, z out of the page. Paths are relative to the scene file. What a file leaves out has the default of its
field; sections other than ``[camera]`` are optional, and ``[marker]`` must be there as soon as anything has a place in
the world.

A scene built or changed in Python is checked by ``loads_scene(dumps_scene(scene))``.
"""

from __future__ import annotations

import importlib.resources
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import cv2

from warp_ar.errors import SceneError, reason
from warp_ar.files import is_file, is_folder, parse_toml, read_text
from warp_ar.scene.calibration_file import load_calibration
from warp_ar.scene.description import (
    RGB,
    SCHEMA,
    Animation,
    AreaLight,
    Board,
    Camera,
    CapturedLight,
    CharucoBoard,
    Color,
    EmissiveMaterial,
    Exposure,
    FileMaterial,
    GridBoard,
    LambertMaterial,
    Light,
    Marker,
    Material,
    MetallicRoughnessMaterial,
    MirrorMaterial,
    Object,
    PhongMaterial,
    Play,
    PoseSpec,
    Probe,
    Proxy,
    ProxyMaterial,
    Scene,
    SourceSpec,
)
from warp_ar.scene.exif import camera_by_exif
from warp_ar.scene.keys import (
    AREA_LIGHT_KEYS,
    IN_MEMORY,
    INTRINSICS,
    LIGHT_KEYS,
    MATERIALS,
    OBJECT_KEYS,
    PROXY_KEYS,
    keys_of,
)
from warp_ar.scene.mesh_files import GLTF_SUFFIXES, MESH_SUFFIXES
from warp_ar.scene.messages import LARGEST, MOST_PIXELS, SMALLEST, nearest
from warp_ar.scene.pose_file import check_rotation, load_poses, pose_of_position, rotation_of_quaternion
from warp_ar.scene.table import Table

_TOP_KEYS: Final = ("schema", "name")
_SECTIONS: Final = ("camera", "source", "marker", "probe", "proxy", "object", "light", "pose", "exposure")
_SOURCES: Final = ("path", "camera", "synthetic")
_TRANSFERS: Final = '"srgb", "linear", "gamma:2.2" or the path of a measured response'
_BOARDS: Final = (
    '"charuco COLUMNSxROWS SQUARE MARKER" or "grid COLUMNSxROWS MARKER GAP" with lengths in metres, such as '
    '"charuco 5x7 0.04 0.03"'
)

_NOMINAL_SIZE: Final = (640, 480)
"""Pixels of a guessed camera until its frames' size is known."""
_DICTIONARIES: Final = {name: int(getattr(cv2.aruco, name)) for name in dir(cv2.aruco) if name.startswith("DICT_")}

_T = TypeVar("_T")


class _Table(Table):
    """One table of a scene file."""

    world: Marker | None = None
    """The world's marker, if there is one."""

    def reflectance(self, key: str, default: Color) -> Color:
        """A colour from 0 to 1, or the path of a texture."""
        value = self.data.get(key, default)
        if isinstance(value, str):
            return self.file(key, "a picture")
        if not isinstance(value, list | tuple):
            self.fail(key, "expected a list of 3 numbers from 0 to 1, or the path of a texture")
        return cast(RGB, self.vector(key, cast(RGB, default), low=0.0, high=1.0))


def _exif_camera(table: _Table, source: object, transfer: str | Path) -> Camera:
    """The camera by the EXIF of the scene's own first picture."""
    path = source.get("path") if isinstance(source, dict) else None
    if not isinstance(path, str):
        table.fail("calibration", '"exif" reads the pictures of the scene: give [source] path; else a file or numbers')
    return camera_by_exif(table.folder / path, transfer)


def _read_camera(table: _Table, source: object = None) -> Camera:
    transfer = _read_transfer(table)
    if table.data.get("calibration") == "exif":
        for key in INTRINSICS:
            if key in table:
                table.fail(key, "not used beside calibration; give either EXIF or the numbers")
        return _exif_camera(table, source, transfer)
    if "calibration" in table:
        for key in INTRINSICS:
            if key in table:
                table.fail(key, "not used beside calibration; give either the file or the numbers")
        if "field_of_view" in table:
            table.fail("field_of_view", "not used beside calibration; give either the file or the guess")
        return load_calibration(table.file("calibration", "a calibration file"), transfer)
    if "field_of_view" in table:
        for key in INTRINSICS:
            if key in table:
                table.fail(key, "not used beside field_of_view; give either the numbers or the guess")
        field = table.number("field_of_view", low=5.0, high=150.0, unit="degrees")
        return Camera.guessed(*_NOMINAL_SIZE, field, transfer)
    if not any(key in table for key in INTRINSICS):
        names = ", ".join(INTRINSICS[:6])
        right = f"give {names}, or field_of_view, or calibration with the path of OpenCV's YAML or JSON"
        table.fail("width", right)
    return Camera(
        width=table.integer("width", low=1, high=MOST_PIXELS),
        height=table.integer("height", low=1, high=MOST_PIXELS),
        fx=table.number("fx", low=SMALLEST, unit="pixels"),
        fy=table.number("fy", low=SMALLEST, unit="pixels"),
        cx=table.number("cx", unit="pixels"),
        cy=table.number("cy", unit="pixels"),
        distortion=table.vector("distortion", Camera.distortion, sizes=(4, 5, 8)),
        transfer=transfer,
    )


def _read_transfer(table: _Table) -> str | Path:
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


def _read_source(table: _Table) -> SourceSpec:
    given = [key for key in _SOURCES if key in table]
    if len(given) != 1:
        key = given[1] if given else "path"
        also = f"{given[0]} is given too; " if given else ""
        table.fail(key, f"{also}expected exactly one of path, camera and synthetic")
    path = table.resolve("path", "a folder of frames or a video") if "path" in table else None
    # Whether the path is there is asked when the source is opened: another source may stand in for it.
    return SourceSpec(
        path=path,
        camera=table.integer("camera", low=0, high=1023) if "camera" in table else None,
        synthetic=table.text("synthetic", right="the name of a generated source") if "synthetic" in table else None,
        fps=table.number("fps", low=1e-3, high=1e5, unit="frames per second") if "fps" in table else None,
        exposures=table.vector("exposures", sizes=range(2, 9), low=1e-6, high=1e3, unit="seconds")
        if "exposures" in table
        else None,
        shown=table.number("shown", low=1e-6, high=1e3, unit="seconds") if "shown" in table else None,
        metering=cast(Any, table.choice("metering", ("fixed", "automatic"), "fixed")) if "metering" in table else None,
    )


def _read_marker(table: _Table) -> Marker:
    dictionary = table.choice("dictionary", _DICTIONARIES, Marker.dictionary)
    count = len(cv2.aruco.getPredefinedDictionary(_DICTIONARIES[dictionary]).bytesList)
    white = table.number("white", Marker.white, low=0.01, high=1.0)
    if "board" not in table:
        return Marker(dictionary, table.integer("id", Marker.id, low=0, high=count - 1), table.length("size"), white)
    for key in ("id", "size"):
        if key in table:
            table.fail(key, "not used beside board, which says its own sizes; remove one of the two")
    board = _read_board(table)
    if board.marker_count > count:
        table.fail("board", f"needs {board.marker_count} markers; {dictionary} has {count}")
    return Marker(dictionary, white=white, board=board)


def _read_own_marker(parent: _Table) -> Marker | None:
    """The marker that something rides on: a number, of the world's dictionary and size, or a table."""
    if "marker" not in parent:
        return None
    world, value = parent.world, parent.data["marker"]
    if isinstance(value, dict):
        given = {"dictionary": world.dictionary, **value} if world else value
        if world and world.board is None and "board" not in value:
            given = {"size": world.size, **given}
        keys = [key for key in keys_of(Marker) if key != "white"]
        own = _read_marker(parent.inner("marker", given, keys))
    elif world is None or world.board is not None or isinstance(value, bool) or not isinstance(value, int):
        right = 'a table such as { id = 7, size = 0.05 } or { board = "grid 2x2 0.03 0.01" }'
        parent.fail("marker", f"expected {right}" + (", or an id" if world and world.board is None else ""))
    else:
        count = len(cv2.aruco.getPredefinedDictionary(_DICTIONARIES[world.dictionary]).bytesList)
        own = Marker(world.dictionary, parent.integer("marker", low=0, high=count - 1), world.size)
    if world is not None and own.dictionary == world.dictionary and _ids(own) & _ids(world):
        number = min(_ids(own) & _ids(world))
        parent.fail("marker", f"marker {number} of {own.dictionary} is the world's own; use another id or dictionary")
    return own


def _ids(marker: Marker) -> set[int]:
    """Numbers in its dictionary that a marker or board shows."""
    return {marker.id} if marker.board is None else set(range(marker.board.marker_count))


def _read_board(table: _Table) -> Board:
    words = table.text("board", right=_BOARDS).split()
    match = re.fullmatch(r"([0-9]{1,4})x([0-9]{1,4})", words[1]) if len(words) == 4 else None
    if match is None or words[0] not in ("charuco", "grid"):
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
    return CharucoBoard(columns, rows, first, second)


def _read_probe(table: _Table) -> Probe:
    reflectance = Probe.reflectance
    if isinstance(table.data.get("reflectance"), list):
        reflectance = cast(RGB, table.vector("reflectance", low=0.01, high=1.0))
    elif "reflectance" in table:
        reflectance = (table.number("reflectance", low=0.01, high=1.0),) * 3
    own = _read_own_marker(table)
    return Probe(table.vec3("center", unit="metres"), table.length("radius"), reflectance, own)


def _read_proxy(table: _Table) -> Proxy:
    shape = table.choice("shape", PROXY_KEYS)
    table.only("shape", PROXY_KEYS[shape], ("size", "file"))
    sides = {"plane": 2, "box": 3}.get(shape)
    return Proxy(
        shape=cast(Any, shape),
        at=table.vec3("at", Proxy.at, unit="metres"),
        rotate=table.vec3("rotate", Proxy.rotate, unit="degrees"),
        size=() if sides is None else table.vector("size", sizes=(sides,), low=SMALLEST, unit="metres"),
        file=_read_mesh_path(table) if shape == "mesh" else None,
        marker=_read_own_marker(table),
        material=_read_proxy_material(table),
    )


def _read_proxy_material(parent: _Table) -> ProxyMaterial | None:
    if "material" not in parent:
        return None
    section, given = parent.name("material"), parent.data["material"]
    table = _Table(parent.label, parent.folder, section, given, keys_of(ProxyMaterial))
    reflectance = ProxyMaterial.reflectance
    if isinstance(table.data.get("reflectance"), list):
        reflectance = cast(RGB, table.vector("reflectance", low=0.0, high=1.0))
    elif "reflectance" in table:
        reflectance = (table.number("reflectance", low=0.0, high=1.0),) * 3
    return ProxyMaterial(table.number("roughness", ProxyMaterial.roughness, low=0.0, high=1.0), reflectance)


def _read_mesh_path(table: _Table) -> Path:
    path = table.file("file", "a mesh")
    if path.suffix.lower() not in MESH_SUFFIXES:
        table.fail("file", f"unknown mesh format; use one of {', '.join(MESH_SUFFIXES)}")
    return path


def _read_object(table: _Table) -> Object:
    shape = table.choice("shape", OBJECT_KEYS)
    table.only("shape", OBJECT_KEYS[shape], (key for keys in OBJECT_KEYS.values() for key in keys))
    major = table.length("major_radius") if shape == "torus" else Object.major_radius
    minor = table.length("minor_radius") if shape == "torus" else Object.minor_radius
    if shape == "torus" and minor >= major:
        table.fail("minor_radius", f"must be below major_radius ({major:g}), else the torus has no hole")
    return Object(
        shape=cast(Any, shape),
        file=_read_mesh_path(table) if shape == "mesh" else None,
        radius=table.length("radius") if "radius" in OBJECT_KEYS[shape] else Object.radius,
        size=_read_size(table, shape),
        length=table.length("length") if shape == "tube" else Object.length,
        major_radius=major,
        minor_radius=minor,
        at=table.vec3("at", Object.at, unit="metres"),
        rotate=table.vec3("rotate", Object.rotate, unit="degrees"),
        scale=table.number("scale", Object.scale, low=SMALLEST),
        material=_read_material(table) if "material" in table else Object.material,
        animate=_read_animation(table),
        play=_read_play(table, shape),
        marker=_read_own_marker(table),
    )


def _read_play(parent: _Table, shape: str) -> Play | None:
    if "play" not in parent:
        return None
    if shape != "mesh" or _read_mesh_path(parent).suffix.lower() not in GLTF_SUFFIXES:
        parent.fail("play", f"plays an animation of a file; give one that ends in {' or '.join(GLTF_SUFFIXES)}")
    table = parent.inner("play", parent.data["play"], keys_of(Play))
    animation: str | int = Play.animation
    if isinstance(table.data.get("animation"), str):
        animation = table.text("animation", right="an animation's name, or its number from 0 on")
    elif "animation" in table:
        animation = table.integer("animation", low=0)
    return Play(
        animation=animation,
        loop=table.flag("loop", Play.loop),
        start=table.number("start", Play.start, unit="seconds"),
        speed=table.number("speed", Play.speed, low=SMALLEST),
    )


def _read_size(table: _Table, shape: str) -> tuple[float, ...]:
    """Whole lengths of a rect or a box."""
    sides = {"rect": 2, "box": 3}.get(shape)
    return Object.size if sides is None else table.vector("size", sizes=(sides,), low=SMALLEST, unit="metres")


def _read_material(parent: _Table) -> Material:
    known = ["model", *keys_of(*MATERIALS.values())]
    table = parent.inner("material", parent.data["material"], known)
    model = table.choice("model", MATERIALS)
    kind = MATERIALS[model]
    table.only("model", keys_of(kind), known[1:])
    if kind is FileMaterial:
        return FileMaterial()
    if kind is PhongMaterial:
        return PhongMaterial(
            diffuse=table.reflectance("diffuse", PhongMaterial.diffuse),
            specular=table.reflectance("specular", PhongMaterial.specular),
            shininess=table.number("shininess", PhongMaterial.shininess, low=0.0),
        )
    if kind is MetallicRoughnessMaterial:
        return MetallicRoughnessMaterial(
            base_color=table.reflectance("base_color", MetallicRoughnessMaterial.base_color),
            metallic=table.number("metallic", MetallicRoughnessMaterial.metallic, low=0.0, high=1.0),
            roughness=table.number("roughness", MetallicRoughnessMaterial.roughness, low=0.0, high=1.0),
        )
    if kind is LambertMaterial:
        return LambertMaterial(table.reflectance("base_color", LambertMaterial.base_color))
    if kind is EmissiveMaterial:
        return EmissiveMaterial(
            color=table.vec3("color", EmissiveMaterial.color, low=0.0),
            intensity=table.number("intensity", EmissiveMaterial.intensity, low=0.0),
            image=table.file("image", "a picture") if "image" in table else None,
            two_sided=table.flag("two_sided", EmissiveMaterial.two_sided),
        )
    return MirrorMaterial(table.reflectance("base_color", MirrorMaterial.base_color))


def _read_animation(parent: _Table) -> Animation | None:
    if "animate" not in parent:
        return None
    table = parent.inner("animate", parent.data["animate"], keys_of(Animation))
    if "period" in table and "sway" not in table:
        table.fail("period", "is the duration of a swing; give sway too, its excursion in metres")
    if "pivot" in table and "turn" not in table:
        table.fail("pivot", "is the point to turn about; give turn too, in degrees per second")
    return Animation(
        turn=table.vec3("turn", Animation.turn, unit="degrees per second"),
        pivot=table.vec3("pivot", unit="metres") if "pivot" in table else None,
        sway=table.vec3("sway", Animation.sway, unit="metres"),
        period=table.number("period", Animation.period, low=1e-3, unit="seconds"),
    )


def _read_area_light(table: _Table, kind: str) -> AreaLight:
    return AreaLight(
        kind=cast(Any, kind),
        intensity=table.number("intensity", low=0.0),
        color=table.vec3("color", AreaLight.color, low=0.0),
        at=table.vec3("at", unit="metres"),
        rotate=table.vec3("rotate", AreaLight.rotate, unit="degrees"),
        size=_read_size(table, kind) if kind == "rect" else AreaLight.size,
        radius=table.length("radius") if kind != "rect" else AreaLight.radius,
        length=table.length("length") if kind == "tube" else AreaLight.length,
        image=table.file("image", "a picture") if "image" in table else None,
        two_sided=table.flag("two_sided", AreaLight.two_sided),
        animate=_read_animation(table),
        marker=_read_own_marker(table),
    )


def _read_light(table: _Table) -> Light | AreaLight:
    kinds = {**LIGHT_KEYS, **AREA_LIGHT_KEYS}
    kind = table.choice("kind", kinds)
    table.only("kind", kinds[kind], (key for keys in kinds.values() for key in keys))
    if kind in AREA_LIGHT_KEYS:
        return _read_area_light(table, kind)
    spot = kind == "spot"
    at = Light.at if kind == "directional" else table.vec3("at", unit="metres")
    target = table.vec3("target", unit="metres") if "target" in table else None
    direction = None
    if target is not None:
        if "direction" in table:
            table.fail("direction", "target is given too; expected exactly one of the two")
        if target == at:
            table.fail("target", "is where the light itself is; move one of the two")
    elif kind != "point":
        if spot and "direction" not in table:
            table.fail("target", "a spot light needs a target (a point) or a direction")
        direction = table.vec3("direction")
        if not any(abs(component) >= SMALLEST for component in direction):
            table.fail("direction", "has no length; expected the way the light travels, such as [0, 0, -1]")
    outer = table.number("outer_angle", low=0.0, high=90.0, unit="degrees") if spot else Light.outer_angle
    inner = table.number("inner_angle", low=0.0, high=90.0, unit="degrees") if spot else Light.inner_angle
    if inner > outer:
        table.fail("inner_angle", f"must not be above outer_angle ({outer:g})")
    attenuation = table.vec3("attenuation", Light.attenuation, low=0.0)
    if not any(term >= SMALLEST for term in attenuation):
        table.fail("attenuation", "is zero everywhere; expected constant, linear and quadratic term, such as [0, 0, 1]")
    return Light(
        kind=cast(Any, kind),
        intensity=table.number("intensity", low=0.0),
        color=table.vec3("color", Light.color, low=0.0),
        at=at,
        target=target,
        direction=direction,
        inner_angle=inner,
        outer_angle=outer,
        attenuation=attenuation,
        radius=table.number("radius", Light.radius, low=0.0, unit="metres"),
        animate=_read_animation(table),
        marker=_read_own_marker(table),
    )


def _read_captured(table: _Table) -> CapturedLight:
    return CapturedLight(
        table.file("file", "a captured light (OpenEXR)"),
        table.number("scale", CapturedLight.scale, low=SMALLEST),
        table.vec3("rotate", CapturedLight.rotate, unit="degrees"),
    )


_POSE_KEYS: Final = ("R", "t", "quaternion", "position", "rotate", "file")
_POSES: Final = "expected R and t, quaternion and t (both camera_from_world), position and rotate, or file"


def _read_pose(table: _Table) -> PoseSpec:
    given = [key for key in ("R", "quaternion", "position", "file") if key in table]
    if len(given) != 1:
        key = given[1] if given else "R"
        table.fail(key, f"{given[0]} is given too; {_POSES}" if given else _POSES)
    way = given[0]
    others = {"R": ("t",), "quaternion": ("t",), "position": ("rotate",), "file": ()}[way]
    for key in table.data:
        if key != way and key not in others:
            table.fail(key, f"not used with {way}; {_POSES}")
    if way == "file":
        path = table.file("file", "poses: COLMAP's images, OpenTrackIO, USD, or JSON")
        return PoseSpec(load_poses(path), path)
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


def _read_exposure(table: _Table) -> Exposure:
    if table.data.get("scale") == "auto":
        return Exposure("auto")
    if isinstance(table.data.get("scale"), str):
        table.fail("scale", 'expected a number, 0 or more, or "auto"')
    return Exposure(table.number("scale", 1.0, low=0.0))


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
        names = ", ".join(path.name for path in found[:4]) or "none"
        raise SceneError(f"{folder}: expected a folder with one scene file, NAME.toml; it has {names}")
    return found[0]


def _desks_beside(path: Path) -> list[str]:
    """Folders with a scene beside a path that is not there, as one would write them."""
    try:
        beside = sorted(folder for folder in path.parent.iterdir() if is_folder(folder))[:200]
        return [str(folder) for folder in beside if any(folder.glob("*.toml"))]
    except (OSError, ValueError):
        return []


def load_scene(path_or_name: str | Path) -> Scene:
    """Read a scene file.

    Args:
        path_or_name: A file, a folder that holds one, or the name of a bundled scene.

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
    return loads_scene(read_text(path, SceneError, expected="TOML"), path)


def _check_top(top: _Table, data: dict[str, Any], label: str) -> None:
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


def loads_scene(text: str, path: str | Path | None = None) -> Scene:
    """Read a scene from text.

    Args:
        text: TOML.
        path: The file that the text stands for: named in errors, and its folder is where relative paths start. Without
            it they start at the current folder.

    Raises:
        SceneError: As :func:`load_scene`.
    """
    path = None if path is None else Path(path)
    label = "scene" if path is None else str(path)
    folder = Path.cwd() if path is None else path.parent.resolve()
    data = parse_toml(text, label, SceneError)
    top = _Table(label, folder, "", {key: data[key] for key in data if key not in _SECTIONS}, (*_TOP_KEYS, *_SECTIONS))
    _check_top(top, data, label)

    def in_world(table: _Table) -> _Table:
        table.world = marker
        return table

    def one(section: str, keys: Sequence[str], read: Any) -> Any:
        return read(_Table(label, folder, section, data[section], keys)) if section in data else None

    def many(section: str, keys: Sequence[str], read: Any, *, single: bool = False) -> tuple[Any, ...]:
        value = data.get(section, [])
        if single and isinstance(value, dict):
            return (read(in_world(_Table(label, folder, section, value, keys))),)
        if not isinstance(value, list):
            raise SceneError(f"{label}: {section}: there may be several: write [[{section}]] instead of [{section}]")
        return tuple(
            read(in_world(_Table(label, folder, f"{section}[{i}]", item, keys))) for i, item in enumerate(value)
        )

    lights, captured = _split_lights(data.get("light", []), label)
    data = {**data, "light": lights}
    marker = one("marker", keys_of(Marker), _read_marker)
    shining = many("light", keys_of(Light, AreaLight), _read_light)
    emitting = tuple(light.as_object() for light in shining if isinstance(light, AreaLight))
    objects = many("object", [key for key in keys_of(Object) if ("object", key) not in IN_MEMORY], _read_object)
    scene = Scene(
        schema=SCHEMA,
        name=top.text("name", "scene" if path is None else path.stem),
        camera=one(
            "camera",
            (*INTRINSICS, "transfer", "calibration", "field_of_view"),
            lambda table: _read_camera(table, data.get("source")),
        ),
        source=one("source", keys_of(SourceSpec), _read_source),
        marker=marker or Marker(),
        probes=many("probe", keys_of(Probe), _read_probe, single=True),
        proxies=many("proxy", keys_of(Proxy), _read_proxy),
        objects=objects + emitting,
        lights=tuple(light for light in shining if isinstance(light, Light)),
        captured=None if captured is None else _read_captured(_Table(label, folder, *captured, keys_of(CapturedLight))),
        pose=one("pose", _POSE_KEYS, _read_pose),
        has_marker="marker" in data or "pose" not in data,
        exposure=one("exposure", keys_of(Exposure), _read_exposure) or Exposure(),
        path=path,
    )
    placed = [section for section in ("probe", "proxy", "object", "light") if data.get(section)]
    if placed and "marker" not in data and "pose" not in data:
        raise SceneError(
            f"{label}: [marker] is missing: [{placed[0]}] has its place in the marker's frame; give its size, "
            "or the camera's [pose]"
        )
    return scene
