"""Meshes and textures from files, through trimesh and OpenCV."""

from __future__ import annotations

import dataclasses
import io
import logging
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError
from warp_ar.files import is_file, read_bytes
from warp_ar.pictures import read_picture
from warp_ar.scene.geometry import Mesh, make_mesh, smooth_normals
from warp_ar.scene.mesh_assets import Assets, check_counts, check_gltf

FloatArray = npt.NDArray[np.float32]
ByteArray = npt.NDArray[np.uint8]

MESH_SUFFIXES: Final = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")
"""Mesh files that :func:`load_mesh` reads."""

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


def load_texture(path: str | Path) -> ByteArray:
    """Read a picture as a base colour texture.

    Args:
        path: PNG, JPEG, BMP, TIFF, WebP, GIF or PNM; deeper than 8 bits is reduced, alpha dropped, grey becomes RGB.

    Returns:
        (h, w, 3) RGB, sRGB-encoded, row 0 at the top.

    Raises:
        SceneError: The file is missing, no picture, or too large.
    """
    image = read_picture(path, cv2.IMREAD_COLOR_RGB, SceneError, f"{path}: the texture")
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
    if not is_file(path):
        raise SceneError(f"{path}: no such mesh file")
    data = read_bytes(path, "mesh_bytes", SceneError)
    assets = Assets(path, library_first=path.suffix.lower() == ".obj")
    check_counts(path, data)
    if path.suffix.lower() in (".glb", ".gltf"):
        check_gltf(path, data, assets)
    import trimesh  # here, since it takes half a second and most scenes need no file

    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type=path.suffix[1:].lower(), resolver=assets, process=False)
        parts = [part for node in scene.graph.nodes_geometry if (part := _read_part(path, scene, node)) is not None]
    except SceneError:
        raise
    except _LOADER_ERRORS as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise SceneError(f"{path}: the mesh cannot be read; is the file whole? ({reason})") from error
    # What else than a colour a glTF file may name, such as normals, is not read.
    if path.suffix.lower() == ".obj" and assets.problem is not None:
        raise assets.problem
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
    return make_mesh(
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
