"""Blender as a client: what it makes of the light of a USD. WARP_AR_BLENDER names an interpreter with ``bpy``."""

from __future__ import annotations

import dataclasses
import os
import pathlib
import subprocess

import numpy as np
import pytest

from warp_ar.light.captured import latlong_directions, texel_solid_angles
from warp_ar.output.environment_file import write_environment
from warp_ar.output.shot import Shot
from warp_ar.output.usd_file import write_usd
from warp_ar.scene import Pose, load_scene

BLENDER = os.environ.get("WARP_AR_BLENDER", "")
LIGHT = 0.02  # relative: noise of 512 paths a pixel is 1 % and averaged, the ball's facets are 0.1 %
SCALE = 2.2  # of the camera: metres across


@pytest.mark.skipif(not BLENDER, reason="needs Blender: name an interpreter with bpy in WARP_AR_BLENDER")
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
    done = subprocess.run(command, capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, done.stderr
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
