"""Animations of glTF files as the page plays them: chosen, started, held, made faster, without a jump of the pose."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any

from warp_ar.errors import SceneError, UsageError
from warp_ar.scene import Object, Play
from warp_ar.scene.mesh_files import GLTF_SUFFIXES, animations_of
from warp_ar.scene.object_materials import file_stamp, moving_mesh_of

NONE = -1
"""Number of no animation: everything stands as the file's nodes do."""
_DIGITS = 4
"""Of seconds that the page sets, in scene files: a tenth of a millisecond."""


def names_of(item: Object) -> tuple[str, ...]:
    """Names of the animations of an object's file, by number; one without a name is told by its number."""
    if item.file is None or item.mesh is not None or item.file.suffix.lower() not in GLTF_SUFFIXES:
        return ()
    return _names(item.file, file_stamp(item.file))


@functools.lru_cache(maxsize=64)
def _names(path: Path, stamp: tuple[int, int]) -> tuple[str, ...]:
    try:
        return tuple(name or f"Animation {number}" for number, name in enumerate(animations_of(path)))
    except SceneError:
        return ()  # the scene that shows the object says what is wrong


def play_record(item: Object) -> dict[str, Any]:
    """What the page shows of an object's animations."""
    names = names_of(item)
    if not names:
        return {}
    play = item.play
    if play is None:
        return {"animations": names, "animation": NONE, "speed": Play.speed, "loop": Play.loop, "paused": False}
    number = names.index(play.animation) if isinstance(play.animation, str) else play.animation
    shown = {"speed": play.speed, "loop": play.loop, "paused": play.paused}
    return {"animations": names, "animation": number, **shown}


def set_play(item: Object, key: str, value: float, seconds: float) -> Object:
    """The object with one value of its animation changed; its pose at that moment stays.

    Args:
        item: An object with a glTF file.
        key: ``animation``: its number, ``NONE`` for none, which begins at once; ``speed``; ``loop``; ``paused``: 0 goes
            on from the pose that is held, or anew if that is the last one.
        value: Number or flag.
        seconds: Of the frame that is shown, since the first.

    Raises:
        UsageError: The object's file has no such animation, or it plays none.
    """
    names = names_of(item)
    if key == "animation":
        number = int(value)
        if not NONE <= number < len(names):
            raise UsageError(f"animation {number}: the file has {len(names)}, counted from 0")
        begun = Play(animation=number, start=round(seconds, _DIGITS))
        return dataclasses.replace(item, play=None if number == NONE else begun)
    moving = moving_mesh_of(item)
    if item.play is None or moving is None:
        raise UsageError("the object plays no animation: choose one first")
    at = item.play.time_at(seconds, moving.duration)
    if key == "paused" and not value and not item.play.loop and at >= moving.duration:
        at = 0.0
    changed: Any = value if key == "speed" else bool(value)
    held = dataclasses.replace(item.play, offset=round(at, _DIGITS), start=round(seconds, _DIGITS))
    return dataclasses.replace(item, play=dataclasses.replace(held, **{key: changed}))
