"""Row 18: a constant environment is constant under any mask, and filtering keeps total energy at every level and
method.

Bound: the best anchor's 0.05 %.
"""

from __future__ import annotations

import functools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.hard_cases.rig import ENVIRONMENT_HEIGHT, FILTERS, METHODS, SIZE, LoneStage, methods, solid_angles
from warp_ar.kernels.environment.lobes import lobe_count, lobe_offset, lobe_size
from warp_ar.kernels.structs import LAMBERT, METALLIC_ROUGHNESS, MIRROR, PHONG

HEIGHT = ENVIRONMENT_HEIGHT
MAP = (HEIGHT, 2 * HEIGHT)
FURNACE = 5e-4
make_lone = functools.lru_cache(maxsize=64)(LoneStage)


@pytest.mark.atlas(row=18, stage="accumulate")
@pytest.mark.atlas(row=18, stage="fill")
@given(seed=st.integers(0, 99), hidden=st.floats(0, 1), exponent=st.floats(-6, 6))
def test_a_constant_environment_under_any_mask(rig_for, seed, hidden, exponent):
    """Whatever is hidden in whichever frame: what is known has the environment's radiance to the bit, and so has the
    rest."""
    rig = rig_for("fill", "default")
    rig.set_params(world_from_camera=np.zeros((3, 3)))  # the camera looks nowhere: its frame is no constant environment
    rng = np.random.default_rng(seed)
    radiance = np.float32(10.0**exponent)
    rig.poke("environment_confidence", 0.0)
    for frame in range(4):
        mask = rng.random(MAP) >= hidden
        mask[seed % HEIGHT, frame] = True  # something is seen
        rig.poke("probe_radiance", np.where(mask[..., None], radiance, 0.0).repeat(3, -1))
        rig.poke("probe_confidence", (mask * rng.uniform(0.01, 1, MAP)).astype(np.float32))
        known = rig.run("accumulate")
        seen = known["environment_confidence"] > 0
        assert (known["environment_radiance"][seen] == radiance).all()
    (filled,) = rig.run("fill").values()
    np.testing.assert_allclose(filled, radiance, rtol=FURNACE)


@pytest.mark.atlas(row=18)
@pytest.mark.parametrize(("stage", "method"), FILTERS)
@given(row=st.integers(0, HEIGHT - 1), column=st.integers(0, 2 * HEIGHT - 1), sky=st.sampled_from([0.0, 1e-4, 1.0]))
def test_a_lamp_of_one_texel_keeps_its_energy(device, stage, method, row, column, sky):
    """The integral over all directions, wherever the lamp stands: pi times the flux, each level the flux."""
    surroundings = np.full((*MAP, 3), sky, np.float32)
    surroundings[row, column] = 1e6
    flux = float((solid_angles(*MAP)[..., None] * surroundings.astype(float)).sum((0, 1))[0])
    (values,) = make_lone(device, stage, method, HEIGHT).run(environment=surroundings).values()
    if values.shape == (9, 3):  # coefficients: the constant one holds the mean
        assert values[0, 0] * 0.28209479 * 4 * np.pi == pytest.approx(np.pi * flux, rel=FURNACE)
        return
    if stage == "irradiance":
        total = float((solid_angles(*values.shape[:2]) * values[..., 0]).sum())
        # Maps are sums of point samples.
        assert total == pytest.approx(np.pi * flux, rel=3e-3)
        return
    for level in range(lobe_count(HEIGHT)):
        rows, columns = lobe_size(HEIGHT, level)
        start = lobe_offset(HEIGHT, level)
        texels = values[start : start + rows * columns, 0].reshape(rows, columns)
        total = float((solid_angles(rows, columns) * texels.astype(float)).sum())
        # Brute force is normalised texel by texel: exact for a constant, not for a lamp between two texels.
        bound = 0.12 if method == "brute_force" else FURNACE
        assert total == pytest.approx(flux, rel=bound), f"level {level}"


@pytest.mark.atlas(row=18, stage="environment_samples")
@given(row=st.integers(0, HEIGHT - 1), column=st.integers(0, 2 * HEIGHT - 1), exponent=st.floats(-4, 8))
def test_samples_of_a_lamp_hold_its_flux(device, row, column, exponent):
    """Half the samples follow the light: a lamp of any radiance is neither lost nor counted twice."""
    surroundings = np.full((*MAP, 3), 1e-4, np.float32)
    surroundings[row, column] = 10.0**exponent
    samples = make_lone(device, "environment_samples", "default", HEIGHT).run(environment=surroundings)[
        "environment_samples"
    ]
    flux = float((solid_angles(*MAP) * surroundings[..., 0].astype(float)).sum())
    found = float((samples["measure"] * samples["radiance"][:, 0].astype(float)).sum())
    # A stratified sum: a lamp's share of 1,024 samples is right to one of them, or two where it crosses strata.
    assert found == pytest.approx(flux, rel=0.02)


# --- White objects in a white environment
# -------------------------------------------------------------------------------------

WHITE = {
    "lambert": {"model": LAMBERT, "base_color": 1.0},
    "phong": {"model": PHONG, "base_color": 0.0, "specular": 1.0, "shininess": 40.0},
    "gold without colour": {"model": METALLIC_ROUGHNESS, "base_color": 1.0, "metallic": 1.0, "roughness": 0.3},
    "mirror": {"model": MIRROR, "base_color": 1.0},
}
# A rough metal's lobe is looked up in two tables of 32 x 32, and its lost energy given back by a fit.
TABLES = 0.02
# What an object receives is a sum over one set of the environment's samples, averaged over its neighbours: see
# tests/test_near_field.py.
SAMPLED, SAMPLED_MEAN = 0.25, 0.03
# Share of the light that dies out between white objects and the desk.
LOST = 0.3


@pytest.fixture
def furnace_for(rig_for):
    """A rig in which the environment, the desk's picture and every object are white, and no lamp shines.

    The ball and the box lie far below: where they hide the desk from the camera, nobody knows what it looks like.
    """
    used = []

    def made(stage, method, material):
        rig = rig_for(stage, method)
        scene = rig.pipeline.inputs.host_scene.ray_scene
        for array in (scene.materials, scene.proxies):
            used.append((array, array.numpy().copy()))
        records = scene.materials.numpy().copy()
        for field, value in material.items():
            records[field] = value
        records["base_texture"] = records["specular_texture"] = -1
        scene.materials.assign(records)
        for array, field, index in ((scene.proxies, "position", 1), (rig.arrays["probes"], "center", 0)):
            records = array.numpy().copy()
            records[field][index] = (0.0, 0.0, -1e3)
            array.assign(records)
        rig.poke("frame", np.full((SIZE[1], SIZE[0], 3), 255, np.uint8))
        rig.poke("environment", 1.0)
        lights = rig.get("light_array")
        lights["intensity"] = 0.0
        rig.arrays["light_array"].assign(lights)
        if "emitters" in rig.arrays:
            rig.arrays["emitters"].zero_()
        for name, value in (("shadow_ratio", 1.0), ("added_light", 0.0)):
            if name in rig.arrays:
                rig.poke(name, value)
        names = [one.name for one, _ in rig.pipeline._scheduler._stages]
        for name in names[min(map(names.index, {"key_lights", "irradiance"} & set(names))) : names.index(stage)]:
            if name not in ("environment_shadow", "relight"):
                rig.run(name)
        return rig

    yield made
    for array, records in used:
        array.assign(records)


@pytest.mark.atlas(row=18, stage="shade")
@pytest.mark.parametrize("method", METHODS["shade"])
@pytest.mark.parametrize("name", WHITE)
def test_white_objects_cannot_be_told_from_a_white_environment(furnace_for, method, name):
    virtual = furnace_for("shade", method, WHITE[name]).run("shade")["virtual"]
    covered = virtual[..., 3] > 0
    ratio = virtual[covered][:, :3] / virtual[covered][:, 3:]
    near = method != "environment" and name != "mirror"
    assert covered.any()
    np.testing.assert_allclose(ratio.mean(0), 1.0, atol=SAMPLED_MEAN if near else TABLES)
    np.testing.assert_allclose(ratio, 1.0, atol=SAMPLED if near else TABLES)
    if name in ("lambert", "mirror") and not near:
        np.testing.assert_allclose(ratio, 1.0, atol=FURNACE)


@pytest.mark.atlas(row=18, stage="near_field")
@pytest.mark.parametrize("name", WHITE)
def test_what_surrounds_a_white_object_is_white(furnace_for, name):
    rig = furnace_for("near_field", "default", WHITE[name])
    outputs = rig.run("near_field")
    seen = rig.get("hit_object") >= 0
    mirrored = outputs["near_reflected"][seen]
    np.testing.assert_allclose(mirrored[:, :3], mirrored[:, 3:].repeat(3, 1), atol=TABLES)
    if name == "lambert":
        received = outputs["near_irradiance"][seen]
        np.testing.assert_allclose(received.mean(0) / np.pi, 1.0, atol=SAMPLED_MEAN)
        np.testing.assert_allclose(received / np.pi, 1.0, atol=SAMPLED)


@pytest.mark.atlas(row=18, stage="environment_shadow")
@pytest.mark.parametrize("method", methods("environment_shadow"))
def test_white_objects_give_back_the_light_that_they_take(furnace_for, method):
    """Black ones only take; white ones give it back but for what dies out between them and the desk."""
    black = furnace_for("environment_shadow", method, {**WHITE["lambert"], "base_color": 0.0}).run("environment_shadow")
    white = furnace_for("environment_shadow", method, WHITE["lambert"]).run("environment_shadow")
    taken, left = 1.0 - black["shadow_ratio"], 1.0 - white["shadow_ratio"]
    assert taken.min() >= 0.0
    assert taken.max() > 0.2, "the objects throw shadows"
    assert abs(left).mean() < LOST * taken.mean()
    assert -left.min() < SAMPLED


@pytest.mark.atlas(row=18, stage="mirror_ball")
@pytest.mark.parametrize("method", methods("mirror_ball"))
@pytest.mark.parametrize("name", WHITE)
def test_white_objects_in_a_white_ball_change_nothing(furnace_for, rig_for, method, name):
    """A perfect mirror among white objects: what it shows of them is what it showed of the environment behind them."""
    ball = rig_for("mirror_ball", method).arrays["probes"].numpy().copy()
    ball["reflectance"] = 1.0
    found = {}
    for color, colors in ((0.0, {"base_color": 0.0, "specular": 0.0}), (1.0, {})):
        rig = furnace_for("mirror_ball", method, {**WHITE[name], **colors})
        rig.arrays["probes"].assign(ball)
        found[color] = rig.run("mirror_ball")["mirror_ball"]
    black = found[0.0].max(-1) < 0.0
    assert black.any(), "the ball must show the objects"
    if name in ("lambert", "mirror"):
        assert found[0.0].min() >= -1.0, "nothing is darker than black"
        assert found[0.0].min() < -0.5, "black objects are black in it, where they fill a pixel"
    np.testing.assert_allclose(found[1.0], 0.0, atol=FURNACE if name in ("lambert", "mirror") else TABLES)
    np.testing.assert_array_equal(found[1.0][~black & (found[0.0] == 0.0).all(-1)], 0.0)
