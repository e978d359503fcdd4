"""Objects of a running pipeline by name: an edit gives the picture of a pipeline built for it, and compiles nothing."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tests.test_pipeline import SPARED, Frames, frames, make_scene, run
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import SceneError, UsageError
from warp_ar.scene import AreaLight, LambertMaterial, MirrorMaterial, Object, Scene, dumps_scene, loads_scene
from warp_ar.scene.geometry import make_mesh
from warp_ar.stages.quality import PRESETS

pytestmark = pytest.mark.slow
__all__ = ["frames"]  # a fixture

pytestmark = pytest.mark.slow

BALL = Object("sphere", radius=0.02, at=(0.0, 0.06, 0.02), material=LambertMaterial((0.2, 0.5, 0.9)), name="ball")
UPRIGHT = np.array([[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.02], [0.0, 0.0, 1.0, 0.05], [0.0, 0.0, 0.0, 1.0]])


def named() -> Scene:
    sphere, torus = make_scene().objects
    return make_scene(objects=(dataclasses.replace(sphere, name="lamp"), torus))


def turn_lamp(pipeline: Pipeline) -> None:
    pipeline.objects["lamp"].world_from_object = UPRIGHT


def paint_torus(pipeline: Pipeline) -> None:
    torus = pipeline.objects[1]
    torus.material = dataclasses.replace(torus.material, base_color=(0.1, 0.2, 0.9))


def mirror_lamp(pipeline: Pipeline) -> None:
    pipeline.objects["lamp"].material = MirrorMaterial((0.9, 0.9, 0.9))


def add_and_remove(pipeline: Pipeline) -> None:
    pipeline.objects.add(BALL).place((0.1, 0.1, 0.02))
    pipeline.objects.remove("lamp")


def go_to_paper(pipeline: Pipeline) -> None:
    pipeline.change(quality="paper")


@pytest.mark.parametrize("edit", [turn_lamp, paint_torus, mirror_lamp, add_and_remove, go_to_paper])
def test_an_edit_equals_a_new_pipeline_that_goes_on(edit: Callable[[Pipeline], None], frames: Frames) -> None:
    """Whatever the arrays held that are used again; and a picture of before can still be read."""
    with Pipeline(named(), device="cpu", quality="low") as live, Pipeline(named(), device="cpu", quality="low") as old:
        expected, held = run(old, frames[:2])[1].image.copy(), run(live, frames[:2])[1]
        arrays = live.arrays
        edit(live)
        allowed = SPARED if live.arrays is arrays else 0
        np.testing.assert_array_equal(held.image, expected)
        with Pipeline(live.scene, device="cpu", quality=live.quality) as new:
            new.continue_from(old)
            for index, image in enumerate(frames[1:3]):
                shown = live(image, time_seconds=0.1 + index / 30).image
                anew = new(image, time_seconds=0.1 + index / 30).image
                assert np.abs(shown.astype(int) - anew).max() <= allowed
                assert np.abs(shown.astype(int) - expected).max() > 20 * SPARED


def test_another_object_of_a_kind_that_is_there_compiles_nothing(frames: Frames) -> None:
    compiled: list[int] = []
    with Pipeline(named(), device="cpu", quality="low") as pipeline:
        _ = pipeline(frames[0]).image
        pipeline.objects.add(BALL)
        pipeline.objects["ball"].material = LambertMaterial((0.9, 0.1, 0.1))
        pipeline.objects.remove(0)
        pipeline.warm_up(lambda done, count: compiled.append(count))
        assert compiled == []
        assert [item.value.shape for item in pipeline.objects] == ["torus", "sphere"]


def test_poses_come_back() -> None:
    with Pipeline(named(), device="cpu", quality="low") as pipeline:
        lamp = pipeline.objects["lamp"]
        assert f"{pipeline.objects} {lamp}" == "SceneObjects({'lamp': 'sphere', 1: 'torus'}) SceneObject('lamp')"
        lamp.world_from_object = 2.0 * UPRIGHT + np.diag([0.0, 0.0, 0.0, -1.0])
        np.testing.assert_allclose(lamp.world_from_object[:3], 2.0 * UPRIGHT[:3], atol=1e-6)
        half = np.sqrt(0.5)
        lamp.place(UPRIGHT[:3, 3], (0.0, 0.0, half, half), 3.0)
        np.testing.assert_allclose(lamp.world_from_object[:3, :3], 3.0 * UPRIGHT[:3, :3], atol=1e-6)
        lamp.value = dataclasses.replace(lamp.value, radius=0.01)
        assert pipeline.scene.objects[0].radius == 0.01
        assert pipeline.objects[np.int64(1)].value == named().objects[1]


def flat(corners: np.ndarray) -> Object:
    """Return an object of triangles (m, 3, 3), each with its own normal."""
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.repeat(across / np.linalg.norm(across, axis=1, keepdims=True), 3, axis=0)
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    mesh = make_mesh(corners.reshape(-1, 3), faces, normals)
    return Object("mesh", mesh=mesh, material=LambertMaterial((0.2, 0.5, 0.9)), name="wedge")


def test_a_sheared_mesh_equals_one_with_sheared_vertices(frames: Frames) -> None:
    """And moving it without another shear writes numbers in place."""
    shear, there = np.array([[1.0, 0.5, 0, 0], [0, 0.7, 0, 0], [0, 0, -1.5, 0], [0, 0, 0, 1]]), np.eye(4)
    there[:3] = UPRIGHT[:3]
    corners = trimesh.creation.cylinder(radius=0.02, height=0.03, sections=9).triangles
    with Pipeline(make_scene(objects=(flat(corners),)), device="cpu", quality="low") as pipeline:
        wedge = pipeline.objects["wedge"]
        wedge.world_from_object = shear
        np.testing.assert_allclose(wedge.world_from_object, shear, atol=1e-9)
        _ = pipeline(frames[0]).image
        arrays = pipeline.arrays
        wedge.world_from_object = there @ shear
        image = pipeline(frames[0], time_seconds=0.1).image.copy()
        assert pipeline.arrays is arrays
    moved = trimesh.transform_points(corners.reshape(-1, 3), there @ shear).reshape(-1, 3, 3)
    with Pipeline(make_scene(objects=(flat(moved[:, ::-1]),)), device="cpu", quality="low") as new:
        expected = run(new, [frames[0], frames[0]])[1].image
    assert (np.abs(image.astype(int) - expected) > SPARED).mean() < 1e-4, "but for rays that graze an edge"


@pytest.fixture(scope="module")
def standing() -> Iterator[Pipeline]:
    with Pipeline(named(), device="cpu", quality="low") as pipeline:
        yield pipeline


@pytest.mark.parametrize(
    ("edit", "error", "told"),
    [
        (lambda all_: all_["lmap"], UsageError, "did you mean .lamp"),
        (lambda all_: all_[2], UsageError, "numbers run from 0 to 1"),
        (lambda all_: all_.remove("ball"), UsageError, "there is no 'ball'"),
        (lambda all_: all_.add(dataclasses.replace(BALL, name="lamp")), UsageError, "there is an object 'lamp'"),
        (lambda all_: all_.add("ball"), UsageError, "expected an Object"),
        (lambda all_: all_.add(Object("mesh", file=Path("gone.glb"))), SceneError, "gone.glb"),
        (lambda all_: all_.add(dataclasses.replace(BALL, at=(np.nan, 0.0, 0.0))), SceneError, "finite"),
        (lambda all_: all_["lamp"].place((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)), SceneError, "with a length"),
        (lambda all_: all_["lamp"].place((0.0, 0.0, 0.0), scale=-1.0), SceneError, "expected a mesh"),
        (lambda all_: all_["lamp"].place("abc"), SceneError, "expected 3 numbers"),
        (lambda all_: all_["lamp"].place((0.0, 0.0, 0.0), scale=None), SceneError, "finite numbers"),
        (lambda all_: all_.add(dataclasses.replace(BALL, at=np.full(3, np.nan))), SceneError, "finite"),
        (lambda all_: setattr(all_[1], "value", named().objects[0]), UsageError, "another object 'lamp'"),
        (lambda all_: setattr(all_[1], "value", None), UsageError, "value is NoneType; expected an Object"),
        (lambda all_: setattr(all_[1], "material", None), SceneError, "material = None: expected"),
        (lambda all_: setattr(all_[1], "world_form_object", UPRIGHT), AttributeError, "world_form_object"),
        (lambda all_: all_[True], UsageError, "there is no True"),
    ],
)
def test_an_edit_that_cannot_be_changes_nothing(edit, error, told, frames: Frames, standing: Pipeline) -> None:
    before = standing(frames[0], time_seconds=0.0).image.copy()
    with pytest.raises(error, match=told):
        edit(standing.objects)
    assert standing.scene.objects == named().objects
    np.testing.assert_array_equal(standing(frames[0], time_seconds=0.0).image, before)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"scene": 7}, "scene = 7: expected Scene or text or a path"),
        ({"quality": "lwo"}, "is no preset; did you mean low"),
        ({"quality": PRESETS["low"].with_methods(recover="shadnig")}, 'did you mean "shading"'),
        ({"outputs": None}, "outputs = None: expected a tuple"),
        ({"exposures": 0.1}, "exposures = 0.1: expected a tuple"),
        ({"size": "640x480"}, "size = '640x480': expected a tuple of 2 times a whole number or None"),
        ({"size": (320, 0)}, "expected whole numbers above 0"),
        ({"bands": -1}, "bands = -1: expected whole numbers above 0"),
        ({"shown": "x"}, "shown = 'x': expected a finite number"),
    ],
)
def test_a_pipeline_names_what_it_cannot_take(given, told) -> None:
    with pytest.raises(UsageError, match=told):
        Pipeline(**{"scene": make_scene(), "device": "cpu", **given})


def test_names_are_kept_in_files() -> None:
    lamp = AreaLight("disk", 2.0, at=(0.0, 0.0, 0.3), radius=0.05, name="panel").as_object()
    scene = make_scene(objects=(BALL, lamp))
    assert [item.name for item in loads_scene(dumps_scene(scene)).objects] == ["ball", "panel"]
    text = '[[light]]\nkind = "rect"\nintensity = 2.0\nat = [0, 0, 1]\nsize = [0.1, 0.1]\nname = "panel"\n'
    read = loads_scene(dumps_scene(make_scene(objects=(), lights=())) + text)
    assert read.objects[0].name == "panel"
