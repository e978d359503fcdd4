"""How a plane mirrors, told from rendered desks of known gloss: their lobe is integrated in another way."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest

from tests.rendered_room import Room, look_at, radiance_along, render, table_irradiance, true_environment
from warp_ar.light.receiver_gloss import Surroundings, View, estimate_gloss, shown_well

SIZE = (112, 84)
FOCAL = 1.15 * SIZE[0]
ROOM = Room(seed=11, table=(0.8, 0.6), reflectance=0.85, lamp=60.0)
GAIN = 0.35


def mirrored(points, wo, f0, alpha, count=24):
    """What a table sends toward ``wo`` by its gloss: facets drawn by their density, not as they are seen."""
    rng, out, irradiance = np.random.default_rng(1), np.zeros((len(points), 3)), table_irradiance(ROOM, 512)

    def smith(cosine):
        return 0.5 * (np.sqrt(1 + alpha**2 * (1 / np.maximum(cosine, 1e-4) ** 2 - 1)) - 1)

    for k in range(count):
        u, turn = (k + rng.random(len(points))) / count, 2 * np.pi * rng.random(len(points))
        cosine = 1 / np.sqrt(1 + alpha**2 * u / (1 - u))
        sine = np.sqrt(1 - cosine**2)
        half = np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine], -1)
        cos_d = (half * wo).sum(-1)
        wi = 2 * cos_d[:, None] * half - wo
        leaves = (wi[:, 2] > 1e-4) & (cos_d > 0)
        fresnel = f0 + (1 - f0) * (1 - np.clip(cos_d, 0, 1)) ** 5
        weight = np.where(leaves, fresnel * cos_d / (wo[:, 2] * cosine * (1 + smith(wo[:, 2]) + smith(wi[:, 2]))), 0)
        wi[~leaves] = [0, 0, 1]
        out += weight[:, None] * radiance_along(ROOM, points + np.array([0, 0, 1e-5]), wi, irradiance)
    return out / count


@functools.cache
def matt_desk():
    """Linear render, rays, camera, and where the table is."""
    matrix = np.array([[FOCAL, 0, (SIZE[0] - 1) / 2], [0, FOCAL, (SIZE[1] - 1) / 2], [0, 0, 1]])
    eye = ROOM.center + np.array([0.06, -0.42, 0.25])
    rotation, translation = look_at(eye, np.array([0.02, 0.02, 0.03]))
    picture = render(ROOM, matrix, (rotation, translation), SIZE, samples=1).astype(float)
    columns, rows = np.meshgrid(
        (np.arange(SIZE[0]) - matrix[0, 2]) / FOCAL, (np.arange(SIZE[1]) - matrix[1, 2]) / FOCAL
    )
    rays = np.stack([columns, rows, np.ones_like(rows)], -1)
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ rotation
    place = eye - eye[2] / rays[..., 2:] * rays
    on = (rays[..., 2] < 0) & (np.abs(place[..., 0]) < ROOM.table[0]) & (np.abs(place[..., 1]) < ROOM.table[1])
    along = rays @ (eye - ROOM.center)
    on &= along**2 < ((eye - ROOM.center) ** 2).sum() - ROOM.radius**2
    return picture, rays, eye, place, on


def photograph(f0=None, roughness=0.0):
    picture, rays, eye, place, on = matt_desk()
    picture = picture.copy()
    if f0 is not None:
        picture[on] += mirrored(place[on], -rays[on], f0, roughness**2)
    rng = np.random.default_rng(0)
    light = GAIN * picture
    light += rng.normal(size=light.shape) * np.sqrt(1e-6 + 4e-4 * np.clip(light, 0, 1))
    seen = np.float32(np.clip(light, 0, 1))
    return View(seen, np.ones(seen.shape[:2], bool), rays, eye, ROOM.center, ROOM.radius, ROOM.reflectance)


@functools.cache
def light():
    radiance = np.float32(GAIN * true_environment(ROOM, 64, 2))
    return Surroundings(radiance, np.zeros(radiance.shape[:2], np.float32), np.ones(radiance.shape[:2], np.float32))


def test_a_polished_desk_tells_its_gloss_and_a_matt_one_nothing():
    """The same grain, with and without a reflection in it."""
    found = estimate_gloss(photograph(0.1, 0.2), light())
    assert found.reflectance is not None
    assert found.reflectance_low < 0.1 < found.reflectance_high < 0.2
    assert found.roughness_low <= 0.2 <= found.roughness_high < 0.5
    assert "the plane mirrors" in found.words
    matt = estimate_gloss(photograph(), light())
    assert matt.reflectance is None
    assert "not told" in matt.words


@pytest.mark.parametrize("unknown", ["clips", "is not seen"])
def test_what_a_desk_would_mirror_must_be_known(unknown):
    given = light()
    gone = np.ones_like(given.clipped)
    if unknown == "clips":
        given = Surroundings(np.minimum(given.radiance, 1), gone, given.confidence)
    else:
        given = Surroundings(given.radiance, given.clipped, 0 * gone)
    found = estimate_gloss(photograph(), given)
    assert found.reflectance is None
    assert "clips, or is not seen well" in found.words


def test_too_little_of_a_desk_tells_nothing():
    view = photograph()
    view.usable[6:] = False
    assert "too little" in estimate_gloss(view, light()).words


def test_the_rim_of_a_ball_shows_little():
    """Directions away from the camera are beyond 60 degrees on the ball where they are 120 and more from it."""
    view = photograph()
    height = 32
    known = shown_well(view, np.ones((height, 2 * height), np.float32))
    theta, phi = (
        (np.arange(height) + 0.5) * math.pi / height,
        (np.arange(2 * height) + 0.5) * math.pi / height - math.pi,
    )
    t, p = np.meshgrid(theta, phi, indexing="ij")
    d = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], -1)
    back = (view.eye - view.center) / np.linalg.norm(view.eye - view.center)
    angle = np.degrees(np.arccos(np.clip(d @ back, -1, 1)))
    assert (known[angle < 119] == 1).all()
    assert (known[angle > 121] == 0).all()
