"""Sections of a scene file about what stands on the desk: marker, mirror balls, proxies, captured light."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any, Final, cast

import cv2

from warp_ar.scene.description import (
    LATLONG_AXES,
    Board,
    CapturedLight,
    CharucoBoard,
    GridBoard,
    Marker,
    Probe,
    Proxy,
    ProxyMaterial,
)
from warp_ar.scene.keys import PROXY_KEYS, keys_of
from warp_ar.scene.materials import RGB
from warp_ar.scene.mesh_files import MESH_SUFFIXES
from warp_ar.scene.messages import LARGEST, SMALLEST
from warp_ar.scene.scene_table import SceneTable

_BOARDS: Final = (
    '"charuco COLUMNSxROWS SQUARE MARKER" or "grid COLUMNSxROWS MARKER GAP" with lengths in metres, such as '
    '"charuco 5x7 0.04 0.03"'
)
_DICTIONARIES: Final = {name: int(getattr(cv2.aruco, name)) for name in dir(cv2.aruco) if name.startswith("DICT_")}


def read_marker(table: SceneTable) -> Marker:
    """``[marker]``."""
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


def read_own_marker(parent: SceneTable) -> Marker | None:
    """The marker that something rides on: a number, of the world's dictionary and size, or a table."""
    if "marker" not in parent:
        return None
    world, value = parent.world, parent.data["marker"]
    if isinstance(value, dict):
        given = {"dictionary": world.dictionary, **value} if world else value
        if world and world.board is None and "board" not in value:
            given = {"size": world.size, **given}
        keys = [key for key in keys_of(Marker) if key != "white"]
        own = read_marker(parent.inner("marker", given, keys))
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
    """A ``[[probe]]``."""
    reflectance = Probe.reflectance
    if isinstance(table.data.get("reflectance"), list):
        reflectance = cast(RGB, table.vector("reflectance", low=0.01, high=1.0))
    elif "reflectance" in table:
        reflectance = (table.number("reflectance", low=0.01, high=1.0),) * 3
    own = read_own_marker(table)
    return Probe(table.vec3("center", unit="metres"), table.length("radius"), reflectance, own)


def read_proxy(table: SceneTable) -> Proxy:
    """A ``[[proxy]]``."""
    shape = table.choice("shape", PROXY_KEYS)
    table.only("shape", PROXY_KEYS[shape], ("size", "file"))
    sides = {"plane": 2, "box": 3}.get(shape)
    return Proxy(
        shape=cast(Any, shape),
        at=table.vec3("at", Proxy.at, unit="metres"),
        rotate=table.vec3("rotate", Proxy.rotate, unit="degrees"),
        size=() if sides is None else table.vector("size", sizes=(sides,), low=SMALLEST, unit="metres"),
        file=_read_mesh_path(table) if shape == "mesh" else None,
        marker=read_own_marker(table),
        material=_read_proxy_material(table),
    )


def _read_proxy_material(parent: SceneTable) -> ProxyMaterial | None:
    if "material" not in parent:
        return None
    section, given = parent.name("material"), parent.data["material"]
    table = SceneTable(parent.label, parent.files, section, given, keys_of(ProxyMaterial))
    reflectance = ProxyMaterial.reflectance
    if isinstance(table.data.get("reflectance"), list):
        reflectance = cast(RGB, table.vector("reflectance", low=0.0, high=1.0))
    elif "reflectance" in table:
        reflectance = (table.number("reflectance", low=0.0, high=1.0),) * 3
    return ProxyMaterial(table.number("roughness", ProxyMaterial.roughness, low=0.0, high=1.0), reflectance)


def _read_mesh_path(table: SceneTable) -> Path:
    path = table.file("file", "a mesh")
    if path.suffix.lower() not in MESH_SUFFIXES:
        table.fail("file", f"unknown mesh format; use one of {', '.join(MESH_SUFFIXES)}")
    return path


def read_captured(table: SceneTable) -> CapturedLight:
    """The ``[[light]]`` that is a file."""
    return CapturedLight(
        table.file("file", "a captured light (OpenEXR or HDR)"),
        table.number("scale", CapturedLight.scale, low=SMALLEST),
        table.vec3("rotate", CapturedLight.rotate, unit="degrees"),
        table.choice("axes", LATLONG_AXES) if "axes" in table else None,
    )
