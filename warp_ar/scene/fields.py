"""Keys of scene files: one declaration beside each field, by which files are read, checked, written and explained.

A dataclass of a section annotates its fields, ``radius: Annotated[float, Key("metres", "0.03", low=SMALLEST)]``. What a
value is (a number, a list, a word, a path, a table) follows from the type. Constructors check what they are given by
these declarations; readers of files let them, and say of what they refuse in which file and at which key it stands.
"""

from __future__ import annotations

import dataclasses
import numbers
import types
import typing
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, NoReturn, TypeAlias

import numpy as np

from warp_ar.errors import SceneError
from warp_ar.scene.messages import LARGEST, SMALLEST, nearest

MOST: Final = 10**9
"""Largest whole number without another bound."""
_UNITS: Final = ("metres", "degrees", "pixels", "seconds", "frames per second")
"""Units that messages name; the others are ranges, which are said anyway."""


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
    grey: bool = False
    """True if one number may stand for a list of equal ones."""


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
    optional: bool = False
    """True if the value may be None."""
    kinds: tuple[Any, ...] = ()
    """Types of which a value may be, where it is no number, list or word."""

    def admit(self, value: Any) -> Any:
        """Return a value as the field holds it: plain numbers, tuples in place of lists, paths in place of texts.

        Raises:
            ValueError: It cannot be; the message says what would be right.
        """
        if (value is None and self.optional) or (isinstance(value, str) and value in self.words):
            return value
        if self.form in ("table", "path", "flag", "text"):
            value = Path(value) if self.form == "path" and isinstance(value, str) else value
            if isinstance(value, self.kinds):
                return value
        elif self.form in ("number", "integer"):
            if self._is_right(value):
                return int(value) if self.form == "integer" else float(value)
        elif self.form == "color" and isinstance(value, Path):
            return value
        elif self.form != "word":
            value = 3 * (value,) if self.key.grey and self._is_right(value) else value
            listed = isinstance(value, Collection) and not isinstance(value, str)
            if listed and len(value) in (self.key.sizes or (len(value),)) and all(map(self._is_right, value)):
                return tuple(map(float, value))
        raise ValueError(self._right(value))

    def _is_right(self, value: Any) -> bool:
        """Return whether a number is within the key's bounds; one that is not finite is not."""
        kinds: Any = (numbers.Integral, np.integer) if self.form == "integer" else (numbers.Real, np.generic)
        low, high = self._bounds()
        # Compared before it is converted: an integer may be too large for a float.
        return isinstance(value, kinds) and not isinstance(value, bool) and bool(low <= value <= high)

    def _bounds(self) -> tuple[float, float]:
        low, high = self.key.low, self.key.high
        if self.form == "integer":
            low, high = (0 if low == -LARGEST else low), (MOST if high == LARGEST else high)
        return low, high

    def _right(self, value: Any) -> str:
        """Return words for what would be right in the place of a value."""
        key, words = self.key, " or ".join(f'"{word}"' for word in self.words)
        match self.form:
            case "word" if len(self.words) < 8:
                return f"expected one of {words.replace(' or ', ', ')}"
            case "word":
                known = isinstance(value, str) and value
                return f"unknown; {nearest(value, self.words)}" if known else f"expected a name such as {self.words[0]}"
            case "integer":
                return "expected a whole number from {} to {}".format(*self._bounds())
            case "number":
                what, each = "a number", ""
            case "vector" | "color":
                what, each = f"a list of {' or '.join(map(str, key.sizes)) or 'several'} numbers", "each "
            case _:
                return f"expected {' or '.join(kind.__name__ for kind in self.kinds)}"
        if key.low == SMALLEST:
            bound = f", {each}above 0" if each else " above 0"
        elif key.low > -LARGEST:
            bound = f" from {key.low:g} to {key.high:g}" if key.high < LARGEST else f", {key.low:g} or more"
        else:
            bound = f", {each}finite"
        unit = f" ({key.unit})" if key.unit in _UNITS else ""
        also = f", or {words}" * bool(words) + ", or the path of a texture" * (self.form == "color")
        return f"expected {what}{bound}{unit}{also}"


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
    words = key.words or sum((typing.get_args(part) for part in parts if typing.get_origin(part) is Literal), ())
    own = [part for part in parts if part is not type(None) and typing.get_origin(part) is not Literal]
    optional = type(None) in parts
    if key.words or not own:
        return Field(name, key, "word", default, words, optional)
    if typing.get_origin(own[0]) is tuple:
        return Field(name, key, "color" if Path in own else "vector", default, (), optional)
    forms = {bool: "flag", int: "integer", float: "number", str: "text", Path: "path"}
    return Field(name, key, forms.get(own[0], "table"), default, words, optional, tuple(own))


class FieldError(SceneError):
    """A value of a dataclass cannot be."""

    key: str
    """The field."""
    right: str
    """Words for what would be right."""


class Checked:
    """A dataclass that checks what it is given against the keys of its fields.

    Raises:
        FieldError: A value cannot be.
    """

    USES: ClassVar[dict[str, tuple[str, ...]]] = {}
    """Keys that only some kinds of it use, by the kind, which is its first field."""

    def __post_init__(self) -> None:
        """Check all values."""
        unused: set[str] = set()
        for number, field in enumerate(fields_of(type(self)).values()):
            if field.name in unused:
                continue
            try:
                value = field.admit(getattr(self, field.name))
            except ValueError as error:
                fail(self, field.name, str(error))
            object.__setattr__(self, field.name, value)
            if number == 0 and self.USES:
                unused = not_used(self.USES, value)


def not_used(uses: dict[str, tuple[str, ...]], kind: str) -> set[str]:
    """Return the keys that other kinds use, but not this one."""
    return {key for keys in uses.values() for key in keys} - set(uses[kind])


def fail(item: object, key: str, right: str) -> NoReturn:
    """Raise the error that names class, field, value and what would be right.

    Raises:
        FieldError: Always.
    """
    value = repr(getattr(item, key))
    shown = value if len(value) <= 80 else f"{value[:60]}..."
    error = FieldError(f"{type(item).__name__}: {key} = {shown}: {right}")
    error.key, error.right = key, right
    raise error from None


Vec3: TypeAlias = tuple[float, float, float]
Place: TypeAlias = Annotated[Vec3, Key("metres", "[0.15, 0.055, 0.03]")]
Turn: TypeAlias = Annotated[Vec3, Key("degrees", "[0.0, 0.0, -25.0]")]
Length: TypeAlias = Annotated[float, Key("metres", "0.03", low=SMALLEST, required=True)]
Share: TypeAlias = Annotated[float, Key("0 to 1", "0.25", low=0.0, high=1.0)]
LIGHT_COLOR: Final = Key("linear RGB", "[1.0, 0.9, 0.7]", low=0.0)
COLOR: Final = Key("linear RGB, 0 to 1", "[1.0, 0.77, 0.34]", low=0.0, high=1.0)
