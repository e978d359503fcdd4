"""Exported light in other colour spaces, and by a grey card."""

from __future__ import annotations

import math
import pathlib

import numpy as np
import pytest

from warp_ar import environment
from warp_ar.light.captured import latlong_directions, texel_solid_angles
from warp_ar.output.environment_file import (
    COLOR_SPACES,
    EnvironmentInfo,
    convert_light,
    grey_card_scale,
    read_environment,
    read_environment_info,
    write_environment,
)
from warp_ar.signals import (
    HLG_WHITE,
    P3_D65,
    PQ_WHITE,
    REC_709,
    REC_2020,
    hlg_of_light,
    light_of_hlg,
    light_of_pq,
    pq_of_light,
    rgb_from_rgb,
    xyz_from_rgb,
)
from warp_ar.srgb import decode_srgb, encode_srgb

ADAPTED = 2e-4  # the configuration's matrices have six digits, its whites' chromaticities five
FLOAT32 = 3e-6  # there and back
# Linear Bradford transform, as ACES adapts whites (S-2014-004, annex; ICC.1).
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


def light() -> np.ndarray:
    return np.random.default_rng(4).uniform(0.0, 5.0, (16, 32, 3)).astype(np.float32)


def expected_matrix() -> np.ndarray:
    source, target = (xyz_from_rgb(COLOR_SPACES[name]) for name in ("rec709", "acescg"))
    gains = (BRADFORD @ target @ np.ones(3)) / (BRADFORD @ source @ np.ones(3))
    return np.linalg.inv(target) @ np.linalg.inv(BRADFORD) @ np.diag(gains) @ BRADFORD @ source


def test_acescg_is_aces_own() -> None:
    radiance = light()
    found = convert_light(radiance, "rec709", "acescg")
    np.testing.assert_allclose(found, radiance @ expected_matrix().T, atol=5.0 * ADAPTED)
    np.testing.assert_allclose(convert_light(found, "acescg", "rec709"), radiance, atol=5.0 * FLOAT32)
    np.testing.assert_allclose(convert_light(np.ones((1, 1, 3), np.float32), "rec709", "acescg"), 1.0, atol=ADAPTED)


def test_a_grey_card_has_18_percent(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    radiance = light()
    write_environment(tmp_path / "a.exr", radiance, info=EnvironmentInfo(white_level=2.0, white_luminance=300.0))
    arguments = [str(tmp_path / "a.exr"), "--output", str(tmp_path / "b.exr"), "--axes", "z-up", "--grey-card"]
    assert environment.main(arguments) == 0
    found = read_environment(tmp_path / "b.exr").astype(float)
    up = np.clip(latlong_directions(16)[..., 2], 0.0, None) * texel_solid_angles(16)
    irradiance = ((found @ np.array([0.2126, 0.7152, 0.0722])) * up).sum()
    assert 0.18 * irradiance / np.pi == pytest.approx(0.18, rel=1e-5)
    scale = grey_card_scale(radiance)
    assert f"{scale:.6g}" in capsys.readouterr().err
    said = read_environment_info(tmp_path / "b.exr")
    assert said.white_level == pytest.approx(2.0 * scale, rel=1e-5)
    assert said.white_luminance == pytest.approx(300.0 / scale, rel=1e-5)


# --- Transfer functions of HDR against ITU-R BT.2100's own words and tables, and matrices of primaries ----------------


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


@pytest.mark.parametrize("light", [0.0, 0.01, 1 / 12, 0.0834, 0.265, 0.5, 1.0])
def test_hlg_is_the_recommendation_s(light: float) -> None:
    # The recommendation's b and c have eight digits.
    assert float(hlg_of_light(light / HLG_WHITE)) == pytest.approx(hlg_oetf(light), abs=2e-8)
    assert float(light_of_hlg(hlg_oetf(light))) * HLG_WHITE == pytest.approx(light, abs=5e-8)


def test_every_curve_has_its_inverse() -> None:
    signal = np.linspace(0.0, 1.0, 1025)
    for light_of, signal_of in (
        (light_of_pq, pq_of_light),
        (light_of_hlg, hlg_of_light),
        (decode_srgb, encode_srgb),
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
