"""Meshes from files and from trimesh, still or moved by an animation of the file."""

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
from warp_ar.scene.node_animation import Anchor, MovingMesh, MovingPart, part_transforms
from warp_ar.scene.polygon_files import READERS

MESH_SUFFIXES: Final = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off")
"""Mesh files that :func:`load_mesh` reads."""

GLTF_SUFFIXES: Final = (".glb", ".gltf")
"""Those of glTF."""

_DAMAGES: Final = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError, MemoryError)
"""Errors that readers raise on damaged files, beside their own."""
MOST_PARTS: Final = 256
"""Parts that an animation moves: each is a shape of its own, and a ray asks all of them."""


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
    contents, source = _read_file(path, animation)
    with _said_in_words(path):
        return moving_mesh(source, contents)


def animations_of(path: Path) -> list[str]:
    """Names of a glTF file's animations, by number; empty where one has none.

    Raises:
        SceneError: As :func:`load_mesh`.
    """
    data = read_bytes(path, "mesh_bytes", SceneError)
    with _said_in_words(path):
        return animation_names(GltfFile(MeshSource(path, data)))


def _load(path: Path) -> tuple[Mesh, MeshSource]:
    """A mesh, and what it was read from."""
    contents, source = _read_file(path)
    with _said_in_words(path):
        return join_parts(source, contents.parts), source


@contextlib.contextmanager
def _said_in_words(path: Path) -> Iterator[None]:
    """Turn what readers raise on damaged files into a SceneError."""
    try:
        yield
    except SceneError:
        raise
    except _DAMAGES as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise SceneError(f"{path}: the mesh cannot be read; is the file whole? ({reason})") from error


def _read_file(path: Path, animation: str | int | None = None) -> tuple[GltfContents, MeshSource]:
    """Parts of a file, one or more, and what they were read from."""
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise SceneError(f"{path}: unknown mesh format {path.suffix!r}; use one of {', '.join(MESH_SUFFIXES)}")
    if not is_file(path):
        raise SceneError(f"{path}: no such mesh file")
    source = MeshSource(path, read_bytes(path, "mesh_bytes", SceneError))
    # What is not finite is named when it is looked through.
    with _said_in_words(path), np.errstate(all="ignore"):
        if suffix in GLTF_SUFFIXES:
            contents = load_gltf(source, animation=animation)
        else:
            contents = GltfContents([(-1, part, None) for part in READERS[suffix](source)])
        if not contents.parts:
            raise SceneError(f"{path}: holds no triangle; a mesh with faces is needed (a point cloud has none)")
        return contents, source


def mesh_from_trimesh(source: Any) -> Mesh:
    """The mesh of a ``trimesh.Trimesh`` or ``trimesh.Scene`` in memory, with its colours or materials, as GLB has them.

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
                mesh.unmerge_vertices()  # GLB has colours of vertices alone
            if isinstance(getattr(mesh.visual, "material", None), trimesh.visual.material.SimpleMaterial):
                mesh.visual.material = mesh.visual.material.to_pbr()
                mesh.visual.material.metallicFactor = 0.0
            made.add_geometry(mesh, transform=transform)
        if not made.geometry:
            raise SceneError(f"{path} holds no triangle")
        taken = MeshSource(path, made.export(file_type="glb"))
        return join_parts(taken, load_gltf(taken, memory=True).parts)


def moving_mesh(source: MeshSource, contents: GltfContents) -> MovingMesh:
    """One mesh for all that stands still, and one for every moving node that triangles hang on.

    Args:
        source: The file.
        contents: Of the file, with an animation.

    Raises:
        SceneError: More than ``MOST_PARTS`` nodes move, or a vertex lies too far off.
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
    anchors, renamed = _used(contents.anchors, [on for on, _, _ in placed])
    transforms = part_transforms(anchors, [renamed.get(on, -1) for on, _, _ in placed], 0.0)
    rest = join_parts(source, [_at_rest(part, way) for (_, part, _), way in zip(placed, transforms, strict=True)])
    parts = []
    for group in groups:
        mesh = _with_materials_of(rest, join_parts(source, [part for _, part, _ in group]))
        own = [bend for _, _, bend in group if bend is not None]
        bend = functools.partial(_bent, mesh, own) if own else None
        parts.append(MovingPart(mesh, renamed.get(group[0][0], -1), bend))
    return MovingMesh(rest, tuple(parts), anchors, contents.duration)


def _with_materials_of(whole: Mesh, mesh: Mesh) -> Mesh:
    """A mesh that is a part of another one, with all of that one's materials and pictures."""
    numbers = None
    if len(whole.materials) > 1:
        own = np.array([whole.materials.index(one) for one in mesh.materials or (MeshMaterial(),)], np.int32)
        numbers = own[0 if mesh.triangle_materials is None else mesh.triangle_materials]
        numbers = np.ascontiguousarray(np.broadcast_to(numbers, len(mesh.faces)))
    return dataclasses.replace(mesh, materials=whole.materials, images=whole.images, triangle_materials=numbers)


def _bent(mesh: Mesh, bends: list[Bending], seconds: float) -> Mesh:
    """A mesh whose primitives are bent as they are at a time of the animation."""
    parts = [part for bend in bends if (part := bend(seconds)) is not None]
    vertices, normals = (
        np.concatenate([getattr(part, name) for part in parts]).astype(np.float32) for name in ("vertices", "normals")
    )
    # A damaged skin may place vertices so far out that their squares overflow single precision.
    vertices = np.clip(np.nan_to_num(vertices), -LARGEST, LARGEST)
    tangents = filled(parts, [part.tangents for part in parts], (1.0, 0.0, 0.0, 1.0))
    own = None if tangents is None else tangents.astype(np.float32)
    return dataclasses.replace(mesh, vertices=vertices, normals=normals, tangents=own)


def _used(anchors: tuple[Anchor, ...], carriers: list[int]) -> tuple[tuple[Anchor, ...], dict[int, int]]:
    """The anchors that triangles hang on, and those above them; their new numbers by the old."""
    needed: set[int] = set()
    for carrier in carriers:
        number = carrier
        while number >= 0 and number not in needed:
            needed.add(number)
            number = anchors[number].parent
    renamed = {old: new for new, old in enumerate(sorted(needed))}
    kept = (dataclasses.replace(anchors[old], parent=renamed.get(anchors[old].parent, -1)) for old in renamed)
    return tuple(kept), renamed


def _at_rest(part: MeshPart, transform: npt.NDArray[np.float64]) -> MeshPart:
    """A part where it stands at time 0; a node may have no size at first: what hangs on it then is a point."""
    point = np.tile(transform[:3, 3], (len(part.vertices), 1))
    return part.moved(transform) or dataclasses.replace(part, vertices=point)
