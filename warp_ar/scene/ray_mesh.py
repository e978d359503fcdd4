"""Meshes as rays meet them: which shapes become one, and the BVH that no ray slips through."""

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
from warp_ar.scene.object_materials import file_mesh
from warp_ar.scene.object_shapes import ObjectShape
from warp_ar.scene.shapes import box_mesh, disk_mesh, rect_mesh, silhouette_tolerance, torus_mesh, tube_mesh

FloatArray = npt.NDArray[np.float64]

BOX_MARGIN: Final = 2.0**-18
"""Margin of a triangle's box in the BVH, in radii of the mesh; see ``kernels/rays/shapes.py``."""
BVH_CONSTRUCTOR: Final = "sah"
"""Constructor of trees; Warp's default on CUDA builds faster, but rays take 1.2 to 1.5 times as long."""
BVH_LEAF_SIZES: Final = {"cpu": 4, "cuda": 1}
"""Triangles per leaf: on CUDA a ray that tests triangles holds up those beside it that still walk."""
PICTURE_CELLS: Final = 16
"""Into how many parts along either side a rect is cut whose picture emits: light is looked for where it is bright."""


@dataclasses.dataclass(frozen=True, eq=False)
class RayMesh:
    """A mesh that rays can meet, moved so that the centre of its bounding box is its origin."""

    mesh: Any
    """``wp.Mesh`` whose corners are not shared: corner k of face f is point 3 f + k."""
    center: FloatArray
    """Origin in the coordinates of the source, (3,)."""
    half: FloatArray
    """Half sizes of its bounding box, (3,)."""
    normals: npt.NDArray[np.float32]
    """Unit normal of each corner, (3 m, 3)."""
    uvs: npt.NDArray[np.float32]
    """Texture coordinates of each corner, (3 m, 2)."""


def make_ray_mesh(mesh: Mesh, device: Any) -> RayMesh:
    """Build the BVH of a mesh with a margin around every triangle, so that no ray slips through a shared edge.

    The BVH is built over triangles that span the enlarged boxes; then the true corners take their place. Nothing is
    refitted afterwards, so the boxes keep their margin, and the triangles that rays are tested against are exact.
    Most meshes stand still in their own space: the tree is built once, so it is the one that is walked fastest.

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
    """Corners of the triangles about a centre, (m, 3, 3), half sizes, margin."""
    # Vertices at one position stay at one position to the last bit: every corner is computed the same way.
    corners = (mesh.vertices.astype(np.float64) - center).astype(np.float32)[mesh.faces]
    half = np.abs(corners).reshape(-1, 3).max(axis=0).astype(np.float64)
    return corners, half, float(np.float32(BOX_MARGIN * np.linalg.norm(half)))


def _spanning(corners: npt.NDArray[np.float32], margin: float) -> npt.NDArray[np.float32]:
    """Corners of triangles that span others with their margin, (3 m, 3)."""
    low, high = corners.min(axis=1) - np.float32(margin), corners.max(axis=1) + np.float32(margin)
    return np.stack([low, high, corners[:, 0]], axis=1).reshape(-1, 3)


def bend_ray_mesh(ray_mesh: RayMesh, mesh: Mesh) -> RayMesh:
    """Have rays meet a mesh whose vertices are elsewhere now: boxes follow them, trees stay where they are.

    Args:
        ray_mesh: What rays have met so far, of which no other scene has a share; its place in memory stays.
        mesh: With the same faces.
    """
    corners, half, margin = _corners(mesh, ray_mesh.center)
    points = ray_mesh.mesh.points
    points.assign(_spanning(corners, margin))
    ray_mesh.mesh.refit()
    points.assign(corners.reshape(-1, 3))
    return dataclasses.replace(ray_mesh, half=half, normals=mesh.normals[mesh.faces].reshape(-1, 3))


_SHARED: weakref.WeakKeyDictionary[Mesh, weakref.WeakValueDictionary[str, RayMesh]] = weakref.WeakKeyDictionary()


def shared_ray_mesh(mesh: Mesh, device: Any) -> RayMesh:
    """``make_ray_mesh`` of a file's mesh, one for all scenes of a device for as long as any of them holds it.

    A mesh that a program made itself may change in its hands: each scene has its own of that.
    """
    by_device = _SHARED.setdefault(mesh, weakref.WeakValueDictionary())
    known = by_device.get(str(device))
    if known is None:
        known = by_device[str(device)] = make_ray_mesh(mesh, device)
    return known


def mesh_key(item: ObjectShape | scenes.Object | scenes.Proxy) -> Any:
    """Return the key of a mesh: file, part, or a torus's radii and tolerance; None for what rays meet analytically."""
    if isinstance(item, ObjectShape):
        if item.mesh is None:
            return mesh_key(item.item)
        return item.mesh if item.bend is None else (item.index, item.mesh)  # another object's is bent otherwise
    if item.shape == "mesh":
        return item.mesh if isinstance(item, scenes.Object) and item.mesh is not None else item.file
    if not isinstance(item, scenes.Object):
        return None
    if item.shape == "torus":
        outer = item.scale * (item.major_radius + item.minor_radius)
        return item.major_radius, item.minor_radius, silhouette_tolerance(outer) / item.scale
    gap = silhouette_tolerance(item.scale * max(item.radius, 0.5 * item.length)) / item.scale
    emissive = isinstance(item.material, scenes.EmissiveMaterial)
    match item.shape:
        case "rect":
            pictured = emissive and item.material.image is not None  # type: ignore[union-attr]
            return "rect", item.size[:2], PICTURE_CELLS if pictured else 1
        case "disk":
            return "disk", item.radius, gap
        case "tube":
            return "tube", item.radius, item.length, gap
        case "box" if emissive:
            return "box", item.size
    return None


_MAKERS: Final[dict[str, Any]] = {"rect": rect_mesh, "disk": disk_mesh, "tube": tube_mesh, "box": box_mesh}


def make_mesh(key: Any) -> Mesh:
    """Make the mesh of a ``mesh_key``."""
    if isinstance(key, Mesh):
        return key
    if isinstance(key, Path):
        return file_mesh(key)
    if isinstance(key[-1], Mesh):
        return key[-1]
    return _MAKERS[key[0]](*key[1:]) if key[0] in _MAKERS else torus_mesh(*key)


def texture_density(mesh: Mesh) -> npt.NDArray[np.float32]:
    """Texture coordinates of both sets per unit of length on each triangle, (m, 2): square roots of ratios of areas."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    found = np.zeros((len(mesh.faces), 2))
    for index, uvs in enumerate((mesh.uvs, mesh.uvs_second)):
        if uvs is not None:
            u, v = uvs[mesh.faces].astype(np.float64).transpose(2, 0, 1)
            spanned = (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])
            found[:, index] = np.sqrt(np.abs(spanned) / np.where(area > 0.0, area, np.inf))
    return found.astype(np.float32)
