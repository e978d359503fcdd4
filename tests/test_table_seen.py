"""The table around a photographed ball tells what the ball reflects, and how much light there is at least."""

import numpy as np
import pytest

from tests.photo_files import FOCAL_35MM, encode_srgb
from tests.rendered_room import Room, look_at, render, true_environment
from warp_ar.ball.ball_finder import BallOutline
from warp_ar.kernels.color import decode_table
from warp_ar.light.captured import irradiance_above
from warp_ar.photographs.support import plane_from_contact
from warp_ar.photographs.table_seen import Table
from warp_ar.scene import Camera

SIZE = (450, 340)
FOCAL = FOCAL_35MM / np.hypot(36, 24) * np.hypot(*SIZE)
CAMERA = Camera(*SIZE, FOCAL, FOCAL, (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2)
WITHIN = 0.05
"""Error of a reflectance that can be told."""
BRIGHTEST_WOOD = (0.3, 0.5)
"""Reflectance of the brightest tenth of the room's table, mean of RGB, less what the ball shades."""


def table_of(room, seed=0, off=1.0, stand=None):
    """The table of a photographed room, with the contact picked ``off`` pixels away, and the exposure's gain."""
    matrix = np.array([[FOCAL, 0, CAMERA.cx], [0, FOCAL, CAMERA.cy], [0, 0, 1]])
    rotation, translation = look_at(room.center + np.array([0.06, -0.42, 0.25]), np.array([0.02, 0.02, 0.03]))
    linear = render(room, matrix, (rotation, translation), SIZE, samples=2).astype(float)
    gain = 0.4 / np.percentile(linear, 70)
    noise = np.random.default_rng(seed).normal(size=linear.shape)
    light = gain * linear + noise * np.sqrt(1e-6 + 4e-4 * np.clip(gain * linear, 0, 1))
    x, y, z = rotation @ room.center + translation
    sphere = (x / room.radius, y / room.radius, z / room.radius)
    outline = BallOutline((0.0, 0.0), (1.0, 1.0), 0.0, (0.0, 0.0, 0.0), 1.0, sphere)
    x, y, z = rotation @ (0.0, 0.0, room.lift) + translation
    contact = x / z * FOCAL + CAMERA.cx + off, y / z * FOCAL + CAMERA.cy - off
    plane = plane_from_contact(sphere, CAMERA, contact)
    if stand is not None:
        plane = plane_from_contact(sphere, CAMERA, contact, room.radius, stand=stand)
    return Table.under(outline, encode_srgb(light).astype(np.uint8), CAMERA, plane, decode_table("srgb")), gain


@pytest.mark.parametrize(("seed", "reflectance"), [(11, 0.55), (12, 0.7), (13, 0.9)])
def test_a_ball_s_reflectance_is_told_with_an_interval_that_holds(seed, reflectance):
    table, _ = table_of(Room(seed=seed, table=(0.8, 0.6), reflectance=reflectance))
    told = table.reflectance_of_ball()
    assert told.reflectance == pytest.approx((reflectance,) * 3, abs=WITHIN)
    assert abs(np.log(np.mean(told.reflectance) / reflectance)) < 2.0 * told.deviation < 0.15


def test_a_ball_on_a_stand_of_known_height_is_over_the_table():
    room = Room(seed=11, table=(0.8, 0.6), lift=0.08, reflectance=0.7)
    table, gain = table_of(room, off=0.0, stand=room.lift)
    assert table.probe.center == pytest.approx((0.0, 0.0, room.lift + room.radius), abs=1e-6)
    assert table.probe.radius == room.radius
    told = table.reflectance_of_ball()
    assert told is None or told.reflectance == pytest.approx((0.7,) * 3, abs=WITHIN)
    true = (gain * true_environment(room, 32)).astype(np.float32)
    assert BRIGHTEST_WOOD[0] < table.reflectance_under(irradiance_above(true)) < BRIGHTEST_WOOD[1]


def test_light_that_is_too_low_makes_the_table_too_white():
    room = Room(seed=11, table=(0.8, 0.6))
    table, gain = table_of(room)
    true = (gain * true_environment(room, 32)).astype(np.float32)
    implied = table.reflectance_under(irradiance_above(true))
    assert BRIGHTEST_WOOD[0] < implied < BRIGHTEST_WOOD[1]
    assert table.reflectance_under(irradiance_above(true / 4)) == pytest.approx(4 * implied)


def test_a_ball_on_a_stand_is_not_taken_for_one_on_the_table():
    """Its mirror image of the table is another one: nothing is said."""
    assert table_of(Room(seed=11, table=(0.8, 0.6), lift=0.08))[0].reflectance_of_ball() is None
