"""Tables that mirror their surroundings, told by frames from several sides; matt ones are never taken for such."""

from __future__ import annotations

import dataclasses
import re

import cv2
import numpy as np
import pytest

from tests.polished_table import HEIGHT, WIDTH, film
from warp_ar.doctor import look_for_polish
from warp_ar.kernels.color import decode_table
from warp_ar.light.polish import estimate_polish
from warp_ar.scene import ProxyMaterial

TABLE = decode_table("srgb")
ROWS, COLUMNS = np.mgrid[-1 : 1 : HEIGHT * 1j, -1 : 1 : WIDTH * 1j]
SPOILED = {
    "as it is": None,
    "dark corners": lambda linear, _: linear * (1.0 - 0.25 * (ROWS**2 + COLUMNS**2))[..., None],
    "exposure that drifts": lambda linear, number: linear * 0.8 ** (number % 3),
    "another response": lambda linear, _: 1.1 * np.clip(linear, 0.0, 1.0) ** 1.25,
}


def estimate(made, views=None):
    return estimate_polish(made.scene, made.scene.camera, views or made.views, made.capture(), TABLE)


@pytest.mark.parametrize(("seed", "roughness", "reflectance"), [(1, 0.08, 0.05), (6, 0.15, 0.04), (7, 0.2, 0.06)])
def test_a_polished_table_is_told_with_its_numbers(seed, roughness, reflectance):
    made = film(seed, roughness, reflectance)
    found = estimate(made)
    assert found is not None, made.about
    assert found.reflectance is not None
    assert found.roughness[1] <= roughness <= found.roughness[2]
    assert found.reflectance[1] <= reflectance <= found.reflectance[2]


@pytest.mark.parametrize("spoiled", SPOILED)
@pytest.mark.parametrize("seed", [4, 8])
def test_a_matt_table_is_not_taken_for_polished(seed, spoiled):
    made = film(seed, 0.0, 0.0, clutter=True, spoil=SPOILED[spoiled])
    assert estimate(made) is None, made.about


def test_views_from_one_side_tell_nothing():
    made = film(1, 0.08, 0.05)
    assert estimate(made, made.views[:2]) is None


def test_what_the_scene_says_is_not_asked():
    made = film(1, 0.08, 0.05)
    (plane,) = made.scene.proxies
    polished = dataclasses.replace(plane, material=ProxyMaterial())
    made.scene = dataclasses.replace(made.scene, proxies=(polished,))
    assert estimate(made) is None


def test_doctor_says_what_to_write(tmp_path):
    """Of the same film as pictures in a folder, by the poses that it finds itself; of a matt table, nothing."""
    for name, reflectance in (("polished", 0.04), ("matt", 0.0)):
        made = film(6, 0.15, reflectance)
        (tmp_path / name).mkdir()
        for number, (image, _) in enumerate(made.views):
            cv2.imwrite(str(tmp_path / name / f"{number}.png"), image[..., ::-1])
        line = look_for_polish(made.scene, tmp_path / name, 120)
        if name == "matt":
            assert line is None
        else:
            assert line is not None
            assert "[proxy.material]" in line
            assert float(re.search(r"reflectance = (\S+)", line)[1]) == pytest.approx(0.04, rel=0.5)
    assert look_for_polish(made.scene, None, 120) is None
