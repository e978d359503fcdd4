"""Tables of a TOML file: checked values, and errors that name file, key, value and what would be right."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, ClassVar, Final, NoReturn, Self, cast

from warp_ar.errors import SceneError, WarpArError
from warp_ar.files import is_file
from warp_ar.scene.fields import Vec3
from warp_ar.scene.messages import LARGEST, SMALLEST, nearest, show_key, show_value

MISSING: Final = dataclasses.MISSING
MOST: Final = 10**9
"""Largest whole number without another bound."""


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

    def only(self, kind: str, allowed: Iterable[str], others: Iterable[str], *, default: str = "") -> None:
        """Complain about keys that other kinds of this section use, but not the one that key ``kind`` names."""
        unused = sorted(set(others) - set(allowed))
        for key in self.data:
            if key in unused:
                used = ", ".join(sorted(set(allowed)))
                value = show_value(self.data.get(kind, default))
                self.fail(key, f"not used with {kind} = {value}; its own keys are {used}")

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
        if default is not None and key not in self.data:
            return default
        return self._number(key, self.data.get(key), low, high, _range("a number", low, high, unit))

    def _number(self, key: str, value: object, low: float, high: float, right: str) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.fail(key, f"expected {right}")
        # Compared before it is converted: an integer may be too large for a float.
        if not low <= value <= high:
            self.fail(key, f"expected {right}")
        return float(value)

    def length(self, key: str) -> float:
        """Metres, above 0."""
        return self.number(key, low=SMALLEST, unit="metres")

    def integer(self, key: str, default: int | None = None, *, low: int, high: int = MOST) -> int:
        """A whole number."""
        if default is not None and key not in self.data:
            return default
        value = self.data.get(key)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            self.fail(key, f"expected a whole number from {low} to {high}")
        return value

    def text(self, key: str, default: str | None = None, *, right: str = "some text") -> str:
        """Some text."""
        if default is not None and key not in self.data:
            return default
        value = self.data.get(key)
        if not isinstance(value, str) or not value:
            self.fail(key, f"expected {right}")
        return value

    def choice(self, key: str, options: Iterable[str], default: str | None = None) -> str:
        """One of several words."""
        options = list(options)
        few = len(options) < 8
        right = "one of " + ", ".join(f'"{option}"' for option in options) if few else f'a name such as "{options[0]}"'
        value = self.text(key, default, right=right)
        if value not in options:
            self.fail(key, f"expected {right}" if few else f"unknown; {nearest(value, options)}")
        return value

    def vector(
        self,
        key: str,
        default: tuple[float, ...] | None = None,
        *,
        sizes: Sequence[int] = (3,),
        low: float = -LARGEST,
        high: float = LARGEST,
        unit: str = "",
    ) -> tuple[float, ...]:
        """A list of numbers from ``low`` to ``high``, as many as one of ``sizes``; errors as those of ``number``."""
        if default is not None and key not in self.data:
            return default
        value = self.data.get(key)
        right = _range(f"a list of {' or '.join(map(str, sizes))} numbers", low, high, unit)
        if not isinstance(value, list) or len(value) not in sizes:
            self.fail(key, f"expected {right}")
        return tuple(self._number(key, element, low, high, right) for element in value)

    def vec3(self, key: str, default: Vec3 | None = None, *, low: float = -LARGEST, unit: str = "") -> Vec3:
        """Three numbers."""
        return cast(Vec3, self.vector(key, default, low=low, unit=unit))

    def find(self, text: str) -> Path | None:
        """Return the path that a text names, links followed; None if this file must not name it."""
        path = (self.folder / text).resolve()
        path.exists()  # a name that is too long for the system is refused here
        return path

    def resolve(self, key: str, right: str) -> Path:
        """Return a path, links followed; whether anything is there is not asked."""
        value = self.text(key, right=f"the path of {right}")
        try:
            path = self.find(value)
        except (OSError, RuntimeError, ValueError):  # too long, a loop of links, a zero byte
            self.fail(key, f"expected the path of {right}; this cannot be one")
        if path is None:
            self.fail(
                key,
                f"expected {right}; no file of this name came with the scene; open a scene with its own "
                "files by python -m warp_ar.live, or drop a ZIP that holds them",
            )
        return path

    def file(self, key: str, right: str) -> Path:
        """The path of a file that is there."""
        path = self.resolve(key, right)
        if not is_file(path):
            self.fail(key, f"no such file: {path}")
        return path


def _range(what: str, low: float, high: float, unit: str) -> str:
    """Words for a range of numbers."""
    unit = f" ({unit})" if unit else ""
    if low > -LARGEST and high < LARGEST:
        return f"{what} from {low:g} to {high:g}{unit}"
    if low == SMALLEST:
        return f"{what} above 0{unit}" if what.startswith("a number") else f"{what}, each above 0{unit}"
    if low > -LARGEST:
        return f"{what}, {low:g} or more{unit}"
    return f"{what}, finite{unit}" if what == "a number" else f"{what}, each finite{unit}"
