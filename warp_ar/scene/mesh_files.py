"""Meshes from files and from trimesh, static or moved by an animation of the file."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError
from warp_ar.files import is_file, read_bytes
from warp_ar.scene.geometry import Mesh
from warp_ar.scene.gltf import Bending, GltfContents, animation_names, load_gltf
from warp_ar.scene.gltf_file import GltfFile
from warp_ar.scene.materials import MeshMaterial
from warp_ar.scene.mesh_parts import LARGEST, MeshPart, filled, join_parts
from warp_ar.scene.mesh_source import MeshSource
from warp_ar.scene.node_animation import MovingMesh, MovingPart, part_transforms
from warp_ar.scene.polygon_files import READERS

MESH_SUFFIXES: Final = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")
"""Suffixes of mesh files that :func:`load_mesh` reads."""

GLTF_SUFFIXES: Final = (".glb", ".gltf")
"""Suffixes of glTF files."""

_DAMAGES: Final = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError, MemoryError)
"""Errors that readers raise on damaged files, in addition to their own."""
MOST_PARTS: Final = 256
"""Largest number of animated parts; each is a shape of its own, and every ray tests all of them."""


def load_mesh(path: str | Path) -> Mesh:
    """Read a mesh file: PLY, OBJ with its MTL, glTF or GLB, STL, OFF.

    All parts of a file are joined, placed by its scene graph; every triangle keeps its material. Vertex normals are
    those of the file. Without normals they are flat (as glTF requires), smooth except at edges that turn more than
    ``CREASE`` (OBJ, STL, OFF), or :func:`smooth_normals` (PLY, the format of scans).

    Args:
        path: The file; its suffix determines the format.

    Returns:
        The mesh in the file's units. glTF is rotated from +Y up to +Z up; other formats keep the file's axes.

    Raises:
        SceneError: The file or a texture that it names is missing, damaged or of another format, or the mesh holds no
            triangle, a vertex that is not finite, or a face with an index out of range. An OBJ without its MTL file is
            a mesh without materials.
    """
    return _load(Path(path))[0]


def referenced_files(path: Path) -> dict[str, bytes]:
    """Return the contents of the files that a mesh file refers to (materials, buffers, textures), by their names in it.

    Raises:
        SceneError: A file is missing, damaged or of another format.
    """
    return _load(path)[1].known


def load_moving_mesh(path: Path, animation: str | int) -> MovingMesh:
    """Read a glTF file and one of its animations.

    Args:
        path: The file.
        animation: Name of the animation, or its number from 0 on.

    Raises:
        SceneError: The file is missing or damaged, or it has no such animation.
    """
    contents, source = _read_file(path, animation)
    with _said_in_words(path):
        return moving_mesh(source, contents)


def animations_of(path: Path) -> list[str]:
    """Return the names of a glTF file's animations in file order; an unnamed animation has an empty name.

    Raises:
        SceneError: The file is missing or damaged.
    """
    data = read_bytes(path, "mesh_bytes", SceneError)
    with _said_in_words(path):
        return animation_names(GltfFile(MeshSource(path, data)))


def _load(path: Path) -> tuple[Mesh, MeshSource]:
    """Return the mesh of a file and its source."""
    contents, source = _read_file(path)
    with _said_in_words(path):
        return join_parts(source, contents.parts), source


@contextlib.contextmanager
def _said_in_words(path: Path) -> Iterator[None]:
    """Convert errors that readers raise on damaged files into a SceneError."""
    try:
        yield
    except SceneError:
        raise
    except _DAMAGES as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise SceneError(f"{path}: the mesh cannot be read; is the file whole? ({reason})") from error


def _read_file(path: Path, animation: str | int | None = None) -> tuple[GltfContents, MeshSource]:
    """Return the contents of a file, with at least one part, and its source."""
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise SceneError(f"{path}: unknown mesh format {path.suffix!r}; use one of {', '.join(MESH_SUFFIXES)}")
    if not is_file(path):
        raise SceneError(f"{path}: no such mesh file")
    source = MeshSource(path, read_bytes(path, "mesh_bytes", SceneError))
    # Values that are not finite are reported by the check of each part.
    with _said_in_words(path), np.errstate(all="ignore"):
        if suffix in GLTF_SUFFIXES:
            contents = load_gltf(source, animation=animation)
        else:
            contents = GltfContents([(-1, part, None) for part in READERS[suffix](source)])
        if not contents.parts:
            raise SceneError(f"{path}: holds no triangle; a mesh with faces is needed (a point cloud has none)")
        return contents, source


def mesh_from_trimesh(source: Any) -> Mesh:
    """Return the mesh of a ``trimesh.Trimesh`` or ``trimesh.Scene`` in memory, by way of trimesh's GLB export.

    Args:
        source: The object; its axes and units stay as they are.

    Raises:
        SceneError: It holds no triangle, a vertex that is not finite, or a face with an index out of range.
    """
    import trimesh

    if not isinstance(source, trimesh.Trimesh | trimesh.Scene):
        raise SceneError(f"a mesh is {type(source).__name__}; a trimesh.Trimesh or trimesh.Scene is needed")
    scene = source if isinstance(source, trimesh.Scene) else trimesh.Scene(source)
    path = Path("a mesh in memory")
    made = trimesh.Scene()
    with _said_in_words(path):
        for node in scene.graph.nodes_geometry:
            transform, name = scene.graph[node]
            if not len(getattr(scene.geometry[name], "faces", ())):
                continue
            mesh = scene.geometry[name].copy(include_cache=True)
            if mesh.visual.kind == "face":
                mesh.unmerge_vertices()  # GLB stores colours at vertices only
            if isinstance(getattr(mesh.visual, "material", None), trimesh.visual.material.SimpleMaterial):
                mesh.visual.material = mesh.visual.material.to_pbr()
                mesh.visual.material.metallicFactor = 0.0
            made.add_geometry(mesh, transform=transform)
        if not made.geometry:
            raise SceneError(f"{path} holds no triangle")
        taken = MeshSource(path, made.export(file_type="glb"))
        return join_parts(taken, load_gltf(taken, memory=True).parts)


def moving_mesh(source: MeshSource, contents: GltfContents) -> MovingMesh:
    """Return one mesh of all static triangles, and one mesh for every animated node that has triangles.

    Args:
        source: The file.
        contents: Contents of the file, read with an animation.

    Raises:
        SceneError: More than ``MOST_PARTS`` nodes move, or a vertex is too far from the origin.
    """

    def moves_as(one: tuple[int, MeshPart, Bending | None]) -> tuple[int, bool]:
        return one[0], one[2] is not None

    placed = sorted(contents.placed, key=moves_as)
    groups = [list(group) for _, group in itertools.groupby(placed, moves_as)]
    if len(groups) > MOST_PARTS:
        raise SceneError(
            f"{source.path}: its animation moves {len(groups):,} parts; at most {MOST_PARTS} are: join meshes, or "
            "leave out the object's play"
        )
    transforms = part_transforms(contents.anchors, [on for on, _, _ in placed], 0.0)
    rest = join_parts(source, [_at_rest(part, way) for (_, part, _), way in zip(placed, transforms, strict=True)])
    parts = []
    for group in groups:
        mesh = _with_materials_of(rest, join_parts(source, [part for _, part, _ in group]))
        own = [bend for _, _, bend in group if bend is not None]
        bend = functools.partial(_bent, mesh, own) if own else None
        parts.append(MovingPart(mesh, group[0][0], bend))
    return MovingMesh(rest, tuple(parts), contents.anchors, contents.duration)


def _with_materials_of(whole: Mesh, mesh: Mesh) -> Mesh:
    """Return a mesh, which is a part of ``whole``, with all materials and pictures of ``whole``."""
    numbers = None
    if len(whole.materials) > 1:
        own = np.array([whole.materials.index(one) for one in mesh.materials or (MeshMaterial(),)], np.int32)
        numbers = own[0 if mesh.triangle_materials is None else mesh.triangle_materials]
        numbers = np.ascontiguousarray(np.broadcast_to(numbers, len(mesh.faces)))
    return dataclasses.replace(mesh, materials=whole.materials, images=whole.images, triangle_materials=numbers)


def _bent(mesh: Mesh, bends: list[Bending], seconds: float) -> Mesh:
    """Return a mesh whose primitives are deformed for a time of the animation."""
    parts = [part for bend in bends if (part := bend(seconds)) is not None]
    vertices, normals = (
        np.concatenate([getattr(part, name) for part in parts]).astype(np.float32) for name in ("vertices", "normals")
    )
    # A damaged skin may place vertices so far away that their squares overflow single precision.
    vertices = np.clip(np.nan_to_num(vertices), -LARGEST, LARGEST)
    tangents = filled(parts, [part.tangents for part in parts], (1.0, 0.0, 0.0, 1.0))
    own = None if tangents is None else tangents.astype(np.float32)
    return dataclasses.replace(mesh, vertices=vertices, normals=normals, tangents=own)


def _at_rest(part: MeshPart, transform: npt.NDArray[np.float64]) -> MeshPart:
    """Return a part at its place at time 0; if its node has zero scale then, the part collapses to a point."""
    point = np.tile(transform[:3, 3], (len(part.vertices), 1))
    return part.moved(transform) or dataclasses.replace(part, vertices=point)
