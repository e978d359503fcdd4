"""Meshes and textures from files: glTF by ``scene.gltf``, other formats through trimesh, pictures through OpenCV."""

from __future__ import annotations

import contextlib
import io
import logging
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError
from warp_ar.files import is_file, read_bytes
from warp_ar.pictures import read_picture
from warp_ar.scene.geometry import Mesh, creased_normals, smooth_normals
from warp_ar.scene.gltf import GltfContents, load_gltf
from warp_ar.scene.gltf_animation import animation_names
from warp_ar.scene.mesh_assets import Assets, check_counts, read_gltf
from warp_ar.scene.mesh_materials import MeshMaterial
from warp_ar.scene.mesh_parts import LARGEST, MeshPart, join_parts
from warp_ar.scene.moving_mesh import moving_mesh
from warp_ar.scene.mtl import read_library_material
from warp_ar.scene.node_animation import MovingMesh
from warp_ar.scene.polygon_files import READERS
from warp_ar.scene.texture_codes import encode_texture
from warp_ar.srgb import decode_srgb

ByteArray = npt.NDArray[np.uint8]

MESH_SUFFIXES: Final = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")
"""Mesh files that :func:`load_mesh` reads."""

GLTF_SUFFIXES: Final = (".glb", ".gltf")
"""Those of glTF."""

CREASE: Final = 40.0
"""Degrees: where a file of a drawing format (OBJ, STL, OFF) has no normals, an edge that turns more is sharp."""
_DRAWN: Final = (".obj", ".stl", ".off")
_STL_HEADER: Final = 80
"""Bytes before the triangles of a binary STL."""
_STL_TEXT: Final = 1 << 12
"""Bytes within which a text has its first facet."""

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
    if image.dtype.kind == "f":  # linear values
        return encode_texture(np.clip(np.nan_to_num(image), 0.0, 1.0), encoded=True)
    result: ByteArray = np.asarray(image / 257.0 if image.dtype == np.uint16 else image, dtype=np.uint8)
    return result


def load_mesh(path: str | Path) -> Mesh:
    """Read a mesh file: PLY, OBJ with its MTL, glTF or GLB, STL, OFF.

    All parts of a file are joined, placed as its scene graph says; every triangle keeps its material. Vertex normals
    are the file's. Where it has none they are flat (glTF says so), smooth but for edges that turn more than ``CREASE``
    (OBJ, STL, OFF), or :func:`smooth_normals` (PLY, the format of scans).

    Args:
        path: The file; its suffix tells the format.

    Returns:
        The mesh in the file's own units; of glTF turned from +Y up to +Z up, of others in the file's own axes.

    Raises:
        SceneError: The file or a texture that it names is missing, damaged or of another format, or the mesh holds no
            triangle, a vertex that is not finite, or a face with an index out of range. An OBJ without its MTL file is
            a mesh without materials.
    """
    return _load(Path(path))[0]


def files_beside(path: Path) -> dict[str, bytes]:
    """The files that a mesh file names (materials, buffers, textures), by the names that it has for them.

    Raises:
        SceneError: As :func:`load_mesh`.
    """
    return _load(path)[1].known


def load_moving_mesh(path: Path, animation: str | int) -> MovingMesh:
    """Read a glTF file and one of its animations.

    Args:
        path: The file.
        animation: Name of the animation, or its number from 0 on.

    Raises:
        SceneError: As :func:`load_mesh`; or there is no such animation, or it is damaged.
    """
    contents = _read_file(path, animation)[0]
    with _said_in_words(path):
        return moving_mesh(f"{path}", contents)


def animations_of(path: Path) -> list[str]:
    """Names of a glTF file's animations, by number; empty where one has none.

    Raises:
        SceneError: As :func:`load_mesh`.
    """
    data = read_bytes(path, "mesh_bytes", SceneError)
    with _said_in_words(path):
        return animation_names(path, read_gltf(path, data, Assets(path))[0])


def _load(path: Path) -> tuple[Mesh, Assets]:
    """A mesh, and what it was read from."""
    contents, assets = _read_file(path)
    with _said_in_words(path):
        return join_parts(f"{path}", contents.parts, contents.images, contents.notes), assets


@contextlib.contextmanager
def _said_in_words(path: Path) -> Iterator[None]:
    """Turn what readers raise on damaged files into a SceneError."""
    try:
        yield
    except SceneError:
        raise
    except _LOADER_ERRORS as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise SceneError(f"{path}: the mesh cannot be read; is the file whole? ({reason})") from error


def _read_file(path: Path, animation: str | int | None = None) -> tuple[GltfContents, Assets]:
    """Parts of a file, one or more, and what they were read from."""
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise SceneError(f"{path}: unknown mesh format {path.suffix!r}; use one of {', '.join(MESH_SUFFIXES)}")
    if not is_file(path):
        raise SceneError(f"{path}: no such mesh file")
    data = read_bytes(path, "mesh_bytes", SceneError)
    suffix = path.suffix.lower()
    assets = Assets(path)
    check_counts(path, data)
    with _said_in_words(path):
        if suffix in GLTF_SUFFIXES:
            contents = load_gltf(path, data, assets, animation=animation)
        else:
            images: list[ByteArray] = []
            notes: list[str] = []
            contents = GltfContents(_read_parts(path, data, assets, images, notes), images, notes)
        if not contents.parts:
            raise SceneError(f"{path}: holds no triangle; a mesh with faces is needed (a point cloud has none)")
        return contents, assets


def _read_parts(path: Path, data: bytes, assets: Assets, images: list[ByteArray], notes: list[str]) -> list[MeshPart]:
    """Return the parts of a file without a scene graph."""
    suffix = path.suffix.lower()
    crease = CREASE if suffix in _DRAWN else None
    with np.errstate(all="ignore"):  # what is not finite is named when it is looked through
        if suffix in READERS:
            return READERS[suffix](path, data, assets, images, notes, crease)
        import trimesh  # here, since it takes half a second and most scenes need no file

        if data[:_STL_HEADER].lower().lstrip().startswith(b"solid") and b"facet" in data[:_STL_TEXT].lower():
            data = data.lower()  # trimesh knows the words in lower case alone
        scene = trimesh.load_scene(io.BytesIO(data), file_type=suffix[1:], process=False)
        return _scene_parts(f"{path}", scene, images, notes, crease)


def mesh_from_trimesh(source: Any) -> Mesh:
    """The mesh of a ``trimesh.Trimesh`` or ``trimesh.Scene`` in memory, with its colours or materials.

    Args:
        source: The object; its axes and units stay as they are.

    Raises:
        SceneError: It holds no triangle, a vertex that is not finite, or a face with an index out of range.
    """
    import trimesh

    if not isinstance(source, trimesh.Trimesh | trimesh.Scene):
        raise SceneError(f"a mesh is {type(source).__name__}; a trimesh.Trimesh or trimesh.Scene is needed")
    label = "a mesh in memory"
    scene = source if isinstance(source, trimesh.Scene) else trimesh.Scene(source)
    images: list[ByteArray] = []
    notes: list[str] = []
    try:
        parts = _scene_parts(label, scene, images, notes, CREASE)
    except SceneError:
        raise
    except _LOADER_ERRORS as error:
        raise SceneError(f"{label} cannot be taken ({type(error).__name__}: {' '.join(str(error).split())})") from error
    if not parts:
        raise SceneError(f"{label} holds no triangle")
    return join_parts(label, parts, images, notes)


def _scene_parts(
    label: str, scene: Any, images: list[ByteArray], notes: list[str], crease: float | None
) -> list[MeshPart]:
    """Parts of a scene of trimesh, in its world."""
    known: dict[int, MeshMaterial | None] = {}
    parts = []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        geometry = scene.geometry[name]
        if not (np.abs(transform) < LARGEST).all():
            raise SceneError(f"{label}: node {node!r} has a transform that is not finite")
        if np.asarray(getattr(geometry, "faces", ()), dtype=np.int64).size == 0:
            continue
        source = getattr(geometry.visual, "material", None)
        if id(source) not in known:
            known[id(source)] = read_library_material(label, source, images, notes)
        moved = _read_part(label, geometry, known[id(source)], crease).moved(np.asarray(transform, dtype=np.float64))
        if moved is not None:
            parts.append(moved)
    return parts


def _read_part(label: str, geometry: Any, material: MeshMaterial | None, crease: float | None) -> MeshPart:
    """Triangles of a mesh of trimesh, with its normals, texture coordinates and colours."""
    faces = np.asarray(geometry.faces, dtype=np.int64)
    vertices = np.asarray(geometry.vertices, dtype=np.float64)
    # trimesh computes normals when asked; only its cache tells whether the file had them.
    given = "vertex_normals" in geometry._cache
    normals = np.asarray(geometry.vertex_normals, dtype=np.float64) if given else None
    visual = geometry.visual
    uvs = getattr(visual, "uv", None)
    if uvs is not None:
        uvs = np.asarray(uvs, dtype=np.float64)[:, :2]
    colors = None
    kind = getattr(visual, "kind", None) if getattr(visual, "defined", False) else None
    if kind in ("vertex", "face"):
        values = linear_color(np.asarray(visual.vertex_colors if kind == "vertex" else visual.face_colors))
        if kind == "face" and len(values) == len(faces) and faces.max(initial=-1) < len(vertices):
            # A colour for each triangle: its corners are its own.
            corners = faces.ravel()
            normals = _corner_normals(vertices, faces, crease) if normals is None else normals[corners]
            vertices, values = vertices[corners], np.repeat(values, 3, axis=0)
            uvs = None if uvs is None or len(uvs) <= corners.max(initial=-1) else uvs[corners]
            faces = np.arange(len(corners), dtype=np.int64).reshape(-1, 3)
        colors = values if len(values) == len(vertices) else None
    return MeshPart.checked(
        label, vertices, faces, normals, uvs=(uvs, None), colors=colors, material=material, crease=crease
    )


def _corner_normals(vertices: npt.NDArray[Any], faces: npt.NDArray[np.int64], crease: float | None) -> Any:
    """Normals of every corner of a mesh whose triangles are about to get corners of their own."""
    if crease is not None:
        return creased_normals(vertices, faces, crease)[1]
    return smooth_normals(vertices, faces)[faces.ravel()]


def linear_color(colors: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Linear RGBA of (n, 3 or 4) colours of 8 bits, sRGB-encoded as programs write them; PLY's alpha is not used."""
    return np.concatenate([decode_srgb(colors[:, :3] / 255.0), np.ones((len(colors), 1))], axis=1)
