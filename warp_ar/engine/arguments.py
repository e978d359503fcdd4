"""Checks of what callers give a pipeline: one line says what is wrong and what would be right."""

from __future__ import annotations

import math
import numbers
import os
import pathlib
import typing
from collections.abc import Sequence

from warp_ar.engine.layers import check_outputs, expand_outputs
from warp_ar.errors import UsageError
from warp_ar.scene import Scene, load_scene
from warp_ar.scene.fields import check_finite
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


def check_exposure(scene: Scene) -> None:
    """Check a scene's exposure.

    Raises:
        UsageError: It is no number that a camera can have.
    """
    scale = scene.exposure.scale
    if scale != "auto" and (isinstance(scale, str) or not 0.0 <= scale < math.inf):
        raise UsageError(f'exposure.scale = {scale!r}: expected a finite number, 0 or more, or "auto"')


def read_scene(scene: object) -> Scene:
    """Return the scene that was given, checked.

    Raises:
        SceneError: It cannot be read, or one of its numbers is not finite.
        UsageError: It is none.
    """
    if isinstance(scene, str | os.PathLike):
        scene = load_scene(scene if isinstance(scene, str) else pathlib.Path(scene))
    if not isinstance(scene, Scene):
        raise UsageError(f"scene is {type(scene).__name__}; expected a Scene, a scene file, or a bundled name")
    check_exposure(scene)
    check_finite(scene)
    return scene


def check_frames(exposures: Sequence[float], outputs: tuple[str, ...], linear: bool) -> tuple[str, ...]:
    """The outputs, expanded, of frames that can be lit.

    Raises:
        UsageError: An exposure is none, an output is unknown, or frames of several exposures are linear.
    """
    for exposure in exposures:
        check_number("exposures", exposure, above=0.0)
    check_outputs(outputs)
    if linear and exposures:
        raise UsageError("linear frames of several exposures cannot be merged; give them as 8-bit codes")
    return expand_outputs(outputs)
