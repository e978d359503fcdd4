"""Checks of what callers give a pipeline: one line says what is wrong and what would be right."""

from __future__ import annotations

import math
import numbers
import os
import pathlib
import typing
from collections.abc import Collection, Sequence
from typing import Any, Final

import numpy as np

from warp_ar.engine.layers import check_outputs, expand_outputs
from warp_ar.errors import UsageError
from warp_ar.scene import Camera, CapturedLight, Exposure, Light, Marker, Object, Probe, Proxy, Scene, load_scene
from warp_ar.stages.request import Estimates


def check_number(name: str, value: object, above: float = -math.inf) -> None:
    """Check an argument that is a number of seconds.

    Raises:
        UsageError: It is no finite number, or not above the bound.
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Real) or not math.isfinite(value) or value <= above:
        right = "a finite number of seconds" if above == -math.inf else f"a finite number of seconds above {above:g}"
        raise UsageError(f"{name} = {value!r}: expected {right}")


def check_estimates(estimates: object) -> None:
    """Check an argument that says how to wait for light that is estimated.

    Raises:
        UsageError: There is no such way.
    """
    ways = typing.get_args(Estimates)
    if estimates not in ways:
        raise UsageError(f"estimates = {estimates!r}: expected {', '.join(map(repr, ways))}")


_ONE: Final[dict[str, Any]] = {
    "camera": Camera,
    "marker": Marker,
    "exposure": Exposure,
    "captured": CapturedLight | None,
}
_SEVERAL: Final[dict[str, Any]] = {"objects": Object, "lights": Light, "proxies": Proxy, "probes": Probe}


def check_scene(scene: Any) -> None:
    """Check a scene that a program may have made.

    Raises:
        UsageError: It is no scene, or a part of it is something else.
    """
    if not isinstance(scene, Scene):
        raise UsageError(f"scene is {type(scene).__name__}; expected a Scene, a scene file, or a bundled name")
    for name, kind in (_ONE | _SEVERAL).items():
        value = getattr(scene, name)
        if name in _SEVERAL and not isinstance(value, tuple | list):
            raise UsageError(f"scene.{name} is {type(value).__name__}; expected a tuple of {kind.__name__}")
        for item in value if name in _SEVERAL else (value,):
            if not isinstance(item, kind):
                right = getattr(kind, "__name__", str(kind))
                raise UsageError(f"scene.{name} holds {type(item).__name__}; expected {right}")


def read_scene(scene: object) -> Scene:
    """Return the scene that was given, checked.

    Raises:
        SceneError: It cannot be read.
        UsageError: It is none, or a part of it is something else.
    """
    if isinstance(scene, str | os.PathLike):
        scene = load_scene(scene if isinstance(scene, str) else pathlib.Path(scene))
    check_scene(scene)
    return typing.cast(Scene, scene)


def check_counts(name: str, value: object, count: int) -> None:
    """Check an argument that is one whole number above 0, or several; None passes.

    Raises:
        UsageError: It is not.
    """
    values = value if isinstance(value, tuple | list) and count > 1 else (value,)
    whole = all(isinstance(one, int | np.integer) and not isinstance(one, bool) and one > 0 for one in values)
    if value is not None and not (whole and len(values) == count):
        right = "a whole number above 0" if count == 1 else f"{count} whole numbers above 0"
        raise UsageError(f"{name} = {value!r}: expected {right}")


def check_frames(exposures: Sequence[float], outputs: tuple[str, ...], linear: bool) -> tuple[str, ...]:
    """The outputs, expanded, of frames that can be lit.

    Raises:
        UsageError: An exposure is none, an output is unknown, or frames of several exposures are linear.
    """
    for name, value in (("exposures", exposures), ("outputs", outputs)):
        if isinstance(value, str) or not isinstance(value, Collection):
            raise UsageError(f"{name} = {value!r}: expected a tuple")
    for exposure in exposures:
        check_number("exposures", exposure, above=0.0)
    check_outputs(outputs)
    if linear and exposures:
        raise UsageError("linear frames of several exposures cannot be merged; give them as 8-bit codes")
    return expand_outputs(outputs)
