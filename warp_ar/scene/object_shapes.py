"""The shapes that virtual objects are: one each, but for those whose file moves them in several parts.

Layers, mattes and exchange files number and name shapes; where nothing is played, these are the objects.
"""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import numpy.typing as npt

from warp_ar.scene.description import Object, Scene
from warp_ar.scene.geometry import Mesh
from warp_ar.scene.mesh_parts import LARGEST
from warp_ar.scene.node_animation import Bend, MovingMesh
from warp_ar.scene.object_materials import moving_mesh_of

Array = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class ObjectShape:
    """An object, or a part of one that moves by itself."""

    item: Object
    index: int
    """Number of the object in its scene."""
    moving: MovingMesh | None = None
    """Animation that the object plays; None: it is one shape."""
    part: int = 0
    """Number of the part in ``moving``."""

    @property
    def mesh(self) -> Mesh | None:
        """Triangles of the part; None where the object is one shape."""
        return None if self.moving is None else self.moving.parts[self.part].mesh

    @property
    def bend(self) -> Bend | None:
        """Function from a time to the part's triangles; None: they are always the same."""
        return None if self.moving is None else self.moving.parts[self.part].bend


def object_shapes(scene: Scene) -> tuple[ObjectShape, ...]:
    """Shapes of a scene's objects, in their order.

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
    """``world_from_part`` of an object's parts, (parts, 4, 4), in its marker's frame where it has one.

    Args:
        item: The object.
        moving: What it plays.
        seconds: Since the first frame.
    """
    assert item.play is not None
    rotation, position = item.pose_at(seconds)
    own = np.eye(4)
    own[:3, :3], own[:3, 3] = item.scale * rotation, position
    with np.errstate(over="ignore", invalid="ignore"):  # a chain of large scales; see split_linear
        placed: Array = own @ moving.transforms_at(item.play.time_at(seconds, moving.duration))
    return placed


@dataclasses.dataclass(frozen=True)
class Stretch:
    """A linear map (3, 3) as a record of ``structs.Shape`` holds it: ``scale * rotation``."""

    scale: float
    """Length of the longest image of a unit vector; 0: the map makes nothing of a shape."""
    rotation: Array
    """The map over its scale."""
    inverse: Array
    """Inverse of ``rotation``."""
    stretch: float
    """Longest over shortest image of a unit vector; 0 for a rotation, whose inverse is its transpose."""


_RIGID = 1e-6
"""Relative difference of lengths below which single precision calls them equal."""
_FLAT = 1e-5
"""Shortest over longest image of a unit vector, below which a shape has no thickness for rays."""


def split_linear(linear: Array) -> Stretch:
    """Tell turns and even scales from all other linear maps, (3, 3)."""
    nothing = Stretch(0.0, np.eye(3), np.eye(3), 0.0)
    if not (np.abs(linear) < LARGEST).all():
        return nothing
    lengths = np.linalg.svd(linear, compute_uv=False)
    longest, shortest = float(lengths[0]), float(lengths[-1])
    if not shortest > _FLAT * longest:
        return nothing
    if shortest > (1.0 - _RIGID) * longest and np.linalg.det(linear) > 0.0:
        scale = float(np.cbrt(np.linalg.det(linear)))
        return Stretch(scale, linear / scale, linear.T / scale, 0.0)
    rotation: Array = linear / longest
    return Stretch(longest, rotation, np.asarray(np.linalg.inv(rotation), dtype=np.float64), longest / shortest)


def shape_label(shape: ObjectShape) -> str:
    """Words for a shape, as in the name of its matte."""
    name = shape.item.file.stem if shape.item.file else shape.item.shape
    return f"object_{shape.index}_{name}" + (f"_part_{shape.part}" if shape.part else "")


def surface_names(scene: Scene) -> tuple[str, ...]:
    """A name for every surface, in the order of the layer ``ids``: virtual objects, proxies, mirror balls.

    Letters, digits and underscores, each name once: ``object_0_bunny`` by its file or its shape, ``proxy_1_plane``. Of
    an object whose file moves it in parts, each part has a name: ``object_0_truck``, ``object_0_truck_part_1``.
    """
    objects = map(shape_label, object_shapes(scene))
    proxies = (f"proxy_{k}_{one.file.stem if one.file else one.shape}" for k, one in enumerate(scene.proxies))
    balls = (f"ball_{k}" for k in range(len(scene.probes)))
    return tuple(re.sub(r"\W", "_", name, flags=re.ASCII) for name in (*objects, *proxies, *balls))
