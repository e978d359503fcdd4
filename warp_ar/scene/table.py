"""Sections (tables) of a TOML file: checked values, and errors that name file, key, value and allowed values."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, ClassVar, NoReturn, Self

from warp_ar.errors import SceneError, WarpArError
from warp_ar.scene.fields import MOST, Field, Key
from warp_ar.scene.messages import LARGEST, nearest, show_key, show_value


class Table:
    """Table of a TOML file; each kind of file derives a class with its own error type."""

    error: ClassVar[type[WarpArError]] = SceneError
    """Type of error that is raised."""

    def __init__(self, label: str, folder: Path, section: str, data: object, keys: Sequence[str]) -> None:
        """Check the keys.

        Args:
            label: Name of the file in messages.
            folder: Folder where relative paths start.
            section: Name of the table in the file; empty for the top of the file.
            data: Parsed value of the table.
            keys: Allowed keys.

        Raises:
            WarpArError: Of type ``error``: ``data`` is no table, or has a key that is not among ``keys``. All methods
                raise that type.
        """
        self.label, self.folder, self.section = label, folder, section
        if not isinstance(data, dict):
            raise self.error(f"{label}: {section} = {show_value(data)}: expected a table with {', '.join(keys)}")
        self.data: dict[str, Any] = data
        for key in data:
            if key not in keys:
                raise self.error(f"{label}: {self.name(key)}: unknown key; {nearest(key, keys)}")

    def inner(self, key: str, data: object, keys: Sequence[str]) -> Self:
        """Return the inner table under ``key``, whose parsed value is ``data``; ``keys`` are allowed in it."""
        return type(self)(self.label, self.folder, self.name(key), data, keys)

    def __contains__(self, key: str) -> bool:
        return key in self.data

    def name(self, key: str) -> str:
        """Return the name of a key in messages."""
        return f"{self.section}.{show_key(key)}" if self.section else show_key(key)

    def fail(self, key: str, right: str) -> NoReturn:
        """Raise an error that names a key, its value and the allowed values.

        Raises:
            WarpArError: Always, of type ``error``.
        """
        value = f" = {show_value(self.data[key])}" if key in self.data else " is missing"
        raise self.error(f"{self.label}: {self.name(key)}{value}: {right}")

    def only(self, kind: str, uses: dict[str, tuple[str, ...]]) -> None:
        """Raise an error for keys that other kinds of this section use, but not this kind.

        ``kind`` is the key that names the section's kind, ``uses`` the keys of each kind.
        """
        own = sorted(set(uses[self.data[kind]]))
        for key in self.data:
            if key not in own and any(key in keys for keys in uses.values()):
                value = show_value(self.data[kind])
                self.fail(key, f"not used with {kind} = {value}; its own keys are {', '.join(own)}")

    def admit(self, field: Field) -> Any:
        """Return the value of a field's key in the form that the field stores."""
        try:
            return field.admit(self.data.get(field.name))
        except ValueError as error:
            self.fail(field.name, str(error))

    def _take(self, key: str, form: str, default: Any, words: tuple[str, ...] = (), **how: Any) -> Any:
        """Return the checked value of a key that is no field; ``how`` are further arguments of `Key`."""
        if default is not None and key not in self.data:
            return default
        return self.admit(Field(key, Key(**how), form, None, words))

    def flag(self, key: str, default: bool | None = None) -> bool:
        """Return a boolean."""
        value = self.data.get(key, default)
        if not isinstance(value, bool):
            self.fail(key, "expected true or false")
        return value

    def number(
        self, key: str, default: float | None = None, *, low: float = -LARGEST, high: float = LARGEST, unit: str = ""
    ) -> float:
        """Return a number from ``low`` to ``high``; messages name its ``unit``.

        Raises:
            SceneError: The key is missing and has no default, or its value is not allowed.
        """
        return float(self._take(key, "number", default, low=low, high=high, unit=unit))

    def integer(self, key: str, default: int | None = None, *, low: int, high: int = MOST) -> int:
        """Return a whole number from ``low`` to ``high``."""
        return int(self._take(key, "integer", default, low=low, high=high))

    def text(self, key: str, default: str | None = None, *, right: str = "some text") -> str:
        """Return a text."""
        value = self.data.get(key, default)
        if not isinstance(value, str) or not (value or key not in self.data):
            self.fail(key, f"expected {right}")
        return value

    def choice(self, key: str, options: Iterable[str], default: str | None = None) -> str:
        """Return one of several words."""
        return str(self._take(key, "word", default, tuple(options)))

    def vector(self, key: str, *, sizes: tuple[int, ...] = (3,), low: float = -LARGEST, high: float = LARGEST) -> Any:
        """Return a list of numbers from ``low`` to ``high`` whose length is one of ``sizes``.

        A missing key or another value is an error.
        """
        return self._take(key, "vector", None, sizes=sizes, low=low, high=high)
