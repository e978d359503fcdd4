"""Keys of scene files: one declaration beside each field, by which files are read, checked, written and explained.

A dataclass of a section annotates its fields, ``radius: Annotated[float, Key("metres", "0.03", low=SMALLEST)]``. What a
value is (a number, a list, a word, a path, a table) follows from the type. Constructors check what they are given by
the same declarations; values that are not finite pass there, and `check_finite` names them with their place.
"""

from __future__ import annotations

import dataclasses
import math
import numbers
import types
import typing
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, NoReturn, TypeAlias

import numpy as np

from warp_ar.errors import SceneError
from warp_ar.scene.messages import LARGEST, SMALLEST, nearest


@dataclasses.dataclass(frozen=True)
class Key:
    """A key of a scene file."""

    unit: str = "-"
    """Unit of its value; a dash where it has none."""
    example: str = ""
    """A value as TOML."""
    low: float = -LARGEST
    """Least value of each number; ``SMALLEST`` reads "above 0"."""
    high: float = LARGEST
    """Largest value of each number."""
    sizes: tuple[int, ...] = (3,)
    """Numbers of a list; empty: as many as the section's kind has, by ``sides``."""
    right: str = ""
    """Words for a text, or for what lies at a path."""
    words: tuple[str, ...] = ()
    """Words that a text may be."""
    required: bool = False
    """True if a file must give it wherever the section's kind uses it, though the field has a default."""
    beside: str = ""
    """Other keys as TOML, without which the example is not complete; those that are required go without saying."""


@dataclasses.dataclass(frozen=True)
class Field:
    """A field of a dataclass with its key."""

    name: str
    key: Key
    form: str
    """Form of the value: number, integer, flag, text, word, path, vector, color or table."""
    default: Any
    """``dataclasses.MISSING`` where there is none."""
    words: tuple[str, ...] = ()
    """Words that are allowed."""
    kind: Any = None
    """Dataclass of a table."""
    optional: bool = False
    """True if the value may be None."""
    kinds: tuple[Any, ...] = ()
    """Types of which a value may be, where it is no number, list or word."""


_KINDS: Final = ("table", "path", "flag", "text")
"""Forms of which constructors check the type alone."""
_KNOWN: Final[dict[Any, dict[str, Field]]] = {}


def fields_of(kind: Any) -> dict[str, Field]:
    """Return the fields of a dataclass that are keys of a scene file, by name."""
    if kind not in _KNOWN:
        hints = typing.get_type_hints(kind, include_extras=True)
        declared = {name: typing.get_args(hint) for name, hint in hints.items() if typing.get_origin(hint) is Annotated}
        fields = (field for field in dataclasses.fields(kind) if field.name in declared)
        _KNOWN[kind] = {field.name: _field(field.name, field.default, *declared[field.name]) for field in fields}
    return _KNOWN[kind]


def _field(name: str, default: Any, hint: Any, key: Key) -> Field:
    """Return a field by its type and its key."""
    parts = typing.get_args(hint) if typing.get_origin(hint) in (types.UnionType, typing.Union) else (hint,)
    own = [part for part in parts if part is not type(None)]
    optional, first = len(own) < len(parts), own[0]
    if key.words or typing.get_origin(first) is Literal:
        return Field(name, key, "word", default, key.words or typing.get_args(first), optional=optional)
    if typing.get_origin(first) is tuple:
        return Field(name, key, "color" if Path in own else "vector", default, optional=optional)
    forms = {bool: "flag", int: "integer", float: "number", str: "text", Path: "path"}
    return Field(name, key, forms.get(first, "table"), default, kind=first, optional=optional, kinds=tuple(own))


class Checked:
    """A dataclass that checks what it is given against the keys of its fields.

    Raises:
        SceneError: A value cannot be; the message names class, field, value and what would be right.
    """

    USES: ClassVar[dict[str, tuple[str, ...]]] = {}
    """Keys that only some kinds of it use, by the kind, which is its first field."""

    def __post_init__(self) -> None:
        """Check all values."""
        every = fields_of(type(self))
        unused: set[str] = set()
        if self.USES:
            selector = next(iter(every))
            _check_word(self, every[selector], getattr(self, selector), tuple(self.USES))
            unused = not_used(self.USES, getattr(self, selector))
        for field in every.values():
            value = getattr(self, field.name)
            if field.name in unused or (value is None and field.optional):
                continue
            if field.form in _KINDS:
                _check_kind(self, field, value)
            elif field.form == "word":
                _check_word(self, field, value, field.words)
            elif field.form in ("number", "integer"):
                _check_numbers(self, field, (value,), "a number ")
                object.__setattr__(self, field.name, _plain(value))
            elif field.key.sizes and not (field.form == "color" and isinstance(value, Path)):
                count = " or ".join(map(str, field.key.sizes))
                if not isinstance(value, Collection) or isinstance(value, str) or len(value) not in field.key.sizes:
                    fail(self, field.name, f"expected {count} numbers")
                _check_numbers(self, field, tuple(value), f"{count} numbers, each ")
                object.__setattr__(self, field.name, tuple(map(_plain, value)))


def _plain(value: Any) -> Any:
    """Return a number as Python's own: scenes are compared and hashed."""
    return value.item() if isinstance(value, np.generic) else value


def not_used(uses: dict[str, tuple[str, ...]], kind: str) -> set[str]:
    """Return the keys that other kinds use, but not this one."""
    return {key for keys in uses.values() for key in keys} - set(uses[kind])


def fail(item: object, key: str, right: str) -> NoReturn:
    """Raise the error that names class, field, value and what would be right.

    Raises:
        SceneError: Always.
    """
    value = repr(getattr(item, key))
    shown = value if len(value) <= 80 else f"{value[:60]}..."
    raise SceneError(f"{type(item).__name__}: {key} = {shown}: {right}")


def _check_kind(item: object, field: Field, value: object) -> None:
    if field.form == "path" and isinstance(value, str):
        object.__setattr__(item, field.name, Path(value))
    elif not isinstance(value, field.kinds):
        fail(item, field.name, f"expected {' or '.join(kind.__name__ for kind in field.kinds)}")


def _check_word(item: object, field: Field, value: object, words: tuple[str, ...]) -> None:
    if value not in words:
        known = f"unknown; {nearest(str(value), words)}" if value else f"expected one of {', '.join(words)}"
        fail(item, field.name, known)


def _check_numbers(item: object, field: Field, values: tuple[Any, ...], what: str) -> None:
    low, high = field.key.low, field.key.high
    bound = "of any size"
    if low == SMALLEST:
        bound = "above 0"
    elif low > -LARGEST:
        bound = f"from {low:g} to {high:g}" if high < LARGEST else f"{low:g} or more"
    for value in values:
        real = isinstance(value, numbers.Real | np.generic) and not isinstance(value, bool)
        # Written so that NaN passes.
        if not real or (low > -LARGEST and float(value) < low) or (high < LARGEST and float(value) > high):
            fail(item, field.name, f"expected {what}{bound}")


def check_finite(scene: Any, *, leave: tuple[str, ...] = ()) -> None:
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
    """Yield what is not finite in a value, with its name."""
    if isinstance(value, float):
        if not math.isfinite(value):
            yield f"{name} = {value}"
    elif isinstance(value, tuple):
        for index, item in enumerate(value):
            yield from _not_finite(item, f"{name}[{index}]")
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from _not_finite(getattr(value, field.name), f"{name}.{field.name}")


Vec3: TypeAlias = tuple[float, float, float]
Place: TypeAlias = Annotated[Vec3, Key("metres", "[0.15, 0.055, 0.03]")]
Turn: TypeAlias = Annotated[Vec3, Key("degrees", "[0.0, 0.0, -25.0]")]
Length: TypeAlias = Annotated[float, Key("metres", "0.03", low=SMALLEST, required=True)]
Share: TypeAlias = Annotated[float, Key("0 to 1", "0.25", low=0.0, high=1.0)]
LIGHT_COLOR: Final = Key("linear RGB", "[1.0, 0.9, 0.7]", low=0.0)
COLOR: Final = Key("linear RGB, 0 to 1", "[1.0, 0.77, 0.34]", low=0.0, high=1.0)
