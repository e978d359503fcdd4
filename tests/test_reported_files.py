"""Small files that users of other tools met, each with the value that is right."""

from __future__ import annotations

import json
import pathlib

import numpy as np
import pytest

from warp_ar import environment
from warp_ar.light.captured import Light
from warp_ar.light.latlong_axes import from_axes
from warp_ar.output.environment_file import read_environment


@pytest.fixture
def cases(shared: pathlib.Path) -> pathlib.Path:
    folder = shared / "cases"
    if not folder.is_dir():
        pytest.skip("needs ../shared/cases")
    return folder


def test_environment_exr_nan_window(cases: pathlib.Path, tmp_path: pathlib.Path) -> None:
    folder, out = cases / "environment_exr_nan_window", tmp_path / "x.json"
    assert environment.main([str(folder / "nan.exr"), "--output", str(out)]) == 0
    json.loads(out.read_text(), parse_constant=lambda word: pytest.fail(word))
    cropped = read_environment(folder / "cropped_window.exr")
    assert cropped.shape == (8, 16, 3)
    assert not cropped[[0, 1, 6, 7]].any()
    assert cropped[2:6].any()


def test_light_exr_axes(cases: pathlib.Path) -> None:
    path = cases / "light_exr_axes" / "envmap_latlong.exr"
    np.testing.assert_array_equal(Light.load(path).radiance, from_axes(Light.load(path, "z-up").radiance, "y-up"))


def test_light_exr_chromaticities(cases: pathlib.Path) -> None:
    found = Light.load(cases / "light_exr_chromaticities" / "own_acescg.exr").radiance
    # The file's AP1 has five digits.
    np.testing.assert_allclose(found.reshape(-1, 3).max(0), (1.0, 0.0, 0.0), atol=2e-4)
