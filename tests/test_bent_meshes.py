"""Skins and morph targets that an animation moves: vertices, normals and rays, each by its closed form."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.gltf_files import Gltf
from tests.layer_rig import look_at, make_frame, make_scene
from tests.test_object_materials import look
from warp_ar.engine.pipeline import Pipeline
from warp_ar.kernels.structs import Shape
from warp_ar.scene import Camera, Object, Play, Scene
from warp_ar.scene.mesh_files import load_mesh, load_moving_mesh
from warp_ar.scene.ray_scene import HostScene

pytestmark = pytest.mark.slow

SINGLE = 2e-6  # float32 of sizes near 1
SQUARES = np.array([[-1, 0, 0], [1, 0, 0], [-1, 1, 0], [1, 1, 0], [-1, 2, 0], [1, 2, 0]], np.float32) * np.float32(
    [0.2, 1, 1]
)
"""A bar of two squares along +Y, in glTF's axes."""
BAR_FACES = np.array([0, 1, 3, 0, 3, 2, 2, 3, 5, 2, 5, 4], np.uint16)
ACROSS, UP, TOWARD = np.eye(3)
ENDS = np.array([-1.0, 1.0])
CUBE = np.array([[x, y, z] for x in ENDS for y in ENDS for z in ENDS], np.float32)
CUBE_FACES = np.array(
    [0, 1, 3, 0, 3, 2, 4, 6, 7, 4, 7, 5, 0, 4, 5, 0, 5, 1, 2, 3, 7, 2, 7, 6, 0, 2, 6, 0, 6, 4, 1, 5, 7, 1, 7, 3],
    np.uint16,
)


def turned(points: Any, angle: float) -> Any:
    """About +Z."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.asarray(points) @ np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]).T


def upright(points: Any) -> Any:
    """From glTF's axes to the program's: (x, y, z) is (x, -z, y)."""
    return np.stack([points[..., 0], -points[..., 2], points[..., 1]], axis=-1)


def play(made: Gltf, node: int, path: str, values: Any, *, way: str = "LINEAR") -> None:
    """Move a node in two seconds from the first value to the second."""
    output = made.array(np.float32(values))
    sampler = {"input": made.array(np.float32([0.0, 2.0])), "output": output, "interpolation": way}
    animation = made.tree.setdefault("animations", [{"name": "go", "channels": [], "samplers": []}])[0]
    animation["samplers"].append(sampler)
    animation["channels"].append({"sampler": len(animation["samplers"]) - 1, "target": {"node": node, "path": path}})


def bar(*, turns: float = np.pi / 2, normals: bool = True) -> Gltf:
    """The upper joint, at y = 1, turns about +Z; the middle of the bar goes half with each joint."""
    made = Gltf()
    weights = np.float32([[1, 0, 0, 0]] * 2 + [[0.5, 0.5, 0, 0]] * 2 + [[0, 1, 0, 0]] * 2)
    attributes = {
        "POSITION": made.array(SQUARES),
        "JOINTS_0": made.array(np.tile(np.uint8([0, 1, 0, 0]), (6, 1))),
        "WEIGHTS_0": made.array(weights),
    }
    if normals:
        attributes["NORMAL"] = made.array(np.tile(np.float32([0, 0, 1]), (6, 1)))
    material = made.material(doubleSided=True, pbrMetallicRoughness={"baseColorFactor": [0.7, 0.2, 0.1, 1]})
    made.node({"attributes": attributes, "indices": made.array(BAR_FACES), "material": material}, skin=0)
    made.tree["nodes"] += [{"children": [2]}, {"translation": [0, 1, 0]}]
    made.tree["nodes"].append({"children": [1]})
    inverse = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    inverse[1, 3, :3] = 0, -1, 0  # column after column
    made.tree["skins"] = [{"joints": [1, 2], "inverseBindMatrices": made.array(inverse.reshape(2, 16))}]
    half = 0.5 * turns
    play(made, 2, "rotation", [[0, 0, 0, 1], [0, 0, np.sin(half), np.cos(half)]])
    return made


def bent_bar(angle: float) -> Any:
    """Vertices of the bar, its upper joint turned by an angle: the middle is the mean of what both joints say."""
    above = turned(SQUARES - UP, angle) + UP
    return np.concatenate([SQUARES[:2], 0.5 * (SQUARES + above)[2:4], above[4:]])


def cube(*, values: Any = ((0.0, 1.0), (1.0, 0.0)), **node: Any) -> Gltf:
    """Target 0 doubles x, target 1 lifts all by 3."""
    made = Gltf()
    grown, lifted = CUBE * np.float32([1, 0, 0]), np.tile(np.float32([0, 3, 0]), (8, 1))
    primitive = {
        "attributes": {"POSITION": made.array(CUBE)},
        "indices": made.array(CUBE_FACES),
        "targets": [{"POSITION": made.array(grown)}, {"POSITION": made.array(lifted)}],
        "material": made.material(pbrMetallicRoughness={"baseColorFactor": [0.2, 0.6, 0.1, 1]}),
    }
    index = made.node(primitive, **node)
    made.tree["meshes"][0]["weights"] = list(values[0])
    play(made, index, "weights", np.ravel(values))
    return made


def morphed_cube(s: float) -> Any:
    """Vertices at ``s`` of the way."""
    return CUBE * [1.0 + s, 1.0, 1.0] + [0.0, 3.0 * (1.0 - s), 0.0]


def corners(mesh: Any) -> Any:
    return mesh.vertices[mesh.faces]


@pytest.mark.parametrize("seconds", [0.0, 0.7, 1.3, 2.0, 5.0])
def test_a_bar_of_two_joints_bends_as_its_closed_form(tmp_path: pathlib.Path, seconds: float) -> None:
    moving = load_moving_mesh(bar().save(tmp_path / "a.glb"), "go")
    (part,) = moving.parts
    assert part.anchor == -1
    assert part.bend is not None
    angle = min(seconds, 2.0) / 2.0 * np.pi / 2
    bent = part.bend(seconds)
    np.testing.assert_allclose(bent.vertices, upright(bent_bar(angle)), atol=SINGLE)
    np.testing.assert_array_equal(bent.faces, part.mesh.faces)
    np.testing.assert_allclose(bent.normals, np.tile([0.0, -1.0, 0.0], (6, 1)), atol=SINGLE)
    np.testing.assert_allclose(moving.rest.vertices, upright(bent_bar(0.0)), atol=SINGLE)
    assert moving.duration == 2.0
    assert moving.rest.notes == ()


@pytest.mark.parametrize("seconds", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("scale", [[1, 1, 1], [2, 2, 2], [-1, 1, 1]], ids=str)
def test_a_cube_takes_the_shape_of_its_targets(tmp_path: pathlib.Path, seconds: float, scale: list[float]) -> None:
    made = cube(translation=[0, 0, 4], scale=scale)
    (part,) = load_moving_mesh(made.save(tmp_path / "a.glb"), "go").parts
    assert part.bend is not None
    bent = part.bend(seconds)
    expected = upright(morphed_cube(seconds / 2.0) * scale + [0, 0, 4])[CUBE_FACES.reshape(-1, 3)]
    expected = expected if np.prod(scale) > 0 else expected[:, ::-1]
    np.testing.assert_allclose(corners(bent), expected, atol=4 * SINGLE)
    # Without normals of its own each face is flat, whatever the weights are.
    sides = np.cross(expected[:, 1] - expected[:, 0], expected[:, 2] - expected[:, 0])
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    np.testing.assert_allclose(bent.normals[bent.faces], np.repeat(sides[:, None], 3, axis=1), atol=4 * SINGLE)


def test_targets_and_joints_go_together(tmp_path: pathlib.Path) -> None:
    """Targets first, as glTF says, then joints; and what hangs on a moving node keeps its targets there."""
    made = bar()
    primitive = made.tree["meshes"][0]["primitives"][0]
    primitive["targets"] = [{"POSITION": made.array(np.tile(np.float32([0, 0, 1]), (6, 1)))}]
    play(made, 0, "weights", [0.0, 1.0])
    (part,) = load_moving_mesh(made.save(tmp_path / "a.glb"), "go").parts
    assert part.bend is not None
    np.testing.assert_allclose(part.bend(1.0).vertices, upright(bent_bar(np.pi / 4) + 0.5 * TOWARD), atol=SINGLE)
    made = cube()
    play(made, 0, "translation", [[0, 0, 0], [8, 0, 0]])
    moving = load_moving_mesh(made.save(tmp_path / "b.glb"), "go")
    assert [part.anchor for part in moving.parts] == [0]
    place, bend = moving.transforms_at(1.0)[0], moving.parts[0].bend
    assert bend is not None
    found = corners(bend(1.0)) @ place[:3, :3].T + place[:3, 3]
    expected = upright(morphed_cube(0.5) + 4.0 * ACROSS)[CUBE_FACES.reshape(-1, 3)]
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_file_that_is_not_played_stands_as_at_the_start(tmp_path: pathlib.Path) -> None:
    mesh = load_mesh(cube().save(tmp_path / "a.glb"))
    np.testing.assert_allclose(corners(mesh), upright(morphed_cube(0.0))[CUBE_FACES.reshape(-1, 3)], atol=SINGLE)
    assert mesh.notes == ("animations (an object's key play names one)",)


def still(tmp_path: pathlib.Path, vertices: Any, faces: Any, color: Any) -> pathlib.Path:
    """The same triangles in a file that moves nothing."""
    made = Gltf()
    material = made.material(doubleSided=True, pbrMetallicRoughness={"baseColorFactor": [*color, 1]})
    attributes = {"POSITION": made.array(np.float32(vertices))}
    made.node({"attributes": attributes, "indices": made.array(faces), "material": material})
    return made.save(tmp_path / f"still{len(faces)}.glb")


def test_rays_meet_what_is_bent_now(device: str, tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two objects of one file stand at different times; either is hit where its closed form is, one after another."""
    path = bar(normals=False).save(tmp_path / "a.glb")
    items = [
        Object("mesh", file=path, play=Play("go")),
        Object("mesh", file=path, at=(0, 3, 0), play=Play(0, start=-0.5)),
    ]
    at = np.random.default_rng(3).uniform((-1.5, -0.2), (0.5, 2.2), (4000, 2))
    write = HostScene.write_objects
    for seconds in (1.0, 1.5, 0.2):
        for angle, own in ((seconds, 0), (seconds + 0.5, 1)):
            origins = np.stack([at[:, 0], np.full(len(at), 3.0 * own - 2.0), at[:, 1]], axis=-1)
            vertices = bent_bar(angle % 2.0 * np.pi / 4)
            one = Object("mesh", file=still(tmp_path, vertices, BAR_FACES, (0.7, 0.2, 0.1)), at=items[own].at)
            monkeypatch.setattr(HostScene, "write_objects", lambda self, out, _, s=seconds: write(self, out, s))
            found = look(items, origins, (0.0, 1.0, 0.0), device)
            monkeypatch.undo()
            expected = look([one], origins, (0.0, 1.0, 0.0), device)
            near = found["t"] < 2.5
            assert 0.05 < near.mean() < 0.6
            assert (near != (expected["t"] < 2.5)).mean() < 2e-3  # rays that graze an edge
            both = near & (expected["t"] < 2.5)
            for name in ("t", "normal", "diffuse"):
                np.testing.assert_allclose(found[name][both], expected[name][both], atol=2e-5)


def test_a_frame_at_the_same_time_bends_nothing(device: str, tmp_path: pathlib.Path) -> None:
    item = Object("mesh", file=bar().save(tmp_path / "a.glb"), play=Play("go", loop=False))
    host = HostScene(Scene(Camera(64, 48, 60, 60, 32, 24), objects=(item,)), wp.get_device(device))
    records = np.zeros(1, np.dtype(Shape.numpy_dtype()))
    assert host.write_objects(records, 0.0)
    assert [host.write_objects(records, seconds) for seconds in (0.0, 0.5, 0.5, 3.0, 9.0)] == [
        False,
        True,
        False,
        True,
        False,
    ]
    assert records["extent"][0] == pytest.approx([1.0, 0.0, 1.0], abs=1e-5)  # about the middle that it had at rest


def test_pictures_follow_the_bending(device: str, tmp_path: pathlib.Path) -> None:
    """Frame after frame a pipeline shows what one of a still file with the closed form's vertices shows."""
    pose = look_at((0.0, -0.5, 0.3))
    moved = Object("mesh", file=bar(normals=False).save(tmp_path / "a.glb"), scale=0.08, play=Play("go"))
    outputs: Any = {"device": device, "quality": "paper", "outputs": ("image", "depth"), "culling": True}
    with Pipeline(make_scene(objects=(moved,)), **outputs) as pipeline:
        results = []
        for seconds in (0.0, 0.8, 1.6):
            result = pipeline(make_frame(), time_seconds=seconds, pose=pose)
            results.append((result.image.copy(), result.layers["depth"].copy()))
    assert (results[0][1] != results[2][1]).mean() > 0.01
    for seconds, (image, depth) in zip((0.0, 0.8, 1.6), results, strict=True):
        file = still(tmp_path, bent_bar(seconds * np.pi / 4), BAR_FACES, (0.7, 0.2, 0.1))
        one = Object("mesh", file=file, scale=0.08)
        with Pipeline(make_scene(objects=(one,)), **outputs) as pipeline:
            expected = pipeline(make_frame(), time_seconds=seconds, pose=pose)
            far = [np.where(np.isfinite(one), one, 1e3) for one in (expected.layers["depth"], depth)]
            assert (np.abs(far[0] - far[1]) < 1e-4).mean() > 0.998
            assert (np.abs(expected.image.astype(int) - image).max(axis=-1) <= 1).mean() > 0.99
