"""Tables that mirror their surroundings, told by frames from several sides; matt ones are never taken for such."""

from __future__ import annotations

import dataclasses
import re

import cv2
import pytest

from tests.polished_table import film
from warp_ar import doctor
from warp_ar.kernels.color import decode_table
from warp_ar.light.polish import estimate_polish
from warp_ar.scene import ProxyMaterial, dumps_scene, load_scene

pytestmark = pytest.mark.slow

TABLE = decode_table("srgb")
POLISHED = 6, 0.15, 0.04
"""Seed, roughness and reflectance of a table."""


def estimate(made, views=None):
    return estimate_polish(made.scene, made.scene.camera, views or made.views, made.captured, TABLE)


def test_a_polished_table_is_told_with_its_numbers():
    made = film(*POLISHED)
    found = estimate(made)
    assert found is not None, made.about
    assert found.reflectance is not None
    _, roughness, reflectance = POLISHED
    assert found.roughness[1] <= roughness <= found.roughness[2]
    assert found.reflectance[1] <= reflectance <= found.reflectance[2]


def test_a_matt_table_is_not_taken_for_polished():
    """Under an exposure that drifts."""
    made = film(8, 0.0, 0.0, clutter=True, spoil=lambda linear, number: linear * 0.8 ** (number % 3))
    assert estimate(made) is None, made.about


def test_views_from_one_side_tell_nothing():
    made = film(*POLISHED)
    assert estimate(made, made.views[:2]) is None


def test_what_the_scene_says_is_not_asked():
    made = film(*POLISHED)
    (plane,) = made.scene.proxies
    polished = dataclasses.replace(plane, material=ProxyMaterial())
    assert estimate(dataclasses.replace(made, scene=dataclasses.replace(made.scene, proxies=(polished,)))) is None


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Scenes with films as pictures in folders, of a polished table and of a matt one."""
    found = {}
    for name, told in (("polished", POLISHED), ("matt", (6, 0.15, 0.0))):
        made, folder = film(*told), tmp_path_factory.mktemp(name)
        (folder / "frames").mkdir()
        for number, (image, _) in enumerate(made.views):
            cv2.imwrite(str(folder / "frames" / f"{number}.png"), image[..., ::-1])
        box = '[[proxy]]\nshape = "box"\nat = [0.0, 0.6, 0.01]\nsize = [0.02, 0.02, 0.02]\n\n'
        text = dumps_scene(made.scene).replace("[[proxy]]", f"{box}[[proxy]] # the table")
        (folder / "scene.toml").write_text(text + '[source]\npath = "frames"\n')
        found[name] = folder
    return found


def test_doctor_says_and_writes_how_a_table_mirrors(folders, capsys):
    """By the poses that it finds itself; the second time the scene says it already."""
    path = folders["polished"] / "scene.toml"
    doctor.main([str(path)])
    said = capsys.readouterr().out
    assert "[proxy.material]" in said
    assert float(re.search(r"reflectance = (\S+)", said)[1]) == pytest.approx(0.04, rel=0.5)
    assert all(proxy.material is None for proxy in load_scene(path).proxies)
    doctor.main([str(path), "--write"])
    box, table = load_scene(path).proxies
    assert box.material is None
    assert f"roughness = {table.material.roughness:g}" in said
    assert f"reflectance = {table.material.reflectance[0]:g}" in said
    assert "# the table" in path.read_text()
    capsys.readouterr()
    before = path.read_text()
    doctor.main([str(path), "--write"])
    assert "the scene has a [proxy.material]" in capsys.readouterr().err
    assert path.read_text() == before


def test_doctor_writes_nothing_of_a_matt_table(folders, capsys):
    path = folders["matt"] / "scene.toml"
    before = path.read_text()
    doctor.main([str(path), "--write"])
    said = capsys.readouterr()
    assert "table:" not in said.out
    assert "nothing is written" in said.err
    assert path.read_text() == before
