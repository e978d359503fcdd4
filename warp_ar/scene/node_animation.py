"""Nodes that a file moves: keyframes, the ways between them, and transforms of what hangs on the nodes.

A sampler has times t_k and values v_k. Before the first and after the last key it holds the end's value. Between them,
with d = t_{k+1} - t_k and s = (t - t_k) / d, glTF 2.0 (appendix C) has three ways:

- ``STEP``: v_k;
- ``LINEAR``: (1 - s) v_k + s v_{k+1}; rotations go along the shorter arc, at even speed;
- ``CUBICSPLINE``, with tangents in a and out b of each key:
  (2s^3 - 3s^2 + 1) v_k + d (s^3 - 2s^2 + s) b_k + (-2s^3 + 3s^2) v_{k+1} + d (s^3 - s^2) a_{k+1}; rotations are
  normalized afterwards.

A node's transform is T R S. What hangs on one moving node is one ``MovingPart``: a mesh in that node's coordinates,
which is never built again, but for what skins and morph targets bend: its vertices are those of the frame's time.

References:
    Khronos, glTF 2.0 specification, 3.11 and appendix C.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

from warp_ar.scene.geometry import Mesh, quaternion_matrix

Array = npt.NDArray[np.float64]
Bend: TypeAlias = Callable[[float], Mesh]
"""Function that gives a mesh at a time of the animation; only vertices, normals and tangents change."""

WIDTHS: Final[Mapping[str, int]] = {"translation": 3, "rotation": 4, "scale": 3}
"""Numbers of what a channel moves."""
INTERPOLATIONS: Final = ("LINEAR", "STEP", "CUBICSPLINE")


@dataclasses.dataclass(frozen=True, eq=False)
class Sampler:
    """Keyframes of one property of one node."""

    times: Array
    """Seconds, (n,), not decreasing."""
    values: Array
    """(n, w); of ``CUBICSPLINE`` (n, 3, w): tangent in, value, tangent out. For morph targets w is their number."""
    interpolation: str
    """One of ``INTERPOLATIONS``."""
    turns: bool = False
    """True if values are quaternions, x first."""

    def at(self, seconds: float) -> Array:
        """The value, (w,); a quaternion is a unit one."""
        cubic = self.interpolation == "CUBICSPLINE"
        keys = self.values[:, 1] if cubic else self.values
        last = len(self.times) - 1
        k = int(np.searchsorted(self.times, seconds, side="right")) - 1
        if k < 0 or k >= last or self.interpolation == "STEP":
            found = keys[min(max(k, 0), last)]
        else:
            length = self.times[k + 1] - self.times[k]
            s = (seconds - self.times[k]) / length
            if cubic:
                found = self._cubic(k, s, length)
            elif self.turns:
                from trimesh.transformations import quaternion_slerp  # here, for scenes without animations do without

                return np.array(quaternion_slerp(_unit(keys[k]), _unit(keys[k + 1]), s))
            else:
                found = (1.0 - s) * keys[k] + s * keys[k + 1]
        return _unit(found) if self.turns else np.array(found)

    def _cubic(self, k: int, s: float, length: float) -> Array:
        value, leaving = self.values[k, 1], self.values[k, 2]
        arriving, following = self.values[k + 1, 0], self.values[k + 1, 1]
        s2, s3 = s * s, s * s * s
        found: Array = (
            (2.0 * s3 - 3.0 * s2 + 1.0) * value
            + length * (s3 - 2.0 * s2 + s) * leaving
            + (3.0 * s2 - 2.0 * s3) * following
            + length * (s3 - s2) * arriving
        )
        return found


def _unit(quaternion: Array) -> Array:
    """A quaternion of length 1; no turn where a spline passes through zero."""
    length = float(np.linalg.norm(quaternion))
    return quaternion / length if length > 0.0 else np.array([0.0, 0.0, 0.0, 1.0])


@dataclasses.dataclass(frozen=True, eq=False)
class NodeTrack:
    """Movement of one node in its parent."""

    translation: Array
    """(3,); where no sampler says another."""
    rotation: Array
    """Unit quaternion, x first, likewise."""
    scale: Array
    """(3,), likewise."""
    samplers: Mapping[str, Sampler]
    """Samplers by the names of ``WIDTHS``."""

    def transform_at(self, seconds: float) -> Array:
        """``parent_from_node``, (4, 4), at a time of the animation."""

        def now(name: str, still: Array) -> Array:
            return self.samplers[name].at(seconds) if name in self.samplers else still

        result = np.eye(4)
        result[:3, :3] = quaternion_matrix(now("rotation", self.rotation)) * now("scale", self.scale)
        result[:3, 3] = now("translation", self.translation)
        return result


@dataclasses.dataclass(frozen=True, eq=False)
class Anchor:
    """A node that moves, below what moves it."""

    parent: int
    """The next moving node above it, by its number; -1: the file's world, turned to +Z up."""
    offset: Array
    """From its own parent to there, (4, 4): what lies between stands still."""
    track: NodeTrack


@dataclasses.dataclass(frozen=True, eq=False)
class MovingPart:
    """Triangles that move as one."""

    mesh: Mesh
    """In the coordinates of its anchor."""
    anchor: int
    """Index of its moving node; -1 for a part that stands still in the file's world."""
    bend: Bend | None = None
    """Skin and morph targets of the mesh; None for a rigid part."""


@dataclasses.dataclass(frozen=True, eq=False)
class MovingMesh:
    """A file's triangles under one of its animations."""

    rest: Mesh
    """All of them at time 0; its materials and pictures are those of the parts."""
    parts: tuple[MovingPart, ...]
    anchors: tuple[Anchor, ...]
    """Each after its parent."""
    duration: float
    """Time of the last key, in seconds."""

    def transforms_at(self, seconds: float) -> Array:
        """``file_from_part`` of every part, (parts, 4, 4), at a time of the animation; the file's world is +Z up."""
        return part_transforms(self.anchors, [part.anchor for part in self.parts], seconds)


def part_transforms(anchors: tuple[Anchor, ...], wanted: list[int], seconds: float) -> Array:
    """``file_from_anchor`` of the wanted anchors, (n, 4, 4)."""
    found: list[Array] = []
    for anchor in anchors:
        own = anchor.offset @ anchor.track.transform_at(seconds)
        found.append(own if anchor.parent < 0 else found[anchor.parent] @ own)
    return np.stack([np.eye(4) if number < 0 else found[number] for number in wanted])
