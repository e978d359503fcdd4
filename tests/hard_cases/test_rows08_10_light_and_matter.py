"""Rows 8 to 10: materials at their ends, lights in hard places, the paper's blend without a light that dominates.

Bounds: finite, not negative; lights that cannot reach the desk add exactly nothing.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.hard_cases import generators
from tests.hard_cases.rig import METHODS, SIZE, assert_finite, cases, look_at, methods
from warp_ar.kernels.structs import LAMBERT, METALLIC_ROUGHNESS, MIRROR, PHONG

FRAMES = generators.frames(SIZE[1], SIZE[0])
LIGHTS = generators.lights()
WHOLE = (0, SIZE[1], 0, SIZE[0])
# A change of what the camera saw.
SIGNED = ("mirror_ball",)
ENDS = (
    {"model": PHONG, "shininess": 0.0},
    {"model": PHONG, "shininess": 1e5},
    {"model": PHONG, "shininess": 1e-8},
    {"model": METALLIC_ROUGHNESS, "roughness": 0.0, "metallic": 0.0},
    {"model": METALLIC_ROUGHNESS, "roughness": 0.0, "metallic": 1.0},
    {"model": METALLIC_ROUGHNESS, "roughness": 1.0, "metallic": 0.0},
    {"model": METALLIC_ROUGHNESS, "roughness": 1.0, "metallic": 1.0},
    {"model": METALLIC_ROUGHNESS, "roughness": 1e-8, "metallic": 1.0},
    {"model": LAMBERT, "base_color": 0.0},
    {"model": MIRROR, "base_color": 1.0},
)


def set_materials(rig, **fields):
    materials = rig.pipeline.inputs.host_scene.ray_scene.materials
    records = materials.numpy().copy()
    records["base_color"], records["specular"] = 0.8, 0.2
    for field, value in fields.items():
        records[field] = value
    materials.assign(records)


@pytest.fixture
def rig_of(rig_for):
    """``rig_for``, with the materials of the scene put back afterwards."""
    used = {}

    def made(stage, method):
        rig = rig_for(stage, method)
        used[id(rig)] = rig, rig.pipeline.inputs.host_scene.ray_scene.materials.numpy().copy()
        return rig

    yield made
    for rig, records in used.values():
        rig.pipeline.inputs.host_scene.ray_scene.materials.assign(records)


def set_lights(rig, **fields):
    records = rig.get("light_array")
    for field, value in fields.items():
        records[field] = value
    rig.arrays["light_array"].assign(records)
    rig.set_params(light_rect=WHOLE, direct_rect=WHOLE, object_rect=WHOLE, ball_rect=WHOLE)


def run_until(rig, stage):
    names = [one.name for one, _ in rig.pipeline._scheduler._stages]
    for name in names[names.index("visibility") : names.index(stage)]:
        rig.run(name)
    return rig.run(stage)


def assert_light(outputs, cause):
    assert_finite(outputs, cause)
    for name, values in outputs.items():
        assert name in SIGNED or (values >= 0).all(), f"{name} is below zero {cause}"


@pytest.mark.atlas(row=8)
@pytest.mark.parametrize(("stage", "method"), cases("shade", "environment_shadow", "near_field", "mirror_ball"))
@pytest.mark.parametrize("eye", [(0.02, -0.3, 0.35), (0.0, -0.5, 1e-4)], ids=["above", "grazing"])
def test_materials_at_their_ends(rig_of, stage, method, eye):
    """Every end of every model, from above and along the desk, under lights from above and along the desk."""
    rig = rig_of(stage, method)
    inverse = look_at(eye).inverse()
    rig.set_params(camera_position=inverse.translation, world_from_camera=inverse.rotation, shadow_rect=WHOLE)
    for light in ({"direction": (0, 0, -1)}, {"direction": (0.0, 1.0, 0.0), "position": (0.3, 0.0, 0.0)}):
        set_lights(rig, **light)
        for ends in ENDS if method != "brute_force" else ENDS[1:9:3]:
            set_materials(rig, **ends)
            assert_light(run_until(rig, stage), f"for {ends}")


@pytest.mark.atlas(row=8, stage="shade")
@pytest.mark.parametrize("method", METHODS["shade"])
@given(
    shininess=st.floats(0, 1e5),
    roughness=st.floats(0, 1),
    metallic=st.floats(0, 1),
    model=st.sampled_from([PHONG, METALLIC_ROUGHNESS]),
    turn=st.floats(0, math.pi),
)
def test_materials_anywhere_between(rig_of, method, shininess, roughness, metallic, model, turn):
    rig = rig_of("shade", method)
    set_lights(rig, direction=(math.sin(turn), 0.0, math.cos(turn)), position=(-math.sin(turn), 0.0, -math.cos(turn)))
    set_materials(rig, model=model, shininess=shininess, roughness=roughness, metallic=metallic)
    assert_light(rig.run("shade"), "")


@pytest.mark.atlas(row=9)
@pytest.mark.parametrize(("stage", "method"), cases("relight", "shade", "mirror_ball"))
@pytest.mark.parametrize("name", LIGHTS)
def test_lights_in_hard_places(rig_for, stage, method, name):
    rig = rig_for(stage, method)
    for content in ("noise", "black", "white"):
        rig.poke("frame", FRAMES[content])
        set_lights(rig, **LIGHTS[name])
        outputs = run_until(rig, stage)
        assert_light(outputs, f"for a light {name!r} on a frame {content!r}")
        if name in generators.DARK_LIGHTS and stage == "relight":
            # From below, the box on the desk may catch light on its underside, which the camera does not see.
            assert (outputs["added_light"] == 0).all()


@pytest.mark.atlas(row=10, stage="relight")
@pytest.mark.parametrize("method", methods("relight"))
def test_the_blend_from_one_end_of_alpha_to_the_other(rig_for, method):
    """The key light turned from along the virtual one to against it: bounded, continuous, and the ends differ."""
    rig = rig_for("relight", method)
    if "key_lights" not in rig.stage("relight")[0].wiring.reads:
        return  # a method that does not ask
    rig.poke("frame", FRAMES["noise"])
    set_lights(rig, **{**LIGHTS["grazing sun"], "direction": (0.0, 0.0, -1.0), "intensity": (1.0, 1.0, 1.0)})
    key, found = rig.get("key_lights"), []
    for alpha in np.linspace(-1, 1, 41):
        key["direction"], key["directionality"] = (math.sqrt(max(1 - alpha**2, 0)), 0.0, alpha), 1.0
        rig.arrays["key_lights"].assign(key)
        found.append(rig.run("relight")["added_light"])
        assert_light({"added_light": found[-1]}, f"at alpha = {alpha}")
    steps = np.abs(np.diff(found, axis=0)).max(axis=(1, 2, 3))
    assert steps.max() <= 5 * np.abs(found[0] - found[-1]).max() / 40 + 1e-6, "alpha moves light by jumps"
    assert np.abs(found[0] - found[-1]).max() > 0.05, "the ends must differ on a desk with structure"


@pytest.mark.atlas(row=10, stage="key_lights")
@pytest.mark.parametrize("surroundings", ["uniform", "two equal opposite suns", "black", "denormal"])
def test_no_single_light_dominates(rig_for, surroundings):
    """A uniform environment, two equal opposite lights, no light: none has a say, all directions are unit."""
    rig = rig_for("key_lights", "default")
    height = rig.get("environment").shape[0]
    rig.poke("environment", generators.finite_maps(height, 2 * height)[surroundings])
    key = rig.run("key_lights")["key_lights"]
    assert key["directionality"].max() <= 0.01
    np.testing.assert_allclose(np.linalg.norm(key["direction"], axis=-1), 1.0, atol=1e-5)
