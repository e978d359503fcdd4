"""The scene file that a new desk starts from: what one must set, each key with what it means."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Sequence
from typing import TypeAlias

from warp_ar.scene.description import SCHEMA, Marker, Scene
from warp_ar.scene.reference import keys

FIELD_OF_VIEW = 60.0
"""Degrees that are guessed of a camera: between a phone's main camera (65 to 70) and a laptop's (50 to 60)."""
_WIDTH = 110


_Section: TypeAlias = tuple[str, str, list[tuple[str, str, str]]]
"""Head, comment, and entries: section and key as the reference names them, and the value."""


def _sections(source: str | int, marker: Marker, center: Sequence[float], radius: float, mesh: str) -> list[_Section]:
    """What a new desk's file has."""
    board = "" if marker.board is None else str(marker.board)
    spot = ", ".join(repr(float(value)) for value in center)
    return [
        (
            "[camera]",
            "Guessed until it is measured: `python -m warp_ar.calibrate camera` replaces the guess by camera.yml.",
            [("camera", "field_of_view", f"{FIELD_OF_VIEW}")],
        ),
        ("[source]", "", [("source", "camera" if isinstance(source, int) else "path", json.dumps(source))]),
        (
            "[marker]",
            "The printed card. If its rulers are not 100 mm long, multiply both lengths of the board by their length "
            "over 100 mm.",
            [("marker", "dictionary", json.dumps(marker.dictionary)), ("marker", "board", json.dumps(board))],
        ),
        (
            "[probe]",
            "The mirror ball on the card's cross. Its radius is half of what a caliper shows across it; the center's "
            "third number is the same.",
            [("probe", "radius", f"{radius:g}"), ("probe", "center", f"[{spot}]")],
        ),
        (
            "[[proxy]]",
            "The table, which receives shadows.",
            [("proxy", "shape", '"plane"'), ("proxy", "at", "[0.0, 0.0, 0.0]"), ("proxy", "size", "[1.6, 1.2]")],
        ),
        (
            "[[object]]",
            "What is not there: a teapot to the right of the card.",
            [
                *(("object", "shape", '"mesh"'), ("object", "file", json.dumps(mesh))),
                *(("object", "at", "[0.19, 0.02, 0.0]"), ("object", "rotate", "[0.0, 0.0, -25.0]")),
                ("object", "scale", "0.026"),
            ],
        ),
        (
            "[object.material]",
            "",
            [
                ("object.material", "model", '"metallic_roughness"'),
                ("object.material", "base_color", "[1.0, 0.77, 0.34]"),
                ("object.material", "metallic", "1.0"),
                ("object.material", "roughness", "0.25"),
            ],
        ),
    ]


def starter_scene(
    name: str,
    source: str | int,
    marker: Marker,
    center: Sequence[float],
    radius: float,
    mesh: str,
) -> str:
    """Text of a scene file with comments.

    Args:
        name: Name to show.
        source: A path, or a capture device's index.
        marker: The board that is printed.
        center: Where the ball stands, metres.
        radius: Its radius, metres.
        mesh: Path of the object's mesh, relative to the file.
    """
    parts = _sections(source, marker, center, radius, mesh)
    lines = [
        "# Metres, degrees, linear RGB. The origin is the middle of the card's board: x right, y up the page, z up."
    ]
    lines += [f"schema = {SCHEMA}", f"name = {json.dumps(name, ensure_ascii=False)}"]
    for head, comment, entries in parts:
        lines += ["", *(f"# {line}" for line in textwrap.wrap(comment, _WIDTH)), head]
        for section, key, value in entries:
            lines += [*key_comment(section, key), f"{key} = {value}"]
    return "\n".join(lines) + "\n"


def key_comment(section: str, name: str) -> list[str]:
    """Lines of a comment that says what a key is."""
    (key,) = (one for one in keys() if (one.section, one.name) == (section, name))
    said = key.unit == "-" or key.unit.split()[0] in key.meaning.lower()
    return [f"# {line}" for line in textwrap.wrap(key.meaning if said else f"{key.meaning} ({key.unit})", _WIDTH)]


def guesses(scene: Scene) -> list[str]:
    """What a scene only guesses, one line each, with what measures it."""
    found = []
    if (field := scene.camera.field_of_view) is not None:
        where = "" if scene.path is None else f" --write {scene.path.parent}"
        found.append(
            f"the camera is guessed, with a field of view of {field:g} degrees; "
            f"python -m warp_ar.calibrate camera PICTURES{where} measures it"
        )
    return found
