"""Scenes of numbers that are not finite."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from warp_ar.errors import SceneError
from warp_ar.scene import bundled_scenes, load_scene
from warp_ar.scene.description import PoseSpec
from warp_ar.scene.fields import check_finite


@pytest.mark.parametrize("name", bundled_scenes())
def test_bundled_scenes_are_in_order(name: str) -> None:
    check_finite(load_scene(name))


def test_what_is_left_out_is_not_looked_at() -> None:
    turned = tuple(np.eye(3).reshape(-1).tolist())
    scene = dataclasses.replace(load_scene("desk"), pose=PoseSpec(((turned, (0.0, math.inf, 1.0)),)))
    with pytest.raises(SceneError, match=r"pose\.poses\[0\]\[1\]\[1\] = inf"):
        check_finite(scene)
    check_finite(scene, leave=("pose",))
