"""Writing of scene files: a commented file for a new scene, and changed keys in an existing file."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import Comment, Whitespace

from warp_ar.errors import SceneError, SinkError, reason
from warp_ar.files import read_text, write_whole
from warp_ar.scene.description import SCHEMA, Marker, Scene
from warp_ar.scene.key_tables import keys
from warp_ar.scene.reader import loads_scene

FIELD_OF_VIEW = 60.0
"""Assumed field of view of an uncalibrated camera, degrees: between a phone's main camera (65 to 70) and a laptop's (50
to 60)."""
_WIDTH = 110


def starter_scene(
    name: str,
    source: str | int,
    marker: Marker,
    center: Sequence[float],
    radius: float,
    mesh: str,
) -> str:
    """Return the text of a commented scene file.

    Args:
        name: Display name.
        source: Path of the frames, or index of a capture device.
        marker: The printed board.
        center: Centre of the ball, metres.
        radius: Radius of the ball, metres.
        mesh: Path of the object's mesh, relative to the file.
    """
    text = f"""\
# Metres, degrees, linear RGB. The origin is the middle of the card's board: x right, y up the page, z up.
schema = {SCHEMA}
name = {json.dumps(name, ensure_ascii=False)}

# Guessed until it is measured: `python -m warp_ar.calibrate camera` replaces the guess by camera.yml.
[camera]
field_of_view = {FIELD_OF_VIEW}

[source]
{"camera" if isinstance(source, int) else "path"} = {json.dumps(source)}

# The printed card. If its rulers are not 100 mm long, multiply both lengths of the board by their length over
# 100 mm.
[marker]
dictionary = {json.dumps(marker.dictionary)}
board = {json.dumps("" if marker.board is None else str(marker.board))}

# The mirror ball on the card's cross. Its radius is half of what a caliper shows across it; the center's third
# number is the same.
[probe]
radius = {radius:g}
center = {[float(value) for value in center]}

# The table, which receives shadows.
[[proxy]]
shape = "plane"
at = [0.0, 0.0, 0.0]
size = [1.6, 1.2]

# What is not there: a teapot to the right of the card.
[[object]]
shape = "mesh"
file = {json.dumps(mesh)}
at = [0.19, 0.02, 0.0]
rotate = [0.0, 0.0, -25.0]
scale = 0.026

[object.material]
model = "metallic_roughness"
base_color = [1.0, 0.77, 0.34]
metallic = 1.0
roughness = 0.25
"""
    section, lines = "", []
    for line in text.splitlines():
        if head := re.fullmatch(r"\[+([\w.]+)\]+", line):
            section = head[1]
        elif section and (key := re.match(r"(\w+) = ", line)):
            lines += key_comment(section, key[1])
        lines.append(line)
    return "\n".join(lines) + "\n"


def key_comment(section: str, name: str) -> list[str]:
    """Return the comment lines that describe a key."""
    (key,) = (one for one in keys() if (one.section, one.name) == (section, name))
    return [f"# {line}" for line in textwrap.wrap(key.description, _WIDTH)]


def camera_guess(scene: Scene) -> str:
    """Return that a scene's camera is guessed, and the command that measures it; empty if it is not guessed."""
    if (field := scene.camera.field_of_view) is None:
        return ""
    where = "" if scene.path is None else f" --write {scene.path.parent}"
    return (
        f"the camera is guessed, with a field of view of {field:g} degrees; "
        f"python -m warp_ar.calibrate camera PICTURES{where} measures it"
    )


def amend_scene(
    path: Path, section: str, values: Mapping[str, Any], *, index: int = 0, remove: tuple[str, ...] = ()
) -> None:
    """Set keys of one section of a scene file, keeping its comments.

    Args:
        path: The file.
        section: Name of the section, such as ``probe``.
        values: New values by key: numbers, texts, lists of numbers, or tables.
        index: Index among several sections of that name.
        remove: Keys that the new ones replace; their comments in a generated file are removed as well.

    Raises:
        SceneError: The file cannot be read, has no such section, or would become invalid; it is then left unchanged.
        SinkError: The file cannot be written.
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
        if key in table:
            table[key] = value
        else:
            _append(table, key, value)
    made = tomlkit.dumps(document)
    for key in gone:
        made = made.replace("\n".join(["", *key_comment(section, key), ""]), "\n")
    loads_scene(made, path)
    try:
        write_whole(path, made.encode(), keep_links=True)
    except OSError as error:
        raise SinkError(f"{path}: cannot be written: {reason(error)}") from error


def _append(table: Any, key: str, value: Any) -> None:
    """Append a key to a section, before comments that belong to the next section."""
    body = table.value.body
    follows: list[Any] = []
    while body and body[-1][0] is None:
        item = body.pop()[1]
        if isinstance(item, (Comment, Whitespace)):  # tomlkit leaves an empty item where a key was removed
            follows.insert(0, item)
    if isinstance(value, Mapping):
        given, value = value, tomlkit.inline_table()
        value.update(given)
    table.append(key, value)
    for item in follows:
        table.add(item)
