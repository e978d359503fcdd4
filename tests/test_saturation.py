"""At which code channels saturate, told from pictures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import warp as wp

from warp_ar.calibration.saturation import FULL, SaturationLevels
from warp_ar.kernels.color import camera_table, decode_table, is_saturated, saturation_codes
from warp_ar.sources.deep_frame import DeepFrame, codes8

DISC = (160.0, 120.0, 90.0)


STEP10 = 255.0 / 1023.0
"""8-bit codes of a step of 10 bits."""


def ball_picture(top, *, surface=60.0, noise=1.5, seed=0):
    """A ball that mirrors walls of ``surface``, fading to the rim, and two lamps that drive the camera to ``top``."""
    return np.clip(np.round(unrounded_ball(top, surface, noise, seed)), 0, 255).astype(np.uint8)


def unrounded_ball(top, surface=60.0, noise=1.5, seed=0):
    """The same before codes are rounded."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:240, :320].astype(float)
    image = np.full((240, 320, 3), 40.0)
    inside = np.hypot(x - DISC[0], y - DISC[1]) < DISC[2]
    image[inside] = (surface * (0.6 + 0.4 * x / 320))[inside][:, None] * [1.0, 0.95, 0.9]
    image += noise * rng.standard_normal(image.shape)
    for cx, cy, radius in ((120, 90, 24), (200, 110, 12)):
        image[np.hypot(x - cx, y - cy) < radius] = 400.0
    image = cv2.GaussianBlur(image, (0, 0), 1.0)  # the lens
    return np.minimum(image, top)


def deep_of_10_bits(image):
    """Codes in steps of 8 bits as a sensor of 10 bits has them, widened to 16."""
    codes = np.clip(np.round(image / STEP10), 0, 1023)
    return DeepFrame(np.round(codes * (65535.0 / 1023.0)).astype(np.uint16))


@pytest.mark.parametrize("step", [950, 951, 953, 990])
def test_a_plateau_between_two_codes_of_8_bits_is_told_by_deep_frames(step):
    """Steps of 10 bits that are 236.8, 237.05, 237.55 and 246.8 of 255: rounding to 8 bits misses three of them."""
    deep = deep_of_10_bits(unrounded_ball(step * STEP10))
    levels = SaturationLevels()
    assert levels.observe(codes8(deep, "srgb"), [DISC], deep=deep)
    np.testing.assert_allclose(levels.levels, step * STEP10, atol=0.51 / 257.0)  # rounding to 16 bits
    below, _ = deep.clip_levels("srgb", levels.levels)
    assert (below < decode_table("srgb")[round(step * STEP10)]).all()


@pytest.mark.parametrize("top", [238, 235, 247])
def test_a_plateau_below_full_is_where_channels_saturate(top):
    levels = SaturationLevels()
    assert levels.observe(ball_picture(top), [DISC])
    assert levels.levels.tolist() == [top] * 3
    assert not levels.observe(ball_picture(top, seed=1), [DISC])


def test_compression_hides_no_plateau():
    picture = cv2.imencode(".jpg", ball_picture(238), [cv2.IMWRITE_JPEG_QUALITY, 92])[1]
    levels = SaturationLevels()
    levels.observe(cv2.imdecode(picture, cv2.IMREAD_COLOR), [DISC])
    assert np.abs(levels.levels - 238).max() <= 1


@pytest.mark.parametrize("surface", [150.0, 215.0, 238.0])
def test_bright_surfaces_are_no_plateau(surface):
    """Walls, even as bright as that: noise goes to both sides of them."""
    picture = ball_picture(255, surface=surface)
    picture[picture > 250] = 80  # no lamp
    levels = SaturationLevels()
    assert not levels.observe(picture, [DISC])
    assert levels.levels.tolist() == [255] * 3


def test_a_bright_frame_takes_a_level_back():
    levels = SaturationLevels()
    levels.observe(ball_picture(238), [DISC])
    assert levels.observe(ball_picture(255), [DISC])
    assert levels.levels.tolist() == [255] * 3
    # What was higher once is higher for good.
    levels.observe(ball_picture(230), [DISC])
    assert levels.levels.tolist() == [255] * 3


@wp.kernel
def saturated_kernel(table: wp.array[wp.vec3], codes: wp.array[wp.vec3ub], out: wp.array[wp.vec3]):
    i = wp.tid()
    out[i] = is_saturated(codes[i], saturation_codes(table))


@pytest.mark.parametrize(
    ("saturation", "code", "expected"),
    [
        (None, (254, 100, 10), (1, 0, 0)),
        (None, (238, 238, 238), (0, 0, 0)),
        (None, (255, 248, 247), (1, 1, 0)),
        ((238, 238, 238), (237, 230, 100), (1, 0, 0)),
        ((238, 238, 238), (238, 231, 230), (1, 1, 0)),
        ((238, 255, 255), (240, 240, 253), (1, 0, 1)),
    ],
)
def test_kernels_take_levels_from_the_camera_table(device, saturation, code, expected):
    """A plain table of 256 entries saturates at 255; beside a saturated channel what is near counts as well."""
    values = decode_table("srgb") if saturation is None else camera_table("srgb", saturation)
    out = wp.zeros(1, dtype=wp.vec3, device=device)
    table = wp.array(values, dtype=wp.vec3, device=device)
    codes = wp.array(np.array([code], np.uint8), dtype=wp.vec3ub, device=device)
    wp.launch(saturated_kernel, 1, [table, codes], [out], device=device)
    assert out.numpy()[0].tolist() == list(expected)


def blurred_ball(level: float, spread: float, seed: int) -> np.ndarray:
    """A disc on grey whose brightest part is neutral, around ``level``, as sharpening and a hard codec leave it."""
    random = np.random.default_rng(seed)
    image = np.full((80, 80, 3), 60, np.uint8)
    image[20:60, 20:60] = random.integers(20, 225, (40, 40, 1))
    top = np.clip(level + spread * random.normal(size=(14, 14, 1)), 0, 255)
    image[30:44, 30:44] = np.round(top).astype(np.uint8)
    return image


def test_a_blurred_end_is_told_by_a_gain_that_does_not_move_it():
    """The same codes at gains from 0.8 to 1.3: the camera ends there. Nothing is told while the gain stands still."""
    disc = [(40.0, 40.0, 20.0)]
    drifting, steady = SaturationLevels(), SaturationLevels()
    for k, gain in enumerate((1.0, 1.15, 1.3, 1.1, 0.9, 0.8)):
        image = blurred_ball(237.0, 3.0, k)
        drifting.observe(image, disc, gain)
        steady.observe(image, disc)
    assert np.abs(drifting.levels - 237).max() <= 1
    np.testing.assert_array_equal(steady.levels, FULL)


def test_a_lit_surface_moves_with_the_gain():
    """A white wall in the ball: its codes follow the gain by the transfer, and no level is believed."""
    seen = SaturationLevels()
    for k, gain in enumerate((1.0, 1.1, 1.15, 1.05, 0.9, 0.8)):
        seen.observe(blurred_ball(225.0 * gain ** (1 / 2.2), 2.0, k), [(40.0, 40.0, 20.0)], gain)
    np.testing.assert_array_equal(seen.levels, FULL)


def test_under_a_tone_curve_a_blurred_end_is_told_by_one_frame_unless_something_is_brighter():
    """Brighter paper beside the ball: what crowds in it is a wall. Without a curve nothing is told."""
    disc, image = [(40.0, 40.0, 20.0)], blurred_ball(237.0, 3.0, 0)
    beside = image.copy()
    beside[65:75, 5:20] = 250
    told, paper, plain = SaturationLevels(), SaturationLevels(), SaturationLevels()
    told.observe(image, disc, bent=True)
    paper.observe(beside, disc, bent=True)
    plain.observe(image, disc)
    assert np.abs(told.levels - 237).max() <= 1
    np.testing.assert_array_equal([paper.levels, plain.levels], FULL)
