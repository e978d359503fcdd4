"""Scene files, job files and edits drawn from their schemas: taken, or refused in one line; no file appears."""

from __future__ import annotations

import json
import math
import pathlib
import tomllib
from collections.abc import Callable
from typing import Any

import hypothesis.strategies as st
import pytest
import tomlkit
from hypothesis import given, settings

from tests.hostile.corpus import SCENE
from tests.viewer_rig import page_scene
from warp_ar.errors import SceneError, WarpArError
from warp_ar.farm.jobs import parse_jobs
from warp_ar.scene import dumps_scene, loads_scene
from warp_ar.scene.key_tables import keys
from warp_ar.viewer import edits
from warp_ar.viewer.protocol import PARTS, ProtocolError, parse_text

NUMBERS = st.one_of(
    st.sampled_from([0, -1, 1, 0.0, -0.0, 1e-300, 1e300, -1e300, math.nan, math.inf, -math.inf, 2**31, -(2**63), 1e-9]),
    st.floats(-10.0, 10.0),
    st.integers(-5, 70000),
)
WORDS = st.one_of(
    st.sampled_from(
        [
            "",
            ".",
            "..",
            "/",
            "/etc/passwd",
            "../../x",
            "~",
            "NUL",
            "desk",
            "a" * 300,
            "x\x00y",
            "\x1b[2J",
            "auto",
            "none",
        ]
    ),
    st.text(max_size=12),
)
SCALARS = st.one_of(NUMBERS, WORDS, st.booleans())
VALUES = st.one_of(
    SCALARS,
    st.lists(SCALARS, max_size=5),
    st.lists(st.lists(NUMBERS, max_size=3), max_size=3),
    st.dictionaries(st.sampled_from(["id", "size", "x", "animation", "file", "board", ""]), SCALARS, max_size=3),
)
LONGEST_LINE = 2000


def is_refused_in_one_line(read: Callable[[], Any], kind: type[Exception]) -> bool:
    """Return True if what was read is refused; any error but the program's own fails."""
    message = None
    try:
        read()
    except kind as error:
        message = str(error)
    assert message is None or (message and "\n" not in message and len(message) < LONGEST_LINE)
    return message is not None


@pytest.fixture(autouse=True)
def nothing_appears(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run in an empty folder, which stays empty."""
    monkeypatch.chdir(tmp_path)
    yield
    assert not list(tmp_path.iterdir())


KEYS = [(key.section, key.name) for key in keys()]
SOUND = tomllib.loads(SCENE)


def changed(changes: list[tuple[tuple[str, str], Any]]) -> str:
    """Return the sound scene with other values at some keys of the schema, or keys where there were none."""
    data = json.loads(json.dumps(SOUND))
    for (section, name), value in changes:
        table: Any = data
        for part in filter(None, section.replace("[", "").replace("]", "").split(".")):
            table = table.setdefault(part, {}) if isinstance(table, dict) else {}
            if isinstance(table, list):
                table = table[0] if table and isinstance(table[0], dict) else {}
        if isinstance(table, dict):
            table[name] = value
    return tomlkit.dumps(data)


@settings(max_examples=150)
@given(st.lists(st.tuples(st.sampled_from(KEYS), VALUES), min_size=1, max_size=3))
def test_scenes(changes: list[tuple[tuple[str, str], Any]]) -> None:
    text = changed(changes)
    if not is_refused_in_one_line(lambda: loads_scene(text), SceneError):
        scene = loads_scene(text)
        # What is taken is written, or it is said why not, and what is written is taken again.
        if not is_refused_in_one_line(lambda: dumps_scene(scene), WarpArError):
            loads_scene(dumps_scene(scene))


def test_the_sound_scene_is_sound() -> None:
    loads_scene(changed([]))


RUN = ("quality", "light", "segment_frames", "preroll", "decode", "coding", "digests", "unknown")
CLIP = ("name", "scene", "path", "light", "calibration", "frames", "unknown")
DATASET = ("variations", "seed", "objects", "lights", "every", "region", "margin", "exposure", "object", "light")
PLACES = [("run", name) for name in RUN] + [("clip", name) for name in CLIP] + [("dataset", name) for name in DATASET]


@settings(max_examples=100)
@given(st.lists(st.tuples(st.sampled_from(PLACES), VALUES), min_size=1, max_size=3))
def test_jobs(changes: list[tuple[tuple[str, str], Any]]) -> None:
    data: dict[str, Any] = {"schema": 1, "run": {"quality": "low"}, "clip": [{"scene": "desk"}]}
    for (section, name), value in changes:
        table = data.setdefault(section, {"variations": 2, "seed": 1})
        (table[0] if isinstance(table, list) else table)[name] = value
    is_refused_in_one_line(lambda: parse_jobs(data, "jobs.toml"), WarpArError)


EDITED = sorted({name for section, name in KEYS})


@settings(max_examples=150)
@given(st.sampled_from(PARTS), st.integers(-1, 3), st.sampled_from(EDITED), VALUES)
def test_edits(part: str, index: int, key: str, value: Any) -> None:
    message = json.dumps({"type": "set", "part": part, "index": index, "key": key, "value": value})
    if is_refused_in_one_line(lambda: parse_text(message), ProtocolError):
        return
    fields, scene = parse_text(message).fields, page_scene()
    is_refused_in_one_line(
        lambda: edits.set_value(scene, fields["part"], fields["index"], fields["key"], fields["value"]), WarpArError
    )
