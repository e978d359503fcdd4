"""Triangle meshes: files read through trimesh, primitives with exact normals, and rotations.

A mesh is in its own coordinates as the file has them, in metres; no axis is flipped. glTF is y-up, the world of a scene
is z-up: a glTF model is stood upright with ``rotate = [90, 0, 0]``.

References:
    [TW98] Thuermer and Wuethrich, "Computing Vertex Normals from Polygonal Facets", J. of Graphics Tools 3(1), 1998.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError

FloatArray = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int32]
ByteArray = npt.NDArray[np.uint8]

MESH_SUFFIXES: Final = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")
"""Mesh files that :func:`load_mesh` reads."""

# A triangle whose doubled area is below this share of its longest edge squared has no direction worth the name: float32
# vertices on one line come out at 1e-16 in float64, and the thinnest sliver that float32 can hold on purpose at 1e-7.
_ZERO_AREA: Final = 1e-12

# The square of a position, and what a scene's scale may do to it, stay in single precision.
_LARGEST: Final = 1e12

# What trimesh and Pillow have been seen to raise on damaged files; its readers do not document it.
_LOADER_ERRORS: Final = (
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    AssertionError,
    ArithmeticError,
    OSError,
    NotImplementedError,
    NameError,
    SyntaxError,
    EOFError,
    BufferError,
    ImportError,  # an encoding or compression that needs a package which is not there
    RecursionError,
    MemoryError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
)

# trimesh reports damaged files to its logger as well, traceback included; the exception says all that a user can use.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


@dataclasses.dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with unit vertex normals and, where the file has them, texture coordinates and a texture."""

    vertices: FloatArray
    """Positions in metres, (n, 3)."""
    faces: IntArray
    """Vertex indices, (m, 3), counter-clockwise seen from outside."""
    normals: FloatArray
    """Unit vertex normals, (n, 3)."""
    uvs: FloatArray | None = None
    """Texture coordinates, (n, 2): u to the right, v up the picture, (0, 0) at its bottom left corner; they repeat."""
    texture: ByteArray | None = None
    """Base colour, (h, w, 3) RGB, sRGB-encoded, row 0 at the top (v = 1)."""

    @property
    def bounds(self) -> FloatArray:
        """Lowest and highest corner of the axis-aligned box around the vertices in metres, (2, 3)."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])


def rotation_matrix(rotate: Sequence[float]) -> npt.NDArray[np.float64]:
    """Rotation about the fixed x, then the fixed y, then the fixed z axis: R = Rz Ry Rx.

    Args:
        rotate: Angles about x, y and z in degrees.

    Returns:
        The matrix R, (3, 3); a point p turns to R p.
    """
    (cx, sx), (cy, sy), (cz, sz) = ((math.cos(a), math.sin(a)) for a in map(math.radians, rotate))
    return np.array(
        [
            [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
            [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
            [-sy, cy * sx, cy * cx],
        ]
    )


def silhouette_tolerance(extent: float, *, distance: float = 0.4, focal: float = 1000.0, pixels: float = 0.1) -> float:
    """Largest gap between a curved surface and its triangles that a camera cannot see.

    A gap g at distance d moves a silhouette by focal g / d pixels. Things on a desk are seen from 0.4 m or more, and
    objects larger than that from at least their own extent, else they do not fit into the picture.

    Args:
        extent: Radius of the object in metres.
        distance: Nearest distance of the camera in metres.
        focal: Focal length in pixels.
        pixels: Silhouette error that is allowed, in pixels.

    Returns:
        The gap in metres.
    """
    return pixels / focal * max(distance, extent)


def _segments(radius: float, gap: float) -> int:
    """Segments of a circle whose chords stay within ``gap`` of it.

    The chord of a segment of angle 2 pi / n is farthest from its arc at its middle, by the sagitta r (1 - cos(pi / n));
    solved for n: n = pi / acos(1 - gap / r). From 24 on, so that the shading of tiny objects stays smooth.
    """
    return max(24, math.ceil(math.pi / math.acos(1.0 - gap / radius))) if gap < radius else 24


def torus_mesh(major_radius: float, minor_radius: float, tolerance: float | None = None) -> Mesh:
    """Torus around the z axis, centred at the origin.

    Args:
        major_radius: Distance of the tube's centre from the axis in metres.
        minor_radius: Radius of the tube in metres.
        tolerance: Largest gap between triangles and surface in metres; :func:`silhouette_tolerance` of the whole torus
            if left out. Divide by the scale at which the mesh is used.

    Returns:
        The mesh; u runs around the axis from +x through +y, v around the tube from its outermost circle through +z.
    """
    outer = major_radius + minor_radius
    gap = 0.5 * (silhouette_tolerance(outer) if tolerance is None else tolerance)  # half for either circle: gaps add up
    columns, rows = _segments(outer, gap), _segments(minor_radius, gap)
    u, v, faces = _grid(columns, rows)
    # The seam's two copies take one angle, so that they agree to the last bit and no ray slips through.
    phi, psi = (2 * np.pi) * (u % 1.0), (2 * np.pi) * (v % 1.0)
    normals = np.stack([np.cos(phi) * np.cos(psi), np.sin(phi) * np.cos(psi), np.sin(psi)], axis=-1)
    centers = major_radius * np.stack([np.cos(phi), np.sin(phi), np.zeros_like(phi)], axis=-1)
    return _mesh(centers + minor_radius * normals, faces, normals, np.stack([u, v], axis=-1))


def sphere_mesh(radius: float, tolerance: float | None = None) -> Mesh:
    """Sphere centred at the origin.

    Args:
        radius: Radius in metres.
        tolerance: Largest gap between triangles and surface in metres; :func:`silhouette_tolerance` if left out.

    Returns:
        The mesh; u runs around the z axis from -x through -y, +x and +y as in a latlong map, v from -z to +z.
    """
    gap = 0.5 * (silhouette_tolerance(radius) if tolerance is None else tolerance)
    columns = _segments(radius, gap)
    rows = (columns + 1) // 2
    u, v, faces = _grid(columns, rows)
    # The first and last row are the poles: of the two triangles per cell there, the one with two corners on it goes.
    cell = np.arange(len(faces)) // 2
    first = np.arange(len(faces)) % 2 == 0
    faces = faces[~((cell < columns) & first) & ~((cell >= (rows - 1) * columns) & ~first)]
    phi, theta = (2 * np.pi) * ((u % 1.0) - 0.5), np.pi * (1.0 - v)
    sin_theta = np.where((v == 0.0) | (v == 1.0), 0.0, np.sin(theta))
    normals = np.stack([sin_theta * np.cos(phi), sin_theta * np.sin(phi), np.cos(theta)], axis=-1)
    return _mesh(radius * normals, faces, normals, np.stack([u, v], axis=-1))


def box_mesh(size: Sequence[float]) -> Mesh:
    """Axis-aligned box centred at the origin, with flat faces.

    Args:
        size: Lengths along x, y and z in metres.

    Returns:
        The mesh: 24 vertices, 12 triangles, every face with texture coordinates from 0 to 1.
    """
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    vertices, normals = np.empty((6, 4, 3)), np.zeros((6, 4, 3))
    for axis in range(3):
        right, up = (axis + 1) % 3, (axis + 2) % 3
        for side, sign in enumerate((-1.0, 1.0)):
            face = vertices[2 * axis + side]
            face[:, axis], face[:, right], face[:, up] = sign, sign * corners[:, 0], corners[:, 1]
            normals[2 * axis + side, :, axis] = sign
    faces = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(6)[:, None, None]
    half = 0.5 * np.asarray(size, dtype=np.float64)
    return _mesh(
        (half * vertices).reshape(-1, 3),
        faces.reshape(-1, 3),
        normals.reshape(-1, 3),
        np.tile(0.5 + 0.5 * corners, (6, 1)),
    )


def _grid(columns: int, rows: int) -> tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]]:
    """Parameters u and v of a grid's (rows + 1) x (columns + 1) vertices, and two triangles per cell."""
    v, u = np.meshgrid(np.arange(rows + 1) / rows, np.arange(columns + 1) / columns, indexing="ij")
    a = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    b, c, d = a + 1, a + columns + 2, a + columns + 1
    return u.ravel(), v.ravel(), np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)


def _mesh(vertices: Any, faces: Any, normals: Any, uvs: Any = None, texture: ByteArray | None = None) -> Mesh:
    """A mesh of single-precision arrays that lie tightly in memory."""
    return Mesh(
        np.ascontiguousarray(vertices, dtype=np.float32),
        np.ascontiguousarray(faces, dtype=np.int32),
        np.ascontiguousarray(normals, dtype=np.float32),
        None if uvs is None else np.ascontiguousarray(uvs, dtype=np.float32),
        texture,
    )


def smooth_normals(vertices: npt.ArrayLike, faces: npt.ArrayLike) -> FloatArray:
    """Vertex normals as the mean of the adjacent faces' normals, weighted by the corners' angles [TW98].

    Angles, unlike areas, do not depend on how a face is cut into triangles. Vertices at one position share one normal,
    so that no seam of the texture shows in the shading. Triangles without area have no say. Where the faces around a
    vertex cancel (a sheet with two sides), it takes the normal of one of them; a vertex of no face gets +z.

    Args:
        vertices: Positions, (n, 3).
        faces: Vertex indices, (m, 3).

    Returns:
        Unit normals, (n, 3).
    """
    points = np.asarray(vertices, dtype=np.float64)
    corners = np.asarray(faces, dtype=np.int64)
    order = np.lexsort(points.T)
    fresh = np.any(np.diff(points[order], axis=0, prepend=np.nan) != 0.0, axis=1)
    place = np.empty(len(points), dtype=np.int64)
    place[order] = np.cumsum(fresh) - 1
    count = int(fresh.sum())

    a, b, c = (points[corners[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1)
    longest = np.max([np.sum((q - p) ** 2, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    solid = area > _ZERO_AREA * longest
    a, b, c, area, corners = a[solid], b[solid], c[solid], area[solid], corners[solid]
    face_normals = cross[solid] / area[:, None]

    total, fallback = np.zeros((count, 3)), np.tile([0.0, 0.0, 1.0], (count, 1))
    for k, (p, q, r) in enumerate(((a, b, c), (b, c, a), (c, a, b))):
        angle = np.arctan2(area, np.sum((q - p) * (r - p), axis=1))
        where = place[corners[:, k]]
        fallback[where] = face_normals
        for axis in range(3):
            total[:, axis] += np.bincount(where, weights=angle * face_normals[:, axis], minlength=count)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    normals = np.where(length > 1e-6, total / np.maximum(length, 1e-6), fallback)  # an angle's sum of 1e-6 is rounding
    result: FloatArray = normals[place].astype(np.float32)
    return result


def load_texture(path: str | Path) -> ByteArray:
    """Read a picture as a base colour texture.

    Args:
        path: Any 8-bit picture that OpenCV reads; deeper ones are reduced, alpha is dropped, grey becomes RGB.

    Returns:
        (h, w, 3) RGB, sRGB-encoded, row 0 at the top.

    Raises:
        SceneError: The file is missing or no picture.
    """
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise SceneError(f"{path}: cannot read the texture: {error.strerror}") from error
    image = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB) if data.size else None
    if image is None:
        raise SceneError(f"{path}: not a picture that can be read; use PNG or JPEG")
    result: ByteArray = np.asarray(image, dtype=np.uint8)
    return result


def load_mesh(path: str | Path) -> Mesh:
    """Read a mesh file: PLY, OBJ (with its MTL's texture), glTF or GLB, STL, OFF.

    All parts of a file are joined, placed as its scene graph says. Vertex normals are the file's, or
    :func:`smooth_normals` where it has none. Several textures are stacked into one; only pictures count, a material's
    plain colour is the scene's to say.

    Args:
        path: The file; its suffix tells the format.

    Returns:
        The mesh, in the file's own axes and units.

    Raises:
        SceneError: The file or a texture that it names is missing, damaged or of another format, or the mesh holds no
            triangle, a vertex that is not finite, or a face with an index out of range. An OBJ without its MTL file is
            a mesh without texture.
    """
    path = Path(path)
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise SceneError(f"{path}: unknown mesh format {path.suffix!r}; use one of {', '.join(MESH_SUFFIXES)}")
    if not path.is_file():
        raise SceneError(f"{path}: no such mesh file")
    import trimesh  # here, since it takes half a second and most scenes need no file

    try:
        scene = trimesh.load_scene(str(path), process=False)
        parts = [part for node in scene.graph.nodes_geometry if (part := _read_part(path, scene, node)) is not None]
    except SceneError:
        raise
    except _LOADER_ERRORS as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise SceneError(f"{path}: the mesh cannot be read; is the file whole? ({reason})") from error
    if path.suffix.lower() == ".obj" and any(part.image is None for part in parts):
        _check_obj_texture(path)
    if not parts:
        raise SceneError(f"{path}: holds no triangle; a mesh with faces is needed (a point cloud has none)")
    return _join(path, parts)


@dataclasses.dataclass
class _Part:
    """One geometry of a file, already in the file's world."""

    vertices: npt.NDArray[np.float64]
    faces: npt.NDArray[np.int64]
    normals: FloatArray
    uvs: npt.NDArray[np.float64] | None
    image: Any  # a Pillow picture; parts that share a material share the object


def _read_part(path: Path, scene: Any, node: str) -> _Part | None:
    """Geometry at a node of a scene graph; None where it has no triangles or is scaled to nothing."""
    transform, name = scene.graph[node]
    geometry = scene.geometry[name]
    faces = np.asarray(getattr(geometry, "faces", ()), dtype=np.int64)
    linear = np.asarray(transform, dtype=np.float64)[:3, :3]
    if not (np.abs(transform) < _LARGEST).all():
        raise SceneError(f"{path}: node {node!r} has a transform that is not finite")
    determinant = np.linalg.det(linear)
    if faces.size == 0 or determinant == 0.0:
        return None
    vertices = np.asarray(geometry.vertices, dtype=np.float64)
    if faces.min() < 0 or faces.max() >= len(vertices):
        wrong = int(faces.max() if faces.max() >= len(vertices) else faces.min())
        raise SceneError(f"{path}: a face has vertex index {wrong}; there are {len(vertices)} vertices, counted from 0")
    finite = (np.abs(vertices) < _LARGEST).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        raise SceneError(
            f"{path}: vertex {row} is {vertices[row].tolist()}; positions must be finite, below {_LARGEST:g}"
        )
    vertices = vertices @ linear.T + np.asarray(transform, dtype=np.float64)[:3, 3]
    if determinant < 0.0:
        faces = faces[:, ::-1]
    computed = smooth_normals(vertices, faces)
    normals = computed
    # trimesh computes normals when asked; only its cache tells whether the file had them.
    if "vertex_normals" in geometry._cache:
        given = np.asarray(geometry.vertex_normals, dtype=np.float64) @ np.linalg.inv(linear)
        length = np.linalg.norm(given, axis=1, keepdims=True)
        usable = np.isfinite(length) & (length > 0.0)
        normals = np.where(usable, given / np.where(usable, length, 1.0), computed).astype(np.float32)
    uvs = getattr(geometry.visual, "uv", None)
    if uvs is not None:
        uvs = np.asarray(uvs, dtype=np.float64)[:, :2]
        uvs = uvs if len(uvs) == len(vertices) and np.isfinite(uvs).all() else None
    material = getattr(geometry.visual, "material", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    # Where a file has coordinates but no texture, trimesh makes a grey one up; only pictures from files have a format.
    if uvs is None or getattr(image, "format", None) is None:
        image = None
    return _Part(vertices, faces, normals, uvs, image)


def _check_obj_texture(path: Path) -> None:
    """Say which texture of an OBJ file is missing: trimesh leaves it out without a word."""
    with path.open(encoding="utf-8", errors="replace") as lines:
        library = next((line.split(maxsplit=1)[1].strip() for line in lines if re.match(r"mtllib\s+\S", line)), None)
    if library is None or not (path.parent / library).is_file():
        return
    text = (path.parent / library).read_text(encoding="utf-8", errors="replace")
    for name in re.findall(r"(?im)^[ \t]*map_Kd[ \t]+(\S.*?)[ \t]*$", text):
        load_texture(path.parent / name)


def _join(path: Path, parts: list[_Part]) -> Mesh:
    """One mesh of all parts, their textures stacked where there are several."""
    images = list({id(part.image): part.image for part in parts if part.image is not None}.values())
    textured = bool(images)
    plain = any(part.image is None for part in parts)
    texture = None
    if textured:
        try:
            tiles = [np.asarray(image.convert("RGB"), dtype=np.uint8) for image in images]
        except _LOADER_ERRORS as error:
            raise SceneError(f"{path}: a texture of the mesh cannot be read ({error})") from error
        if plain:
            tiles.append(np.full((1, 1, 3), 255, dtype=np.uint8))
        if len(tiles) > 1:
            _stack_uvs(path, parts, images, tiles)
        texture = _stack(tiles)
    keep_uvs = textured or all(part.uvs is not None for part in parts)
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return _mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.uvs for part in parts if part.uvs is not None]) if keep_uvs else None,
        texture,
    )


def _stack(tiles: list[ByteArray]) -> ByteArray:
    """Pictures one above the other, left-aligned."""
    width = max(tile.shape[1] for tile in tiles)
    return np.concatenate([np.pad(tile, ((0, 0), (0, width - tile.shape[1]), (0, 0))) for tile in tiles])


def _stack_uvs(path: Path, parts: list[_Part], images: list[Any], tiles: list[ByteArray]) -> None:
    """Move the parts' texture coordinates to where :func:`_stack` puts their pictures; parts without get the last."""
    width, height = max(tile.shape[1] for tile in tiles), sum(tile.shape[0] for tile in tiles)
    tops = np.cumsum([0, *(tile.shape[0] for tile in tiles)])
    for part in parts:
        index = len(tiles) - 1 if part.image is None else next(i for i, im in enumerate(images) if im is part.image)
        h, w = tiles[index].shape[:2]
        uvs = np.full((len(part.vertices), 2), 0.5) if part.image is None or part.uvs is None else part.uvs
        if uvs.min() < -1e-3 or uvs.max() > 1.0 + 1e-3:
            raise SceneError(
                f"{path}: several textures, one of which repeats; bake them into one or use one object for each"
            )
        # Texel centres of the tile's border are the limits, so that bilinear reads bring in nothing of a neighbour.
        column = np.clip(uvs[:, 0] * w, 0.5, w - 0.5)
        row = np.clip((1.0 - uvs[:, 1]) * h, 0.5, h - 0.5) + tops[index]
        part.uvs = np.stack([column / width, 1.0 - row / height], axis=-1)
