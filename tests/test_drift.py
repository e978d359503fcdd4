"""A camera whose exposure, white balance and tone curve are told from what stands still."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from warp_ar import Pipeline
from warp_ar.scene import Pose, Scene, loads_scene
from warp_ar.sources.deep_frame import DeepFrame
from warp_ar.srgb import decode_srgb
from warp_ar.tracking.drift import CONTRASTS, ExposureDrift
from warp_ar.tracking.markers import pattern_of

SCENE = """schema = 1
[camera]
width = 160
height = 120
fx = 160.0
fy = 160.0
cx = 79.5
cy = 59.5
transfer = "srgb"
[marker]
dictionary = "DICT_4X4_50"
id = 0
size = 0.24
[probe]
center = [0.0, 0.3, 0.03]
radius = 0.03
[[proxy]]
shape = "plane"
size = [1.0, 0.7]
"""
POSE = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.8]))
CONTRAST = 1.01 * CONTRASTS[1]
"""A step between the contrasts that are tried."""
EXACT_GAIN = 2e-3
"""The same by a linear picture: points around the same place of a table interpolated between codes."""
GAIN = 0.02
"""Relative error of a gain: 8-bit codes of ink and table."""


def linear_picture(scene: Scene, ink: float = 0.03) -> np.ndarray:
    """A textured table under the camera, brighter to one side, with the print on it; linear, (120, 160, 3)."""
    y, x = np.mgrid[:120, :160]
    table = 0.15 + 0.1 * (x / 160) + 0.03 * np.sin(0.7 * x) * np.sin(0.9 * y)
    picture = np.repeat(table[..., None], 3, axis=2) * np.array([1.0, 0.9, 0.8])
    pattern = pattern_of(scene.marker)
    side = pattern.side
    for cell, is_white in zip(pattern.cells, pattern.white, strict=True):
        at = scene.camera.matrix() @ (POSE.rotation @ cell + POSE.translation)
        u, v = at[:2] / at[2]
        half = 0.5 * side * scene.camera.fx / 0.8
        rows, columns = slice(round(v - half), round(v + half) + 1), slice(round(u - half), round(u + half) + 1)
        picture[rows, columns] = 0.55 if is_white else 0.55 * ink / 0.85
    return picture


def encode(linear: np.ndarray, contrast: float = 0.0) -> np.ndarray:
    x = np.clip(linear, 0.0, 1.0)
    code = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
    code = code + contrast * code * (1.0 - code) * (code - 0.5)
    return np.round(255 * code).astype(np.uint8)


def follow(pictures: list[np.ndarray]) -> ExposureDrift:
    scene = loads_scene(SCENE)
    drift = ExposureDrift(scene, scene.camera)
    for picture in pictures:
        drift.observe(picture, POSE)
    return drift


@pytest.mark.parametrize("gain", [(0.6, 0.6, 0.6), (1.5, 1.5, 1.5), (1.1, 1.0, 0.85)])
def test_a_gain_is_told_per_channel(gain):
    picture = linear_picture(loads_scene(SCENE))
    drift = follow([encode(picture), encode(picture * gain)])
    assert drift.gain == pytest.approx(gain, rel=GAIN)
    assert drift.contrast == 0.0


@pytest.mark.parametrize("gain", [0.6, 1.5])
def test_a_dark_desk_is_followed_by_its_linear_picture(gain):
    """Paper of code 40 and a table of code 15 to 25: rounding of 8 bits is as large as what is asked."""
    dark = 0.04 * linear_picture(loads_scene(SCENE))
    pictures = [dark * scale for scale in np.linspace(1.0, gain, 8)]
    scene = loads_scene(SCENE)
    by_codes, by_light = ExposureDrift(scene, scene.camera), ExposureDrift(scene, scene.camera)
    for picture in pictures:
        codes = encode(picture)
        by_codes.observe(codes, POSE)
        by_light.observe(codes, POSE, DeepFrame(picture.astype(np.float32)))
    off = [float(np.abs(drift.gain / gain - 1.0).max()) for drift in (by_light, by_codes)]
    assert off[0] < EXACT_GAIN
    assert off[1] > 4.0 * off[0]


def test_an_emitter_that_goes_out_is_no_drift():
    """What it lit most becomes darkest; the camera's gain is the same."""
    picture = linear_picture(loads_scene(SCENE))
    fading = np.linspace(0.35, 1.0, 160)[None, :, None]
    assert (follow([encode(picture), encode(picture * fading)]).gain == 1.0).all()


def test_what_covers_the_picture_holds_the_gain_and_then_ends_it():
    picture = linear_picture(loads_scene(SCENE))
    drifted, covered = encode(0.7 * picture), encode(0.7 * picture)
    covered[:, 40:140] = np.random.default_rng(1).integers(30, 200, (120, 100, 3))
    drift = follow([encode(picture), drifted, covered])
    assert drift.gain == pytest.approx([0.7] * 3, rel=GAIN)
    for _ in range(8):
        drift.observe(covered, POSE)
    assert (drift.gain == 1.0).all()


def test_a_hand_over_the_card_stops_no_drift_that_is_known():
    """The table, most of which is in view, tells the gain of the frame in which the card shows a hand."""
    picture = linear_picture(loads_scene(SCENE))
    hand = picture.copy()
    hand[36:84, 56:104] = 0.35, 0.2, 0.14
    drift = follow([encode(picture), encode(0.7 * picture), encode(0.5 * hand)])
    assert drift.gain == pytest.approx([0.5] * 3, rel=GAIN)


@pytest.mark.parametrize("contrast", [0.0, 0.5, 1.0])
def test_a_tone_curve_is_told_by_print_that_is_too_black(contrast):
    drift = follow([encode(linear_picture(loads_scene(SCENE)), contrast)])
    assert drift.contrast == pytest.approx(contrast, abs=CONTRAST)


def test_a_tone_curve_is_told_by_a_drift_where_ink_is_grey():
    picture = linear_picture(loads_scene(SCENE), ink=0.15)
    gains = (1.0, 1.25, 1.45, 0.7, 0.55)
    bent = follow([encode(picture * gain, 1.0) for gain in gains])
    assert bent.contrast >= 0.5
    assert bent.gain == pytest.approx([gains[-1]] * 3, rel=0.1)
    assert follow([encode(picture * gain) for gain in gains]).contrast == 0.0


def test_virtual_lights_keep_their_value_while_the_exposure_moves():
    """A pipeline's lights shine in the camera values of each frame, the very next one at 60 frames a second too."""
    text = SCENE + '[[light]]\nkind = "point"\nat = [0.2, 0.0, 0.3]\nintensity = 0.2\n'
    picture = linear_picture(loads_scene(text))
    with Pipeline(loads_scene(text), device="cpu", quality="low", follows_camera=True) as pipeline:
        lit = []
        for index, gain in enumerate((1.0, 0.6)):
            result = pipeline(encode(picture * gain), pose=POSE, time_seconds=index / 60)
            lit.append(decode_srgb(cv2.blur(result.image, (5, 5)) / 255.0) / gain)
    added = [part - picture for part in lit]
    table = (slice(10, 30), slice(60, 100))
    assert added[0][table].mean() > 0.05
    assert added[1][table].mean() == pytest.approx(added[0][table].mean(), rel=0.1)


def test_virtual_lights_are_as_bright_as_the_level_at_which_the_camera_saturates():
    """A light of 1 saturates: at code 238 that is the value of code 238."""
    light = '[[light]]\nkind = "point"\nat = [0.0, 0.0, 0.3]\nintensity = 0.5\n'
    with Pipeline(loads_scene(SCENE + light), device="cpu", quality="low") as pipeline:
        picture = encode(linear_picture(pipeline.scene))
        for level in (238, 255):
            pipeline.inputs.fix_saturation(np.full(3, float(level)))
            pipeline(picture, pose=POSE)
            shone = pipeline.inputs.block.host("lights")["intensity"][0]
            np.testing.assert_allclose(shone, 0.5 * decode_srgb(np.array([level]) / 255.0)[0], rtol=1e-6)  # float32


def test_light_that_dims_on_all_surfaces_is_light_unless_the_camera_meters_by_itself() -> None:
    """Nothing tells the two apart: by default frames say what they show, and virtual lights stay as they are."""
    text = SCENE + '[[light]]\nkind = "point"\nat = [0.2, 0.0, 0.3]\nintensity = 0.2\n'
    source = '[source]\npath = "clip"\nmetering = '
    picture = linear_picture(loads_scene(text))
    table = (slice(10, 30), slice(60, 100))
    added = {}
    for metering in ("fixed", "automatic"):
        scene = loads_scene(text + f'{source}"{metering}"\n')
        with Pipeline(scene, device="cpu", quality="low") as pipeline:
            for index, gain in enumerate((1.0, 0.6)):
                result = pipeline(encode(picture * gain), pose=POSE, time_seconds=0.2 * index)
        added[metering] = (decode_srgb(cv2.blur(result.image, (5, 5)) / 255.0) - 0.6 * picture)[table].mean()
    # Not by the whole gain: in a darker frame the table is taken to reflect less.
    assert added["fixed"] > 1.3 * added["automatic"]
