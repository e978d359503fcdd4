"""Blender as a client: what it makes of our USD and OpenEXR, and of Alembic.

WARP_AR_BLENDER names an interpreter with ``bpy``.
"""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib
import re
import subprocess

import cv2
import numpy as np
import pytest

from tests.layer_rig import make_scene
from warp_ar.light.captured import latlong_directions, texel_solid_angles
from warp_ar.output.environment_file import write_environment
from warp_ar.output.layer_file import LayerFrame, LayerSink
from warp_ar.output.shot import Shot
from warp_ar.output.usd_file import write_usd
from warp_ar.scene import Camera, Pose, load_scene
from warp_ar.scene.pose_file import load_pose_file

BLENDER = os.environ.get("WARP_AR_BLENDER", "")
LIGHT = 0.02  # relative: noise of 512 paths a pixel is 1 % and averaged, the ball's facets are 0.1 %
SCALE = 2.2  # of the camera: metres across


PIXELS = 0.5  # of a picture that Blender renders: a sphere of three pixels, by its light's middle
POSE = 2e-6  # Alembic and USD keep placements of Blender's float32
FORMATS = pathlib.Path(__file__).parents[1] / "docs" / "formats.md"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not BLENDER, reason="needs Blender: name an interpreter with bpy in WARP_AR_BLENDER"),
]


def run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, done.stderr


def test_a_grey_ball_in_a_dome_light(tmp_path: pathlib.Path) -> None:
    directions = latlong_directions(64)
    radiance = np.full((64, 128, 3), 0.15)
    for toward, color in (((0.6, 0.5, 0.6), (4.0, 2.0, 1.0)), ((0.3, -0.9, 0.2), (0.5, 1.0, 3.0))):
        axis = np.array(toward) / np.linalg.norm(toward)
        radiance += np.exp(10.0 * (directions @ axis - 1.0))[..., None] * np.array(color)
    write_environment(tmp_path / "shot_environment.exr", radiance.astype(np.float32), axes="y-up")
    shot = Shot(dataclasses.replace(load_scene("desk"), lights=()), 30.0, (Pose(np.eye(3), np.array([0.0, 0.0, 1.0])),))
    shot = Shot(shot.scene, shot.fps, shot.poses, environment=tmp_path / "shot_environment.exr")
    write_usd(tmp_path / "shot.usda", shot)
    script = pathlib.Path(__file__).with_name("blender_ball.py")
    command = [BLENDER, str(script), str(tmp_path / "shot.usda"), str(tmp_path / "ball")]
    run(command)
    with np.load(tmp_path / "ball.npz") as said:
        seen, albedo = said["pixels"].astype(float), float(said["albedo"])

    size = len(seen)
    at = (np.arange(size) + 0.5) / size * SCALE - 0.5 * SCALE
    y, z = np.meshgrid(at, -at)
    inside = y * y + z * z < 0.8**2
    normals = np.stack([np.sqrt(np.maximum(1.0 - y * y - z * z, 0.0)), y, z], -1)[inside]
    area = np.broadcast_to(texel_solid_angles(64), (64, 128)).reshape(-1)
    cos_theta = np.clip(normals @ directions.reshape(-1, 3).T, 0.0, None)
    expected = albedo / np.pi * (cos_theta * area) @ radiance.reshape(-1, 3)
    ratio = seen[inside] / expected
    print("Blender over closed form, mean by channel", ratio.mean(0), "spread", ratio.std(0))
    np.testing.assert_allclose(ratio.mean(0), 1.0, atol=LIGHT)
    # By place: the mean of a quarter of the ball each, so that no turn of the light could hide.
    for above in (z[inside] > 0.0, z[inside] <= 0.0):
        for right in (y[inside] > 0.0, y[inside] <= 0.0):
            np.testing.assert_allclose(ratio[above & right].mean(0), 1.0, atol=LIGHT)


def test_corners_of_proxies_are_rendered_where_the_plate_shows_them(tmp_path: pathlib.Path) -> None:
    camera = Camera(320, 240, 350.0, 350.0, 146.0, 131.0)
    scene = make_scene(camera=camera, lights=())
    turn = cv2.Rodrigues(np.array([2.4, 0.3, 0.2]))[0]
    pose = Pose(turn, np.array([0.02, -0.03, 0.5]))
    write_usd(tmp_path / "shot.usda", Shot(scene, 24.0, (pose,)))
    box = next(proxy for proxy in scene.proxies if proxy.shape == "box")
    half = 0.5 * np.array(box.size)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half + np.array(box.at)
    angles, _ = cv2.Rodrigues(pose.rotation)
    expected = cv2.projectPoints(corners, angles, pose.translation, camera.matrix(), None)[0][:, 0]
    size = np.array([camera.width, camera.height])
    assert ((expected > 5) & (expected < size - 5)).all()
    np.savez(tmp_path / "corners.npz", points=corners, size=size, expected=expected)
    plate = np.full((24, 32, 3), 0.25, np.float32)
    with LayerSink(tmp_path / "layers") as sink:
        sink.write(LayerFrame({"plate": plate}, np.zeros((24, 32, 3), np.uint8), ()))
    next((tmp_path / "layers").iterdir()).rename(tmp_path / "frame.exr")
    run([BLENDER, str(pathlib.Path(__file__).with_name("blender_shot.py")), str(tmp_path)])
    with np.load(tmp_path / "seen.npz") as seen:
        off = np.linalg.norm(seen["pixels"] - expected, axis=1)
        print("corners off by", off.round(3), "pixels; layers are", seen["kind"], seen["size"])
        assert off.max() < PIXELS
        assert tuple(seen["size"]) == (32, 24) or str(seen["kind"]) == "MULTILAYER"


PICTURES = """
import bpy, json, sys
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.world = bpy.data.worlds.new("world")
bpy.ops.wm.usd_import(filepath=sys.argv[1])
told = {}
for item in bpy.data.objects:
    for number, slot in enumerate(item.material_slots):
        nodes, links = slot.material.node_tree.nodes, slot.material.node_tree.links
        read = {}
        for link in links:
            if link.to_node.type == "BSDF_PRINCIPLED":
                node = link.from_node
                while node.type != "TEX_IMAGE" and any(entry.is_linked for entry in node.inputs):
                    near = [entry for entry in node.inputs if entry.is_linked]
                    node = max(near, key=lambda entry: entry.links[0].from_node.type == "TEX_IMAGE").links[0].from_node
                read[link.to_socket.name] = node.image.name if node.type == "TEX_IMAGE" else node.type
        polygons = sum(polygon.material_index == number for polygon in item.data.polygons)
        told[slot.material.name] = [polygons, read]
print("TOLD" + json.dumps(told))
"""


def test_a_model_s_materials_arrive_with_their_pictures(tmp_path: pathlib.Path) -> None:
    scene = load_scene("product")
    write_usd(tmp_path / "shot.usda", Shot(scene, 24.0, (Pose(np.eye(3), np.array([0.0, 0.0, 1.0])),)))
    done = subprocess.run([BLENDER, "-c", PICTURES, str(tmp_path / "shot.usda")], capture_output=True, text=True)
    told = json.loads(next(line for line in done.stdout.splitlines() if line.startswith("TOLD"))[4:])
    polygons, read = told["object_0_jar"]
    assert polygons == 576
    assert {name: read[name] for name in ("Base Color", "Roughness", "Metallic", "Normal")} == {
        "Base Color": "shot_object_0_jar.png",
        "Roughness": "shot_object_0_jar_metallic_roughness.png",
        "Metallic": "shot_object_0_jar_metallic_roughness.png",
        "Normal": "shot_object_0_jar_normal.png",
    }
    polygons, read = told["object_0_jar_1"]
    assert (polygons, read["Normal"]) == (448, "shot_object_0_jar_1_normal.png")


def test_a_camera_in_alembic_becomes_usd_by_the_lines_of_the_docs(tmp_path: pathlib.Path) -> None:
    rows = []
    write = [
        "import bpy, sys",
        "bpy.ops.wm.read_factory_settings(use_empty=True)",
        "camera = bpy.data.objects.new('c', bpy.data.cameras.new('c'))",
        "bpy.context.scene.collection.objects.link(camera)",
        "bpy.context.scene.render.fps = 25",
    ]
    for k in range(1, 5):
        place, turn = (0.1 * k, 0.2, 0.5 + 0.01 * k), (0.3 + 0.02 * k, 0.1, 0.2 * k)
        rows.append((place, turn))
        write += [f"camera.location, camera.rotation_euler = {place}, {turn}"]
        write += [f"camera.keyframe_insert({name!r}, frame={k})" for name in ("location", "rotation_euler")]
    write.append("bpy.ops.wm.alembic_export(filepath=sys.argv[1], start=1, end=4)")
    run([BLENDER, "-c", "\n".join(write), str(tmp_path / "a.abc")])
    lines = re.search(r"```python\n(# usd_of_alembic\.py.*?)```", FORMATS.read_text(), re.DOTALL)
    assert lines is not None
    run([BLENDER, "-c", lines[1], str(tmp_path / "a.abc"), str(tmp_path / "a.usda"), "25"])
    poses = load_pose_file(tmp_path / "a.usda").poses
    assert len(poses) == len(rows)
    for (rotation, translation), (place, (x, y, z)) in zip(poses, rows, strict=True):
        about = [cv2.Rodrigues(np.array(axis))[0] for axis in ((x, 0.0, 0.0), (0.0, y, 0.0), (0.0, 0.0, z))]
        axes = about[2] @ about[1] @ about[0] @ np.diag([1.0, -1.0, -1.0])
        np.testing.assert_allclose(np.reshape(rotation, (3, 3)), axes.T, atol=POSE)
        np.testing.assert_allclose(translation, -axes.T @ np.array(place), atol=POSE)
