"""Variations of a data set: seeded, clear of each other and of the marker, resting on the desk."""

from __future__ import annotations

import dataclasses
import itertools

import cv2
import numpy as np
import pytest

from tests.farm_rig import make_jobs
from tests.kernel_rig import look_at
from warp_ar.farm.dataset import NoPlace, _overlap, draw_variation, local_points, receiver_of
from warp_ar.scene import load_scene
from warp_ar.scene.geometry import rotation_matrix

OBJECTS = [
    {"shape": "sphere", "radius": 0.02},
    {"shape": "box", "size": [0.03, 0.05, 0.02], "rest": "any"},
    {"shape": "torus", "major_radius": 0.02, "minor_radius": 0.006, "scale": 1.5},
]
CONE = {"target": [0, 0, 0], "inner_angle": 15, "outer_angle": 8}
LIGHT = {"kind": "spot", "at": [[-0.3, -0.3, 0.3], [0.3, 0.3, 0.5]], "intensity": [0.5, 2.0], **CONE}
MARGIN = 0.004
ROUNDED = 2e-6
"""Metres by which a hull of single-precision points, and a place rounded to a micrometre, may be off."""


POSES = [look_at((0.5 * np.cos(a), 0.5 * np.sin(a), 0.6)) for a in np.linspace(-2.2, -0.9, 5)]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    section = {"variations": 5, "seed": 3, "objects": [2, 4], "margin": MARGIN, "object": OBJECTS, "light": [LIGHT]}
    return make_jobs(tmp_path_factory.mktemp("jobs"), [{"scene": "desk"}], dataset=section).dataset


@pytest.fixture(scope="module")
def drawn(dataset):
    return [draw_variation(load_scene("desk"), dataset, 0, number, POSES) for number in range(12)]


def points_of(item):
    return item.scale * local_points(item) @ rotation_matrix(item.rotate).T + np.array(item.at)


def hull(points):
    return cv2.convexHull(points[:, :2].astype(np.float32)).reshape(-1, 2).astype(float)


def test_a_seed_gives_one_scene_whoever_draws_it(dataset, drawn):
    assert draw_variation(load_scene("desk"), dataset, 0, 7, POSES) == drawn[7]
    assert len({variation.scene.objects for variation in drawn}) == len(drawn)
    assert draw_variation(load_scene("desk"), dataset, 1, 7, POSES) != drawn[7]


def test_numbers_of_objects_and_lights_are_as_asked(drawn):
    assert {len(variation.scene.objects) for variation in drawn} <= {2, 3, 4}
    assert {len(variation.scene.lights) for variation in drawn} == {1}
    assert {kind for variation in drawn for kind in variation.kinds} == {0, 1, 2}


def test_every_object_rests_on_the_desk(dataset, drawn):
    height = receiver_of(load_scene("desk"), dataset).height
    assert height == -0.0004
    for item in (item for variation in drawn for item in variation.scene.objects):
        assert points_of(item)[:, 2].min() == pytest.approx(height, abs=ROUNDED)


def test_objects_are_apart_from_each_other_and_from_the_desk(dataset, drawn):
    taken = receiver_of(load_scene("desk"), dataset).taken
    assert len(taken) == 3, "the tin, the ball and the marker's card"
    for variation in drawn:
        outlines = [hull(points_of(item)) for item in variation.scene.objects]
        for a, b in itertools.combinations(outlines, 2):
            assert distance(a, b) >= MARGIN - ROUNDED
        for a, b in itertools.product(outlines, taken):
            assert distance(a, b) >= MARGIN - ROUNDED


def distance(a, b):
    """Between two convex outlines: along the best of many directions, from above by less than a thousandth."""
    turn = np.linspace(0, 2 * np.pi, 2000)
    axis = np.stack([np.cos(turn), np.sin(turn)])
    return float(((a @ axis).min(0) - (b @ axis).max(0)).max())


def test_no_object_hides_the_marker_from_any_camera(drawn):
    camera = load_scene("desk").camera
    square = 0.04 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], float)

    def pixels(pose, points):
        return cv2.projectPoints(pose.apply(points), np.zeros(3), np.zeros(3), camera.matrix(), None)[0].reshape(-1, 2)

    for variation, pose in itertools.product(drawn, POSES):
        marker = hull(pixels(pose, square))
        for item in variation.scene.objects:
            assert not _overlap(hull(pixels(pose, points_of(item))), marker)


def test_what_would_hide_the_marker_finds_no_place(tmp_path):
    """A tall box stands before the marker, as the camera sees it, or behind it: only behind it is allowed."""
    low = look_at((0.0, -0.5, 0.15))
    for y0, y1, found in ((-0.2, -0.16, False), (0.28, 0.32, True)):
        section = {"objects": [1, 1], "object": [{"shape": "box", "size": [0.02, 0.02, 0.2]}]}
        dataset = make_jobs(tmp_path, [{"scene": "desk"}], dataset={**section, "region": [-0.01, y0, 0.01, y1]}).dataset
        scene = dataclasses.replace(load_scene("desk"), proxies=(), probes=())
        if found:
            assert len(draw_variation(scene, dataset, 0, 0, [low]).scene.objects) == 1
        else:
            with pytest.raises(NoPlace):
                draw_variation(scene, dataset, 0, 0, [low])


def test_too_many_objects_for_the_region_are_told(tmp_path):
    section = {"objects": [9, 9], "region": [0.1, -0.12, 0.18, -0.05], "object": [OBJECTS[0]]}
    dataset = make_jobs(tmp_path, [{"scene": "desk"}], dataset=section).dataset
    with pytest.raises(NoPlace, match=r"of 9 objects find a place .* enlarge dataset.region"):
        draw_variation(load_scene("desk"), dataset, 0, 0, POSES)
