"""Access to the virtual objects of a running pipeline by name, to move, paint, add and remove them between frames."""

from __future__ import annotations

import dataclasses
import numbers
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError, UsageError
from warp_ar.scene import Material, Object, object_at
from warp_ar.scene.messages import nearest
from warp_ar.scene.node_animation import NodeTrack

Edit: TypeAlias = Callable[[tuple[Object, ...]], Sequence[Object]]
"""Function from the scene's current objects to the objects of the next frame."""


class SceneObjects:
    """Objects of a pipeline's scene. An edit is made by ``Pipeline.change`` and takes effect in the next frame."""

    def __init__(self, objects: Callable[[], tuple[Object, ...]], edit: Callable[[Edit], None]) -> None:
        """Store a function that returns the objects and one that edits them."""
        self._objects, self._edit = objects, edit

    def __repr__(self) -> str:
        """Return a text with the shape of every object by its name or index."""
        shapes = {item.name or index: item.shape for index, item in enumerate(self._objects())}
        return f"SceneObjects({shapes})"

    def __len__(self) -> int:
        """Return the number of objects."""
        return len(self._objects())

    def __iter__(self) -> Iterator[SceneObject]:
        """Yield every object."""
        return (self[item.name or index] for index, item in enumerate(self._objects()))

    def __contains__(self, name: object) -> bool:
        """Return True if an object has that name."""
        return name is not None and any(item.name == name for item in self._objects())

    def __getitem__(self, key: str | int) -> SceneObject:
        """Return an object by its name or its index in the scene.

        Raises:
            UsageError: No object, or more than one, has that name, or the index is out of range.
        """
        find(self._objects(), key)
        return SceneObject(self._objects, self._edit, key)

    def add(self, item: Object) -> SceneObject:
        """Append an object and return it.

        Raises:
            UsageError: ``item`` is not an ``Object``, or another object has its name.
            SceneError: A number is not finite, or a file cannot be used; the scene is unchanged.
        """
        if not isinstance(item, Object):
            raise UsageError(f"add: {type(item).__name__} given; expected an Object, or AreaLight(...).as_object()")
        if item.name in self:
            raise UsageError(f"add: there is an object {item.name!r}; give it another name, or remove that one")
        self._edit(lambda items: (*items, item))
        return self[item.name or len(self) - 1]

    def remove(self, key: str | int) -> None:
        """Remove an object by its name or index; the indices of later objects decrease by one.

        Raises:
            UsageError: No object, or more than one, has that name, or the index is out of range.
        """

        def without(items: tuple[Object, ...]) -> Sequence[Object]:
            index = find(items, key)
            return items[:index] + items[index + 1 :]

        self._edit(without)


class SceneObject:
    """Reference to one object, which is looked up by name or index at each access."""

    __slots__ = ("_edit", "_key", "_objects")  # a misspelt attribute is an error

    def __init__(self, objects: Callable[[], tuple[Object, ...]], edit: Callable[[Edit], None], key: str | int) -> None:
        """Store functions that return and edit the objects, and the name or index of this one."""
        self._objects, self._edit, self._key = objects, edit, key

    def __repr__(self) -> str:
        """Return a text with the object's name or index. The object is not looked up, as it may have been removed."""
        return f"SceneObject({self._key!r})"

    @property
    def value(self) -> Object:
        """Description of the object in the scene; it can be replaced by any other ``Object``.

        Raises:
            UsageError: The new value is not an ``Object``, or another object has its name.
        """
        items = self._objects()
        return items[find(items, self._key)]

    @value.setter
    def value(self, value: Object) -> None:
        self._replace(lambda _: value)

    def _replace(self, made: Callable[[Object], Object]) -> None:
        def edited(items: tuple[Object, ...]) -> Sequence[Object]:
            index = find(items, self._key)
            item, others = made(items[index]), (*items[:index], *items[index + 1 :])
            if not isinstance(item, Object):
                raise UsageError(f"value is {type(item).__name__}; expected an Object")
            if item.name is not None and any(item.name == other.name for other in others):
                raise UsageError(f"value: there is another object {item.name!r}; give each its own name")
            return *others[:index], item, *others[index:]

        self._edit(edited)

    @property
    def world_from_object(self) -> npt.NDArray[np.float64]:
        """Affine transform without animation, (4, 4), metres.

        If the object is attached to a marker of its own, that marker's frame takes the place of the world.

        Raises:
            SceneError: ``object_at`` cannot represent the new value.
        """
        item, matrix = self.value, np.eye(4)
        rotation, matrix[:3, 3] = dataclasses.replace(item, animate=None).pose_at(0.0)
        matrix[:3, :3] = item.scale * rotation @ item.stretch_matrix()
        return matrix

    @world_from_object.setter
    def world_from_object(self, matrix: Any) -> None:
        self._replace(lambda item: object_at(item, matrix))

    def place(self, translation: Any, quaternion: Any = (0.0, 0.0, 0.0, 1.0), scale: Any = 1.0) -> None:
        """Place the object by translation, rotation and scale, as in a glTF node.

        Args:
            translation: Position in metres, (3,).
            quaternion: Rotation as x, y, z, w, of any length but 0.
            scale: Factor on all lengths, or of a mesh one for each axis, (3,).

        Raises:
            SceneError: A number is not finite, the quaternion has no length, or a scale cannot be used.
        """
        try:
            given = [np.asarray(value, np.float64) for value in (translation, quaternion, scale)]
        except (TypeError, ValueError):
            given = []
        length = np.linalg.norm(given[1]) if given else 0.0
        fits = [value.shape for value in given] in ([(3,), (4,), ()], [(3,), (4,), (3,)])
        if not fits or not 0.0 < length < np.inf:
            raise SceneError("place: expected 3 numbers, a quaternion x, y, z, w with a length, and 1 or 3 scales")
        self.world_from_object = NodeTrack(given[0], given[1] / length, given[2], {}).transform_at(0.0)

    @property
    def material(self) -> Material:
        """Material in the scene. A new value of the same model with the same textures changes numbers only."""
        return self.value.material

    @material.setter
    def material(self, material: Material) -> None:
        self._replace(lambda item: dataclasses.replace(item, material=material))


def find(items: Sequence[Object], key: str | int) -> int:
    """Return the index of the object with a name or index.

    Raises:
        UsageError: No object, or more than one, has that name, or the index is out of range.
    """
    if isinstance(key, numbers.Integral) and not isinstance(key, bool) and 0 <= key < len(items):
        return int(key)
    found = [index for index, item in enumerate(items) if item.name == key and key is not None]
    if len(found) == 1:
        return found[0]
    if found:
        raise UsageError(f"objects: {len(found)} have the name {key!r}; give each its own, or use its number")
    if not items:
        raise UsageError(f"objects: there is no {key!r}: the scene has no objects")
    names = [item.name for item in items if item.name is not None]
    known = nearest(str(key), names) if names else "none has a name"
    raise UsageError(f"objects: there is no {key!r}: {known}; numbers run from 0 to {len(items) - 1}")
