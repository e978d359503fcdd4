"""Shapes of virtual objects: one per object, or one per part if an animation moves its parts separately.

Layers, mattes and exchange files number and name shapes; without animations these are the objects.
"""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import numpy.typing as npt

from warp_ar.scene.description import FLATTEST, Object, Scene
from warp_ar.scene.geometry import Mesh, placement
from warp_ar.scene.mesh_parts import LARGEST
from warp_ar.scene.node_animation import Bend, MovingMesh
from warp_ar.scene.object_materials import moving_mesh_of

Array = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class ObjectShape:
    """Object, or a separately moving part of one."""

    item: Object
    index: int
    """Index of the object in its scene."""
    moving: MovingMesh | None = None
    """Animation that the object plays; None: the object is a single shape."""
    part: int = 0
    """Index of the part in ``moving``."""

    @property
    def mesh(self) -> Mesh | None:
        """Return the triangles of the part; None if the object is a single shape."""
        return None if self.moving is None else self.moving.parts[self.part].mesh

    @property
    def bend(self) -> Bend | None:
        """Return the function from a time to the part's deformed triangles; None if the part is rigid."""
        return None if self.moving is None else self.moving.parts[self.part].bend


def object_shapes(scene: Scene) -> tuple[ObjectShape, ...]:
    """Return the shapes of a scene's objects, in their order.

    Raises:
        SceneError: A file has no such animation, or is damaged.
    """
    found: list[ObjectShape] = []
    for index, item in enumerate(scene.objects):
        moving = moving_mesh_of(item)
        if moving is None:
            found.append(ObjectShape(item, index))
        else:
            found += [ObjectShape(item, index, moving, part) for part in range(len(moving.parts))]
    return tuple(found)


def part_placements(item: Object, moving: MovingMesh, seconds: float) -> Array:
    """Return ``world_from_part`` of an object's parts, (parts, 4, 4).

    They are relative to the object's own marker if it has one.

    Args:
        item: The object.
        moving: Animation that the object plays.
        seconds: Time since the first frame.
    """
    assert item.play is not None
    rotation, position = item.pose_at(seconds)
    own = placement(item.scale * rotation @ item.stretch_matrix(), position)
    with np.errstate(over="ignore", invalid="ignore"):  # products of large scales overflow; see split_linear
        placed: Array = own @ moving.transforms_at(item.play.time_at(seconds, moving.duration))
    return placed


_RIGID = 1e-6
"""Largest relative difference of lengths that counts as single-precision rounding."""


def split_linear(linear: Array) -> tuple[float, Array, Array, float]:
    """Factor a linear map, (3, 3), for a record of ``structs.Shape``.

    Returns:
        Length of the longest image of a unit vector, 0 if the map is degenerate; the map divided by that length; the
        inverse of this matrix; and the ratio of the longest to the shortest image of a unit vector, 0 for a rotation
        with uniform scale.
    """
    nothing = 0.0, np.eye(3), np.eye(3), 0.0
    if not (np.abs(linear) < LARGEST).all():
        return nothing
    lengths = np.linalg.svd(linear, compute_uv=False)
    longest, shortest = float(lengths[0]), float(lengths[-1])
    if not longest < FLATTEST * shortest:
        return nothing
    if shortest > (1.0 - _RIGID) * longest and np.linalg.det(linear) > 0.0:
        scale = float(np.cbrt(np.linalg.det(linear)))
        return scale, linear / scale, linear.T / scale, 0.0
    rotation: Array = linear / longest
    return longest, rotation, np.asarray(np.linalg.inv(rotation), dtype=np.float64), longest / shortest


def shape_label(shape: ObjectShape) -> str:
    """Return a name for a shape, as used for its matte."""
    name = shape.item.file.stem if shape.item.file else shape.item.shape
    return f"object_{shape.index}_{name}" + (f"_part_{shape.part}" if shape.part else "")


def surface_names(scene: Scene) -> tuple[str, ...]:
    """Return a unique name for every virtual object, proxy and mirror ball, in the order of the layer ``ids``.

    Names consist of letters, digits and underscores: ``object_0_bunny`` by its file or shape, ``proxy_1_plane``. Each
    separately moving part has a name of its own: ``object_0_truck``, ``object_0_truck_part_1``.
    """
    objects = map(shape_label, object_shapes(scene))
    proxies = (f"proxy_{k}_{one.file.stem if one.file else one.shape}" for k, one in enumerate(scene.proxies))
    balls = (f"ball_{k}" for k in range(len(scene.probes)))
    return tuple(re.sub(r"\W", "_", name, flags=re.ASCII) for name in (*objects, *proxies, *balls))
