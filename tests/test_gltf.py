"""glTF files: what is in the file is in the mesh; what is not shown is named; damage is one clear line."""

from __future__ import annotations

import logging
import pathlib
from typing import Any

import numpy as np
import pytest

from tests.gltf_files import SQUARE, SQUARE_UVS, Gltf
from warp_ar.errors import SceneError
from warp_ar.scene import MetallicRoughnessMaterial, Object, Play
from warp_ar.scene.mesh_files import load_mesh
from warp_ar.scene.object_materials import materials_of

SINGLE = 1e-6  # float32 positions near 1
PICTURE = np.arange(2 * 3 * 4).reshape(2, 3, 4)


def test_y_is_up_and_pictures_stand_upright(tmp_path: pathlib.Path) -> None:
    made = Gltf()
    made.node(made.square())
    mesh = load_mesh(made.save(tmp_path / "a.glb"))
    corner = np.argmin(np.abs(mesh.vertices - [-1, 0, 1]).sum(axis=1))  # the file's (-1, 1, 0): top left
    assert mesh.uvs is not None
    np.testing.assert_allclose(mesh.vertices[corner], [-1, 0, 1], atol=SINGLE)
    np.testing.assert_allclose(mesh.uvs[corner], [0, 1], atol=SINGLE)
    np.testing.assert_allclose(mesh.normals[corner], [0, -1, 0], atol=SINGLE)  # +Z of the file looks at the reader


def test_every_factor_and_texture_arrives(tmp_path: pathlib.Path) -> None:
    made = Gltf()
    textures = [{"index": made.texture(PICTURE + 20 * k), "texCoord": k % 2} for k in range(5)]
    made.material(
        name="all",
        pbrMetallicRoughness={
            "baseColorFactor": [0.1, 0.2, 0.3, 0.4],
            "metallicFactor": 0.5,
            "roughnessFactor": 0.6,
            "baseColorTexture": textures[0],
            "metallicRoughnessTexture": textures[1],
        },
        normalTexture={**textures[2], "scale": 0.7},
        occlusionTexture={**textures[3], "strength": 0.8},
        emissiveTexture=textures[4],
        emissiveFactor=[0.5, 0.25, 0.125],
        alphaMode="MASK",
        alphaCutoff=0.3,
        doubleSided=True,
        extensions={"KHR_materials_emissive_strength": {"emissiveStrength": 4.0}},
    )
    made.node(made.square(0, TEXCOORD_1=made.array(0.5 * SQUARE_UVS)))
    mesh = load_mesh(made.save(tmp_path / "a.glb"))
    (material,) = mesh.materials
    assert material.surface == MetallicRoughnessMaterial((0.1, 0.2, 0.3), 0.5, 0.6)
    assert (material.name, material.alpha, material.opacity, material.cutoff) == ("all", "mask", 0.4, 0.3)
    assert (material.double_sided, material.unlit, material.emission) == (True, False, (2.0, 1.0, 0.5))
    assert (material.normal_scale, material.occlusion_strength) == (0.7, 0.8)
    uses = (material.base, material.metallic_roughness, material.normal, material.occlusion, material.emissive)
    for k, use in enumerate(uses):
        assert use is not None
        assert use.uv_set == k % 2
        np.testing.assert_array_equal(mesh.images[use.image], PICTURE + 20 * k)
    assert mesh.tangents is not None
    np.testing.assert_allclose(mesh.tangents, np.tile([1, 0, 0, 1], (6, 1)), atol=SINGLE)
    green, blue = (PICTURE + 20)[..., 1], (PICTURE + 20)[..., 2]
    np.testing.assert_allclose(material.roughness_span, (green.min() / 255, green.max() / 255))
    np.testing.assert_allclose(material.metallic_span, (blue.min() / 255, blue.max() / 255))
    assert mesh.notes == ()


def test_samplers_and_transforms(tmp_path: pathlib.Path) -> None:
    """KHR_texture_transform: the file's own (u, v) of a corner, moved as the extension says, is where ours is read."""
    made = Gltf()
    transform = {"offset": [0.1, 0.2], "rotation": 0.3, "scale": [2.0, 3.0]}
    texture = made.texture(PICTURE, {"wrapS": 33071, "wrapT": 33648, "magFilter": 9728})
    made.material(
        pbrMetallicRoughness={
            "baseColorTexture": {"index": texture, "extensions": {"KHR_texture_transform": transform}}
        }
    )
    made.node(made.square(0))
    use = load_mesh(made.save(tmp_path / "a.glb")).materials[0].base
    assert use is not None
    assert (use.wrap, use.nearest) == (("clamp", "mirror"), True)
    u, v = 0.25, 0.75
    cos, sin = np.cos(0.3), np.sin(0.3)
    # T R S of the extension's own text, v down.
    expected = np.array([0.1, 0.2]) + np.array([[cos, sin], [-sin, cos]]) @ (np.array([2.0, 3.0]) * [u, v])
    ours = np.array(use.transform).reshape(2, 3) @ [u, 1.0 - v, 1.0]
    np.testing.assert_allclose(ours, [expected[0], 1.0 - expected[1]], atol=1e-12)


def test_primitives_keep_their_materials_and_colours(tmp_path: pathlib.Path) -> None:
    made = Gltf()
    red, unlit = made.material(emissiveFactor=[1, 0, 0]), made.material(extensions={"KHR_materials_unlit": {}})
    colors = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [51, 51, 51]], np.uint8)
    colored = made.square(unlit, COLOR_0=made.array(colors, normalized=True))
    made.node(made.square(red), colored, translation=[0, 5, 0])
    mesh = load_mesh(made.save(tmp_path / "a.glb"))
    assert mesh.triangle_materials is not None
    assert mesh.triangle_materials.tolist() == [0, 0, 1, 1]
    assert [material.unlit for material in mesh.materials] == [False, True]
    assert mesh.colors is not None
    corners = mesh.colors[mesh.faces]
    np.testing.assert_allclose(corners[:2], 1.0)  # colours are linear factors; a part without has white
    np.testing.assert_allclose(corners[2], [[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1]], atol=SINGLE)
    np.testing.assert_allclose(mesh.bounds, [[-1, 0, 4], [1, 0, 6]], atol=SINGLE)


def test_quantized_sparse_and_strips(tmp_path: pathlib.Path) -> None:
    made = Gltf()
    made.tree["extensionsUsed"] = made.tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    places = made.array((SQUARE * 127).astype(np.int8), normalized=True)
    made.node({"attributes": {"POSITION": places}, "indices": made.array(np.uint8([0, 1, 3, 2])), "mode": 5})
    base = made.array(SQUARE)
    moved, where = made.array(np.float32([[9, 9, 9]])), made.array(np.uint16([2]))
    views = [made.tree["accessors"][k]["bufferView"] for k in (where, moved)]
    made.tree["accessors"][base]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": views[0], "componentType": 5123},
        "values": {"bufferView": views[1]},
    }
    made.node({"attributes": {"POSITION": base}, "indices": made.array(np.uint32([0, 1, 2, 3])), "mode": 6})
    mesh = load_mesh(made.save(tmp_path / "a.glb"))
    assert len(mesh.faces) == 4
    corners = mesh.vertices[mesh.faces]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (facing[:2, 1] < 0).all()  # both triangles of the strip are wound alike
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [9, 0, 9], atol=SINGLE)
    np.testing.assert_allclose(np.abs(corners[:2, :, [0, 2]]), 1.0, atol=SINGLE)


def test_nodes_and_skins(tmp_path: pathlib.Path) -> None:
    """A child turns with its parent; a skinned mesh stands where its joints are."""
    made = Gltf()
    half = float(np.sqrt(0.5))
    made.node(made.square(), translation=[3, 0, 0])
    made.tree["nodes"].append({"children": [0], "rotation": [0, 0, half, half]})  # 90 degrees about z: x goes to y
    weights = np.tile(np.float32([2, 0, 0, 0]), (4, 1))
    inverse = np.eye(4, dtype=np.float32)
    inverse[0, 3] = 5.0
    skinned = made.square(JOINTS_0=made.array(np.zeros((4, 4), np.uint8)), WEIGHTS_0=made.array(weights))
    made.node(skinned, skin=0, translation=[99, 0, 0])
    made.tree["nodes"].append({"translation": [0, 0, 7]})
    made.tree["skins"] = [{"joints": [3], "inverseBindMatrices": made.array(inverse.T.reshape(1, 16))}]
    mesh = load_mesh(made.save(tmp_path / "a.glb"))
    first, second = mesh.vertices[mesh.faces[:2].ravel()], mesh.vertices[mesh.faces[2:].ravel()]
    np.testing.assert_allclose(first.mean(axis=0), first.mean(axis=0) * [0, 0, 1], atol=1.1)
    np.testing.assert_allclose([first.min(axis=0), first.max(axis=0)], [[-1, 0, 2], [1, 0, 4]], atol=SINGLE)
    np.testing.assert_allclose([second.min(axis=0), second.max(axis=0)], [[4, -7, -1], [6, -7, 1]], atol=SINGLE)


@pytest.mark.parametrize("play", [None, Play(0)])
def test_skins_and_morph_targets_that_move_are_no_loss(
    tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture, play: Play | None
) -> None:
    """That nothing plays them is said once, however many nodes have them; what is played lacks nothing."""
    made = Gltf()
    ones, joints = np.tile(np.float32([1, 0, 0, 0]), (4, 1)), np.zeros((4, 4), np.uint8)
    for _ in range(2):
        primitive = made.square(JOINTS_0=made.array(joints), WEIGHTS_0=made.array(ones))
        primitive["targets"] = [{"POSITION": made.array(SQUARE)}]
        made.node(primitive, skin=0)
    made.tree["nodes"].append({"translation": [0, 0, 7]})
    made.tree["skins"] = [{"joints": [2]}]
    times = made.array(np.float32([0.0, 1.0]), min=[0.0], max=[1.0])
    samplers = [
        {"input": times, "output": made.array(values)} for values in (np.zeros((2, 3), "f4"), np.zeros(2, "f4"))
    ]
    channels = [{"sampler": 0, "target": {"node": 2, "path": "translation"}}]
    channels += [{"sampler": 1, "target": {"node": k, "path": "weights"}} for k in range(2)]
    made.tree["animations"] = [{"samplers": samplers, "channels": channels}]
    path = made.save(tmp_path / "a.glb")
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            materials_of(Object("mesh", file=path, play=play))
    expected = [f"{path}: not shown: animations (an object's key play names one)"] if play is None else []
    assert [record.getMessage() for record in caplog.records] == expected


def test_a_material_is_its_files_unless_the_scene_says_one(tmp_path: pathlib.Path) -> None:
    made = Gltf()
    made.material(pbrMetallicRoughness={"baseColorTexture": {"index": made.texture(PICTURE)}}, emissiveFactor=[1, 1, 1])
    made.node(made.square(0))
    path = made.save(tmp_path / "a.glb")
    own, given = materials_of(Object("mesh", file=path)), materials_of(Object("mesh", file=path, material=GOLD))
    assert (own.detailed, own.holed) == (True, True)  # a sheet without a back
    assert own.materials[0].emission == (1.0, 1.0, 1.0)
    assert given.materials[0].surface == GOLD
    assert given.materials[0].base is not None
    assert given.materials[0].emission == (0.0, 0.0, 0.0)
    assert not given.holed


GOLD = MetallicRoughnessMaterial((1.0, 0.77, 0.34), 1.0, 0.25)


def broken(change: Any) -> Gltf:
    made = Gltf()
    made.material(pbrMetallicRoughness={"baseColorTexture": {"index": made.texture(PICTURE)}})
    made.node(made.square(0))
    change(made.tree)
    return made


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t["nodes"].append({"children": [1]}) or t.update(scenes=[{"nodes": [1]}]), "reached twice"),
        (lambda t: t["nodes"][0].update(children=[-1]), "child of node 0 is -1"),
        (lambda t: t["nodes"][0].update(rotation=[0, 0, 0, 0]), "rotation without length"),
        (lambda t: t["nodes"][0].update(matrix=[1] * 15), "matrix .* 16 numbers is right"),
        (lambda t: t["nodes"][0].update(translation=[1e300, 0, 0]), "node 0 has a transform that is not finite"),
        (lambda t: t.update(scene=3, scenes=[{}]), "the scene is 3; there are 1"),
        (lambda t: t["meshes"][0]["primitives"][0].update(material=9), "names material 9; there are 1"),
        (lambda t: t["meshes"][0]["primitives"][0]["attributes"].update(POSITION=1), "of 2 numbers each; 3 are right"),
        (lambda t: t["accessors"][0].update(count=10**6), "needs .* bytes; its view has"),
        (lambda t: t["bufferViews"][1].update(byteLength=10**9), "of a buffer of 172"),
        (lambda t: t["bufferViews"][1].pop("buffer"), "buffer view 1 lies in buffer None; there are 1"),
        (lambda t: t["bufferViews"][1].update(byteStride=1), "elements of 12 bytes, one every 1"),
        (lambda t: t["materials"][0].update(alphaMode="SHINE"), "alphaMode 'SHINE'"),
        (lambda t: t["materials"][0].update(emissiveFactor=[1, 2]), "emissiveFactor .* 3 numbers"),
        (lambda t: t.update(extensionsUsed=7), "is no list"),
    ],
)
def test_damage_is_one_clear_line(tmp_path: pathlib.Path, change: Any, message: str) -> None:
    path = broken(change).save(tmp_path / "a.glb")
    with pytest.raises(SceneError, match=message) as caught:
        load_mesh(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert len(str(caught.value).splitlines()) == 1


def test_many_copies_of_a_mesh_are_counted(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Gltf()
    made.node(made.square())
    made.tree["nodes"] *= 600
    path = made.save(tmp_path / "a.glb")
    assert len(load_mesh(path).faces) == 1200
    monkeypatch.setenv("WARP_AR_MAX_MESH_ELEMENTS", "1000")
    with pytest.raises(SceneError, match=r"1,00\d vertices or faces; at most 1,000"):
        load_mesh(path)
