"""Animations of a file's nodes: what samplers give, where parts stand, what rays meet, what damage says."""

from __future__ import annotations

import logging
import pathlib
from typing import Any

import numpy as np
import pytest

from tests.gltf_files import Gltf
from tests.layer_rig import POSES, make_scene
from tests.test_object_materials import look
from tests.twins import node_animation as twin
from warp_ar.errors import SceneError
from warp_ar.output.gltf_file import write_glb
from warp_ar.output.shot import Shot
from warp_ar.scene import Camera, Object, Play, Scene
from warp_ar.scene.mesh_files import load_mesh, load_moving_mesh
from warp_ar.scene.node_animation import Sampler, quaternion_matrix
from warp_ar.scene.object_shapes import object_shapes, part_placements
from warp_ar.scene.ray_scene import HostScene

pytestmark = pytest.mark.slow

EXACT = 1e-12  # two float64 formulas of numbers near 1
SINGLE = 2e-5  # float32 vertices through a few transforms of size 5
DISTANCE = 2e-5  # of rays, likewise
CAMERA = Camera(width=64, height=48, fx=600.0, fy=620.0, cx=30.5, cy=24.0)
TIMES = np.array([0.5, 1.0, 2.5, 3.0])
ASKED = (0.0, 0.5, 0.7, 1.0, 1.9, 2.5, 2.99, 3.0, 7.0)
RNG = np.random.default_rng(11)
VECTORS = RNG.normal(size=(4, 3))
TURNS = RNG.normal(size=(4, 4))
TURNS /= np.linalg.norm(TURNS, axis=1, keepdims=True)
TANGENTS = RNG.normal(size=(4, 3, 3))


@pytest.mark.parametrize("seconds", ASKED)
def test_samplers_follow_their_twin(seconds: float) -> None:
    def at(values: Any, way: str, turns: bool = False) -> Any:
        return Sampler(TIMES, np.asarray(values), way, turns).at(seconds)

    np.testing.assert_allclose(at(VECTORS, "LINEAR"), twin.lerp(TIMES, VECTORS, seconds), atol=EXACT)
    np.testing.assert_array_equal(at(VECTORS, "STEP"), twin.step(TIMES, VECTORS, seconds))
    np.testing.assert_allclose(at(TANGENTS, "CUBICSPLINE"), twin.spline(TIMES, TANGENTS, seconds), atol=EXACT)
    found = quaternion_matrix(at(TURNS, "LINEAR", True))
    np.testing.assert_allclose(found, twin.turn(TIMES, TURNS, seconds), atol=EXACT)
    tangents = RNG.normal(size=(4, 3, 4))
    tangents[:, 1] = TURNS
    expected = twin.matrix(twin.spline(TIMES, tangents, seconds))
    np.testing.assert_allclose(quaternion_matrix(at(tangents, "CUBICSPLINE", True)), expected, atol=EXACT)


@pytest.mark.parametrize(
    ("play", "seconds", "expected"),
    [
        (Play(), 5.5, 1.5),
        (Play(loop=False), 5.5, 2.0),
        (Play(start=1.0), 0.5, 0.0),
        (Play(start=1.0, speed=0.5), 2.0, 0.5),
        (Play(start=-1.0), 0.5, 1.5),
    ],
)
def test_the_clock(play: Play, seconds: float, expected: float) -> None:
    assert play.time_at(seconds, 2.0) == expected
    assert play.time_at(seconds, 0.0) == 0.0


def moving(*, still: bool = True, **scales: Any) -> Gltf:
    """Square 0 stands still; 1 hangs below node 3, which moves, and moves itself; 2 hangs on node 3."""
    made = Gltf()
    red = made.material(pbrMetallicRoughness={"baseColorFactor": [1, 0, 0, 1]})
    blue = made.material(pbrMetallicRoughness={"baseColorFactor": [0, 0, 1, 1]}, doubleSided=True)
    if still:
        made.node(made.square(red), translation=[-4, 0, 0])
    first = made.node(made.square(blue), scale=[0.5, 0.5, 0.5])
    second = made.node(made.square(red), translation=[0, 3, 0])
    made.tree["nodes"].append({"children": [first, second], "rotation": [0, 0, 0.6, 0.8]})
    made.tree["nodes"].append({"children": [len(made.tree["nodes"]) - 1], "translation": [0, 0, -0.5]})
    parent = len(made.tree["nodes"]) - 2
    times = made.array(np.float32(TIMES))
    samplers, channels = [], []

    def move(node: int, path: str, values: Any, way: str) -> None:
        output = made.array(np.float32(values).reshape(-1, np.shape(values)[-1]))
        samplers.append({"input": times, "output": output, "interpolation": way})
        channels.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": path}})

    move(parent, "translation", VECTORS, "LINEAR")
    move(first, "rotation", TURNS, "LINEAR")
    for node, values in scales.items():
        move({"parent": parent, "first": first}[node], "scale", values, "STEP")
    made.tree["animations"] = [{"name": "other", "channels": [], "samplers": []}]
    made.tree["animations"].append({"name": "go", "channels": channels, "samplers": samplers})
    return made


SCALES = {
    "even": {"first": np.tile([[0.5], [1.5], [2.0], [0.7]], (1, 3))},
    "uneven": {"first": [[0.5, 1.0, 2.0], [1.5, 0.5, 1.0], [2.0, 2.0, 0.3], [1, 1, 1]]},
    "sheared": {"parent": [[1.0, 2.0, 0.5]] * 4},
    "mirrored": {"first": [[-1.0, 1.0, 1.0]] * 4},
}


def posed(made: Gltf, seconds: float) -> Gltf:
    """The same file without its animation, its nodes where the twin has them."""
    names = {"translation": twin.lerp, "scale": twin.step}
    for channel in made.tree["animations"][1]["channels"]:
        sampler, target = made.tree["animations"][1]["samplers"][channel["sampler"]], channel["target"]
        view = made.tree["bufferViews"][made.tree["accessors"][sampler["output"]]["bufferView"]]
        data = np.frombuffer(made.data[view["byteOffset"] : view["byteOffset"] + view["byteLength"]], np.float32)
        values = data.astype(float).reshape(len(TIMES), -1)
        node = made.tree["nodes"][target["node"]]
        if target["path"] == "rotation":
            node["rotation"] = Sampler(TIMES, values, "LINEAR", True).at(seconds).tolist()
        else:
            node[target["path"]] = names[target["path"]](TIMES, values, seconds).tolist()
    del made.tree["animations"]
    return made


@pytest.mark.parametrize("scales", SCALES.values(), ids=SCALES)
@pytest.mark.parametrize("seconds", [0.0, 1.3, 2.7])
def test_parts_stand_where_the_posed_file_has_them(tmp_path: pathlib.Path, seconds: float, scales: Any) -> None:
    moved = load_moving_mesh(moving(**scales).save(tmp_path / "a.glb"), "go")
    expected = load_mesh(posed(moving(**scales), seconds).save(tmp_path / "b.glb"))
    assert [part.anchor for part in moved.parts] == [-1, 0, 1]
    assert moved.duration == 3.0
    found = [
        part.mesh.vertices[part.mesh.faces].reshape(-1, 3) @ transform[:3, :3].T + transform[:3, 3]
        for part, transform in zip(moved.parts, moved.transforms_at(seconds), strict=True)
    ]
    places = expected.vertices[expected.faces].reshape(-1, 3)
    order = [np.lexsort(np.round(points, 3).T) for points in (np.concatenate(found), places)]
    np.testing.assert_allclose(np.concatenate(found)[order[0]], places[order[1]], atol=SINGLE)
    assert moved.rest.materials == expected.materials
    assert {part.mesh.images for part in moved.parts} == {()}


@pytest.mark.parametrize("scales", SCALES.values(), ids=SCALES)
def test_rays_meet_the_moving_parts(device: str, tmp_path: pathlib.Path, scales: Any, monkeypatch: Any) -> None:
    """By its records at a time, an object is what the file posed at that time is: uneven, sheared and mirrored too."""
    seconds = 1.3
    at = np.random.default_rng(3).uniform(-4, 4, (3000, 2))
    origins = np.stack([at[:, 0], np.full(3000, -9.0), at[:, 1]], axis=-1)
    item = Object(
        "mesh", file=moving(**scales).save(tmp_path / "a.glb"), rotate=(10, 20, 30), scale=0.8, play=Play("go")
    )
    still = Object(
        "mesh", file=posed(moving(**scales), seconds).save(tmp_path / "b.glb"), rotate=(10, 20, 30), scale=0.8
    )
    write = HostScene.write_objects
    monkeypatch.setattr(HostScene, "write_objects", lambda self, out, _, *rest: write(self, out, seconds, *rest))
    found = look([item], origins, (0.1, 1.0, 0.05), device)
    monkeypatch.undo()
    expected = look([still], origins, (0.1, 1.0, 0.05), device)
    met = (expected["t"] < 1e3) & (found["t"] < 1e3)
    edges = (expected["t"] < 1e3) != (found["t"] < 1e3)
    assert met.sum() > 100
    assert edges.mean() < 2e-3  # rays that graze an edge
    close = np.abs(found["t"] - expected["t"])[met] < DISTANCE * 20
    assert close.mean() > 0.998
    for name in ("normal", "diffuse"):
        np.testing.assert_allclose(found[name][met][close], expected[name][met][close], atol=1e-4)


@pytest.mark.parametrize("scales", SCALES.values(), ids=SCALES)
def test_an_exported_shot_keeps_the_motion(tmp_path: pathlib.Path, scales: Any) -> None:
    item = Object("mesh", file=moving(**scales).save(tmp_path / "a.glb"), at=(0.1, 0, 0), scale=0.1, play=Play("go"))
    scene = make_scene(objects=(item,), lights=())
    shot = Shot(scene, 2.0, (POSES[0],) * 5)
    write_glb(tmp_path / "shot.glb", shot)
    read = load_moving_mesh(tmp_path / "shot.glb", "shot")
    (shape, *_) = object_shapes(scene)
    assert shape.moving is not None
    for seconds in shot.seconds[1:]:
        expected = [
            (part.mesh.vertices @ place[:3, :3].T + place[:3, 3])[part.mesh.faces].reshape(-1, 3)
            for part, place in zip(shape.moving.parts, part_placements(item, shape.moving, seconds), strict=True)
        ]
        # The last parts are the file's moving ones, in their order; what stands still comes first, proxies too.
        found = [
            (part.mesh.vertices @ place[:3, :3].T + place[:3, 3])[part.mesh.faces].reshape(-1, 3)
            for part, place in zip(read.parts, read.transforms_at(seconds), strict=True)
        ]
        for one, other in zip(expected[1:], found[-2:], strict=True):
            np.testing.assert_allclose(np.sort(other, axis=0), np.sort(one, axis=0), atol=SINGLE)


def times(values: Any) -> Any:
    def change(made: Gltf) -> None:
        made.tree["animations"][1]["samplers"][0]["input"] = made.array(np.float32(values))

    return change


def channel(**target: Any) -> Any:
    return lambda made: made.tree["animations"][1]["channels"][0]["target"].update(target)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (times([0, 2, 1, 3]), "sampler 0 has times that are not finite, below 0, or not in order"),
        (times([-1, 0, 1, 3]), "below 0"),
        (times([0, 1]), "2 times and 4 values; 2 are right"),
        (lambda m: m.tree["animations"][1]["samplers"][0].update(interpolation="BEST"), "the interpolation 'BEST'"),
        (lambda m: m.tree["animations"][1]["samplers"][0].update(interpolation="CUBICSPLINE"), "12 are right"),
        (lambda m: m.tree["animations"][1]["channels"][0].update(sampler=9), "channel of sampler 9; there are 2"),
        (lambda m: m.tree["animations"][1]["channels"].append(m.tree["animations"][1]["channels"][0]), "twice"),
        (channel(node=77), "moves node 77; there are 5"),
        (channel(path="rotation"), "of 3 numbers each; 4 are right"),
        (lambda m: m.tree["nodes"][3].update(matrix=list(np.eye(4).ravel())), "moves node 3, which has a matrix"),
        (lambda m: m.tree.update(animations=[]), "it has no animation"),
        (lambda m: m.tree["animations"][1].update(name="gone"), "animation 'go' is asked for; it has 'other', 'gone'"),
    ],
)
def test_damage_is_one_clear_line(tmp_path: pathlib.Path, change: Any, message: str) -> None:
    made = moving()
    change(made)
    path = made.save(tmp_path / "a.glb")
    with pytest.raises(SceneError, match=message) as caught:
        load_moving_mesh(path, "go")
    assert str(caught.value).startswith(f"{path}: ")
    assert len(str(caught.value).splitlines()) == 1


def test_what_is_not_played_is_named(tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture) -> None:
    made = moving()
    entry = made.tree["animations"][1]
    entry["channels"].append({"sampler": 0, "target": {"node": 1, "path": "pointer"}})
    entry["channels"].append({"sampler": 0, "target": {"path": "translation"}})
    path = made.save(tmp_path / "a.glb")
    with caplog.at_level(logging.WARNING):
        object_shapes(Scene(CAMERA, objects=(Object("mesh", file=path, play=Play(1)),)))
    (record,) = caplog.records
    assert record.getMessage() == f"{path}: not shown: animated pointer"
    with pytest.raises(SceneError, match="asked for is animation 2; there are 2"):
        load_moving_mesh(path, 2)


def test_too_many_parts_are_refused(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("warp_ar.scene.mesh_files.MOST_PARTS", 2)
    with pytest.raises(SceneError, match="moves 3 parts; at most 2 are"):
        load_moving_mesh(moving().save(tmp_path / "a.glb"), "go")
