"""Numbers of a scene that was made in Python: files are checked as they are read, dataclasses are not."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

from warp_ar.errors import SceneError
from warp_ar.scene.description import Scene


def check_finite(scene: Scene, *, leave: tuple[str, ...] = ()) -> None:
    """Raise an error if a number of a scene is not finite: it would be every pixel's.

    Args:
        scene: The scene.
        leave: Names of its fields that are known to be in order.

    Raises:
        SceneError: A number is infinite or none; the message names it.
    """
    for field in dataclasses.fields(scene):
        if field.name not in leave:
            for name in _not_finite(getattr(scene, field.name), field.name):
                raise SceneError(f"{name}: expected a finite number")


def _not_finite(value: Any, name: str) -> Iterator[str]:
    """What is not finite in a value, with its name."""
    if isinstance(value, float):
        if not math.isfinite(value):
            yield f"{name} = {value}"
    elif isinstance(value, tuple):
        for index, item in enumerate(value):
            yield from _not_finite(item, f"{name}[{index}]")
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from _not_finite(getattr(value, field.name), f"{name}.{field.name}")
