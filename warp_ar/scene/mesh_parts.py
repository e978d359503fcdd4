"""Parts of a mesh file: checked, placed, and joined into one mesh with a material per triangle."""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError
from warp_ar.scene.geometry import Mesh, creased_normals, make_mesh, smooth_normals, tangent_frames, unit_or
from warp_ar.scene.materials import LambertMaterial, MeshMaterial, TextureUse
from warp_ar.scene.mesh_source import MeshSource

Array = npt.NDArray[np.float64]

LARGEST: Final = 1e12
"""Bound on coordinates within which the square of a position, also after a scene's scaling, is finite in single
precision."""


@dataclasses.dataclass(frozen=True)
class MeshPart:
    """Triangles that share one material."""

    vertices: Array
    """Positions, (n, 3)."""
    faces: npt.NDArray[np.int64]
    """Vertex indices, (m, 3)."""
    normals: Array
    """Unit normals, (n, 3)."""
    uvs: tuple[Array | None, Array | None] = (None, None)
    """Two sets of texture coordinates, (n, 2), v up."""
    colors: Array | None = None
    """Linear RGBA, (n, 4)."""
    tangents: Array | None = None
    """Tangents like ``Mesh.tangents``, (n, 4)."""
    material: MeshMaterial | None = None
    """Material; None if the file gives none."""
    source: npt.NDArray[np.int64] | None = None
    """Index of the file's vertex that each vertex was copied from, (n,); None: the same index."""

    @classmethod
    def checked(
        cls,
        label: str,
        vertices: Array,
        faces: npt.NDArray[np.int64],
        normals: Array | None,
        *,
        uvs: tuple[Array | None, Array | None] = (None, None),
        colors: Array | None = None,
        tangents: Array | None = None,
        material: MeshMaterial | None = None,
        crease: float | None = None,
    ) -> MeshPart:
        """Return a part made from unchecked numbers of a file.

        Args:
            label: The file, for messages.
            vertices: Positions, (n, 3).
            faces: Vertex indices, (m, 3).
            normals: Normals of any length, (n, 3); invalid normals, or all if None, are computed.
            uvs: Two sets of texture coordinates, (n, 2), v up; a set that is not finite is left out.
            colors: Linear RGBA, (n, 4).
            tangents: In the form of ``Mesh.tangents``, (n, 4); left out if any is not finite.
            material: Material; None if the file gives none.
            crease: Angle in degrees above which edges are sharp in computed normals; None: all edges are smooth.

        Raises:
            SceneError: A vertex is not finite or a face has an index out of range.
        """
        check_indices(label, faces, len(vertices))
        finite = (np.abs(vertices) < LARGEST).all(axis=1)
        if not finite.all():
            row = int(np.argmin(finite))
            raise SceneError(f"{label}: vertex {row} is {vertices[row].tolist()}; it must be finite, below {LARGEST:g}")
        uvs = (_finite(uvs[0], len(vertices), 1e9), _finite(uvs[1], len(vertices), 1e9))
        colors, tangents = _finite(colors, len(vertices), 1e9), _finite(tangents, len(vertices), 1e9)
        if normals is None and crease is not None:
            where, computed = creased_normals(vertices, faces, crease)
            part = cls(vertices, faces, np.zeros_like(vertices), uvs, colors, None, material)._taken(where)
            return dataclasses.replace(part, normals=computed.astype(np.float64))._with_tangents()
        smooth = smooth_normals(vertices, faces).astype(np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            unit = smooth if normals is None else unit_or(normals, smooth)
        return cls(vertices, faces, unit, uvs, colors, tangents, material)._with_tangents()

    def _taken(self, where: npt.NDArray[np.int64]) -> MeshPart:
        """Return the triangles without shared vertices: corner k of face f copies vertex ``where[3 f + k]``."""

        def take(values: Array | None) -> Array | None:
            return None if values is None else values[where]

        return dataclasses.replace(
            self,
            vertices=self.vertices[where],
            faces=np.arange(len(where), dtype=np.int64).reshape(-1, 3),
            normals=self.normals[where],
            uvs=(take(self.uvs[0]), take(self.uvs[1])),
            colors=take(self.colors),
            tangents=take(self.tangents),
            source=where if self.source is None else self.source[where],
        )

    def _with_tangents(self) -> MeshPart:
        """Return the part with tangents if its material has a normal map, else without."""
        use = None if self.material is None else self.material.normal
        uvs = None if use is None else self.uvs[use.uv_set]
        if use is None or uvs is None:
            return dataclasses.replace(self, tangents=None)
        if self.tangents is not None:
            across = self.tangents[:, :3] - (self.tangents[:, :3] * self.normals).sum(1, keepdims=True) * self.normals
            length = np.linalg.norm(across, axis=1, keepdims=True)
            if (length > 1e-6).all():
                side = np.where(self.tangents[:, 3:] < 0.0, -1.0, 1.0)
                return dataclasses.replace(self, tangents=np.concatenate([across / length, side], axis=1))
        a, b, _, d, e, _ = use.transform
        # A rotated picture rotates its tangent frames as well: their u is the picture's u.
        turned = uvs @ np.array([[a, b], [d, e]]).T
        where, frames = tangent_frames(self.vertices, self.faces, self.normals, turned)
        return dataclasses.replace(self._taken(where), tangents=frames.astype(np.float64))

    def moved(self, transform: Array) -> MeshPart | None:
        """Return the part transformed by a (4, 4) matrix; None if the matrix is singular."""
        linear = transform[:3, :3]
        determinant = float(np.linalg.det(linear))
        if not np.isfinite(determinant) or determinant == 0.0:
            return None
        vertices = self.vertices @ linear.T + transform[:3, 3]
        # The cofactor matrix equals the inverse transpose up to a factor, and does not overflow where the inverse does.
        cofactors = np.stack([np.cross(linear[(k + 1) % 3], linear[(k + 2) % 3]) for k in range(3)])
        turned = self.normals @ (cofactors * np.sign(determinant)).T
        normals = unit_or(turned, self.normals)
        tangents = self.tangents
        if tangents is not None:
            side = tangents[:, 3:] * np.sign(determinant)
            tangents = np.concatenate([unit_or(tangents[:, :3] @ linear.T, tangents[:, :3]), side], axis=1)
        faces = self.faces[:, ::-1] if determinant < 0.0 else self.faces
        return dataclasses.replace(self, vertices=vertices, faces=faces, normals=normals, tangents=tangents)

    def bent(self, transforms: Array) -> MeshPart:
        """Return the part with each original vertex transformed by its own matrix, (n, 4, 4)."""
        if self.source is not None:
            transforms = transforms[self.source]
        linear = transforms[:, :3, :3]
        vertices = np.einsum("nij,nj->ni", linear, self.vertices) + transforms[:, :3, 3]
        normals = unit_or(np.einsum("nij,nj->ni", linear, self.normals), self.normals)
        tangents = self.tangents
        if tangents is not None:
            along = unit_or(np.einsum("nij,nj->ni", linear, tangents[:, :3]), tangents[:, :3])
            tangents = np.concatenate([along, tangents[:, 3:]], axis=1)
        return dataclasses.replace(self, vertices=vertices, normals=normals, tangents=tangents)


def check_indices(label: str, index: npt.NDArray[np.int64], count: int) -> None:
    """Check that the vertex indices of faces are below ``count``.

    Raises:
        SceneError: An index is out of range; the message begins with ``label``.
    """
    if index.size and not (index.min() >= 0 and index.max() < count):
        wrong = int(index.max() if index.max() >= count else index.min())
        raise SceneError(f"{label}: a face has vertex index {wrong}; there are {count} vertices from 0 on")


def strip_triangles(indices: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return the triangles, (m, 3), of strips that negative indices separate; all have their strip's orientation."""
    place = np.arange(len(indices))
    start = np.maximum.accumulate(np.where(indices < 0, place + 1, 0))
    odd = ((place - start) % 2 == 1)[:-2]
    a, b, c = indices[:-2], indices[1:-1], indices[2:]
    found = np.stack([a, np.where(odd, c, b), np.where(odd, b, c)], axis=-1)
    return found[(found >= 0).all(axis=1)]


def join_parts(source: MeshSource, parts: list[MeshPart]) -> Mesh:
    """Return one mesh of all parts.

    Args:
        source: The file, with the pictures that materials refer to.
        parts: One or more.

    Raises:
        SceneError: A vertex is too far from the origin after all transforms.
    """
    vertices = np.concatenate([part.vertices for part in parts])
    if not (np.abs(vertices) < LARGEST).all():
        raise SceneError(f"{source.path}: its nodes put a vertex beyond {LARGEST:g}")
    materials: dict[MeshMaterial, int] = {}
    said = any(part.material is not None for part in parts) or any(part.colors is not None for part in parts)
    numbers = []
    for part in parts:
        material = _without_lost(part, source) if said else MeshMaterial()
        numbers.append(np.full(len(part.faces), materials.setdefault(material, len(materials)), dtype=np.int32))
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    known = tuple(_with_spans(material, source.images) for material in materials)
    return make_mesh(
        vertices,
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)]),
        np.concatenate([part.normals for part in parts]),
        filled(parts, [part.uvs[0] for part in parts], (0.0, 0.0)),
        uvs_second=filled(parts, [part.uvs[1] for part in parts], (0.0, 0.0)),
        colors=filled(parts, [part.colors for part in parts], (1.0, 1.0, 1.0, 1.0)),
        tangents=filled(parts, [part.tangents for part in parts], (1.0, 0.0, 0.0, 1.0)),
        triangle_materials=np.concatenate(numbers) if len(known) > 1 else None,
        materials=known if said else (),
        images=tuple(source.images),
        notes=tuple(source.notes),
    )


def _without_lost(part: MeshPart, source: MeshSource) -> MeshMaterial:
    """Return a part's material without the textures for which the part has no texture coordinates."""
    if part.material is None:
        # Vertex colours are the surface's reflectance, not a factor of another colour.
        white = LambertMaterial((1.0, 1.0, 1.0))
        return MeshMaterial() if part.colors is None else MeshMaterial(surface=white)
    material = part.material
    for field in dataclasses.fields(material):
        use = getattr(material, field.name)
        if isinstance(use, TextureUse) and part.uvs[use.uv_set] is None:
            gone: dict[str, Any] = {field.name: None}
            material = dataclasses.replace(material, **gone)
            source.note("a texture on triangles without texture coordinates")
    return material


def _with_spans(material: MeshMaterial, images: list[npt.NDArray[np.uint8]]) -> MeshMaterial:
    use = material.metallic_roughness
    if use is None:
        return material
    low, high = (getattr(images[use.image][..., 1:3], name)(axis=(0, 1)) / 255.0 for name in ("min", "max"))
    roughness, metallic = zip(low.tolist(), high.tolist(), strict=True)
    return dataclasses.replace(material, roughness_span=roughness, metallic_span=metallic)


def filled(parts: list[MeshPart], values: list[Array | None], default: tuple[float, ...]) -> Array | None:
    """Return the values of all parts' vertices, with ``default`` for parts that have none; None if no part has any."""
    if all(value is None for value in values):
        return None
    return np.concatenate(
        [
            np.tile(default, (len(part.vertices), 1)) if value is None else value
            for part, value in zip(parts, values, strict=True)
        ]
    )


def _finite(values: Any, count: int, largest: float) -> Array | None:
    if values is None or len(values) != count or not (np.abs(values) < largest).all():
        return None
    return np.asarray(values, dtype=np.float64)
