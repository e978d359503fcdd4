"""Node animation of a glTF file: keyframes, interpolation, and the transforms of animated parts.

A sampler has times t_k and values v_k. Before the first and after the last key it holds that key's value. Between two
keys, with d = t_{k+1} - t_k and s = (t - t_k) / d, glTF 2.0 (appendix C) defines three interpolations:

- ``STEP``: v_k;
- ``LINEAR``: (1 - s) v_k + s v_{k+1}; rotations follow the shorter arc at constant angular speed;
- ``CUBICSPLINE``, with tangents in a and out b of each key:
  (2s^3 - 3s^2 + 1) v_k + d (s^3 - 2s^2 + s) b_k + (-2s^3 + 3s^2) v_{k+1} + d (s^3 - s^2) a_{k+1}; rotations are
  normalized afterwards.

A node's transform is T R S. All triangles below one animated node form one ``MovingPart``: a mesh in that node's
coordinates. A rigid part's mesh is built once; skins and morph targets compute new vertices for every frame.

References:
    Khronos, glTF 2.0 specification, 3.11 and appendix C.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

from warp_ar.scene.geometry import Mesh, placement, quaternion_matrix

Array = npt.NDArray[np.float64]
Bend: TypeAlias = Callable[[float], Mesh]
"""Function from the animation's time in seconds to a mesh; only vertices, normals and tangents differ over time."""

WIDTHS: Final[Mapping[str, int]] = {"translation": 3, "rotation": 4, "scale": 3}
"""Number of components of each animated property."""
INTERPOLATIONS: Final = ("LINEAR", "STEP", "CUBICSPLINE")


@dataclasses.dataclass(frozen=True, eq=False)
class Sampler:
    """Keyframes of one property of one node."""

    times: Array
    """Times in seconds, (n,), in ascending order."""
    values: Array
    """Values, (n, w); for ``CUBICSPLINE`` (n, 3, w) with in-tangent, value, out-tangent. For morph targets, w is their
    number."""
    interpolation: str
    """One of ``INTERPOLATIONS``."""
    turns: bool = False
    """True if values are quaternions (x, y, z, w)."""

    def at(self, seconds: float) -> Array:
        """Return the value at a time, (w,); quaternions are normalized."""
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
                from trimesh.transformations import quaternion_slerp  # seldom needed

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
    """Return the quaternion normalized; the identity where a spline passes through zero."""
    length = float(np.linalg.norm(quaternion))
    return quaternion / length if length > 0.0 else np.array([0.0, 0.0, 0.0, 1.0])


@dataclasses.dataclass(frozen=True, eq=False)
class NodeTrack:
    """Motion of one node relative to its parent."""

    translation: Array
    """Translation, (3,), unless a sampler animates it."""
    rotation: Array
    """Unit quaternion (x, y, z, w), unless a sampler animates it."""
    scale: Array
    """Scale, (3,), unless a sampler animates it."""
    samplers: Mapping[str, Sampler]
    """Samplers by property; the names are those of ``WIDTHS``."""

    def transform_at(self, seconds: float) -> Array:
        """Return ``parent_from_node``, (4, 4), at a time of the animation."""

        def now(name: str, still: Array) -> Array:
            return self.samplers[name].at(seconds) if name in self.samplers else still

        linear = quaternion_matrix(now("rotation", self.rotation)) * now("scale", self.scale)
        return placement(linear, now("translation", self.translation))


@dataclasses.dataclass(frozen=True, eq=False)
class Anchor:
    """Animated node, relative to the next animated node above it."""

    parent: int
    """Index of the next animated node above it; -1: none, relative to the file's world rotated to +Z up."""
    offset: Array
    """Constant transform of the static nodes in between, (4, 4)."""
    track: NodeTrack


@dataclasses.dataclass(frozen=True, eq=False)
class MovingPart:
    """Triangles that move together."""

    mesh: Mesh
    """Mesh in the coordinates of the anchor."""
    anchor: int
    """Index of the animated node; -1 for a static part in the file's world."""
    bend: Bend | None = None
    """Deformation of the mesh by skin and morph targets; None for a rigid part."""


@dataclasses.dataclass(frozen=True, eq=False)
class MovingMesh:
    """Triangles of a file under one of its animations."""

    rest: Mesh
    """All triangles at time 0; the parts share its materials and pictures."""
    parts: tuple[MovingPart, ...]
    anchors: tuple[Anchor, ...]
    """Animated nodes, each after its parent."""
    duration: float
    """Time of the last key, in seconds."""

    def transforms_at(self, seconds: float) -> Array:
        """Return ``file_from_part`` of every part, (parts, 4, 4), at a time of the animation.

        The file's world is +Z up.
        """
        return part_transforms(self.anchors, [part.anchor for part in self.parts], seconds)


def part_transforms(anchors: tuple[Anchor, ...], wanted: list[int], seconds: float) -> Array:
    """Return ``file_from_anchor`` of the wanted anchors, (n, 4, 4)."""
    placed = {-1: np.eye(4)}
    for number in wanted:
        way: list[int] = []  # ancestors that are not placed yet; a file may nest thousands
        while number not in placed:
            way.append(number)
            number = anchors[number].parent
        for own in reversed(way):
            anchor = anchors[own]
            placed[own] = placed[anchor.parent] @ (anchor.offset @ anchor.track.transform_at(seconds))
    return np.stack([placed[number] for number in wanted])
