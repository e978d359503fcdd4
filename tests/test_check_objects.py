"""Objects outside the picture are named, with their side; those that may be there are not."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from warp_ar.checks.check_objects import check_objects, find_outside, sphere_around, written_poses
from warp_ar.checks.check_pictures import Look
from warp_ar.checks.check_scene import check_scene
from warp_ar.checks.checkup import check_look
from warp_ar.errors import SceneError
from warp_ar.scene import (
    Animation,
    Camera,
    CapturedLight,
    EmissiveMaterial,
    Marker,
    Object,
    Pose,
    PoseSpec,
    Scene,
    object_from_trimesh,
)
from warp_ar.scene.object_materials import mesh_of

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
