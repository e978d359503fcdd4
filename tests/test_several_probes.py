"""Several mirror balls: objects between them are lit by what is interpolated, against a desk whose light is known."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.rendered_lamp import Desk, irradiance, picture, radiance
from tests.rendered_room import look_at
from warp_ar.engine.pipeline import Pipeline
from warp_ar.scene import (
    Camera,
    LambertMaterial,
    Marker,
    MirrorMaterial,
    Object,
    Pose,
    Probe,
    Proxy,
    Scene,
    dumps_scene,
    loads_scene,
)
from warp_ar.stages.quality import PRESETS

SIZE = (320, 240)
FOCAL = 320.0
EYE = np.array([0.0, -0.8, 0.35])
DESK = Desk()
BALLS = tuple(Probe((x, 0.0, 0.04), 0.04, (0.85,) * 3) for x in (-0.2, 0.2))
PLACES = (-0.2, -0.1, 0.0, 0.1, 0.2)
"""Of the objects, along the line from ball to ball."""
ASIDE, HEIGHT = -0.05, 0.05
"""Metres from that line to the objects, which may not be where the balls are, and above the desk."""
QUALITY = PRESETS["low"].with_methods(recover="clipped")
# What one ball tells of the light 5 cm from it, where the lamp is 8 % nearer: 16 % of irradiance and a little.
OWN_LIGHT = 0.18
# What the one ball does not see behind it is filled from the frame, or from what the other one sees.
BLIND_CONE = 0.01


def pose(right: float = 0.0) -> Pose:
    """``camera_from_world`` of a camera that looks between the balls, or to the right of there."""
    return Pose(*look_at(EYE, np.array([right, 0.0, 0.04])))


def make_scene(probes: tuple[Probe, ...], surface: Any) -> Scene:
    """Spheres of one material between the balls."""
    width, height = SIZE
    camera = Camera(width, height, FOCAL, FOCAL, (width - 1) / 2, (height - 1) / 2)
    objects = tuple(Object("sphere", at=(x, ASIDE, HEIGHT), radius=0.015, material=surface) for x in PLACES)
    desk = Proxy("plane", size=(2.0, 2.0))
    return Scene(camera, marker=Marker(size=0.08), probes=probes, proxies=(desk,), objects=objects)


def rays(right: float = 0.0) -> NDArray[np.float64]:
    """World directions of pixels."""
    width, height = SIZE
    x, y = np.meshgrid((np.arange(width) - (width - 1) / 2) / FOCAL, (np.arange(height) - (height - 1) / 2) / FOCAL)
    return np.asarray(np.stack([x, y, np.ones_like(x)], -1) @ pose(right).rotation)


def photograph(right: float = 0.0) -> NDArray[np.uint8]:
    """The desk and its balls."""
    balls = [(ball.center, ball.radius, ball.reflectance[0]) for ball in BALLS]
    linear = np.clip(picture(DESK, EYE, rays(right), balls), 0.0, 1.0)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.round(255.0 * encoded).astype(np.uint8)


def truth(mirror: bool) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Which object each pixel shows, or -1, and its radiance (H, W, 3)."""
    d = rays() / np.linalg.norm(rays(), axis=-1, keepdims=True)
    shown, out = np.full(d.shape[:2], -1), np.zeros(d.shape)
    for index, x in enumerate(PLACES):
        o = EYE - np.array([x, ASIDE, HEIGHT])
        along = d @ o
        under = along**2 - o @ o + 0.015**2
        hit = under > 0.0
        points = EYE + (-along - np.sqrt(np.maximum(under, 0.0)))[hit, None] * d[hit]
        normals = (points - np.array([x, ASIDE, HEIGHT])) / 0.015
        shown[hit] = index
        if mirror:
            out[hit] = radiance(DESK, points, d[hit] - 2.0 * (d[hit] * normals).sum(-1, keepdims=True) * normals)
        else:
            out[hit] = 0.8 / np.pi * irradiance(DESK, points, normals, 512)
    return shown, out


def rendered(probes: tuple[Probe, ...], surface: Any, device: str) -> NDArray[np.float64]:
    """Radiance of the objects (H, W, 3) in the pixels that they cover whole; NaN elsewhere."""
    with Pipeline(make_scene(probes, surface), device=device, quality=QUALITY) as pipeline:
        pipeline(photograph(), pose=pose(), time_seconds=0.0)
        virtual = pipeline.arrays["virtual"].numpy().astype(np.float64)
    return np.where(virtual[..., 3:] == 1.0, virtual[..., :3], np.nan)


def errors(probes: tuple[Probe, ...], mirror: bool, device: str) -> NDArray[np.float64]:
    """Root mean square error of each object, over the root mean square of its radiance; of mirrors that of the mean.

    A mirror shows the lamp at each ball's place, as brightly as the ball has weight: what it sends is right, not where.
    """
    surface = MirrorMaterial() if mirror else LambertMaterial((0.8, 0.8, 0.8))
    shown, expected = truth(mirror)
    found = rendered(probes, surface, device)
    result = []
    for index in range(len(PLACES)):
        inside = (shown == index) & np.isfinite(found[..., 0])
        assert inside.sum() > 50
        a, b = found[inside], expected[inside]
        if mirror:
            a, b = a.mean(0), b.mean(0)
        result.append(np.sqrt(((a - b) ** 2).mean() / (b**2).mean()))
    return np.array(result)


@pytest.mark.parametrize("mirror", [False, True])
def test_interpolated_light_is_nearer_to_the_truth_than_either_balls(device: str, mirror: bool) -> None:
    """On objects between the balls; beside one it is that one's."""
    both = errors(BALLS, mirror, device)
    alone = [errors((ball,), mirror, device) for ball in BALLS]
    print(np.round([*alone, both], 3))
    np.testing.assert_allclose([both[0], both[-1]], [alone[0][0], alone[1][-1]], atol=BLIND_CONE)
    # A mirror on its way from ball to ball is now nearer to one's light, now to the other's.
    assert both[1:4].mean() < 0.7 * min(of_one[1:4].mean() for of_one in alone)
    if not mirror:
        np.testing.assert_array_less(both[1:4], np.min(alone, axis=0)[1:4])
        assert both[0] < OWN_LIGHT
        assert both[-1] < OWN_LIGHT


def test_a_ball_that_leaves_the_picture_goes_out_smoothly(device: str) -> None:
    """In the frame in which it leaves nothing changes but by its trust; later objects have the other one's light."""
    scene = make_scene(BALLS, LambertMaterial((0.8, 0.8, 0.8)))
    away = -0.5  # the second ball is out of the picture, the first one and the middle object are in it
    frames = [(photograph(), pose())] * 2 + [(photograph(away), pose(away))] * 40
    shown = []
    with (
        Pipeline(scene, device=device, quality=QUALITY) as both,
        Pipeline(make_scene(BALLS[:1], LambertMaterial((0.8, 0.8, 0.8))), device=device, quality=QUALITY) as first,
    ):
        for number, (frame, at) in enumerate(frames):
            both(frame, pose=at, time_seconds=0.1 * number)
            virtual = both.arrays["virtual"].numpy().astype(np.float64)
            shown.append(virtual[..., :3].sum() / virtual[..., 3].sum())
        trust = both.arrays["probe_places"].numpy()[:, 3].copy()
        for number, (frame, at) in enumerate(frames):
            first(frame, pose=at, time_seconds=0.1 * number)
        virtual = first.arrays["virtual"].numpy().astype(np.float64)
    alone = virtual[..., :3].sum() / virtual[..., 3].sum()
    steps = np.diff(shown[2:])
    assert trust[0] == 1.0
    assert trust[1] < 1e-3
    assert abs(shown[-1] / alone - 1.0) < BLIND_CONE
    assert shown[2] < 0.98 * shown[-1]
    # A time constant of 0.4 s: no step of 0.1 s takes more than 1 - exp(-1/4) = 0.221 of the way; what the first ball
    # shows from the other view comes in meanwhile.
    assert np.abs(steps).max() < 0.25 * (shown[-1] - min(shown[2:]))


def test_what_frames_leave_out_changes_no_bit(device: str) -> None:
    """Frames in which no object is to be seen: light is gathered meanwhile."""
    scene = make_scene(BALLS, LambertMaterial((0.8, 0.8, 0.8)))
    views = (0.0, 3.0, 0.0, -0.5, 3.0, 0.0)
    frames = {right: photograph(right) for right in set(views)}
    lit = []
    for culling in (True, False):
        with Pipeline(scene, device=device, quality=QUALITY, culling=culling) as pipeline:
            lit.append([pipeline(frames[x], pose=pose(x), time_seconds=0.1 * k).image for k, x in enumerate(views)])
    np.testing.assert_array_equal(lit[0], lit[1])


def test_the_environment_is_that_of_the_first_ball(device: str) -> None:
    """As an output, a file, and what receivers are lit by; each further ball has one of its own."""
    found = []
    for balls in (BALLS, BALLS[::-1], BALLS[:1]):
        scene = make_scene(balls, LambertMaterial((0.8, 0.8, 0.8)))
        with Pipeline(scene, device=device, quality=QUALITY, outputs=("image", "environment")) as pipeline:
            found.append(np.array(pipeline(photograph(), pose=pose(), time_seconds=0.0).environment))
            others = pipeline.arrays.get("others_environment")
            if others is not None:
                found.append(np.array(others.numpy()[0]))
    first, second, swapped, _, alone = found
    up = slice(0, found[0].shape[0] // 4)  # what no ball has in its blind cone
    np.testing.assert_allclose(first[up], alone[up], rtol=0.05)
    np.testing.assert_allclose(second[up], swapped[up], rtol=0.05)
    assert np.abs(first[up] - second[up]).max() > 0.3


def test_scene_files_say_several_balls() -> None:
    scene = make_scene(BALLS, LambertMaterial())
    assert loads_scene(dumps_scene(scene)).probes == BALLS
    single = "[probe]\ncenter = [0.0, 0.0, 0.04]\nradius = 0.04\n"
    header = dumps_scene(dataclasses.replace(scene, probes=()))
    assert len(loads_scene(header + single).probes) == 1
    assert len(loads_scene(header + 3 * single.replace("[probe]", "[[probe]]")).probes) == 3
