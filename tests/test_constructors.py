"""Values that scene constructors take are checked where they are given, with class, field, value and what is right."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np
import pytest

from warp_ar import scene as sc
from warp_ar.errors import SceneError, UsageError


@pytest.mark.parametrize(
    ("make", "values", "message"),
    [
        (sc.Object, {"shape": "cube"}, "Object: shape = 'cube': unknown; .*"),
        (sc.Object, {"shape": "sphere", "radius": 0}, "Object: radius = 0: expected a number above 0"),
        (sc.Object, {"shape": "sphere"}, "radius = 0.0: expected a number above 0"),
        (sc.Object, {"shape": "mesh"}, "a mesh needs its file"),
        (sc.Object, {"shape": "torus", "major_radius": 0.1, "minor_radius": 0.2}, "less than major_radius, 0.1"),
        (sc.Object, {"shape": "sphere", "radius": 1, "scale": -1.0}, "scale = -1.0: expected a number above 0"),
        (sc.Object, {"shape": "sphere", "radius": 1, "at": (0, 0)}, r"at = \(0, 0\): expected 3 numbers"),
        (sc.Object, {"shape": "sphere", "radius": 1, "at": ("a", 0, 0)}, "expected 3 numbers"),
        (sc.Proxy, {"shape": "ball"}, "shape = 'ball': unknown"),
        (sc.Probe, {"center": (0, 0, 0), "radius": 0.0}, "Probe: radius = 0.0"),
        (sc.Probe, {"center": (0, 0, 0), "radius": 1, "reflectance": (2, 1, 1)}, "each from 0 to 1"),
        (sc.LambertMaterial, {"base_color": (255, 0, 0)}, r"base_color = \(255, 0, 0\): .*each from 0 to 1"),
        (sc.PhongMaterial, {"shininess": -1.0}, "shininess = -1.0: expected a number 0 or more"),
        (sc.MetallicRoughnessMaterial, {"roughness": 1.5}, "from 0 to 1"),
        (sc.MirrorMaterial, {"base_color": "red"}, "expected 3 numbers"),
        (sc.EmissiveMaterial, {"intensity": -1}, "0 or more"),
        (sc.Light, {"kind": "sun", "intensity": 1}, "kind = 'sun': unknown"),
        (sc.Light, {"kind": "spot", "intensity": 1}, "a spot light needs a target or a direction"),
        (sc.Light, {"kind": "point", "intensity": True}, "intensity = True: expected a number"),
        (sc.Light, {"kind": "directional", "intensity": 1, "direction": (0, 0, 0)}, "the way the light travels"),
        (sc.AreaLight, {"kind": "square", "intensity": 1}, "kind = 'square': unknown"),
        (sc.CapturedLight, {"file": pathlib.Path("a.exr"), "axes": "up"}, "axes = 'up': unknown"),
    ],
)
def test_what_cannot_be_is_named(make: Any, values: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError, match=message):
        make(**values)


@pytest.mark.parametrize("rotation", [2 * np.eye(3), np.diag([1, 1, -1]), np.zeros((3, 3)), np.ones((3, 3))])
def test_a_pose_has_a_rotation(rotation: np.ndarray) -> None:
    with pytest.raises(UsageError, match="expected a rotation matrix"):
        sc.Pose(rotation, np.zeros(3))


def test_numbers_of_numpy_are_numbers() -> None:
    item = sc.Object("sphere", radius=np.float32(0.1), at=np.array([0.0, 1.0, 2.0], np.float32))
    assert item.radius == np.float32(0.1)
