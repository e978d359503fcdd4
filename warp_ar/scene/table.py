"""Tables of a TOML file: checked values, and errors that name file, key, value and what would be right."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, ClassVar, NoReturn, Self

from warp_ar.errors import SceneError, WarpArError
from warp_ar.scene.fields import MOST, Field, Key
from warp_ar.scene.messages import LARGEST, nearest, show_key, show_value


class Table:
    """One table of a file; a kind of file has a class of its own, with its error."""

    error: ClassVar[type[WarpArError]] = SceneError
    """Error that is raised."""

    def __init__(self, label: str, folder: Path, section: str, data: object, keys: Sequence[str]) -> None:
        """Check the keys.

        Args:
            label: How messages call the file.
            folder: Where relative paths start.
            section: The table's name in the file; empty: the file itself.
            data: The table.
            keys: All that it may have.

        Raises:
            WarpArError: As ``error``: it is no table, or has a key that is none of ``keys``. So do all methods.
        """
        self.label, self.folder, self.section = label, folder, section
        if not isinstance(data, dict):
            raise self.error(f"{label}: {section} = {show_value(data)}: expected a table with {', '.join(keys)}")
        self.data: dict[str, Any] = data
        for key in data:
            if key not in keys:
                raise self.error(f"{label}: {self.name(key)}: unknown key; {nearest(key, keys)}")

    def inner(self, key: str, data: object, keys: Sequence[str]) -> Self:
        """A table within this one: the value of a key."""
        return type(self)(self.label, self.folder, self.name(key), data, keys)

    def __contains__(self, key: str) -> bool:
        return key in self.data

    def name(self, key: str) -> str:
        """Return the name by which messages call a key."""
        return f"{self.section}.{show_key(key)}" if self.section else show_key(key)

    def fail(self, key: str, right: str) -> NoReturn:
        """Say what is wrong with a key: its value if it has one, and what would be right.

        Raises:
            WarpArError: Always, as ``error``.
        """
        value = f" = {show_value(self.data[key])}" if key in self.data else " is missing"
        raise self.error(f"{self.label}: {self.name(key)}{value}: {right}")

    def only(self, kind: str, uses: dict[str, tuple[str, ...]]) -> None:
        """Complain about keys that other kinds of this section use, but not the one that key ``kind`` names."""
        own = sorted(set(uses[self.data[kind]]))
        for key in self.data:
            if key not in own and any(key in keys for keys in uses.values()):
                value = show_value(self.data[kind])
                self.fail(key, f"not used with {kind} = {value}; its own keys are {', '.join(own)}")

    def admit(self, field: Field) -> Any:
        """Return the value of a field's key as the field holds it."""
        try:
            return field.admit(self.data.get(field.name))
        except ValueError as error:
            self.fail(field.name, str(error))

    def _take(self, key: str, form: str, default: Any, words: tuple[str, ...] = (), **how: Any) -> Any:
        """Return the checked value of a key that is no field; ``how``: as `Key`."""
        if default is not None and key not in self.data:
            return default
        return self.admit(Field(key, Key(**how), form, None, words))

    def flag(self, key: str, default: bool | None = None) -> bool:
        """Return whether something is so."""
        value = self.data.get(key, default)
        if not isinstance(value, bool):
            self.fail(key, "expected true or false")
        return value

    def number(
        self, key: str, default: float | None = None, *, low: float = -LARGEST, high: float = LARGEST, unit: str = ""
    ) -> float:
        """A number from ``low`` to ``high``; ``unit`` stands in the message if it is not.

        Raises:
            SceneError: The key is missing and has no default, or its value is no such number.
        """
        return float(self._take(key, "number", default, low=low, high=high, unit=unit))

    def integer(self, key: str, default: int | None = None, *, low: int, high: int = MOST) -> int:
        """A whole number."""
        return int(self._take(key, "integer", default, low=low, high=high))

    def text(self, key: str, default: str | None = None, *, right: str = "some text") -> str:
        """Some text."""
        value = self.data.get(key, default)
        if not isinstance(value, str) or not (value or key not in self.data):
            self.fail(key, f"expected {right}")
        return value

    def choice(self, key: str, options: Iterable[str], default: str | None = None) -> str:
        """One of several words."""
        return str(self._take(key, "word", default, tuple(options)))

    def vector(self, key: str, *, sizes: tuple[int, ...] = (3,), low: float = -LARGEST, high: float = LARGEST) -> Any:
        """A list of numbers from ``low`` to ``high``, as many as one of ``sizes``; errors as those of ``number``."""
        return self._take(key, "vector", None, sizes=sizes, low=low, high=high)
