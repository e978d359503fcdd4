"""Shadows of objects that stand on a table under captured light, against a path tracer, and where the light is wrong.

The table has an even reflectance under an open sky, so its picture is one code. Light that is captured too low, by a
guess of the ball's reflectance or by lamps that clip, makes the same table send more than it gets.
"""

import functools

import numpy as np
import pytest

from tests.photo_files import encode_srgb
from tests.rendered_room import look_at
from warp_ar.accuracy.path_tracer import PathTracer
from warp_ar.engine.pipeline import Pipeline
from warp_ar.light.captured import Light, latlong_directions, texel_solid_angles
from warp_ar.scene import (
    Camera,
    CapturedLight,
    LambertMaterial,
    MetallicRoughnessMaterial,
    Object,
    PoseSpec,
    Proxy,
    Scene,
)
from warp_ar.tracking.tracking import given_pose

pytestmark = pytest.mark.slow
W, H = 160, 120
REFLECTANCE, SHOWN, RADIUS = 0.7, 0.3, 0.04
MATERIALS = {"metal": MetallicRoughnessMaterial((0.95,) * 3, 1.0, 0.05), "chalk": LambertMaterial((0.8,) * 3)}
AGREES = 0.1
"""Difference of shadow ratios from the path tracer's."""
RINGS = ((0.0, 0.6), (0.6, 0.9), (0.9, 1.4))
"""Radii from the point of contact between which ratios are averaged; the first is the shadow at the contact."""


def light(level):
    """Camera values of a sky with a bright patch over the table, the sky at a share of its level."""
    d = latlong_directions(64)
    sky = 0.25 + 0.5 * np.maximum(d[..., 2], 0.0) + (d @ np.array([0.5, 0.3, 0.81]) > 0.93)
    received = (np.maximum(d[..., 2], 0.0) * sky * texel_solid_angles(64)).sum()
    sky *= SHOWN * np.pi / REFLECTANCE / received
    radiance = np.where(d[..., 2] > 0.0, level * sky, SHOWN)
    return Light(np.repeat(radiance[..., None], 3, 2).astype(np.float32), np.ones((64, 128), np.float32))


@functools.cache
def world(material, folder, level=1.0):
    """Scene, picture of the table, its points in radii from the contact, and where no ball is seen."""
    camera = Camera(W, H, 200.0, 200.0, (W - 1) / 2, (H - 1) / 2)
    rotation, translation = look_at(np.array([0.0, -0.42, 0.28]), np.array([0.0, 0.0, 0.02]))
    file = folder / f"{level}.exr"
    light(level).save(file)
    # The other one stands far behind the camera, so that kernels of the close surroundings serve both.
    (other,) = MATERIALS.keys() - {material}
    places = {material: (0.0, 0.0, RADIUS), other: (0.0, -1.8, RADIUS)}
    scene = Scene(
        camera=camera,
        name="table",
        proxies=(Proxy("plane", size=(4.0, 4.0)),),
        objects=tuple(Object("sphere", radius=RADIUS, at=places[one], material=MATERIALS[one]) for one in places),
        captured=CapturedLight(file),
        pose=PoseSpec(((tuple(rotation.ravel().tolist()), tuple(translation.tolist())),)),
        has_marker=False,
    )
    x, y = np.meshgrid((np.arange(W) - camera.cx) / camera.fx, (np.arange(H) - camera.cy) / camera.fy)
    rays = np.stack([x, y, np.ones_like(x)], -1) @ rotation
    eye = -rotation.T @ translation
    points = eye - eye[2] / rays[..., 2:] * rays
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    from_ball = eye - (0.0, 0.0, RADIUS)
    beside = (rays @ from_ball) ** 2 - from_ball @ from_ball + (1.05 * RADIUS) ** 2 < 0.0
    picture = np.full((H, W, 3), encode_srgb(SHOWN), np.uint8)
    return scene, picture, np.where(beside, np.hypot(points[..., 0], points[..., 1]) / RADIUS, np.inf)


def rings(ratio, away):
    return np.array([ratio[(away >= low) & (away < high)].mean() for low, high in RINGS])


@functools.cache
def traced(material, folder):
    scene, picture, away = world(material, folder)
    tracer = PathTracer(scene, light(1.0), picture, given_pose(scene.pose, 0), device="cpu")
    tracer.sample(16)
    return rings(tracer.picture().radiance / tracer.frame(), away)


def lit(material, folder, quality, level):
    scene, picture, away = world(material, folder, level)
    with Pipeline(scene, device="cpu", quality=quality, outputs=("image",)) as pipeline:
        pipeline(picture, time_seconds=0.0, pose=given_pose(scene.pose, 0))
        return rings(pipeline.arrays["shadow_ratio"].numpy(), away)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("contact")


@pytest.mark.parametrize("quality", ["low", "high"])
@pytest.mark.parametrize("material", MATERIALS)
def test_shadows_meet_what_throws_them(material, quality, folder):
    assert np.abs(lit(material, folder, quality, 1.0) - traced(material, folder)).max() < AGREES


def test_a_table_too_bright_for_its_light_does_not_glow(folder):
    """Its reflectance would be 1.75: an object beside it must not get more from it than a white table sends."""
    contact, near, far = lit("chalk", folder, "high", 0.4)
    assert contact < near < far < 1.0
    assert contact < 0.85
