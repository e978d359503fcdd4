"""Captured light: its file, how it is turned, and scenes that are lit by it."""

import dataclasses
import json

import numpy as np
import OpenEXR
import pytest

from tests.error_model import check_error
from warp_ar.engine.graph import make_plan
from warp_ar.engine.pipeline import Pipeline
from warp_ar.errors import SceneError
from warp_ar.light.captured import CapturedEmitter, Light, find_emitters, latlong_directions, texel_solid_angles
from warp_ar.light.latlong_axes import DESCRIPTIONS, to_axes, world_from_marker
from warp_ar.scene import dumps_scene, loads_scene
from warp_ar.scene.geometry import rotation_matrix
from warp_ar.signals import REC_709
from warp_ar.stages.quality import PRESETS
from warp_ar.stages.request import Request

pytestmark = pytest.mark.slow

SCENE = """schema = 1
[camera]
width = 96
height = 72
fx = 90.0
fy = 90.0
cx = 47.5
cy = 35.5
transfer = "linear"
[pose]
position = [0.0, -0.5, 0.2]
rotate = [-20.0, 0.0, 0.0]
[[proxy]]
shape = "plane"
size = [2.0, 2.0]
[[object]]
shape = "sphere"
radius = 0.08
at = [0.0, 0.0, 0.08]
[object.material]
model = "lambert"
base_color = [0.5, 0.5, 0.5]
[light]
file = "light.exr"
"""


def constant(value, height=16):
    return Light(np.full((height, 2 * height, 3), value, np.float32), np.ones((height, 2 * height), np.float32))


def smooth(height):
    """A map that changes slowly in every direction."""
    return slope(latlong_directions(height)).astype(np.float32)


def slope(d):
    """Its twin in float64: radiance from directions."""
    return 1.5 + d @ np.array([[0.5, 0.1, 0.0], [0.2, 0.6, 0.1], [0.3, 0.0, 0.7]])


def test_a_light_survives_its_file(tmp_path):
    emitter = CapturedEmitter((0.0, 0.6, 0.8), 0.01, (1.0, 2.0, 3.0), (0.9, 1.9, 2.9), None, 1.5, (0.0, 0.0, 0.1))
    colors = (0.5, 0.25, 0.0, 0.125, 1.0, 0.0, -0.25, 0.0, 0.5)
    light = dataclasses.replace(
        constant(0.5), emitters=(emitter,), exposure=0.02, lower_bound=0.125, white_level=1.0, colors=colors
    )
    light.save(tmp_path / "deep" / "light.exr")
    again = Light.load(tmp_path / "deep" / "light.exr")
    assert (again.radiance == light.radiance).all()
    assert (again.confidence == light.confidence).all()
    assert again.emitters == light.emitters
    assert again.exposure == pytest.approx(0.02)
    assert (again.lower_bound, again.white_level, again.colors) == (0.125, 1.0, colors)
    with OpenEXR.File(str(tmp_path / "deep" / "light.exr")) as file:
        header = dict(file.header())
    assert header["chromaticities"] == pytest.approx(REC_709)
    assert "row 0 toward +z" in header["axes"]
    assert json.loads(header["emitters"])[0]["power"] == [1.0, 2.0, 3.0]


NO_NUMBER = (
    '{"direction": [0, 0, 1], "solid_angle": NaN, "power": [1, 1, 1], "low": [1, 1, 1], "high": null, '
    '"distance": null, "origin": [0, 0, 0]}'
)


@pytest.mark.parametrize("axes", ["blender", "y-up", "opengl"])
def test_a_map_in_other_axes_is_turned(tmp_path, axes):
    """What lies in a direction of the marker's lies there again, emitters too."""
    radiance = smooth(16).astype(np.float32)
    direction = np.array([0.36, -0.48, 0.8])
    emitter = CapturedEmitter(tuple(direction), 0.1, (1.0, 1.0, 1.0), (1.0, 1.0, 1.0), None)
    turned = to_axes(radiance, axes)
    assert np.abs(turned - radiance).max() > 0.1
    light = Light(turned, np.ones(turned.shape[:2], np.float32), (emitter,))
    path = tmp_path / "light.exr"
    light.save(path)
    with OpenEXR.File(str(path)) as file:
        header = dict(file.header())
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    header["axes"] = DESCRIPTIONS[axes]
    OpenEXR.File({k: v for k, v in header.items() if k not in ("channels",)}, channels).write(str(path))
    found = Light.load(path)
    assert np.array_equal(found.radiance, radiance)
    assert np.allclose(world_from_marker(axes) @ found.emitters[0].direction, direction, atol=1e-5)
    header["axes"] = "latlong, upside down"
    OpenEXR.File({k: v for k, v in header.items() if k not in ("channels",)}, channels).write(str(path))
    with pytest.raises(SceneError, match="axes is 'latlong, upside down'; expected one of"):
        Light.load(path)


@pytest.mark.parametrize(
    ("channels", "attributes", "message"),
    [
        ({"Z": np.ones((4, 8), np.float32)}, {}, "R, G and B"),
        ({"RGB": np.ones((4, 9, 3), np.float32)}, {}, "twice as wide"),
        ({"RGB": np.ones((4, 8, 3), np.float32)}, {"emitters": "[{}]"}, "emitters is damaged"),
        ({"RGB": np.ones((4, 8, 3), np.float32)}, {"emitters": "[" * 200_000}, "levels of nesting"),
        ({"RGB": np.ones((4, 8, 3), np.float32)}, {"emitters": f"[{NO_NUMBER}]"}, "a number that is not finite"),
        ({"RGB": np.ones((4, 8, 3), np.float32)}, {"whiteLevel": "bright"}, "whiteLevel is 'bright'"),
        ({"RGB": np.ones((4, 8, 3), np.float32)}, {"exposure": float("nan")}, "exposure is 'nan'"),
        ({"RGB": np.ones((4, 8, 3), np.float32)}, {"cameraColors": "red"}, "cameraColors is 'red'"),
    ],
)
def test_files_that_are_no_light(tmp_path, channels, attributes, message):
    OpenEXR.File(attributes, channels).write(str(tmp_path / "a.exr"))
    with pytest.raises(SceneError, match=message):
        Light.load(tmp_path / "a.exr")


def test_emitters_are_found_with_their_power_and_across_the_seam():
    radiance = np.full((32, 64, 3), 0.1, np.float32)
    radiance[10:12, [0, 1, 62, 63]] = 30.0
    clipped = np.zeros_like(radiance)
    area = texel_solid_angles(32)[10:12].sum() * 4
    (found,) = find_emitters(radiance, clipped, 0.05)
    assert found.power == pytest.approx((30 * area,) * 3, rel=1e-4)
    assert found.solid_angle == pytest.approx(area, rel=1e-4)
    assert found.direction[0] < -0.8
    assert abs(found.direction[1]) < 1e-5
    assert found.high == pytest.approx(tuple(1.05 * p for p in found.power), rel=1e-3)
    clipped[10, 0] = 1.0
    assert find_emitters(radiance, clipped, 0.05)[0].high is None


def test_a_scene_of_captured_light_needs_neither_ball_nor_marker(tmp_path, device):
    constant(0.4).save(tmp_path / "light.exr")
    scene = loads_scene(SCENE, tmp_path / "scene.toml")
    assert scene.captured.file == tmp_path / "light.exr"
    assert not scene.has_marker
    assert loads_scene(dumps_scene(scene), tmp_path / "scene.toml") == scene
    plan = make_plan(Request(scene, PRESETS["medium"], (96, 72)))
    names = [stage.name for stage, _ in plan.stages]
    assert "captured" in names
    assert {"unwrap", "accumulate", "fill", "recover"}.isdisjoint(names)
    frame = np.full((72, 96, 3), 100, np.uint8)
    with Pipeline(scene, device=device, quality="medium", outputs=("image", "environment")) as pipeline:
        result = pipeline(frame)
        image, environment = result.image, result.environment
    assert np.allclose(environment, 0.4, atol=1e-6)
    # A furnace: a Lambertian sphere in constant light shows that light times its reflectance.
    top = image[25:30, 46:50].reshape(-1, 3) / 255
    assert np.abs(top - 0.2).max() < 0.01
    assert (image[2, 2] == 100).all()


def test_scale_and_turn_are_the_scenes(tmp_path, device):
    Light(smooth(64), np.ones((64, 128), np.float32)).save(tmp_path / "light.exr")
    text = SCENE + "scale = 2.0\nrotate = [0.0, 0.0, 90.0]\n"
    scene = loads_scene(text, tmp_path / "scene.toml")
    with Pipeline(scene, device=device, quality="low", outputs=("environment",)) as pipeline:
        environment = pipeline(np.zeros((72, 96, 3), np.uint8)).environment
    wanted = 2.0 * Light.load(tmp_path / "light.exr").resampled(64, rotation_matrix([0.0, 0.0, 90.0]))
    assert np.allclose(environment, wanted, rtol=1e-5)
    check_error("captured", environment, 2.0 * slope(latlong_directions(64) @ rotation_matrix([0.0, 0.0, 90.0])))


def test_colors_take_light_and_emitters_to_the_cameras(tmp_path, device):
    """Red and green change places, and blue is halved."""
    emitter = CapturedEmitter((0.0, 0.6, 0.8), 0.2, (1.0, 2.0, 4.0), (0.5, 1.0, 2.0), None, 0.5)
    dataclasses.replace(Light(smooth(64), np.ones((64, 128), np.float32)), emitters=(emitter,)).save(
        tmp_path / "light.exr"
    )
    scene = loads_scene(SCENE + "colors = [0, 1, 0, 1, 0, 0, 0, 0, 0.5]\n", tmp_path / "scene.toml")
    assert loads_scene(dumps_scene(scene), tmp_path / "scene.toml") == scene
    with Pipeline(scene, device=device, quality="low", outputs=("environment",)) as pipeline:
        environment = pipeline(np.zeros((72, 96, 3), np.uint8)).environment
        power = pipeline.arrays["emitters"].numpy()[0]["power"] if "emitters" in pipeline.arrays else None
    np.testing.assert_allclose(environment, smooth(64)[..., [1, 0, 2]] * (1.0, 1.0, 0.5), rtol=1e-5)
    assert power is None or power == pytest.approx((2.0, 1.0, 2.0))
    assert Light.load(tmp_path / "light.exr").recolored(np.diag([-1.0, 1.0, 1.0])).emitters[0].power == (0.0, 2.0, 4.0)


def test_an_emitter_whose_place_is_known_keeps_it(tmp_path, device):
    """Elsewhere than where the light was captured it stands in another direction, and is nearer."""
    radiance = np.full((32, 64, 3), 0.05, np.float32)
    light = Light(radiance, np.ones((32, 64), np.float32))
    area = np.broadcast_to(texel_solid_angles(32), (32, 64))
    inside = latlong_directions(32) @ np.array([0.0, 0.6, 0.8]) > 0.97
    power = 60.0 * float(area[inside].sum())
    radiance[inside] += 60.0
    emitter = CapturedEmitter((0.0, 0.6, 0.8), 0.2, (power,) * 3, (power,) * 3, None, 0.5)
    found = {}
    for name, emitters in (("far", ()), ("near", (emitter,))):
        dataclasses.replace(light, emitters=emitters).save(tmp_path / f"{name}.exr")
        text = SCENE.replace("light.exr", f"{name}.exr").replace("at = [0.0, 0.0, 0.08]", "at = [0.0, 0.2, 0.08]")
        with Pipeline(loads_scene(text, tmp_path / "scene.toml"), device=device, quality="medium") as pipeline:
            assert ("emitters" in pipeline.arrays) == (name == "near")
            found[name] = pipeline(np.full((72, 96, 3), 40, np.uint8), time_seconds=0.0).image.astype(float)
            if name == "near":
                record = pipeline.arrays["emitters"].numpy()[0]
                assert record["distance"] == pytest.approx(0.5)
                assert record["power"] == pytest.approx(power, rel=1e-4)
    # The ball stands nearly under the emitter, 0.34 m from it instead of 0.5 m.
    assert np.abs(found["near"] - found["far"]).max() > 10
