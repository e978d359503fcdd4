"""Results written into a scene file; its comments, its order and its other keys stay as they are."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from warp_ar.errors import SceneError, SinkError, reason
from warp_ar.files import read_text, write_whole
from warp_ar.scene.reader import loads_scene
from warp_ar.scene.starter import key_comment


def amend_scene(
    path: Path, section: str, values: Mapping[str, Any], *, index: int = 0, remove: tuple[str, ...] = ()
) -> None:
    """Set keys of one section of a scene file.

    Args:
        path: The file.
        section: Such as ``probe``; of several of its kind, the one at ``index``.
        values: Keys with numbers, texts, lists of numbers, or a section below: its own keys.
        index: Which of several.
        remove: Keys that the new ones stand for; what a new desk's file says of them goes with them.

    Raises:
        SceneError: The file cannot be read, has no such section, or would no longer be a scene; it is left as it was.
        SinkError: It cannot be written.
    """
    text = read_text(path, SceneError, expected="TOML")
    try:
        document = tomlkit.parse(text)
    except TOMLKitError as error:
        raise SceneError(f"{path}: not valid TOML: {error}") from error
    table: Any = document.get(section)
    if isinstance(table, list):
        table = table[index] if index < len(table) else None
    if table is None:
        raise SceneError(f"{path}: [{section}] is missing: there is nothing to write {', '.join(values)} into")
    gone = [key for key in remove if key in table]
    for key in gone:
        del table[key]
    for key, value in values.items():
        if isinstance(value, Mapping):
            _set_below(table, key, value)
        else:
            table[key] = value
    made = tomlkit.dumps(document)
    for key in gone:
        made = made.replace("\n".join(["", *key_comment(section, key), ""]), "\n")
    loads_scene(made, path)
    try:
        write_whole(path, made.encode(), keep_links=True)
    except OSError as error:
        raise SinkError(f"{path}: cannot be written: {reason(error)}") from error


def _set_below(table: Any, key: str, values: Mapping[str, Any]) -> None:
    """Put a section below another, before the comment that stands above what follows in the file."""
    body = table.value.body
    follows: list[Any] = []
    while body and body[-1][0] is None:
        follows.insert(0, body.pop()[1])
    below = tomlkit.table()
    for name, value in values.items():
        below[name] = value
    table.add(tomlkit.nl())
    table.append(key, below)
    for item in follows:
        table.add(item)
