"""A file's triangles, cut into what moves as one."""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError
from warp_ar.scene.geometry import Mesh
from warp_ar.scene.gltf import GltfContents
from warp_ar.scene.mesh_parts import MeshPart, join_parts
from warp_ar.scene.node_animation import Anchor, MovingMesh, MovingPart, part_transforms

MOST_PARTS: Final = 256
"""Each is a shape of its own, and a ray asks all of them."""


def moving_mesh(label: str, contents: GltfContents) -> MovingMesh:
    """One mesh for all that stands still, and one for every moving node that triangles hang on.

    Args:
        label: The file, for messages.
        contents: Of the file, with an animation.

    Raises:
        SceneError: More than ``MOST_PARTS`` nodes move, or a vertex lies too far off.
    """
    carriers = sorted(set(contents.carriers))
    if len(carriers) > MOST_PARTS:
        raise SceneError(
            f"{label}: its animation moves {len(carriers):,} parts; at most {MOST_PARTS} are: join meshes, or leave "
            "out the object's play"
        )
    placed = list(zip(contents.parts, contents.carriers, strict=True))
    groups = [[part for part, on in placed if on == one] for one in carriers]
    joint = join_parts(label, [part for group in groups for part in group], contents.images, contents.notes)
    anchors, renamed = _used(contents.anchors, carriers)
    parts = []
    vertex = face = 0
    for carrier, group in zip(carriers, groups, strict=True):
        vertices, faces = (sum(len(getattr(part, name)) for part in group) for name in ("vertices", "faces"))
        parts.append(MovingPart(_cut(joint, vertex, vertices, face, faces), renamed.get(carrier, -1)))
        vertex, face = vertex + vertices, face + faces
    transforms = part_transforms(anchors, [part.anchor for part in parts], 0.0)
    return MovingMesh(_at_rest(joint, parts, transforms), tuple(parts), anchors, contents.duration)


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


def _cut(joint: Mesh, vertex: int, vertices: int, face: int, faces: int) -> Mesh:
    """A run of vertices and faces, with all materials and pictures."""

    def run(values: npt.NDArray[Any] | None, start: int, count: int) -> Any:
        return None if values is None else np.ascontiguousarray(values[start : start + count])

    own = {
        name: run(getattr(joint, name), vertex, vertices)
        for name in ("vertices", "normals", "uvs", "uvs_second", "colors", "tangents")
    }
    numbers = run(joint.triangle_materials, face, faces)
    cut_faces = np.ascontiguousarray(joint.faces[face : face + faces] - np.int32(vertex))
    return dataclasses.replace(joint, faces=cut_faces, triangle_materials=numbers, **own)


def _at_rest(joint: Mesh, parts: list[MovingPart], transforms: npt.NDArray[np.float64]) -> Mesh:
    """All parts where they stand at time 0."""
    vertices, normals, tangents, faces = [], [], [], []
    start = 0
    for part, transform in zip(parts, transforms, strict=True):
        mesh = part.mesh
        whole = MeshPart(
            mesh.vertices.astype(np.float64),
            mesh.faces.astype(np.int64),
            mesh.normals.astype(np.float64),
            tangents=None if mesh.tangents is None else mesh.tangents.astype(np.float64),
        )
        # A node may have no size at first: what hangs on it then is a point.
        moved = whole.moved(transform) or dataclasses.replace(
            whole, vertices=np.tile(transform[:3, 3], (len(whole.vertices), 1))
        )
        vertices.append(moved.vertices)
        normals.append(moved.normals)
        tangents.append(moved.tangents)
        faces.append(moved.faces + start)
        start += len(moved.vertices)

    def joined(values: list[Any], dtype: Any) -> Any:
        return None if values[0] is None else np.ascontiguousarray(np.concatenate(values), dtype=dtype)

    return dataclasses.replace(
        joint,
        vertices=joined(vertices, np.float32),
        faces=joined(faces, np.int32),
        normals=joined(normals, np.float32),
        tangents=joined(tangents, np.float32),
    )
