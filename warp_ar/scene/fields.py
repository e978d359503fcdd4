"""Declarations of scene file keys.

Each stands at its dataclass field and drives reading, checking, writing and documentation.

A section's dataclass annotates its fields, for example ``radius: Annotated[float, Key("metres", "0.03",
low=SMALLEST)]``. The type decides the form of the value: a number, list, word, path or table. Constructors check their
arguments against these declarations. Readers of files rely on that check and add the file and the key to its error.
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

from warp_ar.declared import words_for
from warp_ar.errors import SceneError
from warp_ar.scene.messages import LARGEST, SMALLEST, nearest

MOST: Final = 10**9
"""Largest whole number that is accepted where no other bound is given."""
_UNITS: Final = ("metres", "degrees", "pixels", "seconds", "frames per second")
"""Units that error messages name; the other units are ranges, which the messages state anyway."""


@dataclasses.dataclass(frozen=True)
class Key:
    """Declaration of a scene file key."""

    unit: str = "-"
    """Unit of the value; a dash if it has none."""
    example: str = ""
    """Example of a value, as TOML."""
    low: float = -LARGEST
    """Smallest allowed value of each number; error messages show ``SMALLEST`` as "above 0"."""
    high: float = LARGEST
    """Largest value of each number."""
    sizes: tuple[int, ...] = (3,)
    """Allowed lengths of a list; empty: the length depends on the section's kind, by ``sides``."""
    right: str = ""
    """Description of a valid text, or of the file expected at a path, for error messages."""
    words: tuple[str, ...] = ()
    """Allowed words of a text."""
    required: bool = False
    """True if a file must give the key wherever the section's kind uses it, even though the field has a default."""
    grey: bool = False
    """True if one number may replace a list of equal numbers."""


@dataclasses.dataclass(frozen=True)
class Field:
    """Field of a dataclass together with its key."""

    name: str
    key: Key
    form: str
    """Form of the value: number, integer, flag, text, word, path, vector, color or table."""
    default: Any
    """Default value; ``dataclasses.MISSING`` if there is none."""
    words: tuple[str, ...] = ()
    """Allowed words."""
    optional: bool = False
    """True if the value may be None."""
    kinds: tuple[Any, ...] = ()
    """Allowed types of a value that is no number, list or word."""

    def admit(self, value: Any) -> Any:
        """Return a value in the form that the field stores: plain numbers, tuples for lists, paths for texts.

        Raises:
            ValueError: The value is not allowed; the message describes allowed values.
        """
        if (value is None and self.optional) or (isinstance(value, str) and value in self.words):
            return value
        if self.form in ("table", "path", "flag", "text"):
            value = Path(value) if value and self.form == "path" and isinstance(value, str) else value
            if isinstance(value, self.kinds) and value != "":
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
        """Return True if a number is finite and within the key's bounds."""
        kinds: Any = (numbers.Integral, np.integer) if self.form == "integer" else (numbers.Real, np.generic)
        low, high = self._bounds()
        # Compare before converting: an integer may be too large for a float.
        return isinstance(value, kinds) and not isinstance(value, bool) and bool(low <= value <= high)

    def _bounds(self) -> tuple[float, float]:
        low, high = self.key.low, self.key.high
        if self.form == "integer":
            low, high = (0 if low == -LARGEST else low), (MOST if high == LARGEST else high)
        return low, high

    def _right(self, value: Any) -> str:
        """Return a description of allowed values, for error messages."""
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
                return f"expected {' or '.join(map(words_for, self.kinds))}"
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
    """Return the fields of a dataclass that are scene file keys, by name."""
    if kind not in _KNOWN:
        hints = typing.get_type_hints(kind, include_extras=True)
        declared = {name: typing.get_args(hint) for name, hint in hints.items() if typing.get_origin(hint) is Annotated}
        fields = (field for field in dataclasses.fields(kind) if field.name in declared)
        _KNOWN[kind] = {field.name: _field(field.name, field.default, *declared[field.name]) for field in fields}
    return _KNOWN[kind]


def _field(name: str, default: Any, hint: Any, key: Key) -> Field:
    """Return the ``Field`` of a dataclass field with its type and key."""
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
    """Invalid value of a dataclass field."""

    key: str
    """Name of the field."""
    right: str
    """Description of allowed values."""


class Checked:
    """Base of dataclasses that check their values against the keys of their fields.

    Raises:
        FieldError: A value is not allowed.
    """

    USES: ClassVar[dict[str, tuple[str, ...]]] = {}
    """Keys that only some kinds of the section use, by kind; the kind is the dataclass's first field."""

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
    """Return the keys that a kind does not use but another kind does."""
    return {key for keys in uses.values() for key in keys} - set(uses[kind])


def fail(item: object, key: str, right: str) -> NoReturn:
    """Raise an error that names class, field, value and allowed values.

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
