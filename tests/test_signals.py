"""Transfer functions of HDR against ITU-R BT.2100's own words and tables, and matrices of primaries."""

from __future__ import annotations

import math

import numpy as np
import pytest

from warp_ar.signals import (
    HLG_WHITE,
    P3_D65,
    PQ_WHITE,
    REC_709,
    REC_2020,
    converted,
    hlg_of_light,
    light_of_hlg,
    light_of_pq,
    light_of_srgb,
    pq_of_light,
    rgb_from_rgb,
    srgb_of_light,
)

FLOAT64 = 1e-12  # roundings of a handful of float64 operations, relative
POWER = 1e-9  # PQ's exponent of 78.8 magnifies roundings
CURVES = 1e-6  # sRGB's two parts do not quite meet, and PQ of no light is 7.3e-7
PRINTED = 6e-5  # of matrices that recommendations print with four digits


def pq(signal: float) -> float:
    """BT.2100 table 4, reference PQ EOTF, cd/m², in its own rational constants."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 128 * 2523 / 4096, 3424 / 4096, 32 * 2413 / 4096, 32 * 2392 / 4096
    power = signal ** (1 / m2)
    return 10000.0 * (max(power - c1, 0.0) / (c2 - c3 * power)) ** (1 / m1)


def hlg_oetf(light: float) -> float:
    """BT.2100 table 5, HLG reference OETF; its constants b and c as it defines them."""
    a = 0.17883277
    b, c = 1 - 4 * a, 0.5 - a * math.log(4 * a)
    return math.sqrt(3 * light) if light <= 1 / 12 else a * math.log(12 * light - b) + c


@pytest.mark.parametrize("signal", [0.0, 0.01, 0.1, 0.25, 0.5, 0.58, 0.75, 0.9, 1.0])
def test_pq_is_the_recommendation_s(signal: float) -> None:
    assert float(light_of_pq(signal)) * PQ_WHITE == pytest.approx(pq(signal), rel=POWER, abs=POWER)


def test_pq_has_its_known_levels() -> None:
    # BT.2408 table 1: 203 cd/m² is 58 % of the signal; 100 cd/m² is code 520 of 10 bits, full range.
    assert float(pq_of_light(1.0)) == pytest.approx(0.58, abs=5e-3)
    assert float(pq_of_light(100.0 / PQ_WHITE)) == pytest.approx(0.50808, abs=1e-5)
    assert float(light_of_pq(1.0)) == pytest.approx(10000.0 / 203.0, rel=POWER)


@pytest.mark.parametrize("light", [0.0, 0.01, 1 / 12, 0.0834, 0.265, 0.5, 1.0])
def test_hlg_is_the_recommendation_s(light: float) -> None:
    # The recommendation's b and c have eight digits.
    assert float(hlg_of_light(light / HLG_WHITE)) == pytest.approx(hlg_oetf(light), abs=2e-8)
    assert float(light_of_hlg(hlg_oetf(light))) * HLG_WHITE == pytest.approx(light, abs=5e-8)


def test_hlg_white_is_three_quarters() -> None:
    assert pytest.approx(0.265, abs=5e-4) == HLG_WHITE
    assert float(light_of_hlg(0.75)) == pytest.approx(1.0, rel=FLOAT64)


def test_every_curve_has_its_inverse() -> None:
    signal = np.linspace(0.0, 1.0, 1025)
    for light_of, signal_of in (
        (light_of_pq, pq_of_light),
        (light_of_hlg, hlg_of_light),
        (light_of_srgb, srgb_of_light),
    ):
        light = np.minimum(light_of(signal), light_of(1.0))
        assert (np.diff(light) > 0.0).all()
        np.testing.assert_allclose(signal_of(light), signal, atol=CURVES)


def test_primaries_are_those_that_recommendations_print() -> None:
    # BT.2087-0: linear BT.709 to BT.2020.
    printed = [[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]]
    np.testing.assert_allclose(rgb_from_rgb(REC_709, REC_2020), printed, atol=PRINTED)
    for source in (REC_709, REC_2020, P3_D65):
        np.testing.assert_allclose(rgb_from_rgb(source, REC_709) @ np.ones(3), 1.0, rtol=FLOAT64)
        back = rgb_from_rgb(REC_709, source) @ rgb_from_rgb(source, REC_709)
        np.testing.assert_allclose(back, np.eye(3), atol=FLOAT64)


def test_pictures_are_converted_pixel_by_pixel() -> None:
    picture = np.random.default_rng(3).uniform(0.0, 4.0, (5, 7, 3))
    expected = np.einsum("ij,hwj->hwi", rgb_from_rgb(REC_2020, REC_709), picture)
    np.testing.assert_allclose(converted(picture, REC_2020, REC_709), expected, atol=1e-5)
    np.testing.assert_array_equal(converted(picture, REC_709, REC_709), picture.astype(np.float32))
