"""The response by the card's greys: curves of many cameras are found within the interval that is stated."""

from __future__ import annotations

import imageio.v3
import numpy as np
import pytest
from scipy.stats import binom

from tests.printed_card import PrintedCard, linear_of, poses, smooth_curve
from warp_ar import calibrate
from warp_ar.calibration.response import measure_grey_response
from warp_ar.errors import UsageError
from warp_ar.scene import Camera, load_scene
from warp_ar.tracking.card_layout import CARD_MARKER

pytestmark = pytest.mark.slow

CAMERA = Camera(640, 480, 620.0, 620.0, 319.5, 239.5)
SETUPS = 6
INSIDE = binom.ppf(0.05, SETUPS, 0.95)
"""Of so many set-ups: sound intervals of 95 % hold fewer curves for one choice of set-ups in twenty, or less."""
CLOSE = 0.35
"""Logarithm of a value, from code 40 on: the ink's spread alone, of which the test's printers have 1.5 %, does 0.1."""


SAME = 0.005
"""Share: each picture's own exposure has a weak prior, and it counts once for each."""


def pictures(seed, count=5, low=0.25, **options):
    rng = np.random.default_rng(seed)
    card, encode = PrintedCard(rng, **options), smooth_curve(rng)
    lights = rng.uniform(low, 0.95, count)
    taken = [
        card.photograph(CAMERA, pose, light, encode) for pose, light in zip(poses(rng, count), lights, strict=True)
    ]
    return taken, linear_of(encode)


def test_curves_lie_in_their_intervals():
    inside = 0
    for seed in range(SETUPS):
        images, truth = pictures(seed)
        found = measure_grey_response(images)
        codes = np.arange(40, int(found.span[1]), 8)
        error = np.abs(np.log(found.curve[codes, 1] / truth[codes]))
        assert error.max() < CLOSE
        inside += bool((error < 2 * found.deviation[codes, 1]).mean() > 0.95)
        # An interval that holds anything says nothing.
        assert found.deviation[128].max() < 0.2
    assert inside >= INSIDE


def test_more_exposures_tell_more():
    alike, _ = pictures(3, count=3, low=0.94)
    apart, _ = pictures(3, count=6, low=0.15)
    assert measure_grey_response(apart).deviation[64, 1] < measure_grey_response(alike).deviation[64, 1]


def test_many_alike_pictures_tell_what_a_few_do():
    """What is wrong with pictures of one desk is alike in all: it must not outvote what is expected of the ink."""
    images, _ = pictures(2)
    few, many = measure_grey_response(images), measure_grey_response(images * 4)
    assert np.allclose(many.curve, few.curve, rtol=SAME)
    assert np.allclose(many.deviation, few.deviation, rtol=SAME)


def test_what_does_not_tell_is_refused():
    images, _ = pictures(1, count=2)
    with pytest.raises(UsageError, match="in 1 of 1 pictures; expected 2"):
        measure_grey_response(images[:1])
    with pytest.raises(UsageError, match="in 0 of 2 pictures"):
        measure_grey_response([np.full((480, 640, 3), 90, np.uint8)] * 2)
    dark = [(image * 0.25).astype(np.uint8) for image in images]
    with pytest.raises(UsageError, match="its white is bright"):
        measure_grey_response(dark)
    rng = np.random.default_rng(0)
    near = Camera(1920, 1440, 3600.0, 3600.0, 959.5, 719.5)
    close = [PrintedCard(rng).photograph(near, pose, 0.8, smooth_curve(rng)) for pose in poses(rng, 2)]
    with pytest.raises(UsageError, match="one by one"):
        measure_grey_response(close)


def test_the_command_writes_it_into_the_scene(tmp_path, capsys):
    images, truth = pictures(4)
    for number, image in enumerate(images):
        imageio.v3.imwrite(tmp_path / f"{number}.png", image)
    scene = tmp_path / "scene.toml"
    scene.write_text(
        '# mine\nschema = 1\n[camera] # guessed\nfield_of_view = 60.0\n[marker]\ndictionary = "DICT_4X4_50"\n'
        f'board = "{CARD_MARKER.board}"\n'
    )
    assert calibrate.main(["response", *map(str, sorted(tmp_path.glob("*.png"))), "--write", str(scene)]) == 0
    said = capsys.readouterr().out
    assert "by 5 pictures" in said
    assert "+/-" in said
    assert load_scene(scene).camera.transfer == tmp_path / "response.txt"
    assert "# guessed" in scene.read_text()
    curve = np.loadtxt(tmp_path / "response.txt")
    assert curve.shape == (256, 3)
    assert abs(np.log(curve[128, 0] / truth[128])) < CLOSE
    assert calibrate.main(["response", str(tmp_path / "0.png"), "--output", str(tmp_path / "r.txt")]) == 2
