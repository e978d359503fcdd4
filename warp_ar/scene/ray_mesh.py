"""Meshes for ray intersection: which shapes become meshes, and a watertight BVH."""

from __future__ import annotations

import dataclasses
import weakref
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar import scene as scenes
from warp_ar.scene.geometry import Mesh
from warp_ar.scene.object_materials import file_mesh, stretched_mesh
from warp_ar.scene.object_shapes import ObjectShape
from warp_ar.scene.shapes import box_mesh, disk_mesh, rect_mesh, silhouette_tolerance, torus_mesh, tube_mesh

FloatArray = npt.NDArray[np.float64]

BOX_MARGIN: Final = 2.0**-18
"""Margin around a triangle's box in the BVH, relative to the mesh's radius; see ``kernels/rays/shapes.py``."""
BVH_CONSTRUCTOR: Final = "sah"
"""Warp's BVH constructor. Its default on CUDA builds faster, but rays then take 1.2 to 1.5 times as long."""
BVH_LEAF_SIZES: Final = {"cpu": 4, "cuda": 1}
"""Triangles per BVH leaf: on CUDA, a ray that tests triangles stalls the other threads of its warp."""
PICTURE_CELLS: Final = 16
"""Number of parts along each side into which a rect with an emissive picture is cut, so that light sampling finds its
bright parts."""


@dataclasses.dataclass(frozen=True, eq=False)
class RayMesh:
    """Mesh for ray intersection, translated so that the centre of its bounding box is the origin."""

    mesh: Any
    """``wp.Mesh`` without shared vertices: corner k of face f is point 3 f + k."""
    center: FloatArray
    """Position of its origin in the source's coordinates, (3,)."""
    half: FloatArray
    """Half sizes of the bounding box, (3,)."""
    normals: npt.NDArray[np.float32]
    """Unit normal of each corner, (3 m, 3)."""
    uvs: npt.NDArray[np.float32]
    """Texture coordinates of each corner, (3 m, 2)."""


def make_ray_mesh(mesh: Mesh, device: Any) -> RayMesh:
    """Build the BVH of a mesh with a margin around every triangle, so that no ray passes through a shared edge.

    The BVH is built over triangles that span the enlarged boxes; afterwards the exact corners replace theirs. The tree
    is not refitted, so its boxes keep the margin while rays are tested against exact triangles. Most meshes are rigid:
    their tree is built once, so traversal speed counts more than build speed.

    Args:
        mesh: The triangles.
        device: Warp device.
    """
    low, high = (bound.astype(np.float64) for bound in mesh.bounds)
    center = 0.5 * (low + high)
    corners, half, margin = _corners(mesh, center)
    points = wp.array(_spanning(corners, margin), dtype=wp.vec3, device=device)
    indices = wp.array(np.arange(corners.shape[0] * 3, dtype=np.int32), dtype=wp.int32, device=device)
    leaf_size = BVH_LEAF_SIZES["cpu" if points.device.is_cpu else "cuda"]
    ray_mesh = wp.Mesh(points=points, indices=indices, bvh_constructor=BVH_CONSTRUCTOR, bvh_leaf_size=leaf_size)
    wp.copy(points, wp.array(corners.reshape(-1, 3), dtype=wp.vec3, device=device))
    uvs = np.zeros((len(mesh.vertices), 2), np.float32) if mesh.uvs is None else mesh.uvs
    normals = mesh.normals[mesh.faces].reshape(-1, 3)
    return RayMesh(ray_mesh, center, half, normals, uvs[mesh.faces].reshape(-1, 2))


def _corners(mesh: Mesh, center: FloatArray) -> tuple[npt.NDArray[np.float32], FloatArray, float]:
    """Return the corners of the triangles relative to a centre, (m, 3, 3), the half sizes, and the margin."""
    # Vertices at equal positions stay equal to the last bit, because every corner is computed in the same way.
    corners = (mesh.vertices.astype(np.float64) - center).astype(np.float32)[mesh.faces]
    half = np.abs(corners).reshape(-1, 3).max(axis=0).astype(np.float64)
    return corners, half, float(np.float32(BOX_MARGIN * np.linalg.norm(half)))


def _spanning(corners: npt.NDArray[np.float32], margin: float) -> npt.NDArray[np.float32]:
    """Return corners, (3 m, 3), of triangles whose boxes are those of the given triangles plus the margin."""
    low, high = corners.min(axis=1) - np.float32(margin), corners.max(axis=1) + np.float32(margin)
    return np.stack([low, high, corners[:, 0]], axis=1).reshape(-1, 3)


def bend_ray_mesh(ray_mesh: RayMesh, mesh: Mesh) -> RayMesh:
    """Return the ray mesh with moved vertices: the boxes are refitted, the tree's structure is kept.

    Args:
        ray_mesh: Previous ray mesh, not shared with another scene; its arrays are updated in place.
        mesh: Mesh with the same faces and new vertices.
    """
    corners, half, margin = _corners(mesh, ray_mesh.center)
    points = ray_mesh.mesh.points
    points.assign(_spanning(corners, margin))
    ray_mesh.mesh.refit()
    points.assign(corners.reshape(-1, 3))
    return dataclasses.replace(ray_mesh, half=half, normals=mesh.normals[mesh.faces].reshape(-1, 3))


_SHARED: weakref.WeakKeyDictionary[Mesh, weakref.WeakValueDictionary[str, RayMesh]] = weakref.WeakKeyDictionary()


def shared_ray_mesh(mesh: Mesh, device: Any) -> RayMesh:
    """Return ``make_ray_mesh`` of a file's mesh, shared by all scenes of a device as long as any of them uses it.

    A mesh made in memory may be changed by the program, so each scene has a copy of its own.
    """
    by_device = _SHARED.setdefault(mesh, weakref.WeakValueDictionary())
    known = by_device.get(str(device))
    if known is None:
        known = by_device[str(device)] = make_ray_mesh(mesh, device)
    return known


def mesh_key(item: ObjectShape | scenes.Object | scenes.Proxy) -> Any:
    """Return the cache key of a mesh: file, part, or a function that makes it and its arguments.

    Return None for shapes that rays intersect analytically.
    """
    if isinstance(item, ObjectShape):
        if item.mesh is None:
            return mesh_key(item.item)
        return item.mesh if item.bend is None else (item.index, item.mesh)  # another object deforms its own copy
    if item.shape == "mesh":
        if not isinstance(item, scenes.Object):
            return item.file
        source = item.file if item.mesh is None else item.mesh
        return source if item.stretch is None else (_stretched, source, item.stretch)
    if not isinstance(item, scenes.Object):
        return None
    if item.shape == "torus":
        outer = item.scale * (item.major_radius + item.minor_radius)
        return torus_mesh, item.major_radius, item.minor_radius, silhouette_tolerance(outer) / item.scale
    gap = silhouette_tolerance(item.scale * max(item.radius, 0.5 * item.length)) / item.scale
    emissive = isinstance(item.material, scenes.EmissiveMaterial)
    match item.shape:
        case "rect":
            pictured = emissive and item.material.image is not None  # type: ignore[union-attr]
            return rect_mesh, item.size[:2], PICTURE_CELLS if pictured else 1
        case "disk":
            return disk_mesh, item.radius, gap
        case "tube":
            return tube_mesh, item.radius, item.length, gap
        case "box" if emissive:
            return box_mesh, item.size
    return None


def _stretched(source: Path | Mesh, stretch: tuple[float, ...]) -> Mesh:
    return stretched_mesh(make_mesh(source), stretch)


def make_mesh(key: Any) -> Mesh:
    """Return the mesh of a ``mesh_key``."""
    if isinstance(key, Mesh):
        return key
    if isinstance(key, Path):
        return file_mesh(key)
    if isinstance(key[-1], Mesh):
        return key[-1]
    made: Mesh = key[0](*key[1:])
    return made


def texture_density(mesh: Mesh) -> npt.NDArray[np.float32]:
    """Return the density of both sets of texture coordinates on each triangle, (m, 2).

    It is the square root of the ratio of the area in texture space to the area in space.
    """
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    found = np.zeros((len(mesh.faces), 2))
    for index, uvs in enumerate((mesh.uvs, mesh.uvs_second)):
        if uvs is not None:
            u, v = uvs[mesh.faces].astype(np.float64).transpose(2, 0, 1)
            spanned = (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])
            found[:, index] = np.sqrt(np.abs(spanned) / np.where(area > 0.0, area, np.inf))
    return found.astype(np.float32)
