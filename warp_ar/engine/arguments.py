"""Checks of a pipeline's arguments; each error is one line that names the fault and the remedy."""

from __future__ import annotations

import math
from collections.abc import Sequence

from warp_ar.declared import fits
from warp_ar.engine.layers import check_outputs, expand_outputs
from warp_ar.errors import UsageError
from warp_ar.scene.messages import nearest
from warp_ar.stages import STAGES
from warp_ar.stages.features import AREA_SAMPLES
from warp_ar.stages.quality import Quality


def check_number(name: str, value: object, above: float = -math.inf) -> None:
    """Check that an argument, a number of seconds, is finite and greater than ``above``.

    Args:
        name: Name of the argument in messages.
        value: Its value, of any type.
        above: Lower bound, which the value must exceed.

    Raises:
        UsageError: The value is not a finite number, or not above the bound.
    """
    if not fits(value, float) or value <= above:  # type: ignore[operator]
        right = "a finite number of seconds" if above == -math.inf else f"a finite number of seconds above {above:g}"
        raise UsageError(f"{name} = {value!r}: expected {right}")


def check_methods(quality: Quality) -> None:
    """Check that the stages and methods that a ``Quality`` names exist.

    Raises:
        UsageError: A stage or method does not exist.
    """
    shared = {"area_light": tuple(AREA_SAMPLES), "light_shadow": ("hard", "soft")}
    known = {stage.name: ("default", *stage.methods) for stage in STAGES} | shared
    for stage, method in quality.methods:
        if method not in known.get(stage, ()):
            right = nearest(method, known[stage]) if stage in known else f"no such stage; {nearest(stage, known)}"
            raise UsageError(f"quality: methods: {stage!r} by {method!r}: {right}")


def check_frames(exposures: Sequence[float], outputs: tuple[str, ...]) -> tuple[str, ...]:
    """Check the arguments that describe frames; return the outputs with ``radiance`` expanded to its layers.

    Args:
        exposures: Exposure times of the frames, seconds.
        outputs: Names of the outputs.

    Raises:
        UsageError: An exposure is invalid, or an output is unknown.
    """
    for exposure in exposures:
        check_number("exposures", exposure, above=0.0)
    check_outputs(outputs)
    return expand_outputs(outputs)
