"""Table of emitting objects, from which kernels sample points on them; see ``kernels/rays/area_lights.py``.

A triangle's probability is proportional to its area times its mean emission. Where a picture gives the emission, the
share ``BY_AREA`` of the probability is proportional to area alone: bright texels that the few samples of the picture
miss are then still sampled now and then.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from warp_ar.kernels import structs
from warp_ar.scene.description import Object
from warp_ar.scene.geometry import Mesh
from warp_ar.scene.materials import RGB, Color, EmissiveMaterial, MeshMaterial, TextureUse
from warp_ar.scene.object_materials import is_closed, materials_of
from warp_ar.scene.textures import linear_texture, load_emission

FloatArray = npt.NDArray[np.float64]

BY_AREA: Final = 0.05
"""Share of the probability that is proportional to area alone, where emission varies within triangles."""
_LUMINANCE: Final = np.array([0.2126, 0.7152, 0.0722])
_GRID: Final = 6
"""Samples along a triangle's edge at which emission pictures are read."""
_LARGEST: Final = 256
"""Largest size of a picture's longer side, pixels; enough for the mean over a triangle."""


class AreaTable(NamedTuple):
    """Emitting objects and their faces, with sampling probabilities, for ``structs.RayScene``."""

    lights: npt.NDArray[Any]
    """Records of ``structs.AreaLight``, one per object that emits."""
    faces: npt.NDArray[np.int32]
    """Object index, triangle index (-1: a sphere), and 1 if only the front emits, (n, 3)."""
    shares: npt.NDArray[np.float32]
    """Cumulative distribution of emitted power over the rows of ``faces``, (n,); the last value is 1."""


def emits(material: MeshMaterial) -> bool:
    """Return True if a material emits light."""
    return material.unlit or any(material.emission)


def emits_light(item: Object) -> bool:
    """Return True if an object emits light.

    Raises:
        SceneError: Its mesh cannot be read.
    """
    return any(map(emits, materials_of(item).materials))


def make_area_table(objects: Sequence[Object], meshes: Sequence[Mesh | None]) -> AreaTable:
    """Return the table of a scene's emitting objects; it is empty if no object emits.

    Args:
        objects: All virtual objects of the scene.
        meshes: Mesh that rays intersect for each object, None for a sphere.
    """
    dtype = structs.struct_dtype(structs.AreaLight)
    lights: list[Any] = []
    faces: list[npt.NDArray[Any]] = []
    weights: list[FloatArray] = []
    for index, (item, mesh) in enumerate(zip(objects, meshes, strict=True)):
        if not emits_light(item):
            continue
        areas, normals, means, front, numbers = _faces_of(item, mesh)
        bright = means @ _LUMINANCE
        power = areas * bright
        record = np.zeros((), dtype)
        record["object"] = index
        record["power"] = (areas * np.where(front, 1.0, 2.0)) @ means
        if power.sum() > 0.0 and mesh is not None:
            record["facing"] = (power * front) @ normals / (power * np.where(front, 1.0, 2.0)).sum()
        lights.append(record)
        whole = areas.sum()
        even = areas * (power.sum() / whole) if whole > 0.0 else areas
        lit = power > 0.0 if np.ptp(bright) == 0.0 or not _varies(item) else even > 0.0
        weight = np.where(lit, (1.0 - BY_AREA) * power + BY_AREA * even, 0.0) if _varies(item) else power
        keep = weight > 0.0
        faces.append(np.stack([np.full(keep.sum(), index), numbers[keep], front[keep]], axis=1))
        weights.append(weight[keep] * item.scale**2)
    found = np.concatenate([np.zeros((0, 3)), *faces]).astype(np.int32)
    total = np.cumsum(np.concatenate([np.zeros(0), *weights]))
    shares = (total / total[-1]).astype(np.float32) if len(total) else np.zeros(0, np.float32)
    records = np.array(lights, dtype) if len(total) else np.zeros(0, dtype)
    return AreaTable(records, found, shares)


def _varies(item: Object) -> bool:
    """Return True if emission varies within a triangle of an object."""
    if isinstance(item.material, EmissiveMaterial):
        return item.material.image is not None
    return any(
        material.emissive is not None or (material.unlit and material.base is not None)
        for material in materials_of(item).materials
    )


def _faces_of(item: Object, mesh: Mesh | None) -> tuple[Any, ...]:
    """Return areas (object space), normals, mean emission, front-only flags and indices of an object's triangles."""
    materials = materials_of(item).materials
    if mesh is None:
        area = 4.0 * np.pi * item.radius**2
        emission = np.array([_constant(materials[0])])
        return np.array([area]), np.zeros((1, 3)), emission, np.array([True]), np.array([-1])
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(across, axis=1)
    normals = across / np.where(doubled > 0.0, doubled, 1.0)[:, None]
    own = np.zeros(len(doubled), int) if mesh.triangle_materials is None else mesh.triangle_materials
    means = np.zeros((len(doubled), 3))
    front = np.full(len(doubled), is_closed(mesh))
    for number, material in enumerate(materials):
        mine = own == number if len(materials) > 1 else np.full(len(doubled), True)
        if emits(material) and mine.any():
            means[mine] = np.array(_constant(material)) * _picture_means(item, mesh, material, mine)
        if not material.double_sided:
            front |= mine
    return 0.5 * doubled, normals, means, front, np.arange(len(doubled))


def _constant(material: MeshMaterial) -> RGB:
    if not material.unlit:
        return material.emission
    color: Color = getattr(material.surface, "base_color", (1.0, 1.0, 1.0))
    return (1.0, 1.0, 1.0) if isinstance(color, Path) else color


def _picture_means(item: Object, mesh: Mesh, material: MeshMaterial, mine: npt.NDArray[Any]) -> Any:
    """Return the mean value of the emission picture over each triangle, (m, 3); 1 where a triangle has no picture."""
    use = material.base if material.unlit else material.emissive
    if isinstance(item.material, EmissiveMaterial) and item.material.image is not None:
        picture, use = load_emission(item.material.image)[0], TextureUse(0, wrap=("clamp", "clamp"))
    elif use is not None:
        picture = np.ascontiguousarray(mesh.images[use.image][..., :3])
    uvs = None if use is None else (mesh.uvs if use.uv_set == 0 else mesh.uvs_second)
    if use is None or uvs is None:
        return 1.0
    linear = linear_texture(picture)
    step = -(-max(linear.shape[:2]) // _LARGEST)
    height, width = (max(side // step, 1) for side in linear.shape[:2])
    blocks = linear[: height * step, : width * step] if step > 1 else linear
    if step > 1 and min(linear.shape[:2]) >= step:
        linear = blocks.reshape(height, step, width, step, 3).mean(axis=(1, 3))
    a, b, c, d, e, f = use.transform
    total = np.zeros((int(mine.sum()), 3))
    corners = uvs[mesh.faces[mine]].astype(np.float64)
    places = [(i + 1 / 3, j + 1 / 3) for i in range(_GRID) for j in range(_GRID - i)]
    for i, j in places:
        p, q = i / _GRID, j / _GRID
        u, v = (p * corners[:, 0] + q * corners[:, 1] + (1.0 - p - q) * corners[:, 2]).T
        x, y = a * u + b * v + c, d * u + e * v + f
        x, y = ((value % 1.0 if way == "repeat" else np.abs((value + 1.0) % 2.0 - 1.0) if way == "mirror"
                 else np.clip(value, 0.0, 1.0)) for value, way in zip((x, y), use.wrap, strict=True))  # fmt: skip
        columns = np.minimum((x * linear.shape[1]).astype(int), linear.shape[1] - 1)
        rows = np.minimum(((1.0 - y) * linear.shape[0]).astype(int), linear.shape[0] - 1)
        total += linear[rows, columns]
    return total / len(places)
