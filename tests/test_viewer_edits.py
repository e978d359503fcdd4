"""Edits of a scene from the page: checked as a scene file is, undone and done again."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
from typing import Any

import pytest

from tests.viewer_rig import SIZE, page_scene
from warp_ar.errors import SceneError, UsageError
from warp_ar.scene import Camera, Exposure, Light, MirrorMaterial, PhongMaterial, Proxy, bundled_scenes, load_scene
from warp_ar.sources.synthetic import Synthetic
from warp_ar.stages.quality import PRESETS
from warp_ar.tracking.card_layout import CARD_MARKER
from warp_ar.viewer import edits
from warp_ar.viewer.controls import Controls, Feed
from warp_ar.viewer.edits import Wanted
from warp_ar.viewer.protocol import parse_text


def test_edits_are_checked_as_the_file_is() -> None:
    scene = page_scene()
    moved = edits.set_value(scene, "light", 0, "at", (0.1, 0.2, 0.3))
    assert moved.lights[0].at == (0.1, 0.2, 0.3)
    assert dataclasses.replace(moved, lights=scene.lights) == scene
    assert edits.set_value(scene, "object", 1, "roughness", 0.7).objects[1].material.roughness == 0.7
    shining = edits.set_value(scene, "object", 1, "model", "emissive")
    for key, value in (("intensity", 3.0), ("color", (1.0, 0.5, 0.2))):
        shining = edits.set_value(shining, "object", 1, key, value)
        assert getattr(shining.objects[1].material, key) == value
    assert edits.set_value(scene, "object", 0, "model", "mirror").objects[0].material == MirrorMaterial((0.5, 0.4, 0.3))
    assert isinstance(edits.set_value(scene, "object", 0, "model", "phong").objects[0].material, PhongMaterial)
    assert edits.set_value(scene, "exposure", 0, "scale", "auto").exposure == Exposure("auto")
    with pytest.raises(UsageError, match="key 'image' cannot be edited"):  # else a page could read the server's files
        edits.set_value(shining, "object", 1, "image", "/etc/hostname")
    for part, index, key, value in [
        ("light", 0, "intensity", -1.0),
        ("light", 0, "at", "here"),
        ("light", 0, "color", 3.0),
        ("object", 1, "minor_radius", 1.0),
        ("object", 0, "scale", 0.0),
        ("object", 1, "metallic", 2.0),
        ("exposure", 0, "scale", -0.5),
        ("exposure", 0, "scale", "dark"),
        ("marker", 0, "dictionary", "DICT_9X9"),
    ]:
        with pytest.raises(SceneError):
            edits.set_value(scene, part, index, key, value)


def test_what_is_new_stands_apart_and_on_the_desk() -> None:
    scene = load_scene("desk")
    for kind in ("sphere", "box", "torus", "torus"):
        scene = edits.add_part(scene, "object", kind)
    scene = edits.duplicate_part(scene, "object", 0)
    assert scene.objects[-1].file == scene.objects[0].file
    for index, item in enumerate(scene.objects):
        for other in scene.objects[:index]:
            apart = math.dist(item.at[:2], other.at[:2])
            assert apart > 0.9 * (item.radius + other.radius + 0.02), (item, other)
    lights = edits.duplicate_part(edits.add_part(scene, "light", "point"), "light", 1).lights
    assert len({light.at for light in lights}) == len(lights)
    for index, (item, rotate, lowest) in enumerate(
        [(scene.objects[1], (0.0, 0.0, 0.0), -0.03), (scene.objects[2], (0.0, 90.0, 45.0), -0.025)], 1
    ):
        lifted = edits.set_value(scene, "object", index, "at", (*item.at[:2], 0.4))
        turned = edits.set_value(lifted, "object", index, "rotate", rotate)
        assert edits.snap_object(turned, index).objects[index].at == (*item.at[:2], pytest.approx(-lowest))
    assert edits.snap_object(scene, 0).objects[0].at[2] == pytest.approx(0.0, abs=0.002), "the teapot's foot"
    with pytest.raises(UsageError, match="object 9"):
        edits.snap_object(scene, 9)


@pytest.mark.parametrize(
    ("part", "key", "value"),
    [
        ("object", "file", "secret.ply"),
        ("object", "material", "x"),
        ("object", "__class__", "x"),
        ("object", "base_color", "/etc/passwd"),
        ("object", "base_color", 0.5),
        ("object", "shininess", 5.0),
        ("object", "model", "shiny"),
        ("light", "animate", 1.0),
        ("proxy", "file", "secret.ply"),
    ],
)
def test_no_edit_names_a_file_or_what_is_no_key(part: str, key: str, value: Any) -> None:
    with pytest.raises((UsageError, SceneError)):
        edits.set_value(page_scene(), part, 0, key, value)
    with pytest.raises(UsageError):
        edits.set_value(page_scene(), "light", 5, "at", (0.0, 0.0, 0.0))


def test_what_is_hidden_stays_hidden_when_something_before_it_goes() -> None:
    scene = page_scene(lights=(Light("point", 1.0), Light("point", 2.0), Light("point", 3.0)))
    wanted = Wanted(scene, PRESETS["low"], hidden=frozenset({("light", 0), ("light", 2), ("object", 1)}))
    after = wanted.without_part("light", 0)
    assert after.hidden == {("light", 1), ("object", 1)}
    assert [light.intensity for light in after.shown_scene().lights] == [2.0]
    assert [part.shape for part in after.shown_scene().objects] == ["sphere"]


def test_a_camera_that_was_calibrated_is_known_when_it_comes_back() -> None:
    first, again, other = (
        Camera(*size, fx, fx, 1.0, 1.0) for size, fx in (((64, 48), 60.0), ((64, 48), 61.0), ((8, 6), 7.0))
    )
    wanted = Wanted(page_scene(), PRESETS["low"]).with_camera(first).with_camera(other).with_camera(again)
    assert [wanted.camera_of(size) for size in ((64, 48), (8, 6), (4, 3))] == [again, other, None]


def test_effects_are_left_out_of_what_is_shown() -> None:
    wanted = Wanted(page_scene(), PRESETS["low"])
    lists = {"objects": "objects", "lights": "lights", "environment": "probes", "receiver": "proxies"}
    for name, empty in lists.items():
        shown = wanted.with_effect(name, False).shown_scene()
        assert getattr(shown, empty) == ()
        assert getattr(wanted.with_effect(name, False).with_effect(name, True).shown_scene(), empty) != ()
    assert wanted.with_effect("exposure", False).shown_scene().exposure == Exposure()
    assert wanted.with_effect("relief", False).shown_quality().method("relight") == "flat"
    assert wanted.with_effect("environment_shadow", False).shown_quality().method("environment_shadow") == "none"
    assert wanted.with_method("prefilter", "fis128").shown_quality().method("prefilter") == "fis128"
    assert wanted.with_method("prefilter", "fis128").with_method("prefilter", "").shown_quality() == PRESETS["low"]
    for stage, method in [("prefilter", "best"), ("nonsense", "fis128")]:
        with pytest.raises(UsageError):
            wanted.with_method(stage, method)


@pytest.mark.parametrize("name", sorted(bundled_scenes()))
def test_every_bundled_scene_is_told_to_the_page_without_a_path(name: str) -> None:
    record = json.dumps(edits.wanted_record(Wanted(load_scene(name), PRESETS["low"])))
    assert "/" not in record


@pytest.mark.parametrize(("part", "kind"), edits.NEW)
def test_what_can_be_added_can_be_read_back(part: str, kind: str) -> None:
    scene = edits.add_part(page_scene(), part, kind)
    assert edits.checked(scene) == scene
    for _ in range(edits.MOST_PARTS):
        with contextlib.suppress(UsageError):
            scene = edits.add_part(scene, part, kind)
    assert len({"object": scene.objects, "light": scene.lights}[part]) == edits.MOST_PARTS


def test_the_printed_card_is_used_with_the_sizes_that_were_typed() -> None:
    scene = page_scene()
    used = edits.use_card(scene, 0.031, 0.097)
    assert (used.objects, used.lights) == (scene.objects, scene.lights)
    assert edits.card_ruler(used) == pytest.approx(0.097)
    assert edits.card_ruler(edits.use_card(scene, 0.031, 0.1)) == pytest.approx(0.1)
    assert edits.card_ruler(scene) is None
    assert used.marker.board.square_length == pytest.approx(0.97 * CARD_MARKER.board.square_length)
    assert used.probes[0].center == pytest.approx((0.0, 0.97 * 0.114, 0.031))
    assert any(proxy.shape == "plane" for proxy in used.proxies)
    # Boxes stood around the marker of before; those that were pointed out beside the card stay.
    assert not any(proxy.shape == "box" for proxy in edits.use_card(load_scene("desk"), 0.031, 0.1).proxies)
    with_box = edits.add_item(used, "proxy", Proxy("box", size=(0.06, 0.06, 0.06)))
    assert edits.use_card(with_box, 0.031, 0.098).proxies == with_box.proxies
    own = edits.set_value(used, "marker", 0, "size", 0.05)
    assert own.marker.board is None
    assert own.marker.size == 0.05
    for radius, ruler, said in [(31.0, 0.1, "31000 mm; expected 5 to"), (0.03, 97.0, "97000 mm; expected 50 to 150")]:
        with pytest.raises(UsageError, match=said):
            edits.use_card(scene, radius, ruler)


def test_a_material_comes_back_with_its_model() -> None:
    """Gold made chalk, and metal again, is gold again; of another object nothing is kept."""
    wanted = Wanted(page_scene(), PRESETS["low"])
    for key, value in (("model", "metallic_roughness"), ("metallic", 1.0), ("roughness", 0.3)):
        wanted = wanted.with_value("object", 0, key, value)
    gold = wanted.scene.objects[0].material
    wanted = wanted.with_value("object", 0, "model", "lambert").with_value("object", 1, "model", "lambert")
    wanted = wanted.with_value("object", 0, "model", "metallic_roughness")
    assert wanted.scene.objects[0].material == gold
    assert wanted.without_part("object", 0).materials == ()


def test_edits_are_undone_and_done_again() -> None:
    told: list[dict[str, Any]] = []
    feed = Feed(Synthetic("card", size=SIZE))
    start = Wanted(page_scene(), PRESETS["low"])
    controls = Controls(feed, start, told.append)

    def edit(**message: Any) -> None:
        made = edits.make_edit(parse_text(json.dumps(message)), start)
        assert made is not None
        controls.change(*made)

    seen = [controls.wanted]
    for message in (
        {"type": "remove", "part": "object", "index": 0},
        {"type": "add", "part": "light", "kind": "spot"},
        {"type": "set", "part": "proxy", "index": 0, "key": "at", "value": [0.1, 0.0, 0.0]},
        {"type": "show", "part": "light", "index": 0, "on": False},
        {"type": "effect", "name": "receiver", "on": False},
        {"type": "method", "stage": "prefilter", "method": "fis128"},
        {"type": "card", "radius": 0.03, "ruler": 0.1},
        {"type": "reset"},
    ):
        edit(**message)
        assert controls.wanted != seen[-1]
        seen.append(controls.wanted)
    assert told[-1]["undo"] == "undo all edits"
    controls.change(lambda w: dataclasses.replace(w, quality=PRESETS["high"]))  # no edit: it stays
    for before in seen[-2::-1]:
        controls.undo()
        assert controls.wanted == dataclasses.replace(before, quality=PRESETS["high"])
    assert told[-1]["undo"] is None
    assert told[-1]["redo"] == "remove object 1"
    controls.undo()
    for after in seen[1:]:
        controls.redo()
        assert controls.wanted == dataclasses.replace(after, quality=PRESETS["high"])
    # What is done anew forgets what was undone; a drag is one edit.
    controls.undo()
    for x in (0.1, 0.2, 0.3):
        edit(type="set", part="light", index=0, key="at", value=[x, 0.0, 0.2])
    assert told[-1]["redo"] is None
    controls.undo()
    assert controls.wanted == dataclasses.replace(seen[-2], quality=PRESETS["high"])
    # An edit that cannot be built is none.
    good = controls.wanted
    edit(type="add", part="object", kind="box")
    controls.give_back(good, controls.wanted)
    controls.undo()
    assert controls.wanted == dataclasses.replace(seen[-3], quality=PRESETS["high"])
    controls.close()
