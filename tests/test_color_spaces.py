"""Exported light in other colour spaces, and by a grey card."""

from __future__ import annotations

import pathlib

import numpy as np
import OpenEXR
import pytest

from warp_ar import environment
from warp_ar.light.captured import latlong_directions, texel_solid_angles
from warp_ar.output.color_spaces import COLOR_SPACES, convert_light, grey_card_scale
from warp_ar.output.environment_file import EnvironmentInfo, read_environment, read_environment_info, write_environment
from warp_ar.signals import xyz_from_rgb

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


def test_a_file_in_acescg_says_so_and_comes_back(tmp_path: pathlib.Path) -> None:
    write_environment(tmp_path / "a.exr", light(), axes="y-up", color_space="acescg")
    with OpenEXR.File(str(tmp_path / "a.exr")) as file:
        np.testing.assert_allclose(file.header()["chromaticities"], COLOR_SPACES["acescg"], rtol=1e-6)
    np.testing.assert_allclose(read_environment(tmp_path / "a.exr"), light(), atol=5.0 * FLOAT32)


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


def test_what_cannot_be_is_one_line(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_environment(tmp_path / "a.exr", light())
    write_environment(tmp_path / "dark.exr", np.zeros((4, 8, 3), np.float32))
    for name, more, line in (
        (
            "a",
            ["--output", str(tmp_path / "b.hdr"), "--color-space", "acescg"],
            "is told in OpenEXR alone; name an .exr",
        ),
        ("dark", ["--output", str(tmp_path / "b.exr"), "--grey-card"], "the light from above is 0"),
    ):
        assert environment.main([str(tmp_path / f"{name}.exr"), *more]) == 2
        said = capsys.readouterr().err
        assert line in said
        assert said.count("\n") == 1
