"""The command that writes shots: its files, and one line for what cannot be."""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib
import struct

import cv2
import numpy as np
import pytest
import trimesh

from tests.gltf_files import Gltf
from tests.layer_rig import POSES, make_scene
from tests.test_live import message, write_scene
from warp_ar import export
from warp_ar.output.environment_file import read_environment
from warp_ar.output.gltf_file import write_glb
from warp_ar.output.shot import Shot, mesh_of, texture_files, used_materials
from warp_ar.output.usd_file import write_usd
from warp_ar.scene import Camera, Light, Object
from warp_ar.scene.description import Animation
from warp_ar.scene.geometry import placement
from warp_ar.scene.materials import EmissiveMaterial, PhongMaterial
from warp_ar.scene.mesh_files import load_mesh

pytestmark = pytest.mark.slow


def run(*arguments: object) -> int:
    return export.main([str(argument) for argument in ("--device", "cpu", *arguments)])


@pytest.fixture
def clip(tmp_path: pathlib.Path) -> pathlib.Path:
    """A scene whose frames lie in a folder."""
    import cv2

    from warp_ar.sources.synthetic import Synthetic

    frames = tmp_path / "frames"
    frames.mkdir()
    with Synthetic("card") as card:
        for index, frame in zip(range(3), card, strict=False):
            cv2.imwrite(str(frames / f"{index:04d}.png"), frame.image[..., ::-1])
    return write_scene(tmp_path, source='path = "frames"\nfps = 25.0')


def test_a_shot_is_written_with_its_light(clip: pathlib.Path, tmp_path: pathlib.Path, capsys) -> None:
    out = tmp_path / "out"
    assert run(clip, "--output", out / "shot.glb", "--stmaps") == 0
    assert sorted(path.name for path in out.iterdir()) == [
        "shot.glb",
        "shot_distort.exr",
        "shot_environment.exr",
        "shot_undistort.exr",
    ]
    assert capsys.readouterr().out.splitlines()[0] == "3 frames"
    assert np.isfinite(read_environment(out / "shot_environment.exr")).all()
    data = (out / "shot.glb").read_bytes()
    tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    assert tree["asset"]["extras"] == {"plate": "../frames", "fps": 25.0, "environment": "shot_environment.exr"}
    # A second time its own files are replaced.
    assert run(clip, "--output", out / "shot.glb") == 0
    assert "is replaced: this program wrote it before" in capsys.readouterr().err


def test_every_balls_light_is_written(clip: pathlib.Path, tmp_path: pathlib.Path, capsys) -> None:
    """In files of their own, which say where the ball stands; a program that knows one light takes the first."""
    more = "\n[[probe]]\ncenter = [0.1, 0.03, 0.03]\nradius = 0.03\n"
    clip.write_text(clip.read_text().replace("[probe]", "[[probe]]") + more)
    assert run(clip, "--output", tmp_path / "shot.glb", "--frames", 1) == 0
    printed = capsys.readouterr().out.splitlines()
    maps = [tmp_path / f"shot_{name}.exr" for name in ("environment", "environment_1")]
    assert [str(path) for path in maps] == [line for line in printed if line.endswith(".exr")]
    first, second = map(read_environment, maps)
    assert np.abs(first - second).max() > 0.0
    data = (tmp_path / "shot.glb").read_bytes()
    extras = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])["asset"]["extras"]
    assert extras["environment"] == "shot_environment.exr"
    assert extras["other_environments"] == [{"file": "shot_environment_1.exr", "at": [0.1, 0.03, 0.03]}]
    usd = pytest.importorskip("pxr.Usd", reason="needs usd-core, of the extra exchange")
    assert run(clip, "--output", tmp_path / "shot.usda", "--frames", 1) == 0
    stage = usd.Stage.Open(str(tmp_path / "shot.usda"))
    other = stage.GetPrimAtPath("/shot/lights/environment_1")
    assert stage.GetPrimAtPath("/shot/lights/environment").IsActive()
    assert not other.IsActive()
    assert tuple(other.GetCustomDataByKey("at")) == (0.1, 0.03, 0.03)
    # With one ball less nothing of the other's light stays; what is somebody else's does.
    theirs = tmp_path / "shot_environment_7.exr"
    theirs.write_bytes(b"somebody's")
    clip.write_text(clip.read_text().replace(more, ""))
    capsys.readouterr()
    assert run(clip, "--output", tmp_path / "shot.glb", "--frames", 1) == 0
    assert "shot_environment_1.exr: removed; an earlier export" in capsys.readouterr().err
    assert maps[0].exists()
    assert not maps[1].exists()
    assert theirs.exists()


def test_frames_without_a_marker_have_no_way(clip: pathlib.Path, tmp_path: pathlib.Path, capsys) -> None:
    import cv2

    for path in (tmp_path / "frames").iterdir():
        cv2.imwrite(str(path), np.full((480, 640, 3), 128, np.uint8))
    assert run(clip, "--output", tmp_path / "shot.glb", "--no-environment") == 1
    assert "no frame shows the marker" in message(capsys)
    assert not (tmp_path / "shot.glb").exists()


def test_files_of_others_stay(clip: pathlib.Path, tmp_path: pathlib.Path, capsys) -> None:
    (tmp_path / "shot.glb").write_bytes(b"somebody's")
    assert run(clip, "--output", tmp_path / "shot.glb", "--no-environment") == 1
    assert "this program did not write it" in message(capsys)
    assert run(clip, "--output", tmp_path / "shot.glb", "--no-environment", "--overwrite", "--frames", 1) == 0


def test_usd_without_its_library_is_named(clip: pathlib.Path, tmp_path: pathlib.Path, monkeypatch, capsys) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pxr", None)
    assert run(clip, "--output", tmp_path / "shot.usda") == 2
    assert 'USD files need usd-core; install it with pip install "warp-ar[exchange]"' in message(capsys)


def test_every_usd_is_known_again(clip: pathlib.Path, tmp_path: pathlib.Path, capsys) -> None:
    pytest.importorskip("pxr.Usd", reason="needs usd-core, of the extra exchange")
    for name in ("shot.usdc", "shot.usd"):
        for _ in range(2):
            assert run(clip, "--output", tmp_path / name, "--frames", 1, "--no-environment") == 0
        assert f"{name} is replaced: this program wrote it before" in capsys.readouterr().err
    (tmp_path / "other.usdc").write_bytes(b"PXR-USDC and then nothing that it should have")
    assert run(clip, "--output", tmp_path / "other.usdc", "--frames", 1, "--no-environment") == 1
    assert "this program did not write it" in message(capsys)


BOX = """
[[object]]
shape = "box"
size = [0.02, 0.02, 0.02]
material = { model = "lambert", base_color = "%s" }
"""


def test_pictures_of_others_beside_a_usd_stay(tmp_path: pathlib.Path, clip: pathlib.Path, capsys) -> None:
    """A texture goes beside the file: not over somebody's picture, and not over the one that it is made from."""
    import cv2

    pytest.importorskip("pxr.Usd", reason="needs usd-core, of the extra exchange")
    own, written = tmp_path / "wood.png", tmp_path / "shot_object_1_box.png"
    for path in (own, written):
        cv2.imwrite(str(path), np.full((8, 8, 3), 90, np.uint8))
    before, text = written.read_bytes(), clip.read_text()
    options = (clip, "--output", tmp_path / "shot.usda", "--frames", 1, "--no-environment")
    for name, words in (("shot_object_1_box", "is the same as"), ("wood", "this program did not write it")):
        clip.write_text(text + BOX % f"{name}.png")
        assert run(*options) != 0
        assert words in message(capsys)
        assert written.read_bytes() == before
    for more in (("--overwrite",), ()):  # its own the second time
        assert run(*options, *more) == 0
        assert written.read_bytes() != before


# --- A shot as USD and glTF, read back by others' readers: usd-core and trimesh ---------------------------------------


# USD keeps a camera's lens in float32: 1e-7 of a picture of 64 pixels, and frusta of float64.
PIXELS = 1e-4
# glTF keeps places and turns in float32.
GLTF = 1e-6

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float) * (0.05, 0.025, 0.03)


@pytest.fixture(scope="module")
def shot() -> Shot:
    """A camera without distortion whose principal point is off the middle; its second frame is lost."""
    scene = make_scene(
        camera=Camera(64, 48, 70.0, 72.0, 29.0, 27.5),
        lights=(
            Light("point", 0.2, at=(0.1, -0.1, 0.3)),
            Light(
                "spot",
                0.5,
                color=(1.0, 0.5, 2.0),
                at=(0.2, 0.1, 0.3),
                target=(0, 0, 0),
                inner_angle=10.0,
                outer_angle=30.0,
                animate=Animation(sway=(0.1, 0.0, 0.0), period=1.0),
            ),
            Light("directional", 0.3, direction=(0.3, 0.2, -1.0)),
        ),
    )
    return Shot(scene, 24.0, (POSES[0], None, POSES[1]))


def in_picture(camera, pose, points):
    turn, _ = cv2.Rodrigues(pose.rotation)
    return cv2.projectPoints(points, turn, pose.translation, camera.matrix(), None)[0][:, 0]


@pytest.fixture(scope="module")
def stage(shot, tmp_path_factory):
    usd = pytest.importorskip("pxr.Usd", reason="needs usd-core, of the extra exchange")
    path = tmp_path_factory.mktemp("usd") / "shot.usda"
    assert write_usd(path, shot) == [path]
    assert sorted(entry.name for entry in path.parent.iterdir()) == ["shot.usda"]
    return usd.Stage.Open(str(path))


def test_usd_shows_corners_where_the_camera_does(shot, stage):
    """By USD's own frustum: proxies' corners fall onto the plate's pixels."""
    from pxr import Gf, UsdGeom

    camera = shot.camera
    prim = UsdGeom.Camera(stage.GetPrimAtPath("/shot/camera"))
    box = UsdGeom.Mesh(stage.GetPrimAtPath("/shot/proxies/proxy_1_box"))
    points = np.array(box.GetPointsAttr().Get(), float)
    world = np.array(box.ComputeLocalToWorldTransform(0)).T
    placed = points @ world[:3, :3].T + world[:3, 3]
    expected = CORNERS + np.array([0.0, 0.1, 0.03])
    np.testing.assert_allclose(np.unique(np.round(placed, 6), axis=0), np.unique(np.round(expected, 6), axis=0))
    for frame in (0, 2):
        frustum = prim.GetCamera(frame).frustum
        to_clip = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
        seen = np.array([to_clip.Transform(Gf.Vec3d(*point)) for point in placed])
        # Clip coordinates -1..1 span the outer edges of the picture's pixels.
        pixels = np.stack([(seen[:, 0] + 1) / 2 * camera.width, (1 - seen[:, 1]) / 2 * camera.height], -1) - 0.5
        np.testing.assert_allclose(pixels, in_picture(camera, shot.poses[frame], placed), atol=PIXELS)


def test_usd_says_units_times_and_lens(shot, stage):
    from pxr import UsdGeom

    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 2, 24)
    prim = stage.GetPrimAtPath("/shot/camera")
    assert list(prim.GetAttribute("warp_ar:intrinsics").Get()) == [70.0, 72.0, 29.0, 27.5]
    times = UsdGeom.Camera(prim).GetOrderedXformOps()[0].GetTimeSamples()
    assert times == [0.0, 2.0], "a frame without a pose has no sample"


def test_usd_moves_what_is_animated(shot, stage):
    from pxr import UsdGeom

    box = UsdGeom.Xformable(stage.GetPrimAtPath("/shot/objects/object_1_box"))
    for frame in range(3):
        rotation, position = shot.scene.objects[1].pose_at(frame / 24.0)
        found = np.array(box.ComputeLocalToWorldTransform(frame)).T
        np.testing.assert_allclose(found, placement(rotation, position), atol=1e-12)
    still = UsdGeom.Xformable(stage.GetPrimAtPath("/shot/objects/object_0_sphere"))
    assert not still.TransformMightBeTimeVarying()


def test_usd_lights(shot, stage):
    from pxr import UsdLux

    point = UsdLux.SphereLight(stage.GetPrimAtPath("/shot/lights/light_0"))
    # Radiance of a sphere of radius r and power normalised: i / (4 pi r^2); seen face on it has an area of pi r^2.
    radius = point.GetRadiusAttr().Get()
    radiance = point.GetIntensityAttr().Get() / (4 * np.pi * radius**2)
    assert radiance * np.pi * radius**2 == pytest.approx(0.2)
    assert point.GetNormalizeAttr().Get()
    assert point.GetTreatAsPointAttr().Get()
    spot = stage.GetPrimAtPath("/shot/lights/light_1")
    shaping = UsdLux.ShapingAPI(spot)
    assert shaping.GetShapingConeAngleAttr().Get() == 30.0
    assert shaping.GetShapingConeSoftnessAttr().Get() == pytest.approx(2 / 3)
    for frame in (0, 2):
        at, direction = shot.scene.lights[1].pose_at(frame / 24.0)
        matrix = np.array(UsdLux.SphereLight(spot).ComputeLocalToWorldTransform(frame)).T
        np.testing.assert_allclose(matrix[:3, 3], at, atol=1e-12)
        np.testing.assert_allclose(-matrix[:3, 2], direction, atol=1e-12)
        assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1.0)
    sun = UsdLux.DistantLight(stage.GetPrimAtPath("/shot/lights/light_2"))
    assert sun.GetIntensityAttr().Get() == pytest.approx(0.3)


def test_usd_materials_and_dome(shot, tmp_path):
    pytest.importorskip("pxr.Usd", reason="needs usd-core, of the extra exchange")
    from pxr import Usd, UsdLux, UsdShade

    lit = dataclasses.replace(shot, environment=tmp_path / "room.exr", plate=tmp_path / "clip.mp4")
    for suffix in (".usda", ".usdc", ".usd"):
        write_usd(tmp_path / f"shot{suffix}", lit)
        stage = Usd.Stage.Open(str(tmp_path / f"shot{suffix}"))
        bound = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath("/shot/objects/object_1_box"))
        surface = bound.ComputeBoundMaterial()[0].ComputeSurfaceSource()[0]
        assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
        assert surface.GetInput("metallic").Get() == 1.0
        assert surface.GetInput("roughness").Get() == pytest.approx(0.3)
        np.testing.assert_allclose(surface.GetInput("diffuseColor").Get(), (0.9, 0.8, 0.4), rtol=1e-6)
        dome = UsdLux.DomeLight(stage.GetPrimAtPath("/shot/lights/environment"))
        assert dome.GetTextureFileAttr().Get().path == "./room.exr"
        # The file's y, its pole, is the scene's z, and its z the scene's -y.
        matrix = np.array(dome.ComputeLocalToWorldTransform(0)).T[:3, :3]
        np.testing.assert_allclose(matrix @ [0, 1, 0], [0, 0, 1], atol=1e-12)
        np.testing.assert_allclose(matrix @ [0, 0, 1], [0, -1, 0], atol=1e-12)
        assert stage.GetRootLayer().customLayerData["plate"].endswith("clip.mp4")


def glb(path):
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def test_gltf_puts_meshes_where_the_scene_does(shot, tmp_path):
    """By trimesh's reader: every vertex, turned to y up."""
    write_glb(tmp_path / "shot.glb", shot)
    loaded = trimesh.load(tmp_path / "shot.glb")
    scene = shot.scene
    for name, item in (("object_0_sphere", scene.objects[0]), ("object_1_box", scene.objects[1])):
        rotation, position = item.pose_at(0.0)
        expected = mesh_of(item).vertices @ rotation.T + position
        transform, geometry = loaded.graph[name]
        found = trimesh.transform_points(loaded.geometry[geometry].vertices, transform)
        np.testing.assert_allclose(found, expected[:, [0, 2, 1]] * (1, 1, -1), atol=GLTF)
    assert loaded.camera.fov[1] == pytest.approx(np.degrees(2 * np.arctan(24 / 72.0)))


def test_gltf_moves_camera_and_objects(shot, tmp_path):
    write_glb(tmp_path / "shot.glb", shot)
    tree, binary = glb(tmp_path / "shot.glb")
    nodes = {node["name"]: index for index, node in enumerate(tree["nodes"])}

    def values(accessor):
        entry = tree["accessors"][accessor]
        view = tree["bufferViews"][entry["bufferView"]]
        lanes = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[entry["type"]]
        data = np.frombuffer(binary, np.float32, entry["count"] * lanes, view["byteOffset"])
        return data.reshape(entry["count"], lanes)

    animation = tree["animations"][0]
    tracks = {}
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        tracks[channel["target"]["node"], channel["target"]["path"]] = (
            values(sampler["input"])[:, 0],
            values(sampler["output"]),
        )
    times, places = tracks[nodes["camera"], "translation"]
    np.testing.assert_allclose(times, [0.0, 2 / 24], rtol=1e-6)
    expected = [shot.poses[frame].inverse().translation for frame in (0, 2)]
    np.testing.assert_allclose(places, expected, atol=GLTF)
    times, turns = tracks[nodes["object_1_box"], "rotation"]
    for frame, (x, y, z, w) in enumerate(turns.astype(float)):
        turned, _ = cv2.Rodrigues(
            2 * np.arctan2(np.linalg.norm([x, y, z]), w) * np.array([x, y, z]) / np.linalg.norm([x, y, z])
        )
        np.testing.assert_allclose(turned, shot.scene.objects[1].pose_at(frame / 24.0)[0], atol=1e-6)
    lights = tree["extensions"]["KHR_lights_punctual"]["lights"]
    assert [light["type"] for light in lights] == ["point", "spot", "directional"]
    # Radiance of the channels is colour times intensity, the colour within 0..1.
    assert lights[1]["intensity"] == pytest.approx(1.0)
    np.testing.assert_allclose(lights[1]["color"], (0.5, 0.25, 1.0))
    assert lights[1]["spot"]["outerConeAngle"] == pytest.approx(np.radians(30.0))
    assert tree["cameras"][0]["extras"]["intrinsics"] == [70.0, 72.0, 29.0, 27.5]
    for view in tree["bufferViews"]:
        assert view["byteOffset"] % 4 == 0
        assert view["byteOffset"] + view["byteLength"] <= len(binary)


def test_a_phong_lobe_becomes_as_wide_a_one():
    item = Object("sphere", radius=0.1, material=PhongMaterial((0.1, 0.2, 0.3), (0.4, 0.5, 0.6), 30.0))
    (material,), _ = used_materials(item, mesh_of(item))
    assert (material.base_color, material.metallic, material.specular) == ((0.1, 0.2, 0.3), 0.0, (0.4, 0.5, 0.6))
    assert material.roughness == pytest.approx((2 / 32) ** 0.25)
    assert not material.pictures


def test_emission_is_told(tmp_path):
    """What emits keeps its radiance: above 1 too, with its picture, in the file's own material and the scene's."""
    made = Gltf()
    picture = np.random.default_rng(2).integers(0, 256, (4, 4, 3)).astype(np.uint8)
    made.material(
        emissiveFactor=[0.5, 0.25, 1.0],
        emissiveTexture={"index": made.texture(picture)},
        extensions={"KHR_materials_emissive_strength": {"emissiveStrength": 6.0}},
    )
    made.node(made.square(0))
    scene = make_scene(
        objects=(
            Object("mesh", file=made.save(tmp_path / "screen.glb")),
            Object("sphere", radius=0.02, material=EmissiveMaterial((1.0, 0.5, 0.25), 0.5)),
            Object("sphere", radius=0.02),
        ),
        proxies=(),
        lights=(),
    )
    told = Shot(scene, 24.0, (POSES[0],))
    write_glb(tmp_path / "shot.glb", told)
    mesh = load_mesh(tmp_path / "shot.glb")
    first, second, third = mesh.materials
    np.testing.assert_allclose(first.emission, (3.0, 1.5, 6.0), rtol=1e-6)
    assert first.emissive is not None
    np.testing.assert_array_equal(mesh.images[first.emissive.image][..., :3], picture)
    assert (second.emission, second.emissive, third.emission) == ((0.5, 0.25, 0.125), None, (0.0, 0.0, 0.0))

    usd = pytest.importorskip("pxr.Usd", reason="needs usd-core, of the extra exchange")
    from pxr import UsdShade

    path = tmp_path / "usd" / "shot.usda"
    path.parent.mkdir()
    written = write_usd(path, told)
    assert set(written) == {path, *texture_files(scene, path).values()}
    stage = usd.Stage.Open(str(path))

    def value(where, name):
        return tuple(UsdShade.Shader(stage.GetPrimAtPath(f"/shot/materials/{where}")).GetInput(name).Get())

    assert value("object_0_screen/emission", "scale") == (3.0, 1.5, 6.0, 1.0)
    source = UsdShade.Shader(stage.GetPrimAtPath("/shot/materials/object_0_screen/surface")).GetInput("emissiveColor")
    assert source.HasConnectedSource()
    assert value("object_1_sphere/surface", "emissiveColor") == (0.5, 0.25, 0.125)
    assert not UsdShade.Shader(stage.GetPrimAtPath("/shot/materials/object_2_sphere/surface")).GetInput("emissiveColor")
    saved = cv2.imread(str(texture_files(scene, path)["object_0_screen_emission"]))
    np.testing.assert_array_equal(saved[..., ::-1], picture)


COLORS = np.array([[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1], [0.5, 0.25, 1, 1]], np.float32)


def make_detailed(path):
    """A model of three materials: all five pictures, placed and wrapped; alpha by a picture; colours of vertices."""
    made, rng = Gltf(), np.random.default_rng(5)
    pictures = [rng.integers(0, 256, (4, 8, 3)).astype(np.uint8) for _ in range(4)]
    turned = {"extensions": {"KHR_texture_transform": {"offset": [0.2, 0.7], "rotation": 0.6, "scale": [2.0, 3.0]}}}
    sampler = {"wrapS": 33071, "wrapT": 33648, "magFilter": 9728}
    label = {
        "baseColorFactor": [0.9, 0.8, 0.7, 1.0],
        "metallicFactor": 0.75,
        "roughnessFactor": 0.5,
        "baseColorTexture": {"index": made.texture(pictures[0], sampler), **turned},
        "metallicRoughnessTexture": {"index": made.texture(pictures[1])},
    }
    made.material(
        name="label",
        pbrMetallicRoughness=label,
        normalTexture={"index": made.texture(pictures[2]), "scale": 0.5},
        occlusionTexture={"index": made.texture(pictures[3]), "strength": 0.25},
        emissiveFactor=[0.1, 0.2, 0.3],
    )
    leaf = made.texture(rng.integers(0, 256, (4, 4, 4)).astype(np.uint8))
    base = {"baseColorTexture": {"index": leaf}, "baseColorFactor": [1.0, 1.0, 1.0, 0.9]}
    made.material(name="leaf", pbrMetallicRoughness=base, alphaMode="MASK", alphaCutoff=0.3, doubleSided=True)
    made.material(name="paint", pbrMetallicRoughness={"baseColorFactor": [0.5, 1.0, 1.0, 1.0], "metallicFactor": 0.0})
    made.node(made.square(0), made.square(1), made.square(2, COLOR_0=made.array(COLORS)))
    return made.save(path)


def told_of(use, mesh):
    """A picture's codes and how it lies, whatever its number."""
    if use is None:
        return None
    return mesh.images[use.image].tobytes(), use.uv_set, np.round(use.transform, 5).tolist(), use.wrap, use.nearest


def test_all_materials_of_a_file_are_told_in_gltf(tmp_path):
    """What leaves and comes back is what was there: every factor, picture, sampler and place, by triangle."""
    source = make_detailed(tmp_path / "model.glb")
    scene = make_scene(objects=(Object("mesh", file=source),), proxies=(), lights=())
    write_glb(tmp_path / "shot.glb", Shot(scene, 24.0, (POSES[0],)))
    before, after = load_mesh(source), load_mesh(tmp_path / "shot.glb")
    assert len(after.materials) == 3
    for one, other in zip(before.materials, after.materials, strict=True):
        assert other.name == f"object_0_model_{one.name}"
        for field in ("base", "metallic_roughness", "normal", "occlusion", "emissive"):
            assert told_of(getattr(other, field), after) == told_of(getattr(one, field), before), (one.name, field)
        for field in ("surface", "alpha", "opacity", "double_sided", "normal_scale", "occlusion_strength", "emission"):
            assert getattr(other, field) == getattr(one, field), (one.name, field)
    assert after.materials[1].cutoff == 0.3
    assert np.bincount(after.triangle_materials).tolist() == np.bincount(before.triangle_materials).tolist()
    painted = after.faces[after.triangle_materials == 2]
    np.testing.assert_allclose(np.unique(after.colors[painted].reshape(-1, 4), axis=0), np.unique(COLORS, axis=0))
    assert len(after.images) == len(before.images), "equal pictures are held once"


def test_all_materials_of_a_file_are_told_in_usd(tmp_path):
    """Each binds its own triangles; pictures carry channels, scale, bias, wrapping and place."""
    usd = pytest.importorskip("pxr.Usd", reason="needs usd-core, of the extra exchange")
    from pxr import UsdGeom, UsdShade

    source = make_detailed(tmp_path / "model.glb")
    scene = make_scene(objects=(Object("mesh", file=source),), proxies=(), lights=())
    path = tmp_path / "usd" / "shot.usda"
    path.parent.mkdir()
    written = write_usd(path, Shot(scene, 24.0, (POSES[0],)))
    assert set(written) == {path, *texture_files(scene, path).values()}
    assert {file.name for file in written} == set(os.listdir(path.parent))
    stage = usd.Stage.Open(str(path))
    prim = stage.GetPrimAtPath("/shot/objects/object_0_model")
    subsets = UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets()
    assert [len(subset.GetIndicesAttr().Get()) for subset in subsets] == [2, 2, 2]
    assert UsdGeom.Subset.ValidateFamily(UsdGeom.Mesh(prim), "face", "materialBind")[0]

    def surface(number):
        bound = UsdShade.MaterialBindingAPI(subsets[number].GetPrim()).ComputeBoundMaterial()[0]
        found = bound.ComputeSurfaceSource()[0]
        assert found.GetIdAttr().Get() == "UsdPreviewSurface"
        return found

    def read(number, name):
        """The picture behind an input, the channel that is read, and its own inputs."""
        source, channel, _ = surface(number).GetInput(name).GetConnectedSource()
        shader = UsdShade.Shader(source.GetPrim())
        assert shader.GetIdAttr().Get() in ("UsdUVTexture", "UsdPrimvarReader_float3")
        return shader, channel, {entry.GetBaseName(): entry.Get() for entry in shader.GetInputs()}

    texture, channel, told = read(0, "diffuseColor")
    assert (channel, told["sourceColorSpace"], told["wrapS"], told["wrapT"]) == ("rgb", "sRGB", "clamp", "mirror")
    np.testing.assert_allclose(told["scale"], (0.9, 0.8, 0.7, 1.0), rtol=1e-6)
    place = UsdShade.Shader(texture.GetInput("st").GetConnectedSource()[0].GetPrim())
    turn, scale, offset = (place.GetInput(name).Get() for name in ("rotation", "scale", "translation"))
    u, v = np.random.default_rng(1).uniform(-1, 1, (2, 9))
    a, b, c, d, e, f = load_mesh(source).materials[0].base.transform
    sine, cosine = np.sin(np.radians(turn)), np.cos(np.radians(turn))
    # As the specification of UsdTransform2d has it: scaled, turned counter-clockwise, moved.
    x, y = scale[0] * u, scale[1] * v
    np.testing.assert_allclose(cosine * x - sine * y + offset[0], a * u + b * v + c, atol=1e-5)
    np.testing.assert_allclose(sine * x + cosine * y + offset[1], d * u + e * v + f, atol=1e-5)
    for name, channel in (("roughness", "g"), ("metallic", "b")):
        _, found, told = read(0, name)
        assert (found, told["sourceColorSpace"]) == (channel, "raw")
        np.testing.assert_allclose(told["scale"], (1.0, 0.5, 0.75, 1.0))
    _, _, told = read(0, "normal")
    np.testing.assert_allclose([told["scale"], told["bias"]], [(1, 1, 2, 1), (-0.5, -0.5, -1, 0)])
    _, found, told = read(0, "occlusion")
    assert (found, told["scale"][0], told["bias"][0]) == ("r", 0.25, 0.75)
    _, found, told = read(1, "opacity")
    assert found == "a"
    assert told["scale"][3] == pytest.approx(0.9)
    assert surface(1).GetInput("opacityThreshold").Get() == pytest.approx(0.3)
    assert cv2.imread(str(path.parent / told["file"].path), cv2.IMREAD_UNCHANGED).shape == (4, 4, 4)
    reader, _, told = read(2, "diffuseColor")
    assert (reader.GetIdAttr().Get(), told["varname"]) == ("UsdPrimvarReader_float3", "displayColor")
    colors = np.array(UsdGeom.PrimvarsAPI(prim).GetPrimvar("displayColor").Get())
    painted = np.array(UsdGeom.Mesh(prim).GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)[
        subsets[2].GetIndicesAttr().Get()
    ]
    expected = np.unique(COLORS[:, :3] * (0.5, 1.0, 1.0), axis=0)
    np.testing.assert_allclose(np.unique(colors[painted].reshape(-1, 3), axis=0), expected)
