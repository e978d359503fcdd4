"""Checks of arguments and fields against their declared types; floats must be finite."""

from __future__ import annotations

import functools
import inspect
import math
import numbers
import os
import types
import typing
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal, ParamSpec, TypeVar

import numpy as np

from warp_ar.errors import UsageError

_P = ParamSpec("_P")
_R = TypeVar("_R")


def _is_real(value: object) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


_PLAIN: Final[dict[Any, tuple[str, Callable[[Any], bool]]]] = {
    Any: ("anything", lambda value: True),
    None: ("None", lambda value: value is None),
    bool: ("True or False", lambda value: isinstance(value, bool | np.bool_)),
    int: ("a whole number", lambda value: _is_real(value) and isinstance(value, numbers.Integral)),
    float: ("a finite number", lambda value: _is_real(value) and abs(value) < math.inf),
    str: ("text", lambda value: isinstance(value, str)),
    Path: ("a path", lambda value: isinstance(value, os.PathLike)),
    os.PathLike: ("a path", lambda value: isinstance(value, os.PathLike)),
}
"""Descriptions of types for messages, each with its check."""


def _parts(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return a type's origin and its type arguments."""
    origin = typing.get_origin(hint) or hint
    return (None if origin is type(None) else origin), typing.get_args(hint)


def fits(value: Any, hint: Any) -> bool:
    """Return True if a value has the declared type."""
    origin, parts = _parts(hint)
    if origin in _PLAIN:
        return _PLAIN[origin][1](value)
    if origin in (types.UnionType, typing.Union):
        return any(fits(value, part) for part in parts)
    if origin is Literal:
        return isinstance(value, str) and value in parts
    if origin not in (tuple, Sequence):
        return not isinstance(origin, type) or isinstance(value, origin)
    if not isinstance(value, Collection) or isinstance(value, str | bytes | Mapping):
        return False
    if origin is Sequence or parts[-1] is Ellipsis:
        return all(fits(item, parts[0]) for item in value)
    return len(value) == len(parts) and all(map(fits, value, parts))


def words_for(hint: Any) -> str:
    """Return the description of a type for messages."""
    origin, parts = _parts(hint)
    if origin in _PLAIN:
        return _PLAIN[origin][0]
    if origin in (types.UnionType, typing.Union):
        return " or ".join(dict.fromkeys(map(words_for, parts)))
    if origin is Literal:
        return ", ".join(map(repr, parts))
    if origin in (tuple, Sequence):
        count = f"{len(parts)} times " if origin is tuple and parts[-1] is not Ellipsis else "any number of times "
        return f"a tuple of {count}{words_for(parts[0])}"
    return str(getattr(origin, "__name__", origin))


def show(value: object) -> str:
    """Return a short text of a value for messages."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else f"{text[:60]}..."


@functools.cache
def _hints_of(item: Any) -> dict[str, Any]:
    """Return the declared types of a function's parameters or a class's fields."""
    return typing.get_type_hints(item)


def check_fields(item: object) -> None:
    """Check the fields of a dataclass.

    Raises:
        UsageError: A field has another type than declared.
    """
    kind: Any = type(item)
    for name, hint in _hints_of(kind).items():
        _check(f"{kind.__name__}: {name}", getattr(item, name), hint)


def _check(name: str, value: object, hint: Any) -> None:
    if not fits(value, hint):
        raise UsageError(f"{name} = {show(value)}: expected {words_for(hint)}")


def checked(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Wrap a function to raise ``UsageError`` for an argument of another type than declared."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*given: _P.args, **named: _P.kwargs) -> _R:
        hints = _hints_of(function)
        for name, value in signature.bind_partial(*given, **named).arguments.items():
            if name in hints:
                _check(name, value, hints[name])
        return function(*given, **named)

    return call
