"""Brackets of photographs: alignment, exposures against pixels, the response."""

import itertools
import math

import cv2
import numpy as np
import pytest

from tests.photo_files import encode_srgb
from tests.photo_room import exposed, photograph, sphere
from warp_ar.ball.ball_finder import silhouette
from warp_ar.errors import UsageError
from warp_ar.kernels.color import decode_table
from warp_ar.photographs.bracket import agree_exposures, align, disagreement, find_soft

TENTH = 0.1
"""Pixels: what alignment is asked for."""


def circle():
    points, _ = silhouette(photograph()[1], sphere())
    middle = points.mean(0)
    return (*middle, float(np.linalg.norm(points - middle, axis=1).mean()))


def shifted(codes, dx, dy):
    matrix = np.array([[1.0, 0.0, dx], [0.0, 1.0, dy]])
    return cv2.warpAffine(codes.astype(np.uint8), matrix, codes.shape[1::-1], flags=cv2.INTER_CUBIC)


def patches(denominators, curve=None):
    images = [exposed(d, curve=curve).astype(np.uint8) for d in denominators]
    return align(images, [circle()] * len(images)).patches


@pytest.mark.parametrize(("dx", "dy"), [(0.0, 0.0), (0.4, -0.3), (2.6, 1.2)])
def test_exposures_are_aligned_to_a_tenth_of_a_pixel(dx, dy):
    long, short = exposed(30).astype(np.uint8), shifted(exposed(120), dx, dy)
    found = align([long, short], [circle()] * 2)
    assert np.abs(np.array(found.circles[1][:2]) - found.circles[0][:2] - (dx, dy)).max() < TENTH
    assert abs(found.circles[1][2] - found.circles[0][2]) < TENTH
    assert found.strangers == ("", "")


def test_another_scene_is_told():
    long = exposed(30).astype(np.uint8)
    turned = np.ascontiguousarray(long[::-1])
    x, y, r = circle()
    found = align([long, turned], [(x, y, r), (x, long.shape[0] - 1 - y, r)])
    assert found.strangers[1].startswith("it shows something else")
    assert found.is_odd  # or the other one is
    assert math.isnan(disagreement(long[:40, :40], np.zeros((40, 40, 3), np.uint8)))


BRACKET = (15, 60, 250, 1000)
TRUE = [1 / d for d in BRACKET]


def test_true_exposures_and_srgb_are_confirmed():
    agreed = agree_exposures(patches(BRACKET), "srgb", {"EXIF": TRUE})
    assert agreed.ratios == pytest.approx([t / TRUE[0] for t in TRUE])
    assert agreed.curve is None
    assert agreed.notes == ()


def test_lying_exposures_are_refused_with_all_three_figures():
    lying, names = [1.0, 0.8, 0.7, 0.5], [1.0, 1 / 9, 1 / 81, 1 / 729]
    with pytest.raises(UsageError) as caught:
        agree_exposures(patches(BRACKET), "srgb", {"EXIF": lying, "names": names})
    message = str(caught.value)
    for figure in ("EXIF says 2", "names say 729", "pixels say"):
        assert figure in message
    assert "--exposures" in message


def test_two_wrong_times_contradict_the_pictures_under_every_response():
    with pytest.raises(UsageError, match=r"no response explains them \(b to c is off by"):
        agree_exposures(patches(BRACKET), "srgb", {"EXIF": [1.0, 0.1, 0.06, 0.045]}, labels="abcd")


def test_a_missing_photograph_is_named_and_the_pixels_believed():
    """At the end it looks like a wrong time of the last; in between, all after it are wrong."""
    agreed = agree_exposures(patches((15, 60, 1000)), "srgb", {"EXIF": TRUE[:3]}, labels="abc")
    assert agreed.ratios == pytest.approx([1.0, 0.25, 0.015], rel=0.1)
    assert agreed.curve is None
    assert agreed.notes[0].startswith("c: EXIF gives it 3.9")
    agreed = agree_exposures(patches((15, 60, 500, 1000)), "srgb", {"EXIF": [1.0, 0.25, 1 / 8, 1 / 16]}, labels="abcd")
    assert agreed.ratios == pytest.approx([1.0, 0.25, 0.03, 0.015], rel=0.1)
    assert agreed.notes[0].startswith("is a photograph missing between b and c? EXIF gives the second")


def test_a_response_that_one_step_needs_is_doubted():
    agreed = agree_exposures(patches((15, 60)), "srgb", {"EXIF": [1.0, 0.16]}, labels="ab")
    assert agreed.curve is not None
    assert agreed.notes[1].startswith("only the step from a to b needs this response; if a time is wrong instead, srgb")


def s_curve(light):
    """A camera's: sRGB with more contrast in the middle, darks three times darker."""
    code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    return code + 0.9 * code * (1 - code) * (code - 0.45)


def test_a_response_is_estimated_where_srgb_does_not_hold():
    bracket = (15, 30, 60, 125, 250, 500)
    agreed = agree_exposures(patches(bracket, s_curve), "srgb", {"EXIF": [1 / d for d in bracket]})
    assert agreed.curve is not None
    (note,) = agreed.notes
    assert "response is not srgb" in note
    grid = np.linspace(0, 1, 20001)
    truth = np.interp(np.arange(40, 230) / 255, s_curve(grid), grid)
    scale = np.median(truth / agreed.curve[40:230, 1])
    error = np.abs(np.log(scale * agreed.curve[40:230, 1] / truth))
    by_srgb = decode_table("srgb")[40:230, 1]
    before = np.abs(np.log(np.median(truth / by_srgb) * by_srgb / truth))
    # Eight numbers describe the curve; 12 % at its worst place is a third of what sRGB errs.
    assert error.max() < min(0.12, 0.5 * before.max())


@pytest.mark.parametrize(("count", "wrong"), [(4, 0), (4, 1), (4, 3), (3, 0), (3, 1), (3, 2)])
def test_one_wrong_time_is_named_and_the_pixels_believed(count, wrong):
    claim = [t * (2.5 if k == wrong else 1.0) for k, t in enumerate(TRUE[:count])]
    agreed = agree_exposures(patches(BRACKET[:count]), "srgb", {"EXIF": claim}, labels="abcd"[:count])
    assert agreed.ratios == pytest.approx([t / TRUE[0] for t in TRUE[:count]], rel=0.1)
    assert agreed.curve is None
    assert agreed.notes[0].startswith(f"{'abcd'[wrong]}: EXIF gives it 2.")


@pytest.mark.parametrize("wrong", range(3))
def test_of_three_times_that_disagree_the_wrong_one_is_doubted(wrong):
    """By a factor that another response explains as well; two of them agree with each of several readings."""
    claim = [t * (1.5 if k == wrong else 1.0) for k, t in enumerate(TRUE[:3])]
    first, *_ = agree_exposures(patches(BRACKET[:3]), "srgb", {"EXIF": claim}, labels="abc").notes
    assert first.startswith(f"{'abc'[wrong]}: EXIF gives it 1.")
    assert "or else" in first
    assert first.endswith("the times disagree, and the first is taken to be wrong")
    bent = agree_exposures(patches(BRACKET[:3], s_curve), "srgb", {"EXIF": claim}, labels="abc")
    assert "if a time is wrong instead" in bent.notes[-1]


def test_a_response_of_no_camera_is_doubted_with_both_readings():
    """Times as of other photographs: a curve explains them, but none that a camera has."""
    lying = [t**1.6 for t in TRUE]
    agreed = agree_exposures(patches(BRACKET), "srgb", {"EXIF": lying})
    assert agreed.curve is not None
    assert "no known camera has this response: gamma 3." in agreed.notes[1]
    assert "--exposures pixels is right (EXIF says 828, pixels say 6" in agreed.notes[1]


def test_a_linear_response_of_8_bits_is_doubted():
    """Times with half of the true steps: sRGB with them looks as a linear camera does."""
    halved = [math.sqrt(t) for t in TRUE]
    agreed = agree_exposures(patches(BRACKET), "srgb", {"EXIF": halved})
    assert any("no known camera has this response: gamma 1." in note for note in agreed.notes)


def test_what_is_wrong_with_one_picture_spoils_no_other():
    """Between the anchor and the others stands one that shows something else."""
    images = [exposed(d).astype(np.uint8) for d in (30, 60, 120, 240)]
    images[1] = np.ascontiguousarray(images[1][::-1])
    found = align(images, [circle()] * 4)
    assert [bool(why) for why in found.strangers] == [False, True, False, False]
    assert np.abs(np.array(found.circles[3]) - circle()).max() < TENTH


def test_a_picture_of_another_light_is_told_from_another_exposure():
    """A lamp to one side: darks to the left, brights to the right, all of the same room."""
    x, _, radius = circle()
    side = 3.0 ** np.clip((np.arange(photograph()[0].shape[1]) - x) / radius, -1.0, 1.0)[:, None]
    light = 30.0 / 150 * photograph()[0].astype(float)
    plain, turned = (encode_srgb(light * share).astype(np.uint8) for share in (1.0, side))
    found = align([plain, turned, exposed(120).astype(np.uint8)], [circle()] * 3)
    assert found.strangers[0] == found.strangers[2] == ""
    assert found.strangers[1].startswith("it shows something else in")


def dimmed(denominator, share=0.05):
    """The photograph with all lamps and the window dimmed."""
    linear = photograph()[0]
    bright = linear.max(2, keepdims=True) > 2.0
    return encode_srgb(30.0 / denominator * np.where(bright, share * linear, linear)).astype(np.uint8)


def covered(denominator, radiance=0.15):
    """The photograph with a hand before a fifth of the ball."""
    x, y, radius = circle()
    hand = np.zeros(photograph()[0].shape[:2], np.uint8)
    cv2.ellipse(hand, ((x - 0.4 * radius, y), (0.7 * radius, 1.2 * radius), 30.0), 1, -1)
    light = np.where(hand[..., None] > 0, radiance * np.array([1.2, 0.9, 0.8]), photograph()[0])
    return encode_srgb(30.0 / denominator * light).astype(np.uint8)


@pytest.mark.parametrize("fault", [dimmed, covered])
@pytest.mark.parametrize("wrong", range(4))
@pytest.mark.parametrize("count", [3, 4])
def test_a_part_of_the_picture_that_contradicts_the_others_is_told(fault, wrong, count):
    if wrong == count:
        return
    images = [exposed(d).astype(np.uint8) for d in BRACKET[:count]]
    images[wrong] = fault(BRACKET[wrong])
    found = align(images, [circle()] * count, [1 / d for d in BRACKET[:count]], 0 if wrong else 1)
    assert [bool(why) for why in found.strangers] == [k == wrong for k in range(count)]
    assert not found.is_odd


@pytest.mark.parametrize("blurred", [None, 1, 2])
def test_a_blurred_picture_is_softer_than_both_neighbours(blurred):
    images = [exposed(d).astype(np.uint8) for d in BRACKET]
    if blurred is not None:
        images[blurred] = cv2.GaussianBlur(images[blurred], (0, 0), 2.0)
    found = align(images, [circle()] * 4, anchor=2 if blurred == 1 else 1)
    assert find_soft(found.patches) == [k for k in [blurred] if k is not None]


def test_without_any_claim_the_pixels_decide():
    agreed = agree_exposures(patches(BRACKET), "srgb", {})
    steps = [b / a for a, b in itertools.pairwise(agreed.ratios)]
    assert steps == pytest.approx([0.25, 0.24, 0.25], rel=0.1)
    assert "pixels alone" in agreed.notes[0]


def test_exposures_far_apart_are_not_judged_by_what_they_share():
    images = [exposed(15).astype(np.uint8), exposed(4000).astype(np.uint8)]
    found = align(images, [circle()] * 2, [1 / 15, 1 / 4000])
    assert found.circles[0] == found.circles[1]
    assert found.strangers == ("", "")
