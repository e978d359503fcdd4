"""Checks of what scene dataclasses are made of in Python; files are checked as they are read.

Values that are not finite pass here: ``finite.check_finite`` names them with their place in the scene.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Collection
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from warp_ar.errors import SceneError
from warp_ar.scene.messages import nearest


def fail(item: object, key: str, right: str) -> NoReturn:
    """Raise the error that names class, field, value and what would be right.

    Raises:
        SceneError: Always.
    """
    value = repr(getattr(item, key))
    shown = value if len(value) <= 80 else f"{value[:60]}..."
    raise SceneError(f"{type(item).__name__}: {key} = {shown}: {right}")


def check_choice(item: object, key: str, choices: Collection[str]) -> None:
    """Check that a field is one of several words.

    Raises:
        SceneError: It is not; so with all checks here.
    """
    value = getattr(item, key)
    if not isinstance(value, str) or value not in choices:
        fail(
            item, key, f"unknown; {nearest(str(value), choices)}" if value else f"expected one of {', '.join(choices)}"
        )


def check_number(
    item: object, key: str, *, above: float | None = None, low: float | None = None, high: float = math.inf
) -> None:
    """Check that a field is a number above ``above``, or from ``low`` to ``high``."""
    _check_range(item, key, (getattr(item, key),), None, above, low, high)


def check_vector(
    item: object,
    key: str,
    size: int | None = 3,
    *,
    above: float | None = None,
    low: float | None = None,
    high: float = math.inf,
) -> None:
    """Check that a field is as many numbers as ``size``, each above ``above``, or from ``low`` to ``high``."""
    value = getattr(item, key)
    if not isinstance(value, Collection) or isinstance(value, str) or (size is not None and len(value) != size):
        fail(item, key, f"expected {size or 'several'} numbers")
    _check_range(item, key, tuple(value), size, above, low, high)


def check_reflectance(item: object, key: str) -> None:
    """Check that a field is a colour from 0 to 1, or the path of a texture."""
    if not isinstance(getattr(item, key), Path):
        check_vector(item, key, low=0.0, high=1.0)


def _check_range(
    item: object,
    key: str,
    values: tuple[Any, ...],
    size: int | None,
    above: float | None,
    low: float | None,
    high: float,
) -> None:
    many = "" if size is None else f"{size} numbers, each "
    bound = "of any size"
    if above is not None:
        bound = f"above {above:g}"
    elif low is not None:
        bound = f"from {low:g} to {high:g}" if high < math.inf else f"{low:g} or more"
    for value in values:
        if isinstance(value, bool) or not isinstance(value, numbers.Real | np.generic):
            fail(item, key, f"expected {many or 'a number '}{bound}")
        number = float(value)  # written so that NaN passes
        if (above is not None and number <= above) or (low is not None and number < low) or number > high:
            fail(item, key, f"expected {many or 'a number '}{bound}")
