"""Scenes written to files: any scene loads again as it was."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.test_scene import BASE, SPHERE, SPOT, folder  # noqa: F401  (a fixture)
from warp_ar import scene as sc
from warp_ar.scene import Camera, Scene, dumps_scene, loads_scene

pytestmark = pytest.mark.slow

FINITE = st.floats(-1e18, 1e18)
POSITIVE = st.floats(1e-18, 1e18)
UNIT = st.floats(0.0, 1.0)
NONNEGATIVE = st.floats(0.0, 1e18)
VEC3 = st.tuples(FINITE, FINITE, FINITE)
PLACES = {"at": VEC3, "rotate": VEC3}


def color(file: pathlib.Path) -> st.SearchStrategy[Any]:
    return st.tuples(UNIT, UNIT, UNIT) | st.just(file)


def animations() -> st.SearchStrategy[sc.Animation | None]:
    return st.none() | st.builds(sc.Animation, VEC3, st.none() | VEC3, VEC3, st.floats(1e-3, 1e18))


def objects(mesh: pathlib.Path, tint: st.SearchStrategy[Any]) -> st.SearchStrategy[sc.Object]:
    materials = st.one_of(
        st.builds(sc.PhongMaterial, tint, tint, NONNEGATIVE),
        st.builds(sc.MetallicRoughnessMaterial, tint, UNIT, UNIT),
        st.builds(sc.LambertMaterial, tint),
        st.builds(sc.MirrorMaterial, tint),
    )
    item: dict[str, Any] = {**PLACES, "scale": POSITIVE, "material": materials, "animate": animations()}
    return st.one_of(
        st.builds(sc.Object, st.just("mesh"), file=st.just(mesh), **item),
        st.builds(sc.Object, st.just("sphere"), radius=POSITIVE, **item),
        st.builds(sc.Object, st.just("box"), size=st.tuples(POSITIVE, POSITIVE, POSITIVE), **item),
        st.builds(
            sc.Object, st.just("torus"), major_radius=st.floats(1.0, 1e18), minor_radius=st.floats(1e-18, 0.9), **item
        ),
    )


def proxies(mesh: pathlib.Path) -> st.SearchStrategy[sc.Proxy]:
    return st.one_of(
        st.builds(sc.Proxy, st.just("plane"), size=st.tuples(POSITIVE, POSITIVE), **PLACES),
        st.builds(sc.Proxy, st.just("box"), size=st.tuples(POSITIVE, POSITIVE, POSITIVE), **PLACES),
        st.builds(sc.Proxy, st.just("mesh"), file=st.just(mesh), **PLACES),
    )


def lights() -> st.SearchStrategy[sc.Light]:
    shine: dict[str, Any] = {
        "intensity": NONNEGATIVE,
        "color": st.tuples(NONNEGATIVE, NONNEGATIVE, NONNEGATIVE),
        "animate": animations(),
    }
    near = {"attenuation": st.tuples(NONNEGATIVE, NONNEGATIVE, POSITIVE), "radius": NONNEGATIVE}
    cone = {"inner_angle": st.floats(0, 20), "outer_angle": st.floats(20, 90)}
    directions = st.tuples(FINITE, FINITE, POSITIVE)
    return st.one_of(
        st.builds(sc.Light, st.just("point"), at=VEC3, **shine, **near),
        st.builds(sc.Light, st.just("spot"), at=VEC3, direction=directions, **shine, **near, **cone),
        st.builds(sc.Light, st.just("spot"), at=st.just((0.0, 0.0, 0.0)), target=directions, **shine, **near, **cone),
        st.builds(sc.Light, st.just("directional"), direction=directions, **shine),
    )


def markers() -> st.SearchStrategy[sc.Marker]:
    white = st.floats(0.01, 1.0)
    dictionaries = st.sampled_from(["DICT_4X4_50", "DICT_APRILTAG_36h11"])
    few, many = st.integers(1, 7), st.integers(2, 10)
    boards = st.one_of(
        st.builds(sc.GridBoard, few, few, POSITIVE, POSITIVE),
        st.builds(sc.CharucoBoard, many, many, st.floats(1.0, 1e18), st.floats(1e-18, 0.9)),
    )
    return st.one_of(
        st.builds(sc.Marker, dictionaries, st.integers(0, 49), POSITIVE, white),
        st.builds(sc.Marker, white=white, board=boards),
    )


def sources(root: pathlib.Path) -> st.SearchStrategy[sc.SourceSpec | None]:
    fps = st.none() | st.floats(1e-3, 1e5)
    return st.one_of(
        st.none(),
        st.builds(sc.SourceSpec, path=st.just(root / "frames"), fps=fps),
        st.builds(sc.SourceSpec, camera=st.integers(0, 9), fps=fps),
        st.builds(sc.SourceSpec, synthetic=st.text(min_size=1).filter(encodable), fps=fps),
    )


def cameras(root: pathlib.Path) -> st.SearchStrategy[Camera]:
    return st.builds(
        Camera,
        st.integers(1, 65536),
        st.integers(1, 65536),
        POSITIVE,
        POSITIVE,
        FINITE,
        FINITE,
        st.sampled_from([4, 5, 8]).flatmap(lambda n: st.tuples(*[FINITE] * n)),
        st.sampled_from(["srgb", "linear", "gamma:2.2", root / "response.json"]),
    )


def scenes(root: pathlib.Path) -> st.SearchStrategy[Scene]:
    mesh, picture = root / "model.ply", root / "wood.png"
    share = st.floats(0.01, 1.0)
    return st.builds(
        Scene,
        camera=cameras(root),
        name=st.text(min_size=1).filter(encodable),
        source=sources(root),
        marker=markers(),
        probes=st.lists(st.builds(sc.Probe, VEC3, POSITIVE, st.tuples(share, share, share)), max_size=2).map(tuple),
        proxies=st.lists(proxies(mesh), max_size=2).map(tuple),
        objects=st.lists(objects(mesh, color(picture)), max_size=3).map(tuple),
        lights=st.lists(lights(), max_size=3).map(tuple),
        exposure=st.builds(sc.Exposure, NONNEGATIVE | st.just("auto")),
    )


def encodable(text: str) -> bool:
    """Whether a file can hold the text: half a surrogate pair cannot be written as UTF-8."""
    return not any("\ud800" <= letter <= "\udfff" for letter in text)


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_what_is_written_loads_as_it_was(folder: pathlib.Path, data: st.DataObject) -> None:
    scene = data.draw(scenes(folder.resolve()))
    text = dumps_scene(scene)
    text.encode("utf-8")
    assert loads_scene(text) == scene
    assert loads_scene(dumps_scene(scene, folder), folder / "other.toml") == scene


@pytest.mark.parametrize("name", ["\x7f\x00\t\n\r\x1b", '"\\u0041"', "\u2028\U0001f4a1 \xe9"])
def test_any_text_can_be_a_name(name: str) -> None:
    scene = Scene(camera=Camera(640, 480, 600.0, 600.0, 320.0, 240.0), name=name)
    assert loads_scene(dumps_scene(scene)) == scene


def test_paths_inside_the_folder_are_written_relative(folder: pathlib.Path) -> None:
    scene = loads_scene(BASE + "[[object]]\nshape = 'mesh'\nfile = 'model.ply'", folder / "scene.toml")
    assert 'file = "model.ply"' in dumps_scene(scene, folder)
    assert f'file = "{(folder / "model.ply").resolve().as_posix()}"' in dumps_scene(scene, folder / "frames")


def test_scenes_are_values(folder: pathlib.Path) -> None:
    make: Callable[[], Scene] = lambda: loads_scene(BASE + SPHERE + SPOT, folder / "scene.toml")  # noqa: E731
    assert make() == make()
    assert hash(make()) == hash(make())
    with pytest.raises(dataclasses.FrozenInstanceError):
        make().name = "other"  # type: ignore[misc]
