"""One rendered room that tests of photographs share, rendered once per process."""

from __future__ import annotations

import functools

import numpy as np

from tests.photo_files import FOCAL_35MM, encode_srgb, write_photo
from tests.rendered_room import Room, look_at, render, true_environment
from warp_ar.scene import Camera

SIZE = (600, 450)
ROOM = Room(seed=3, table=(0.8, 0.6), reflectance=0.85, lamp=60.0)
FOCAL = FOCAL_35MM / np.hypot(36, 24) * np.hypot(*SIZE)
GAIN = 30.0


@functools.cache
def photograph():
    """(linear render, camera, R, t)."""
    matrix = np.array([[FOCAL, 0, (SIZE[0] - 1) / 2], [0, FOCAL, (SIZE[1] - 1) / 2], [0, 0, 1]])
    eye = ROOM.center + np.array([0.06, -0.42, 0.25])
    rotation, translation = look_at(eye, np.array([0.02, 0.02, 0.03]))
    linear = render(ROOM, matrix, (rotation, translation), SIZE, samples=2)
    camera = Camera(*SIZE, FOCAL, FOCAL, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
    return linear, camera, rotation, translation


@functools.cache
def environment():
    """True latlong at the ball, 32 rows."""
    return true_environment(ROOM, 32)


def sphere():
    """The ball's centre before the camera over its radius."""
    _, _, rotation, translation = photograph()
    return (rotation @ ROOM.center + translation) / ROOM.radius


def project(point):
    """Pixel of a point of the world."""
    _, camera, rotation, translation = photograph()
    x, y, z = rotation @ np.array(point, float) + translation
    return np.array([x / z * camera.fx + camera.cx, y / z * camera.fy + camera.cy])


def exposed(denominator, seed=0, curve=None):
    """Codes of the photograph at 1 / denominator seconds, with a sensor's noise, behind a response or sRGB's."""
    light = GAIN / denominator * photograph()[0].astype(float)
    noise = np.random.default_rng(seed + denominator).normal(size=light.shape)
    light = light + noise * np.sqrt(1e-6 + 4e-4 * np.clip(light, 0, 1))
    return encode_srgb(light) if curve is None else np.round(255 * curve(np.clip(light, 0, 1)))


def write_bracket(folder, denominators, *, exif=None, names=None, curve=None):
    """Photographs at several exposures; ``exif`` and ``names`` are denominators that files claim instead."""
    told = exif or denominators
    labels = names or [f"photo_{chr(97 + k)}" for k in range(len(denominators))]
    return [
        write_photo(folder / f"{label}.jpg", exposed(true, curve=curve), denominator=claim)
        for true, claim, label in zip(denominators, told, labels, strict=True)
    ]
