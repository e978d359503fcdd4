"""Materials of virtual objects, from the scene file or from the mesh file.

An object has one or more ``MeshMaterial``: those of its mesh file, or one from the scene. If the scene gives a material
and the mesh file has base colour pictures, each triangle's picture multiplies the scene material's first colour.
"""

from __future__ import annotations

import dataclasses
import functools
import logging
import math
from pathlib import Path
from typing import Any

import numpy as np

from warp_ar.declared import checked
from warp_ar.errors import SceneError, printable
from warp_ar.scene.description import FLATTEST, Object, Scene
from warp_ar.scene.geometry import Mesh, make_mesh, placement
from warp_ar.scene.materials import (
    Color,
    EmissiveMaterial,
    FileMaterial,
    LambertMaterial,
    MeshMaterial,
    MetallicRoughnessMaterial,
    MirrorMaterial,
    PhongMaterial,
)
from warp_ar.scene.mesh_files import load_mesh, load_moving_mesh, mesh_from_trimesh
from warp_ar.scene.mesh_parts import MeshPart
from warp_ar.scene.node_animation import MovingMesh
from warp_ar.scene.textures import file_stamp, load_emission

_LOG = logging.getLogger(__name__)
_NO_FILE = (MeshMaterial(),)

_ROUNDED = 1e-4
"""Largest relative error of a matrix in single precision or rounded to a few digits."""


@dataclasses.dataclass(frozen=True)
class ObjectMaterials:
    """Materials of an object, and the features that decide which kernels and light its scene needs."""

    materials: tuple[MeshMaterial, ...]
    """Materials, at least one, in the order of ``Mesh.materials``."""
    detailed: bool
    """True if kernels must read per-triangle data: several materials, pictures, colours, alpha or emission."""
    holed: bool
    """True if rays may pass through some triangles, by alpha."""
    bumpy: bool
    """True if any material has a normal map."""


def object_from_trimesh(source: Any, **fields: Any) -> Object:
    """Return an object with mesh, materials and textures of a ``trimesh.Trimesh`` or ``trimesh.Scene``.

    Args:
        source: The mesh, in metres; its axes stay as they are.
        fields: Other fields of ``Object``, such as ``at``, ``rotate``, ``scale`` and ``material``.

    Raises:
        SceneError: It holds no triangle, a vertex that is not finite, or a face with an index out of range.
    """
    return Object("mesh", mesh=mesh_from_trimesh(source), **fields)


@checked
def object_at(item: Object, world_from_object: Any) -> Object:
    """Return an object placed by a 4x4 matrix: its ``at``, ``rotate``, ``scale`` and ``stretch`` are replaced.

    A stretch that stays the same from one call to the next is kept exactly, so that the mesh is stretched once.

    Args:
        item: The object.
        world_from_object: Affine transform, (4, 4), from the shape's coordinates to the world in metres, for column
            vectors. A mesh takes any that is invertible; other shapes rotation, uniform scale and translation.

    Raises:
        UsageError: ``item`` is no object.
        SceneError: The matrix is not 4x4, finite, affine and invertible, or stretches a shape that is no mesh.
    """
    from trimesh import transformations  # scenes from files do not need it

    try:
        matrix = np.array(world_from_object, np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise SceneError("world_from_object: expected a 4x4 matrix of finite numbers")
    if np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() > _ROUNDED:
        right = "expected 0, 0, 0, 1; the translation stands in the last column"
        raise SceneError(f"world_from_object: its last row is {matrix[3].tolist()}; {right}")
    matrix[3] = 0.0, 0.0, 0.0, 1.0
    if not np.linalg.cond(matrix[:3, :3]) < FLATTEST:
        raise SceneError(f"world_from_object: {matrix[:3, :3].tolist()} flattens; expected an invertible matrix")
    scale = float(np.linalg.norm(matrix[:3, :3], 2))
    matrix[:3, :3] /= scale
    lengths, shear, *_ = transformations.decompose_matrix(matrix)
    stretch = transformations.compose_matrix(lengths, shear)[:3, :3]
    known = (dataclasses.replace(item, stretch=None), item)
    same = (one.stretch for one in known if np.abs(stretch - one.stretch_matrix()).max() < _ROUNDED)
    turned = matrix[:3, :3] @ np.linalg.inv(stretch)
    x, y, z = map(math.degrees, transformations.euler_from_matrix(turned, "sxyz"))
    return dataclasses.replace(
        item, at=tuple(matrix[:3, 3]), rotate=(x, y, z), scale=scale, stretch=next(same, tuple(stretch.ravel()))
    )


def mesh_of(item: Object) -> Mesh | None:
    """Return the mesh of an object of shape ``mesh``, at time 0 of its animation; None for other shapes.

    Raises:
        SceneError: Its file cannot be read.
    """
    if item.shape != "mesh":
        return None
    mesh, moving = item.mesh, moving_mesh_of(item)
    if mesh is None:
        assert item.file is not None
        mesh = file_mesh(item.file) if moving is None else moving.rest
    return mesh if item.stretch is None else stretched_mesh(mesh, item.stretch)


@functools.lru_cache(maxsize=16)
def stretched_mesh(mesh: Mesh, stretch: tuple[float, ...]) -> Mesh:
    """Return a mesh whose points are mapped by an invertible matrix, given by rows; cached."""
    own = {name: getattr(mesh, name) for name in ("vertices", "faces", "normals", "tangents")}
    moved = MeshPart(**own).moved(placement(np.reshape(stretch, (3, 3)), 0.0))
    return make_mesh(**{**vars(mesh), **{name: getattr(moved, name) for name in own}})


def moving_mesh_of(item: Object) -> MovingMesh | None:
    """Return the animation that an object plays, cached until the file changes; None if it plays none.

    Raises:
        SceneError: Its file has no such animation, or cannot be read.
    """
    if item.play is None or item.file is None or item.mesh is not None:
        return None
    return _read_moving(item.file, file_stamp(item.file), item.play.animation)


@functools.lru_cache(maxsize=8)
def _read_moving(path: Path, stamp: tuple[int, int], animation: str | int) -> MovingMesh:
    moving = load_moving_mesh(path, animation)
    _say(path, moving.rest.notes)
    return moving


def file_mesh(path: Path) -> Mesh:
    """Return the mesh of a file, cached until the file changes; prints once which contents are not shown.

    Raises:
        SceneError: It cannot be read.
    """
    return _read_mesh(path, file_stamp(path))


@functools.lru_cache(maxsize=4)
def _read_mesh(path: Path, stamp: tuple[int, int]) -> Mesh:
    mesh = load_mesh(path)
    _say(path, mesh.notes)
    return mesh


@functools.cache
def _say(path: Path, notes: tuple[str, ...]) -> None:
    if notes:
        _LOG.warning("%s: not shown: %s", printable(path), printable(", ".join(notes)))


def materials_of(item: Object) -> ObjectMaterials:
    """Return the materials of an object and their features.

    Raises:
        SceneError: Its mesh cannot be read.
    """
    mesh = mesh_of(item)
    if isinstance(item.material, EmissiveMaterial):
        materials: tuple[MeshMaterial, ...] = (_emissive(item, item.material, mesh),)
    elif mesh is None:
        surface = LambertMaterial() if isinstance(item.material, FileMaterial) else item.material
        materials = (MeshMaterial(surface=surface),)
    elif isinstance(item.material, FileMaterial):
        materials = mesh.materials or _NO_FILE
        if is_closed(mesh):
            materials = tuple(dataclasses.replace(material, double_sided=True) for material in materials)
    else:
        bases = [material.base for material in mesh.materials] if mesh.uvs is not None else []
        materials = tuple(MeshMaterial(surface=item.material, base=base) for base in bases or [None])
    own = isinstance(item.material, FileMaterial)
    pictured = isinstance(item.material, EmissiveMaterial) or any(
        isinstance(value, Path) for material in materials for value in vars(material.surface).values()
    )
    plain = all(material.plain for material in materials) and len(set(materials)) == 1
    colored = own and mesh is not None and mesh.colors is not None
    return ObjectMaterials(
        materials=materials,
        detailed=pictured or colored or not plain,
        holed=any(material.alpha != "opaque" or not material.double_sided for material in materials),
        bumpy=any(material.normal is not None for material in materials),
    )


def _emissive(item: Object, material: EmissiveMaterial, mesh: Mesh | None) -> MeshMaterial:
    """Return an emissive material as a mesh material; its picture comes from the scene."""
    peak = 1.0 if material.image is None else load_emission(material.image)[1]
    red, green, blue = (peak * material.intensity * factor for factor in material.color)
    closed = item.shape in ("sphere", "box", "torus") or (mesh is not None and is_closed(mesh))
    return MeshMaterial(
        surface=LambertMaterial((0.0, 0.0, 0.0)),
        double_sided=closed or material.two_sided,
        emission=(red, green, blue),
    )


@functools.lru_cache(maxsize=64)
def is_closed(mesh: Mesh) -> bool:
    """Return True if a mesh is closed, so that no back face is visible from outside: every edge has its opposite."""
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    _, place = np.unique(corners, axis=0, return_inverse=True)
    faces = place.reshape(-1, 3).astype(np.int64)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    count = len(corners)
    there = np.sort((faces * count + np.roll(faces, -1, axis=1)).ravel())
    back = np.sort((np.roll(faces, -1, axis=1) * count + faces).ravel())
    return np.array_equal(there, back)


def scene_materials(scene: Scene) -> tuple[MeshMaterial, ...]:
    """Return the materials of all virtual objects, in their order.

    Raises:
        SceneError: A mesh cannot be read.
    """
    return tuple(material for item in scene.objects for material in materials_of(item).materials)


def is_detailed(scene: Scene) -> bool:
    """Return True if shading any object needs per-triangle or per-point material data.

    Raises:
        SceneError: A mesh cannot be read.
    """
    return any(materials_of(item).detailed for item in scene.objects)


def _is_black(color: Color) -> bool:
    return not isinstance(color, Path) and not any(color)


def reflects_diffusely(material: MeshMaterial) -> bool:
    """Return True if a material reflects the environment's irradiance."""
    surface: Any = material.surface
    if material.unlit or isinstance(surface, MirrorMaterial):
        return False
    metallic = surface.metallic if isinstance(surface, MetallicRoughnessMaterial) else 0.0
    return material.metallic_span[0] * metallic < 1.0 and not _is_black(surface.base_color)


def reflects_glossily(material: MeshMaterial) -> bool:
    """Return True if a material reflects the environment's prefiltered radiance."""
    surface: Any = material.surface
    if material.unlit or isinstance(surface, LambertMaterial):
        return False
    color = surface.specular if isinstance(surface, PhongMaterial) else surface.base_color
    return isinstance(surface, MetallicRoughnessMaterial) or not _is_black(color)
