"""Animations of a file as the page plays them: no jump of the pose, undone like other edits, kept in the file."""

from __future__ import annotations

import dataclasses
import json
import pathlib
from typing import Any

import numpy as np
import pytest

from tests.gltf_files import Gltf
from tests.layer_rig import make_scene
from warp_ar.errors import SceneError, UsageError
from warp_ar.scene import Object, Play, Scene, dumps_scene, loads_scene
from warp_ar.scene.object_materials import moving_mesh_of
from warp_ar.scene.object_shapes import part_placements
from warp_ar.stages.quality import PRESETS
from warp_ar.viewer import edits
from warp_ar.viewer.edits import Wanted, names_of, play_record, set_play
from warp_ar.viewer.protocol import ProtocolError, parse_text

DURATION = 2.0
# Times in scene files have four digits, poses move one metre a second.
ROUNDING = 2e-4


@pytest.fixture
def item(tmp_path: pathlib.Path) -> Object:
    """A square that moves one metre to the right each second for two, and one animation more."""
    gltf = Gltf()
    node = gltf.node(gltf.square())
    times, places = np.float32([0.0, DURATION]), np.float32([[0.0, 0.0, 0.0], [DURATION, 0.0, 0.0]])
    animations = []
    for name in ({"name": "Slide"}, {}):
        sampler = {"input": gltf.array(times, min=[0.0], max=[DURATION]), "output": gltf.array(places)}
        channel = {"sampler": 0, "target": {"node": node, "path": "translation"}}
        animations.append({**name, "samplers": [sampler], "channels": [channel]})
    gltf.tree["animations"] = animations
    path = tmp_path / "slide.glb"
    gltf.save(path)
    return Object("mesh", file=path)


def place_at(item: Object, seconds: float) -> float:
    """Metres to the right of the part that moves."""
    moving = moving_mesh_of(item)
    assert moving is not None
    return float(part_placements(item, moving, seconds)[:, 0, 3].max())


def test_the_page_is_told_what_a_file_can_play(item: Object) -> None:
    assert names_of(item) == ("Slide", "Animation 1")
    assert play_record(item)["animation"] == -1
    named = dataclasses.replace(item, play=Play("Slide", speed=2.0))
    shown = {"animations": ("Slide", "Animation 1"), "animation": 0, "speed": 2.0, "loop": True, "paused": False}
    assert play_record(named) == shown
    assert play_record(Object("sphere", radius=0.1)) == {}
    record = edits.wanted_record(Wanted(make_scene(objects=(named,)), PRESETS["low"]))["objects"][0]
    assert {key: record[key] for key in shown} == shown


@pytest.mark.parametrize(("key", "value"), [("paused", 1), ("speed", 3.0), ("speed", 0.2), ("loop", 0)])
@pytest.mark.parametrize("now", [4.0, 6.3, 100.7])
def test_no_change_moves_the_pose(item: Object, key: str, value: float, now: float) -> None:
    playing = set_play(item, "animation", 0, 3.5)
    changed = set_play(playing, key, value, now)
    assert changed.play != playing.play
    assert place_at(changed, now) == pytest.approx(place_at(playing, now), abs=ROUNDING)


def test_pause_holds_and_play_goes_on(item: Object) -> None:
    held = set_play(set_play(item, "animation", 0, 0.0), "paused", 1, 0.75)
    assert place_at(held, 9.0) == pytest.approx(0.75, abs=ROUNDING)
    faster = set_play(held, "speed", 2.0, 9.0)  # while it is held
    assert place_at(faster, 50.0) == pytest.approx(0.75, abs=ROUNDING)
    on = set_play(faster, "paused", 0, 60.0)
    assert place_at(on, 60.25) == pytest.approx(1.25, abs=ROUNDING)


def test_edits_are_kept_in_the_file(item: Object) -> None:
    start = wanted = Wanted(make_scene(objects=(item,)), PRESETS["low"])
    messages: list[dict[str, Any]] = [
        {"key": "animation", "value": 1},
        {"key": "speed", "value": 0.5},
        {"key": "loop", "value": 0},
        {"key": "paused", "value": 1},
    ]
    for number, message in enumerate(messages):
        made = edits.make_edit(parse_text(json.dumps({"type": "animate", "index": 0, **message})), start, 1.0 + number)
        assert made is not None
        wanted = made[0](wanted)
    play = wanted.scene.objects[0].play
    # One second at full speed, two at half of it.
    assert play == Play(1, loop=False, start=4.0, speed=0.5, offset=2.0, paused=True)
    assert loads_scene(dumps_scene(wanted.scene)).objects[0].play == play


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [("animation", 2, "animation 2: the file has 2, counted from 0"), ("speed", 1.0, "plays no animation: choose one")],
)
def test_what_cannot_be_played_is_said(item: Object, key: str, value: float, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        set_play(item, key, value, 0.0)


def test_what_the_file_refuses_the_page_does(item: Object) -> None:
    scene: Scene = make_scene(objects=(set_play(item, "animation", 0, 0.0),))
    with pytest.raises(SceneError, match="speed"):
        edits.set_animation(scene, 0, "speed", -1.0, 0.0)
    with pytest.raises(UsageError, match="object 3: the scene has 1"):
        edits.set_animation(scene, 3, "speed", 1.0, 0.0)
    with pytest.raises(ProtocolError, match="key"):
        parse_text('{"type": "animate", "index": 0, "key": "file", "value": 1}')
