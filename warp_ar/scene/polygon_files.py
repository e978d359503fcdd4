"""OBJ, PLY and OFF: polygons with all that the file declares of their corners, cut into triangles.

Polygons are cut by ear clipping where they are concave, so that areas and winding are kept. Colours are sRGB-encoded,
in 8 or 16 bits or from 0 to 1. What a file declares and is not shown is named in the mesh's notes.

References:
    Wavefront, "Object Files (.obj)", appendix B1. Turk, "The PLY Polygon File Format" (1994). Geomview manual, OFF.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError
from warp_ar.scene.gltf import decode_rgba
from warp_ar.scene.materials import LambertMaterial
from warp_ar.scene.mesh_assets import Assets
from warp_ar.scene.mesh_materials import MeshMaterial, TextureUse
from warp_ar.scene.mesh_parts import MeshPart
from warp_ar.scene.mtl import parse_library, read_library
from warp_ar.srgb import decode_srgb

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
ByteArray = npt.NDArray[np.uint8]

FLAT: Final = 1e-12
"""Share of a polygon's squared size below which a corner has no turn: float64 rounding of its cross product."""
_UNCOLORED: Final = (0.8, 0.8, 0.8, 1.0)
"""Linear colour of faces without one beside others that have one: that of a mesh without colours."""


@dataclasses.dataclass
class Corners:
    """Polygons, one corner after another."""

    vertex: Indices
    """Vertex of each corner, (n,)."""
    lengths: Indices
    """Corners of each polygon, (p,)."""
    uv: Array | None = None
    """Texture coordinates of each corner, (n, 2)."""
    normal: Array | None = None
    """Normal of each corner, (n, 3)."""
    color: Array | None = None
    """Linear RGBA of each polygon, (p, 4)."""


def triangles_of(vertices: Array, corners: Corners) -> tuple[Indices, Indices]:
    """Cut polygons into triangles.

    Args:
        vertices: (v, 3).
        corners: The polygons; those of fewer than three corners have no triangle.

    Returns:
        Corners of the triangles, (m, 3), by their numbers, and the polygon of each, (m,).
    """
    starts = np.cumsum(corners.lengths) - corners.lengths
    found: list[Indices] = []
    owners: list[Indices] = []
    for count in np.unique(corners.lengths[corners.lengths >= 3]).tolist():
        which = np.flatnonzero(corners.lengths == count)
        places = starts[which, None] + np.arange(count)
        bent = np.zeros(len(which), bool)
        if count > 3:
            points = vertices[corners.vertex[places]]
            after = np.roll(points, -1, 1) - points
            turns = np.cross(np.roll(after, 1, 1), after)
            normals = np.cross(points - points[:, :1], np.roll(points, -1, 1) - points[:, :1]).sum(1)
            along = (turns * normals[:, None]).sum(2)
            bent = (along < -FLAT * np.maximum((normals**2).sum(1), 1e-300)[:, None]).any(1)
        fan = np.stack([np.zeros(count - 2, np.int64), np.arange(1, count - 1), np.arange(2, count)], 1)
        found.append(places[~bent][:, fan].reshape(-1, 3))
        owners.append(np.repeat(which[~bent], count - 2))
        for polygon in np.flatnonzero(bent):
            cut = clip_ears(points[polygon])
            found.append(places[polygon][cut])
            owners.append(np.full(len(cut), which[polygon]))
    if not found:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    order = np.argsort(np.concatenate(owners), kind="stable")
    return np.concatenate(found)[order], np.concatenate(owners)[order]


def clip_ears(points: Array) -> Indices:
    """Cut a polygon by ear clipping: a corner goes whose triangle turns as the polygon and holds no other corner.

    A polygon that crosses itself has corners without an ear; there the next corner goes, whatever it holds.

    Args:
        points: (n, 3), about in a plane.

    Returns:
        Corners of n - 2 triangles, wound as the polygon.
    """
    normal = np.cross(points - points[0], np.roll(points, -1, 0) - points[0]).sum(0)
    axis = int(np.argmax(np.abs(normal)))
    plane = points[:, [(axis + 1) % 3, (axis + 2) % 3]]  # seen from +axis, so that areas have the sign of normal[axis]
    sign = 1.0 if normal[axis] >= 0.0 else -1.0
    least = FLAT * float(np.ptp(plane, 0).max()) ** 2

    def turn(a: Any, b: Any, c: Any) -> Any:
        (ux, uy), (vx, vy) = np.moveaxis(b - a, -1, 0), np.moveaxis(c - a, -1, 0)
        return sign * (ux * vy - uy * vx)

    left = list(range(len(points)))
    cut = []
    at = tries = 0
    while len(left) > 3:
        count = len(left)
        before, here, after = (left[(at + step) % count] for step in (-1, 0, 1))
        a, b, c = plane[before], plane[here], plane[after]
        others = plane[[k for k in left if k not in (before, here, after)]]
        others = others[~((others == a) | (others == b) | (others == c)).all(1)] if len(others) else others
        inside = (turn(a, b, others) >= -least) & (turn(b, c, others) >= -least) & (turn(c, a, others) >= -least)
        if (turn(a, b, c) > least and not inside.any()) or tries >= count:
            cut.append((before, here, after))
            del left[at % count]
            at, tries = at % max(len(left), 1), 0
        else:
            at, tries = (at + 1) % count, tries + 1
    return np.array([*cut, tuple(left)], np.int64)


def part_of(
    label: str,
    vertices: Array,
    corners: Corners,
    *,
    colors: Array | None = None,
    material: MeshMaterial | None = None,
    crease: float | None,
    chosen: npt.NDArray[np.bool_] | None = None,
    cut: tuple[Indices, Indices] | None = None,
) -> MeshPart | None:
    """Return the triangles of polygons as a part of a mesh; None where there are none.

    Args:
        label: The file, for messages.
        vertices: (v, 3).
        corners: The polygons.
        colors: Linear RGBA of vertices, (v, 4).
        material: The part's.
        crease: Degrees from which on an edge is sharp where the file has no normals.
        chosen: Polygons that are of this part, (p,); None: all.
        cut: What `triangles_of` gives, where it is known.

    Raises:
        SceneError: A face names a vertex that is not there, or a vertex is not finite.
    """
    if corners.vertex.size and not (corners.vertex.min() >= 0 and corners.vertex.max() < len(vertices)):
        wrong = int(corners.vertex.max() if corners.vertex.max() >= len(vertices) else corners.vertex.min())
        raise SceneError(f"{label}: a face has vertex index {wrong}; there are {len(vertices)} vertices from 0 on")
    triangles, owners = triangles_of(vertices, corners) if cut is None else cut
    if chosen is not None:
        triangles, owners = triangles[chosen[owners]], owners[chosen[owners]]
    if not len(triangles):
        return None
    flat = triangles.ravel()
    of_corners = [values[flat] for values in (corners.uv, corners.normal) if values is not None]
    if corners.color is not None:
        of_corners.append(np.repeat(corners.color[owners], 3, 0))
    index = corners.vertex[flat]
    if not of_corners:
        used, faces = (None, index) if chosen is None else np.unique(index, return_inverse=True)
        where = np.arange(len(vertices)) if used is None else used
        first = None
    else:
        rows = np.column_stack([index.astype(np.float64), *of_corners])
        rows = np.ascontiguousarray(np.where(np.isfinite(rows), rows, 0.0) + 0.0)
        keys = rows.view(np.dtype((np.void, rows.dtype.itemsize * rows.shape[1]))).ravel()
        _, first, faces = np.unique(keys, return_index=True, return_inverse=True)
        order = np.argsort(first)  # as they come in the file
        first, faces = first[order], np.argsort(order)[faces]
        where = index[first]

    def taken(values: Array | None) -> Array | None:
        return None if values is None else values[flat][first]

    own = None if colors is None else colors[where]
    if corners.color is not None:
        face = np.repeat(corners.color[owners], 3, 0)[first]
        own = face if own is None else own * face
    return MeshPart.checked(
        label,
        vertices[where],
        faces.reshape(-1, 3).astype(np.int64),
        taken(corners.normal),
        uvs=(taken(corners.uv), None),
        colors=own,
        material=material,
        crease=crease,
    )


def linear_rgba(values: Array, largest: float) -> Array:
    """Return linear RGBA, (n, 4), of sRGB-encoded colours, (n, 3 or more), of which ``largest`` is white."""
    shown = np.clip(np.nan_to_num(values[:, :3] / largest), 0.0, 1.0)
    return np.concatenate([decode_srgb(shown), np.ones((len(values), 1))], axis=1)


def decode_text(data: bytes) -> str:
    """Return text in UTF-8, with or without a byte-order mark, or else in Latin-1."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


class _Obj:
    """Reads an OBJ line by line."""

    def __init__(self, path: Path, data: bytes, assets: Assets, images: list[ByteArray], notes: list[str]) -> None:
        self._label, self._assets, self._images, self._notes = f"{path}", assets, images, notes
        self._rows: dict[str, list[list[str]]] = {"v": [], "vt": [], "vn": []}
        self._tokens: list[str] = []
        self._faces: list[tuple[int, int, int, int, int]] = []  # corners, material, and v, vt, vn before it
        self._materials: dict[str, int] = {}
        self._libraries: list[str] = []
        self._material = self._number("")
        for line in re.sub(r"\\[ \t]*\r?\n", " ", decode_text(data)).splitlines():
            self._read(line)

    def _number(self, name: str) -> int:
        return self._materials.setdefault(name, len(self._materials))

    def _read(self, line: str) -> None:
        key, _, rest = line.strip().partition("#")[0].replace("\t", " ").partition(" ")
        if key in self._rows:
            self._rows[key].append(rest.split())
        elif key in ("f", "fo"):
            words = rest.split()
            v, vt, vn = (len(self._rows[name]) for name in ("v", "vt", "vn"))
            self._tokens += words
            self._faces.append((len(words), self._material, v, vt, vn))
        elif key in ("usemtl", "mtllib"):
            # A name may have a # in it, but not after a blank.
            name = re.sub(r"\s#.*", "", line.strip()[len(key) :]).strip()
            if key == "usemtl":
                self._material = self._number(name)
            elif name:
                self._libraries.append(name)
        elif key in ("curv", "curv2", "surf"):
            self._notes.extend(["free-form curves and surfaces"] * ("free-form curves and surfaces" not in self._notes))

    def parts(self, crease: float | None) -> list[MeshPart]:
        """Return a part for each material."""
        vertices, colors = self._vertices()
        corners, materials = self._corners()
        library = self._library()
        found = []
        cut = None
        if not corners.vertex.size or (corners.vertex.min() >= 0 and corners.vertex.max() < len(vertices)):
            cut = triangles_of(vertices, corners)
        for name, number in self._materials.items():
            chosen = None if (materials == number).all() else materials == number
            values = library.get(name)
            if name and values is None and library:
                self._notes.append(f"the material {name[:60]}, which no library has")
            material = None
            if values is not None and (chosen is None or chosen.any()):
                material = read_library(self._label, values, self._images, self._notes, self._assets)
            part = part_of(
                self._label, vertices, corners, colors=colors, material=material, crease=crease, chosen=chosen, cut=cut
            )
            found += [] if part is None else [part]
            if chosen is None:
                break
        return found

    def _vertices(self) -> tuple[Array, Array | None]:
        """Return positions and linear colours: x y z [w] or x y z r g b [a]."""
        rows = self._rows["v"]
        if any(len(row) < 3 for row in rows):
            raise SceneError(f"{self._label}: a vertex has fewer than 3 numbers")
        vertices = np.array([row[:3] for row in rows], dtype=np.float64).reshape(-1, 3)
        colored = [len(row) >= 6 for row in rows]
        if not any(colored):
            return vertices, None
        values = np.array([row[3:6] if has else (1, 1, 1) for row, has in zip(rows, colored, strict=True)], np.float64)
        largest = 255.0 if values[np.array(colored)].max(initial=0.0) > 1.0 else 1.0
        values[~np.array(colored)] = largest
        return vertices, linear_rgba(values, largest)

    def _corners(self) -> tuple[Corners, Indices]:
        faces = np.array(self._faces, np.int64).reshape(-1, 5)
        indices = self._indices()
        before = np.repeat(faces[:, 2:], faces[:, 0], 0)
        indices = np.where(indices < 0, indices + before, indices - 1)
        corners = Corners(indices[:, 0], faces[:, 0])
        corners.uv = self._attribute("vt", indices[:, 1], 2)
        corners.normal = self._attribute("vn", indices[:, 2], 3)
        return corners, faces[:, 1]

    def _indices(self) -> Indices:
        """Return v, vt, vn of each corner as the file counts them, (n, 3); 0 where it has none."""
        rows = [[int(number or 0) for number in token.split("/")] for token in self._tokens]
        if any(not 1 <= len(row) <= 3 or row[0] == 0 for row in rows):
            raise SceneError(f"{self._label}: a face names no vertex; corners are v, v/vt or v/vt/vn, counted from 1")
        return np.array([[*row, 0, 0][:3] for row in rows], np.int64).reshape(-1, 3)

    def _attribute(self, key: str, index: Indices, size: int) -> Array | None:
        """Return values of corners, 0 where a corner has none; None where none has."""
        rows = self._rows[key]
        if not rows or not len(index) or (index < 0).all():
            return None
        if index.max() >= len(rows):
            raise SceneError(f"{self._label}: a face names {key} {int(index.max()) + 1}; there are {len(rows)}")
        values = np.array([[*row, "0", "0"][:size] for row in rows], np.float64)
        return np.where((index >= 0)[:, None], values[np.maximum(index, 0)], 0.0)

    def _library(self) -> dict[str, dict[str, Any]]:
        """Return the materials of all libraries by name; the first of a name counts."""
        found: dict[str, dict[str, Any]] = {}
        for said in dict.fromkeys(self._libraries):
            names = [said] if self._assets.has(said) else said.split()
            for name in names:
                data = self._assets.library(name)
                if data is None:
                    shown = re.split(r"[/\\]", name)[-1][:60]
                    self._notes.append(f"the material library {shown}, which is not there")
                else:
                    found = {**parse_library(decode_text(data)), **found}
        return found


def read_obj(
    path: Path, data: bytes, assets: Assets, images: list[ByteArray], notes: list[str], crease: float | None
) -> list[MeshPart]:
    """Read an OBJ with its material libraries: a part for each material."""
    return _Obj(path, data, assets, images, notes).parts(crease)


def read_off(
    path: Path, data: bytes, assets: Assets, images: list[ByteArray], notes: list[str], crease: float | None
) -> list[MeshPart]:
    """Read an OFF: colours, normals and texture coordinates of vertices (COFF, NOFF, STOFF), colours of faces.

    Raises:
        ValueError: It is binary, of another dimension than three, cut off, or no OFF.
    """
    lines = [line.split("#")[0].split() for line in decode_text(data).splitlines()]
    lines = [line for line in lines if line]
    kind = re.fullmatch(r"(ST)?(C)?(N)?(4)?(n)?OFF", lines[0][0]) if lines else None
    if kind is not None:
        lines[0] = lines[0][1:]
        lines = lines if lines[0] else lines[1:]
    if not lines or "BINARY" in lines[0] or (kind is not None and (kind[4] or kind[5])):
        raise ValueError("no OFF of text in three dimensions")
    count, polygons = int(lines[0][0]), int(lines[0][1])
    rows, faces = lines[1 : 1 + count], lines[1 + count : 1 + count + polygons]
    if len(rows) < count or len(faces) < polygons:
        raise ValueError(f"cut off after {len(lines)} lines")
    wide = min(map(len, rows), default=3)
    values = np.array([row[:wide] for row in rows], np.float64).reshape(-1, wide)
    at = 3
    normals = uvs = colors = None
    if kind is not None and kind[3]:
        normals, at = values[:, 3:6], 6
    rest = wide - at - (2 if kind is not None and kind[1] else 0)
    if rest >= 3:
        whole = not any(re.search(r"[.eE]", word) for row in rows for word in row[at : at + 3])
        colors, at = linear_rgba(values[:, at : at + 3], _white(values[:, at : at + 3], whole)), at + min(rest, 4)
    if kind is not None and kind[1] and wide >= at + 2:
        uvs = values[:, at : at + 2]
    lengths = np.array([int(face[0]) for face in faces], np.int64)
    if any(len(face) < 1 + length for face, length in zip(faces, lengths.tolist(), strict=True)):
        raise ValueError("a face has fewer corners than it says")
    index = np.array([int(word) for face in faces for word in face[1 : 1 + int(face[0])]], np.int64)
    corners = Corners(index, lengths)
    inside = bool(index.size) and index.min() >= 0 and index.max() < count
    corners.normal = normals[index] if normals is not None and inside else None
    corners.uv = uvs[index] if uvs is not None and inside else None
    extra = [face[1 + int(face[0]) :] for face in faces]
    if any(len(words) >= 3 for words in extra):
        whole = not any(re.search(r"[.eE]", word) for words in extra for word in words[:3])
        told = np.array([words[:3] if len(words) >= 3 else ("-1",) * 3 for words in extra], np.float64)
        corners.color = linear_rgba(told, _white(told, whole))
        corners.color[told[:, 0] < 0.0] = _UNCOLORED
    elif any(extra):
        notes.append("colours of faces by their number in a table")
    part = part_of(f"{path}", values[:, :3], corners, colors=colors, crease=crease)
    return [] if part is None else [part]


def _white(values: Array, whole: bool) -> float:
    """Return what white is among colours: 255 of whole numbers, else 1, or what fits."""
    largest = float(np.nanmax(values, initial=0.0))
    return 65535.0 if largest > 255.0 else 255.0 if whole or largest > 1.0 else 1.0


_PLY_TYPES: Final = {
    **dict.fromkeys(("char", "int8"), "i1"), **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"), **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"), **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"), **dict.fromkeys(("double", "float64"), "f8"),
}  # fmt: skip
_PLY_COLORS: Final = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_PLY_UVS: Final = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texcoord_u", "texcoord_v"))
_PLY_UNSEEN: Final = frozenset(
    {"confidence", "intensity", "quality", "flags", "alpha", "diffuse_alpha", "a", "texnumber", "curvature", "radius"}
)
"""Properties that say nothing of how a surface looks, or are not used on purpose."""
_Property = tuple[str, str, str | None]
"""Name, type, and for a list the type of its length."""


class _Ply:
    """Reader of a PLY, its elements one after another; ValueError where it is damaged."""

    def __init__(self, data: bytes) -> None:
        head, found, body = data.partition(b"end_header")
        if not data.startswith(b"ply") or not found:
            raise ValueError("no PLY file, or cut off in its header")
        self.texture: str | None = None
        self._elements: list[tuple[str, int, list[_Property]]] = []
        self._order = ""
        for line in decode_text(head).splitlines():
            self._declare(line)
        self._words: list[bytes] = []
        self._at = 0
        self._data = body[2:] if body.startswith(b"\r\n") else body[1:]
        if self._order == "ascii":
            self._words = self._data.split()
        self.values = {name: self._element(name, count, list_) for name, count, list_ in self._elements}
        self.kinds = {name: {key: kind for key, kind, _ in list_} for name, _, list_ in self._elements}

    def _declare(self, line: str) -> None:
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            self._order = {"ascii": "ascii", "binary_little_endian": "<", "binary_big_endian": ">"}[words[1]]
        elif words[:1] == ["element"]:
            self._elements.append((words[1], int(words[2]), []))
        elif words[:2] == ["property", "list"]:
            self._elements[-1][2].append((words[4], _PLY_TYPES[words[3]], _PLY_TYPES[words[2]]))
        elif words[:1] == ["property"]:
            self._elements[-1][2].append((words[2], _PLY_TYPES[words[1]], None))
        elif words[:2] == ["comment", "TextureFile"]:
            self.texture = " ".join(words[2:])

    def _element(self, name: str, count: int, properties: list[_Property]) -> dict[str, Any]:
        """Return an element's values by property: arrays, and of lists (values of all rows, length of each row)."""
        if all(length is None for _, _, length in properties):
            table = self._rows(count, [1] * len(properties), properties)
            return {key: table[key] for key, _, _ in properties}
        start = self._at
        first = self._row(properties) if count else [[] for _ in properties]
        sizes = [1 if n is None else len(values) for values, (_, _, n) in zip(first, properties, strict=True)]
        self._at = start
        try:
            table = self._rows(count, sizes, properties)
            same = all(
                (table[f"#{key}"] == size).all() for (key, _, n), size in zip(properties, sizes, strict=True) if n
            )
        except ValueError:
            same = False
        if same:
            return {
                key: table[key] if n is None else (table[key].ravel(), np.full(count, size, np.int64))
                for (key, _, n), size in zip(properties, sizes, strict=True)
            }
        self._at = start
        rows = [self._row(properties) for _ in range(count)]
        found: dict[str, Any] = {}
        for column, (key, _, length) in enumerate(properties):
            values = np.array([value for row in rows for value in row[column]], np.float64)
            found[key] = values if length is None else (values, np.array([len(row[column]) for row in rows], np.int64))
        return found

    def _rows(self, count: int, sizes: list[int], properties: list[_Property]) -> dict[str, Array]:
        """Return all rows of an element whose lists have these lengths; lengths stand under ``#`` and the name."""
        fields: list[tuple[str, str, int]] = []
        for (key, kind, length), size in zip(properties, sizes, strict=True):
            fields += [] if length is None else [(f"#{key}", length, 1)]
            fields.append((key, kind, size))
        if self._order == "ascii":
            width = sum(size for _, _, size in fields)
            words = self._words[self._at : self._at + count * width]
            if len(words) < count * width:
                raise ValueError("cut off")
            values = np.array([float(word) for word in words], np.float64).reshape(count, width)
            self._at += count * width
            ends = np.cumsum([size for _, _, size in fields]).tolist()
            return {
                key: values[:, end - size : end] if size != 1 or not _is_scalar(key, properties) else values[:, end - 1]
                for (key, _, size), end in zip(fields, ends, strict=True)
            }
        kinds = np.dtype([(key, self._order + kind, (size,)) for key, kind, size in fields])
        if self._at + count * kinds.itemsize > len(self._data):
            raise ValueError(f"cut off after {len(self._data)} bytes")
        table = np.frombuffer(self._data, kinds, count, self._at)
        self._at += count * kinds.itemsize
        return {
            key: table[key][:, 0].astype(np.float64) if _is_scalar(key, properties) else table[key].astype(np.float64)
            for key, _, _ in fields
        }

    def _row(self, properties: list[_Property]) -> list[list[float]]:
        """Return the next row, each property as a list."""
        row = []
        for _, kind, length in properties:
            count = 1 if length is None else int(self._next(length, 1)[0])
            row.append(self._next(kind, count))
        return row

    def _next(self, kind: str, count: int) -> list[float]:
        size = 1 if self._order == "ascii" else np.dtype(kind).itemsize
        end = len(self._words) if self._order == "ascii" else len(self._data)
        if count < 0 or self._at + count * size > end:
            raise ValueError(f"cut off, or a list of {count} entries")
        start, self._at = self._at, self._at + count * size
        if self._order == "ascii":
            return [float(word) for word in self._words[start : self._at]]
        found: list[float] = np.frombuffer(self._data, self._order + kind, count, start).astype(np.float64).tolist()
        return found

    def columns(self, element: str, choices: tuple[tuple[str, ...], ...]) -> tuple[Array | None, float]:
        """Return the columns of the first choice that an element has, and the largest value of their type."""
        values = self.values.get(element, {})
        for names in choices:
            if all(name in values and not isinstance(values[name], tuple) for name in names):
                largest = {"u1": 255.0, "u2": 65535.0, "i2": 32767.0}.get(self.kinds[element][names[0]], 1.0)
                return np.stack([values[name] for name in names], 1), largest
        return None, 1.0

    def colors(self, element: str) -> Array | None:
        """Return linear RGBA of an element's rows."""
        values, largest = self.columns(element, _PLY_COLORS)
        return None if values is None else linear_rgba(values, largest if largest > 1.0 else _white(values, False))

    def unseen(self) -> list[str]:
        """Return the properties of vertices and faces that are not shown, in words."""
        lists = {"vertex_indices", "vertex_index", "texcoord"}
        known = {"x", "y", "z", "nx", "ny", "nz", *sum(_PLY_COLORS, ()), *sum(_PLY_UVS, ()), *lists} | _PLY_UNSEEN
        return [
            f"the property {key[:40]} of each {element}"
            for element in ("vertex", "face")
            for key in self.values.get(element, {})
            if key not in known
        ]


def _is_scalar(key: str, properties: list[_Property]) -> bool:
    return key.startswith("#") or any(key == name and length is None for name, _, length in properties)


def read_ply(
    path: Path, data: bytes, assets: Assets, images: list[ByteArray], notes: list[str], crease: float | None
) -> list[MeshPart]:
    """Read a PLY: colours, normals and texture coordinates of vertices, colours and texture coordinates of faces."""
    ply = _Ply(data)
    vertices, _ = ply.columns("vertex", (("x", "y", "z"),))
    faces = ply.values.get("face", {})
    listed = next((faces[key] for key in ("vertex_indices", "vertex_index") if isinstance(faces.get(key), tuple)), None)
    if vertices is None or listed is None:
        return []
    index, lengths = listed[0].astype(np.int64), listed[1]
    corners = Corners(index, lengths)
    inside = bool(index.size) and index.min() >= 0 and index.max() < len(vertices)
    normals, _ = ply.columns("vertex", (("nx", "ny", "nz"),))
    uvs, _ = ply.columns("vertex", _PLY_UVS)
    if inside:
        corners.normal = None if normals is None else normals[index]
        corners.uv = None if uvs is None else uvs[index]
    texcoord = faces.get("texcoord")
    if isinstance(texcoord, tuple):
        if (texcoord[1] == 2 * lengths).all():
            corners.uv = texcoord[0].reshape(-1, 2)
        elif texcoord[1].any():
            notes.append("texture coordinates of faces that do not fit their corners")
    corners.color = ply.colors("face")
    notes += ply.unseen()
    material = None
    if ply.texture and corners.uv is not None:
        if assets.has(ply.texture):
            images.append(decode_rgba(assets.get(ply.texture), f"{path}: {ply.texture}"))
            material = MeshMaterial(surface=LambertMaterial((1.0, 1.0, 1.0)), base=TextureUse(len(images) - 1))
        else:
            notes.append(f"the texture {ply.texture[:60]}, which is not there")
    part = part_of(f"{path}", vertices, corners, colors=ply.colors("vertex"), material=material, crease=crease)
    return [] if part is None else [part]


Reader = Callable[[Path, bytes, Assets, list[ByteArray], list[str], float | None], list[MeshPart]]
READERS: Final[dict[str, Reader]] = {".obj": read_obj, ".off": read_off, ".ply": read_ply}
"""Readers by ending."""
