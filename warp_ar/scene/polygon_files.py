"""Readers of OBJ, PLY, OFF and STL: polygons with all their attributes, cut into triangles.

Concave polygons are cut by ear clipping, which keeps areas and winding. Colours are sRGB-encoded, with 8 or 16 bits or
from 0 to 1. Contents of the file that are not shown are named in the mesh's notes.

References:
    Wavefront, "Object Files (.obj)", appendix B1. Turk, "The PLY Polygon File Format" (1994). Geomview manual, OFF.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError
from warp_ar.scene.materials import LambertMaterial, MeshMaterial, TextureUse
from warp_ar.scene.mesh_parts import MeshPart, check_indices, strip_triangles
from warp_ar.scene.mesh_source import MeshSource
from warp_ar.scene.mtl import parse_library, read_library
from warp_ar.srgb import decode_srgb

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

CREASE: Final = 40.0
"""Angle in degrees above which an edge is sharp, for files without normals (OBJ, OFF, STL)."""
FLAT: Final = 1e-12
"""Cross product at a corner, as a share of the polygon's squared size, below which the corner is straight: float64
rounding."""
_UNCOLORED: Final = (0.8, 0.8, 0.8, 1.0)
"""Linear colour of faces without colour in a file where other faces have one. Meshes without colours have it too."""


@dataclasses.dataclass
class Polygons:
    """Polygons as a list of corners, with the attributes of corners, polygons and vertices."""

    source: MeshSource
    """The file."""
    vertices: Array
    """Positions, (v, 3)."""
    vertex: Indices
    """Vertex index of each corner, (n,)."""
    lengths: Indices
    """Number of corners of each polygon, (p,)."""
    uv: Array | None = None
    """Texture coordinates of each corner, (n, 2)."""
    normal: Array | None = None
    """Normal of each corner, (n, 3)."""
    color: Array | None = None
    """Linear RGBA of each polygon, (p, 4)."""
    vertex_uv: Array | None = None
    """Texture coordinates of each vertex, (v, 2)."""
    vertex_normal: Array | None = None
    """Normal of each vertex, (v, 3)."""
    vertex_color: Array | None = None
    """Linear RGBA of each vertex, (v, 4)."""

    def parts(
        self,
        groups: Indices | None = None,
        materials: Mapping[int, MeshMaterial] | None = None,
        crease: float | None = CREASE,
    ) -> list[MeshPart]:
        """Cut the polygons into triangles, and return a part of a mesh for each group of polygons that gives any.

        Args:
            groups: Group number of each polygon, (p,); None: all are one group.
            materials: Materials by group number; a group without one has none.
            crease: Angle in degrees above which an edge is sharp if the file has no normals; None: no edge is sharp.

        Raises:
            SceneError: A vertex is not finite, or a vertex index is out of range.
        """
        check_indices(f"{self.source.path}", self.vertex, len(self.vertices))
        if self.uv is None and self.vertex_uv is not None:
            self.uv = self.vertex_uv[self.vertex]
        if self.normal is None and self.vertex_normal is not None:
            self.normal = self.vertex_normal[self.vertex]
        triangles, owners = triangles_of(self)
        own = np.zeros(len(owners), np.int64) if groups is None else groups[owners]
        parts = []
        for number in np.unique(own).tolist():
            chosen = own == number
            parts.append(self._part(triangles[chosen], owners[chosen], (materials or {}).get(number), crease))
        return parts

    def _part(
        self, triangles: Indices, owners: Indices, material: MeshMaterial | None, crease: float | None
    ) -> MeshPart:
        """Return some triangles, in the form of `triangles_of`, as a part of a mesh."""
        flat = triangles.ravel()
        index = self.vertex[flat]
        face = None if self.color is None else np.repeat(self.color[owners], 3, 0)
        of_corners = [values[flat] for values in (self.uv, self.normal) if values is not None]
        of_corners += [] if face is None else [face]
        keys: npt.NDArray[Any] = index
        if of_corners:
            rows = np.column_stack([index.astype(np.float64), *of_corners])
            rows = np.ascontiguousarray(np.where(np.isfinite(rows), rows, 0.0) + 0.0)
            keys = rows.view(np.dtype((np.void, rows.dtype.itemsize * rows.shape[1]))).ravel()
        _, first, faces = np.unique(keys, return_index=True, return_inverse=True)
        if of_corners:
            order = np.argsort(first)  # in the order of the file
            first, faces = first[order], np.argsort(order)[faces]
        where = index[first]

        def taken(values: Array | None) -> Array | None:
            return None if values is None else values[flat][first]

        colors = None if self.vertex_color is None else self.vertex_color[where]
        if face is not None:
            colors = face[first] if colors is None else colors * face[first]
        if colors is not None and (colors[:, 3] < 1.0).any():
            material = material or MeshMaterial(surface=LambertMaterial((1.0, 1.0, 1.0)))
            material = dataclasses.replace(material, alpha="blend") if material.alpha == "opaque" else material
        return MeshPart.checked(
            f"{self.source.path}",
            self.vertices[where],
            faces.reshape(-1, 3).astype(np.int64),
            taken(self.normal),
            uvs=(taken(self.uv), None),
            colors=colors,
            material=material,
            crease=crease,
        )


def triangles_of(polygons: Polygons) -> tuple[Indices, Indices]:
    """Cut polygons into triangles; those with fewer than three corners give none.

    Returns:
        Corner indices of the triangles, (m, 3), and the polygon index of each triangle, (m,).
    """
    lengths = polygons.lengths
    starts = np.cumsum(lengths) - lengths
    found: list[Indices] = []
    owners: list[Indices] = []
    for count in np.unique(lengths[lengths >= 3]).tolist():
        which = np.flatnonzero(lengths == count)
        places = starts[which, None] + np.arange(count)
        bent = np.zeros(len(which), bool)
        if count > 3:
            points = polygons.vertices[polygons.vertex[places]]
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
    """Cut a polygon by ear clipping: an ear is a convex corner whose triangle contains no other corner.

    A polygon that intersects itself may have no ear; then the next corner is removed regardless.

    Args:
        points: Corners, (n, 3), approximately in a plane.

    Returns:
        Corner indices of n - 2 triangles with the polygon's winding.
    """
    normal = np.cross(points - points[0], np.roll(points, -1, 0) - points[0]).sum(0)
    axis = int(np.argmax(np.abs(normal)))
    plane = points[:, [(axis + 1) % 3, (axis + 2) % 3]]  # signed areas have the sign of normal[axis]
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


def linear_rgba(values: Array, largest: float) -> Array:
    """Return linear RGBA, (n, 4), of sRGB-encoded colours, (n, 3 or 4); ``largest`` is the code of white.

    Alpha values that are all at most 1 are taken as 0 to 1, whatever ``largest`` is.
    """
    shown = np.clip(np.nan_to_num(values[:, :3] / largest), 0.0, 1.0)
    alpha = values[:, 3:4] if values.shape[1] > 3 else np.ones((len(values), 1))
    alpha = np.clip(np.nan_to_num(alpha / (largest if alpha.max(initial=0.0) > 1.0 else 1.0)), 0.0, 1.0)
    return np.concatenate([decode_srgb(shown), alpha], axis=1)


def _shown_colors(source: MeshSource, values: Array, largest: float) -> Array:
    """Return linear RGBA of sRGB-encoded colours; opaque if alpha is 0 everywhere, as programs without alpha write."""
    colors = linear_rgba(values, largest)
    if len(colors) and not colors[:, 3].any():
        source.note("alpha of colours, which is 0 everywhere")
        colors[:, 3] = 1.0
    return colors


def decode_text(data: bytes) -> str:
    """Return bytes decoded as UTF-8, with or without byte-order mark, or else as Latin-1."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


_NOT_SHOWN: Final = {
    **dict.fromkeys(("curv", "curv2", "surf"), "free-form curves and surfaces"),
    **dict.fromkeys(("l", "p"), "points and lines"),
    "#MRGB": "colours in ZBrush's comments",
}
"""Statements of an OBJ that are not shown, with their description for notes."""


class _Obj:
    """Line-by-line reader of an OBJ."""

    def __init__(self, source: MeshSource) -> None:
        self._source = source
        self._rows: dict[str, list[list[str]]] = {"v": [], "vt": [], "vn": []}
        self._tokens: list[str] = []
        self._faces: list[tuple[int, int, int, int, int]] = []  # corners, material, counts of v, vt, vn
        self._materials: dict[str, int] = {}
        self._libraries: list[str] = []
        self._smooth = False
        self._material = self._number("")
        for line in re.sub(r"\\[ \t]*\r?\n", " ", decode_text(source.data)).splitlines():
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
            # A name may contain #, but not after a blank.
            name = re.sub(r"\s#.*", "", line.strip()[len(key) :]).strip()
            if key == "usemtl":
                self._material = self._number(name)
            elif name:
                self._libraries.append(name)
        elif key == "s":
            self._smooth |= rest.strip() not in ("", "0", "off")
        elif (key or line[:5]) in _NOT_SHOWN:
            self._source.note(_NOT_SHOWN[key or line[:5]])

    def parts(self) -> list[MeshPart]:
        """Return a part for each material."""
        faces = np.array(self._faces, np.int64).reshape(-1, 5)
        indices = self._indices()
        before = np.repeat(faces[:, 2:], faces[:, 0], 0)
        indices = np.where(indices < 0, indices + before, indices - 1)
        vertices, colors = self._vertices()
        polygons = Polygons(self._source, vertices, indices[:, 0], faces[:, 0], vertex_color=colors)
        polygons.uv = self._attribute("vt", indices[:, 1], 2)
        polygons.normal = self._attribute("vn", indices[:, 2], 3)
        library = self._library()
        if self._smooth and polygons.normal is None:
            self._source.note(f"smoothing groups without normals: edges of more than {CREASE:g} degrees are sharp")
        found = {}
        for name, number in self._materials.items():
            values = library.get(name)
            if name and values is None and library:
                self._source.note(f"the material {name[:60]}, which no library has")
            if values is not None and (faces[:, 1] == number).any():
                found[number] = read_library(self._source, values)
        return polygons.parts(faces[:, 1], found)

    def _vertices(self) -> tuple[Array, Array | None]:
        """Return positions and linear colours of vertices, written as x y z [w] or x y z r g b [a]."""
        rows = self._rows["v"]
        if any(len(row) < 3 for row in rows):
            raise SceneError(f"{self._source.path}: a vertex has fewer than 3 numbers")
        vertices = np.array([row[:3] for row in rows], dtype=np.float64).reshape(-1, 3)
        if all(len(row) < 6 for row in rows):
            return vertices, None
        told = (row[3:7] if len(row) == 7 else [*row[3:6], "nan"] if len(row) >= 6 else ["nan"] * 4 for row in rows)
        values = np.array(list(told), np.float64)
        largest = _white(values[:, :3], False)
        return vertices, _shown_colors(self._source, np.where(np.isnan(values), largest, values), largest)

    def _indices(self) -> Indices:
        """Return the indices v, vt, vn of each corner as the file counts them, (n, 3); 0 if missing."""
        rows = [[int(number or 0) for number in token.split("/")] for token in self._tokens]
        if any(not 1 <= len(row) <= 3 or row[0] == 0 for row in rows):
            raise SceneError(
                f"{self._source.path}: a face names no vertex; corners are v, v/vt or v/vt/vn, counted from 1"
            )
        return np.array([[*row, 0, 0][:3] for row in rows], np.int64).reshape(-1, 3)

    def _attribute(self, key: str, index: Indices, size: int) -> Array | None:
        """Return the values of an attribute at all corners, 0 where a corner has none; None if no corner has it."""
        rows = self._rows[key]
        if not rows or not len(index) or (index < 0).all():
            return None
        if index.max() >= len(rows):
            raise SceneError(f"{self._source.path}: a face names {key} {int(index.max()) + 1}; there are {len(rows)}")
        values = np.array([[*row, "0", "0"][:size] for row in rows], np.float64)
        return np.where((index >= 0)[:, None], values[np.maximum(index, 0)], 0.0)

    def _library(self) -> dict[str, dict[str, Any]]:
        """Return the materials of all libraries by name; the first definition of a name counts."""
        found: dict[str, dict[str, Any]] = {}
        for said in dict.fromkeys(self._libraries):
            for name in [said] if self._source.has(said) else said.split():
                if self._source.has(name):
                    found = {**parse_library(decode_text(self._source.get(name, "text_bytes"))), **found}
                else:
                    shown = re.split(r"[/\\]", name)[-1][:60]
                    self._source.note(f"the material library {shown}, which is not there")
        return found


def read_obj(source: MeshSource) -> list[MeshPart]:
    """Read an OBJ with its material libraries: a part for each material.

    Follows:
        colours of vertices, of 1 or 255; several libraries; continued lines; UTF-8, Latin-1.

    Raises:
        SceneError: Damaged.
    """
    return _Obj(source).parts()


def read_off(source: MeshSource) -> list[MeshPart]:
    """Read an OFF.

    Follows:
        text; COFF, NOFF, STOFF; colours of vertices and faces with alpha, of 1, 255 or 65,535.

    Raises:
        ValueError: Damaged; BINARY, 4OFF, nOFF.
    """
    lines = [line.split("#")[0].split() for line in decode_text(source.data).splitlines()]
    lines = [line for line in lines if line]
    kind = re.fullmatch(r"(ST)?(C)?(N)?(4)?(n)?OFF", lines[0][0]) if lines else None
    if kind is not None:
        lines[0] = lines[0][1:]
        lines = lines if lines[0] else lines[1:]
    if not lines or "BINARY" in lines[0] or (kind is not None and (kind[4] or kind[5])):
        raise ValueError("no OFF of text in three dimensions")
    count, total = int(lines[0][0]), int(lines[0][1])
    source.check_count(count, 1)
    source.check_count(total, 1)
    rows, faces = lines[1 : 1 + count], lines[1 + count : 1 + count + total]
    if len(rows) < count or len(faces) < total:
        raise ValueError(f"cut off after {len(lines)} lines")
    wide = min(map(len, rows), default=3)
    values = np.array([row[:wide] for row in rows], np.float64).reshape(-1, wide)
    lengths = np.array([int(face[0]) for face in faces], np.int64)
    if any(len(face) < 1 + length for face, length in zip(faces, lengths.tolist(), strict=True)):
        raise ValueError("a face has fewer corners than it says")
    indices = np.array([int(word) for face in faces for word in face[1 : 1 + int(face[0])]], np.int64)
    polygons = Polygons(source, values[:, :3], indices, lengths)
    at = 3
    if kind is not None and kind[3]:
        polygons.vertex_normal, at = values[:, 3:6], 6
    rest = wide - at - (2 if kind is not None and kind[1] else 0)
    if rest >= 3:
        whole = not any(re.search(r"[.eE]", word) for row in rows for word in row[at : at + 3])
        given = values[:, at : at + min(rest, 4)]
        polygons.vertex_color = _shown_colors(source, given, _white(given[:, :3], whole))
        at += min(rest, 4)
    if kind is not None and kind[1] and wide >= at + 2:
        polygons.vertex_uv = values[:, at : at + 2]
    extra = [face[1 + int(face[0]) :] for face in faces]
    if any(len(words) >= 3 for words in extra):
        whole = not any(re.search(r"[.eE]", word) for words in extra for word in words[:3])
        # A face may have no colour, or a colour without alpha.
        told = np.array([[*words[:4], "nan"][:4] if len(words) >= 3 else ("-1",) * 4 for words in extra], np.float64)
        white = _white(told[:, :3], whole)
        told[:, 3] = np.where(np.isnan(told[:, 3]), white, told[:, 3])
        polygons.color = _shown_colors(source, told, white)
        polygons.color[told[:, 0] < 0.0] = _UNCOLORED
    elif any(extra):
        source.note("colours of faces by their number in a table")
    return polygons.parts()


def read_stl(source: MeshSource) -> list[MeshPart]:
    """Read an STL.

    Follows:
        binary, text in any case; several solids.

    Raises:
        ValueError: Damaged.
    """
    data = source.data.removeprefix(b"\xef\xbb\xbf")
    count = int.from_bytes(data[80:84], "little")
    is_text = data.lstrip()[:5].lower() == b"solid" and b"facet" in data[:_STL_TEXT].lower()
    if is_text and len(data) != 84 + 50 * count:
        loops = re.split(rb"outer\s+loop", data.lower())[1:]
        words = [re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", loop) for loop in loops]
        if loops and b"endloop" not in loops[-1]:
            raise ValueError("cut off in a facet")
        vertices = np.array([list(map(float, row)) for loop in words for row in loop], np.float64).reshape(-1, 3)
        lengths = np.array(list(map(len, words)), np.int64)
    else:
        source.check_count(count, 1)
        if len(data) < 84 + 50 * count:
            raise ValueError(f"cut off: {count} triangles are promised")
        rows = np.frombuffer(data, [("normal", "<3f4"), ("corners", "<9f4"), ("more", "<u2")], count, 84)
        vertices = rows["corners"].reshape(-1, 3).astype(np.float64)
        lengths = np.full(count, 3)
        if (rows["more"] & 0x8000).any() or b"COLOR=" in data[:80]:
            source.note("colours of triangles")
        if len(data) > 84 + 50 * count:
            source.note("bytes behind the last triangle")
    return Polygons(source, vertices, np.arange(len(vertices)), lengths).parts()


def _white(values: Array, whole: bool) -> float:
    """Return the value of white: 65535 above 255, else 255 for whole numbers or values above 1, else 1."""
    largest = float(np.nanmax(values, initial=0.0))
    return 65535.0 if largest > 255.0 else 255.0 if whole or largest > 1.0 else 1.0


_STL_TEXT: Final = 1 << 12
"""Number of bytes within which a text STL has its first facet."""
_PLY_TYPES: Final = {
    **dict.fromkeys(("char", "int8"), "i1"), **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"), **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"), **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"), **dict.fromkeys(("double", "float64"), "f8"),
}  # fmt: skip
_PLY_INDICES: Final = ("vertex_indices", "vertex_index")
_PLY_COLORS: Final = tuple(
    tuple(start + name for name in names[:count])
    for names in (("red", "green", "blue", "alpha"), ("r", "g", "b", "a"))
    for start in ("", "diffuse_", "color_", "ambient_")
    for count in (4, 3)
)
_PLY_UVS: Final = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texcoord_u", "texcoord_v"))
_PLY_UNSEEN: Final = frozenset({"confidence", "intensity", "quality", "flags", "texnumber", "curvature", "radius"})
"""Properties that do not affect the appearance, or are ignored on purpose."""
_Property = tuple[str, str, str | None]
"""Name, type, and for a list the type of its length (else None)."""


class _Ply:
    """Reader of a PLY, element by element; raises ValueError if the file is damaged."""

    def __init__(self, source: MeshSource) -> None:
        head, found, body = source.data.partition(b"end_header")
        if not source.data.startswith(b"ply") or not found:
            raise ValueError("no PLY file, or cut off in its header")
        self._source = source
        self.textures: list[str] = []
        self._elements: list[tuple[str, int, list[_Property]]] = []
        self._order = ""
        for line in decode_text(head).splitlines():
            self._declare(line)
        self._data = body[2:] if body.startswith(b"\r\n") else body[1:]
        self.kinds = {name: {key: kind for key, kind, _ in list_} for name, _, list_ in self._elements}
        if not self._order:  # a text file is read as if all values were doubles
            self._data, self._order = np.array(self._data.split(), np.float64).tobytes(), "="
            self._elements = [
                (name, count, [(key, "f8", length and "f8") for key, _, length in list_])
                for name, count, list_ in self._elements
            ]
        self._at = 0
        self.values: dict[str, dict[str, Any]] = {}
        for name, count, properties in self._elements:
            source.check_count(count, 1)
            self.values[name] = self._element(count, properties)

    def _declare(self, line: str) -> None:
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            self._order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[words[1]]
        elif words[:1] == ["element"]:
            self._elements.append((words[1], int(words[2]), []))
        elif words[:2] == ["property", "list"]:
            self._elements[-1][2].append((words[4].lower(), _PLY_TYPES[words[3]], _PLY_TYPES[words[2]]))
        elif words[:1] == ["property"]:
            self._elements[-1][2].append((words[2].lower(), _PLY_TYPES[words[1]], None))
        elif words[:2] == ["comment", "TextureFile"]:
            self.textures.append(" ".join(words[2:]))

    def _element(self, count: int, properties: list[_Property]) -> dict[str, Any]:
        """Return an element's values by property: arrays, and for lists (values of all rows, length of each row)."""
        start = self._at
        first = self._row(properties) if count else [[] for _ in properties]
        fields: list[tuple[str, str, tuple[int]]] = []
        for column, ((_, kind, length), values) in enumerate(zip(properties, first, strict=True)):
            fields += [] if length is None else [(f"length {column}", self._order + length, (1,))]
            fields.append((f"{column}", self._order + kind, (len(values),)))
        rows = np.dtype(fields)
        fits = start + count * rows.itemsize <= len(self._data)
        table = np.frombuffer(self._data, rows, count if fits else 0, start)
        lists = [column for column, (_, _, length) in enumerate(properties) if length is not None]
        if fits and all((table[f"length {column}"] == len(first[column])).all() for column in lists):
            self._at = start + table.nbytes  # rows with equal list lengths are read as one table
            columns = [
                (table[f"{column}"].astype(np.float64).ravel(), np.full(count, len(values)))
                for column, values in enumerate(first)
            ]
        else:
            self._at = start
            found = [self._row(properties) for _ in range(count)]
            columns = [
                (np.array([v for row in found for v in row[k]], np.float64), np.array([len(row[k]) for row in found]))
                for k in range(len(properties))
            ]
        return {
            key: column if length else column[0] for (key, _, length), column in zip(properties, columns, strict=True)
        }

    def _row(self, properties: list[_Property]) -> list[list[float]]:
        """Return the next row, each property as a list of values."""
        return [
            self._next(kind, 1 if length is None else int(self._next(length, 1)[0])) for _, kind, length in properties
        ]

    def _next(self, kind: str, count: int) -> list[float]:
        size = np.dtype(kind).itemsize
        if count < 0 or self._at + count * size > len(self._data):
            raise ValueError(f"cut off, or a list of {count} entries")
        values = np.frombuffer(self._data, self._order + kind, count, self._at)
        self._at += count * size
        found: list[float] = values.astype(np.float64).tolist()
        return found

    def columns(self, element: str, choices: tuple[tuple[str, ...], ...]) -> tuple[Array | None, float]:
        """Return the first of several sets of columns that an element has, and the largest value of their type."""
        values = self.values.get(element, {})
        for names in choices:
            if all(name in values and not isinstance(values[name], tuple) for name in names):
                taken = np.stack([values[name] for name in names], 1)
                kind = self.kinds[element][names[0]]
                if kind == "i2" and taken.max(initial=0.0) <= 255.0:
                    kind = "u1"  # signed 16-bit values up to 255 are taken as 8-bit codes
                return taken, {"u1": 255.0, "u2": 65535.0, "i2": 32767.0}.get(kind, 1.0)
        return None, 1.0

    def colors(self, element: str) -> Array | None:
        """Return the linear RGBA of an element's rows."""
        values, largest = self.columns(element, _PLY_COLORS)
        if values is None:
            return None
        return _shown_colors(self._source, values, largest if largest > 1.0 else _white(values, False))

    def unseen(self) -> Iterator[tuple[str, str]]:
        """Yield element and name of each property of vertices and faces that is not shown."""
        lists = {*_PLY_INDICES, "texcoord"}
        known = {"x", "y", "z", "nx", "ny", "nz", *sum(_PLY_COLORS, ()), *sum(_PLY_UVS, ()), *lists} | _PLY_UNSEEN
        for element in ("vertex", "face"):
            yield from ((element, key) for key in self.values.get(element, {}) if key not in known)


def read_ply(source: MeshSource) -> list[MeshPart]:
    """Read a PLY of text or binary of either order.

    Follows:
        text, binary; tristrips; colours of vertices and faces with alpha, 8 or 16 bits or floats; texcoord, texnumber;
        names of several programs.

    Raises:
        ValueError: Damaged.
    """
    ply = _Ply(source)
    vertices, _ = ply.columns("vertex", (("x", "y", "z"),))
    faces = ply.values.get("face", {})
    listed = next((faces[key] for key in _PLY_INDICES if isinstance(faces.get(key), tuple)), None)
    strips = ply.values.get("tristrips", {})
    stripped = next((strips[key] for key in _PLY_INDICES if isinstance(strips.get(key), tuple)), None)
    if stripped is not None and (listed is None or not len(listed[1])):
        rows = np.insert(stripped[0].astype(np.int64), np.cumsum(stripped[1]), -1)
        triangles = strip_triangles(rows)
        faces, listed = {}, (triangles.ravel(), np.full(len(triangles), 3))
    elif stripped is not None:
        source.note("strips of triangles beside faces")
    if vertices is None or listed is None:
        return []
    polygons = Polygons(source, vertices, listed[0].astype(np.int64), listed[1])
    polygons.vertex_normal, _ = ply.columns("vertex", (("nx", "ny", "nz"),))
    polygons.vertex_uv, _ = ply.columns("vertex", _PLY_UVS)
    polygons.vertex_color, polygons.color = ply.colors("vertex"), ply.colors("face") if faces else None
    texcoord = faces.get("texcoord")
    if isinstance(texcoord, tuple):
        if (texcoord[1] == 2 * listed[1]).all():
            polygons.uv = texcoord[0].reshape(-1, 2)
        elif texcoord[1].any():
            source.note("texture coordinates of faces that do not fit their corners")
    for element, key in ply.unseen():
        source.note(f"the property {key[:40]} of each {element}")
    for element in ply.values:
        if element not in ("vertex", "face", "tristrips"):
            source.note(f"the element {element[:40]}")
    textures = ply.textures if polygons.uv is not None or polygons.vertex_uv is not None else []
    own = np.zeros(len(listed[1]), np.int64)
    if len(textures) > 1 and isinstance(faces.get("texnumber"), np.ndarray):
        own = np.clip(faces["texnumber"], 0, len(textures) - 1).astype(np.int64)
    materials = {}
    for number in np.unique(own).tolist() if textures else ():
        if source.has(name := textures[number]):
            source.images.append(source.picture(name, color=True))
            use = TextureUse(len(source.images) - 1)
            materials[number] = MeshMaterial(surface=LambertMaterial((1.0, 1.0, 1.0)), base=use)
        else:
            source.note(f"the texture {name[:60]}, which is not there")
    return polygons.parts(own, materials, crease=None)


READERS: Final[dict[str, Callable[[MeshSource], list[MeshPart]]]] = {
    ".obj": read_obj,
    ".off": read_off,
    ".ply": read_ply,
    ".stl": read_stl,
}
"""Readers by suffix."""
