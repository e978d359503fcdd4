"""Frames in which something covers the ball tell nothing of the light."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.test_drift import POSE, encode, linear_picture
from tests.test_drift import SCENE as WITHOUT_ROOM
from warp_ar import PRESETS, Pipeline
from warp_ar.ball.ball_occlusion import PATIENCE, BallOcclusion
from warp_ar.calibration.saturation import ball_discs
from warp_ar.scene import Pose, loads_scene
from warp_ar.sources.deep_frame import DeepFrame

SCENE = WITHOUT_ROOM.replace("center = [0.0, 0.3, 0.03]\nradius = 0.03", "center = [-0.26, 0.0, 0.05]\nradius = 0.05")
"""The ball is in the picture."""
HAND = np.array([0.35, 0.2, 0.14])
STEP = 0.1
"""Seconds between frames."""
OBJECT = """
[[object]]
shape = "sphere"
radius = 0.03
at = [0.28, 0.0, 0.03]
[object.material]
model = "lambert"
base_color = [0.8, 0.8, 0.8]
"""
RETURNED = 1e-3
"""Relative difference of light before and after a hand: confidence has faded by a hundredth."""


def disc(scene):
    return ball_discs(scene.probes, scene.camera, POSE)[0]


def picture(scene, light=1.0, mirrored=(0.5, 0.45, 0.4)):
    """The table with a ball on it, in which a bright half and a dark one are seen, linear."""
    linear = linear_picture(scene) * light
    x, y, radius = disc(scene)
    v, u = np.mgrid[: linear.shape[0], : linear.shape[1]]
    inside = np.hypot(u - x, v - y) < radius
    linear[inside] = np.where((u < x)[..., None], np.array(mirrored), 0.3 * np.array(mirrored))[inside]
    return linear


def with_hand(linear, scene, hand=HAND):
    """A hand from the left that reaches over the ball."""
    x, y, radius = disc(scene)
    linear = linear.copy()
    linear[round(y - 3 * radius) : round(y + 3 * radius), : round(x + 0.5 * radius)] = hand
    return linear


def watch(pictures, seconds=STEP, gains=None):
    scene = loads_scene(SCENE)
    occlusion = BallOcclusion(scene, scene.camera)
    gains = [np.ones(3)] * len(pictures) if gains is None else gains
    return [
        occlusion.observe(encode(one), [disc(scene)], POSE, seconds * index, gain)
        for index, (one, gain) in enumerate(zip(pictures, gains, strict=True))
    ]


def watch_deep(images, deep_frames):
    scene = loads_scene(SCENE)
    occlusion = BallOcclusion(scene, scene.camera)
    return [
        occlusion.observe(image, [disc(scene)], POSE, STEP * index, np.ones(3), deep)
        for index, (image, deep) in enumerate(zip(images, deep_frames, strict=True))
    ]


def test_a_white_hand_before_lamps_above_white_is_told_by_light():
    """The ball mirrors what is four times as bright as white: its codes are 255 with and without the hand."""
    scene = loads_scene(SCENE)
    bare = picture(scene, mirrored=(4.0, 4.0, 4.0))
    frames = [bare, bare, with_hand(bare, scene, 0.9), bare]
    codes = [encode(frame) for frame in frames]
    assert watch_deep(codes, [DeepFrame(frame.astype(np.float32)) for frame in frames]) == [False, False, True, False]
    assert watch_deep(codes, [None] * 4) == [False] * 4, "8 bits do not hold it"


def test_a_hand_is_told_while_it_is_there():
    scene = loads_scene(SCENE)
    bare = picture(scene)
    hand = with_hand(bare, scene)
    assert watch([bare, bare, hand, hand, bare]) == [False, False, True, True, False]


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_light_that_changes_is_not_taken_for_a_hand(factor):
    scene = loads_scene(SCENE)
    bare = picture(scene)
    changed = picture(scene, factor, tuple(factor * np.array([0.5, 0.45, 0.4])))
    assert watch([bare, bare, changed, changed]) == [False] * 4


def test_what_only_the_ball_mirrors_is_light():
    scene = loads_scene(SCENE)
    bare = picture(scene)
    # Somebody walks by: the ball shows it, the table hardly.
    assert watch([bare, bare, picture(scene, 0.97, (0.1, 0.1, 0.1))]) == [False] * 3


def test_a_hand_beside_the_ball_covers_nothing():
    scene = loads_scene(SCENE)
    bare = picture(scene)
    x, y, radius = disc(scene)
    beside = bare.copy()
    beside[round(y - 3 * radius) : round(y + 3 * radius), : round(x - 1.2 * radius)] = HAND
    assert watch([bare, bare, beside]) == [False] * 3


def test_what_stays_is_believed():
    scene = loads_scene(SCENE)
    bare = picture(scene)
    many = int(PATIENCE / STEP) + 4
    told = watch([bare, bare] + [with_hand(bare, scene)] * many)
    assert told[2 : 2 + int(PATIENCE / STEP)] == [True] * int(PATIENCE / STEP)
    assert not any(told[-2:])


def test_a_frame_without_the_ball_in_it_is_no_cover():
    scene = loads_scene(SCENE)
    occlusion = BallOcclusion(scene, scene.camera)
    image = encode(picture(scene))
    away = Pose(POSE.rotation, np.array([0.0, 5.0, 0.8]))
    for index, pose in enumerate((POSE, away, POSE)):
        discs = ball_discs(scene.probes, scene.camera, pose)
        assert not occlusion.observe(image, discs, pose, STEP * index, np.ones(3))


@pytest.mark.slow
def test_covered_frames_leave_the_light_alone(device):
    scene = loads_scene(SCENE + OBJECT)
    bare, hand = encode(picture(scene)), encode(with_hand(picture(scene), scene))
    lights = []
    pipeline = Pipeline(scene, device=device, quality=PRESETS["medium"], outputs=("image", "environment"))
    try:
        for index, frame in enumerate([bare, bare, hand, hand, bare]):
            result = pipeline(cv2.GaussianBlur(frame, (0, 0), 0.5), time_seconds=STEP * index, pose=POSE)
            lights.append(np.array(result.environment))
            assert pipeline.inputs.covered == (frame is hand)
    finally:
        pipeline.close()
    assert np.array_equal(lights[2], lights[1])
    assert np.array_equal(lights[3], lights[1])
    assert np.abs(lights[4] - lights[1]).max() < RETURNED * lights[1].max()
