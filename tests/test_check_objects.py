"""Objects outside the picture are named, with their side; those that may be there are not."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.printed_card import PrintedCard
from tests.rendered_room import look_at
from warp_ar.checks import checkup
from warp_ar.checks.check_objects import check_objects, find_outside, sphere_around, written_poses
from warp_ar.checks.check_pictures import Look
from warp_ar.checks.check_pictures import look_at as look_over
from warp_ar.checks.check_print import card_scale, check_print
from warp_ar.checks.check_scene import check_scene
from warp_ar.checks.checkup import check_look
from warp_ar.checks.finding import Finding
from warp_ar.errors import SceneError
from warp_ar.scene import (
    Animation,
    Camera,
    CapturedLight,
    CharucoBoard,
    EmissiveMaterial,
    Marker,
    Object,
    Pose,
    PoseSpec,
    Scene,
    load_scene,
    object_from_trimesh,
)
from warp_ar.scene.object_materials import mesh_of
from warp_ar.tracking.card_layout import CARD_MARKER

CAMERA = Camera(64, 48, 64.0, 64.0, 31.5, 23.5)
AHEAD = Pose(np.eye(3), np.zeros(3))
TURNED = Pose(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))
"""It looks the other way."""


def ball(*at: float, **more: Any) -> Object:
    return Object("sphere", radius=0.1, at=at, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("item", "side"),
    [
        (ball(0.0, 0.0, 1.0), None),
        (ball(0.55, 0.0, 1.0), None),  # its rim is in the picture
        (ball(0.8, 0.0, 1.0), "right of the picture"),
        (ball(-0.8, 0.1, 1.0), "left of the picture"),
        (ball(0.1, -0.8, 1.0), "above the picture"),
        (ball(0.1, 0.8, 1.0), "below the picture"),
        (ball(0.0, 0.0, -1.0), "behind the camera"),
        (ball(0.0, 0.0, 0.0), None),  # the camera is in it
        (ball(0.8, 0.0, 1.0, scale=4.0), None),
        (ball(0.8, 0.0, 1.0, animate=Animation((0.0, 0.0, 30.0))), None),
        (ball(0.8, 0.0, 1.0, marker=Marker(size=0.05, id=7)), None),
        (ball(0.8, 0.0, 1.0, material=EmissiveMaterial(intensity=1.0)), None),
        (Object("box", size=(0.1, 1.2, 0.1), at=(0.8, 0.0, 1.0), rotate=(0.0, 0.0, 90.0)), None),
        (Object("torus", major_radius=0.2, minor_radius=0.1, at=(0.7, 0.0, 1.0)), None),
        (Object("tube", radius=0.01, length=0.8, at=(0.8, 0.0, 1.0), rotate=(0.0, 90.0, 0.0)), None),
        (Object("rect", size=(0.1, 0.1, 0.0), at=(0.8, 0.0, 1.0)), "right of the picture"),
        (Object("mesh", file=Path("nowhere.obj"), at=(0.8, 0.0, 1.0)), None),  # the run says what is wrong with it
    ],
)
def test_sides(item: Object, side: str | None) -> None:
    scene = Scene(CAMERA, objects=(ball(0.0, 0.0, 1.0), item))
    assert find_outside(scene, CAMERA, [AHEAD]) == ({} if side is None else {1: side})
    found = [finding.text for finding in check_objects(scene, CAMERA, [AHEAD])]
    assert found == ([] if side is None else [f"[[object]] 1 ({item.shape}) lies {side}, so it cannot be seen"])


def test_one_picture_that_shows_it_is_enough() -> None:
    scene = Scene(CAMERA, objects=(ball(0.0, 0.0, 1.0),))
    assert find_outside(scene, CAMERA, [TURNED, AHEAD]) == {}
    (finding,) = check_objects(scene, CAMERA, [TURNED] * 3)
    assert finding.text == "[[object]] 0 (sphere) lies behind the camera, in all 3 frames that were looked at"
    assert find_outside(scene, CAMERA, []) == {}


def test_a_mesh_lies_in_its_sphere() -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.creation.box((0.2, 0.4, 0.6))
    mesh.apply_translation((3.0, 0.0, 0.0))
    item = object_from_trimesh(mesh, at=(0.0, 0.0, 1.0), rotate=(0.0, 0.0, 90.0), scale=0.5)
    around = sphere_around(item)
    assert around.center == pytest.approx((0.0, 1.5, 1.0), abs=1e-6)
    assert around.radius == pytest.approx(0.25 * np.linalg.norm((0.2, 0.4, 0.6)), rel=1e-6)
    with pytest.raises(SceneError):
        mesh_of(Object("mesh", file=Path("nowhere.obj")))


def test_written_poses_are_looked_at_where_there_is_no_marker() -> None:
    """Those of the whole recording, however long it is."""
    poses = [AHEAD] * 1000 + [TURNED] * 1000
    spec = PoseSpec(tuple((tuple(p.rotation.reshape(-1)), tuple(p.translation)) for p in poses))
    light = CapturedLight(Path("light.exr"))
    scene = Scene(CAMERA, objects=(ball(0.0, 0.0, 1.0),), pose=spec, captured=light, has_marker=False)
    some = written_poses(scene)
    assert 60 < len(some) <= 120
    assert {float(pose.rotation[0, 0]) for pose in some} == {1.0, -1.0}
    image = np.zeros((48, 64, 3), np.uint8)
    look = Look(CAMERA, (image,), (), (), np.zeros((256, 3), np.float32))
    assert check_look(scene, look) == []
    away = dataclasses.replace(scene, objects=(ball(0.0, 9.0, 1.0), ball(0.0, 0.0, 1.0)))
    assert [finding.name for finding in check_look(away, look)] == ["units.at", "object.outside"]
    assert written_poses(dataclasses.replace(scene, pose=None)) == []


@pytest.mark.parametrize(
    ("more", "dark"),
    [
        ({}, True),
        ({"captured": CapturedLight(Path("light.exr"))}, False),
        ({"objects": (ball(0.0, 0.0, 1.0), ball(0.0, 0.1, 1.0, material=EmissiveMaterial(intensity=1.0)))}, False),
    ],
)
def test_captured_light_and_what_emits_light_the_objects(more: dict[str, Any], dark: bool) -> None:
    scene = dataclasses.replace(Scene(CAMERA, objects=(ball(0.0, 0.0, 1.0),)), **more)
    assert ("probe.none" in [finding.name for finding in check_scene(scene)]) == dark


# --- A card that was not printed at true scale is told by its paper ---------------------------------------------------


CAMERA_CHECK_PRINT = Camera(640, 480, 600.0, 600.0, 321.0, 238.0)


def encode(linear):
    return np.clip(linear, 0, 1) ** (1 / 2.2)


def findings(paper, scale, told=1.0, seed=0):
    """What is found where the card is printed at ``scale`` and the scene says ``told``."""
    rng = np.random.default_rng(seed)
    card = PrintedCard(rng, paper=paper, scale=scale)
    images = []
    for k in range(3):
        eye = np.array([0.12 * (k - 1), -0.42, 0.5 + 0.04 * k])
        pose = Pose(*look_at(eye, np.array([0.0, 0.02, 0.0])))
        images.append((card.photograph(CAMERA_CHECK_PRINT, pose, 0.7, encode), k / 24))
    board = CARD_MARKER.board
    lengths = (board.square_length * told, board.marker_length * told)
    marker = dataclasses.replace(CARD_MARKER, board=CharucoBoard(board.columns, board.rows, *lengths))
    look = look_over(marker, CAMERA_CHECK_PRINT, images)
    assert len(look.views) == 3
    return check_print(marker, CAMERA_CHECK_PRINT, look.views)


@pytest.mark.parametrize(("paper", "scale"), [("a4", 0.97), ("letter", 0.97), ("a4", 0.94), ("letter", 1.04)])
def test_other_scales_are_told(paper, scale):
    (found,) = findings(paper, scale)
    assert found.name == "card.print"
    printed = float(found.text.split("printed at ")[1].split("%")[0])
    assert printed == pytest.approx(100 * scale, abs=0.6)
    assert f"be {printed:.1f} mm" in found.remedy


@pytest.mark.parametrize(
    ("paper", "scale", "told"), [("a4", 1.0, 1.0), ("letter", 1.0, 1.0), ("a4", 0.97, 0.97), ("letter", 1.005, 1.0)]
)
def test_what_the_scene_says_is_no_finding(paper, scale, told):
    assert findings(paper, scale, told, seed=1) == []


def test_other_markers_have_no_known_paper():
    assert card_scale(Marker()) is None
    assert card_scale(CARD_MARKER) == 1.0
    assert card_scale(dataclasses.replace(CARD_MARKER, dictionary="DICT_5X5_50")) is None


# --- The quick half of the checks tells where a mirror ball was seen --------------------------------------------------


UNSEEN = ("source.empty", "marker.unseen", "units.ball", "ball.unfound", "ball.outside")


@pytest.mark.parametrize("name", [*UNSEEN, "ball.dull"])
def test_a_ball_is_seen_only_where_it_was_looked_for(monkeypatch, tmp_path, name):
    monkeypatch.setattr(checkup, "check_and_look", lambda *_, **__: ([Finding(name, "", "")], None))
    found, seen = checkup.quick_check(load_scene("desk"), tmp_path)
    assert [each.name for each in found] == [name]
    assert seen == (name not in UNSEEN)


def test_a_device_is_not_opened_twice(monkeypatch):
    looked = []
    monkeypatch.setattr(checkup, "check_and_look", lambda scene, source, **how: (looked.append(source) or [], None))
    assert not checkup.quick_check(load_scene("desk"), 0)[1]
    assert looked == [None]
