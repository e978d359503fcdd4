"""Rows 1 to 3: straight back through the ball, the blind cone, the rim; a ball that is near, cut, hidden or tiny.

Bounds: what is unwrapped lies within the frame's range, and a constant frame gives a constant map, to the furnace's
0.05 %; where the ball says nothing the confidence is 0, and the light of before is kept.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tests.hard_cases import generators
from tests.hard_cases.rig import EXACT, SIZE, assert_finite, look_at
from warp_ar.kernels.color import decode_table

FRAMES = generators.frames(SIZE[1], SIZE[0])
CENTER, RADIUS, REFLECTANCE = np.array([-0.09, 0.02, 0.04]), 0.04, 0.85
FURNACE = 5e-4
AXES = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if abs(x) + abs(y) + abs(z) == 1]


def see_ball(rig, eye):
    """Put the camera at ``eye``, looking at the ball."""
    inverse = look_at(eye, CENTER).inverse()
    rig.set_params(camera_position=inverse.translation, world_from_camera=inverse.rotation)
    return rig.run("unwrap")


def assert_sane(outputs, low=0.0, high=1.0):
    assert_finite(outputs)
    radiance, confidence = outputs["probe_radiance"], outputs["probe_confidence"]
    assert ((confidence >= 0) & (confidence <= 1)).all()
    seen = confidence > 0
    tolerance = 1e-5  # a running mean of up to 64 values
    assert (radiance[seen] >= low * (1 - tolerance)).all()
    assert (radiance[seen] <= high * (1 + tolerance) / REFLECTANCE).all()
    assert (radiance[~seen] == 0).all()
    assert ((outputs["probe_clipped"] >= 0) & (outputs["probe_clipped"] <= 1 + tolerance)).all()


@pytest.mark.atlas(row=1, stage="unwrap")
@pytest.mark.atlas(row=4, stage="unwrap")
@pytest.mark.atlas(row=5, stage="unwrap")
@pytest.mark.parametrize("method", EXACT)
@pytest.mark.parametrize("axis", AXES, ids=str)
def test_light_straight_back_along_an_axis(rig_for, method, axis):
    """The camera where R = -view falls exactly on a pole, the seam or a texel's corner; the proxies out of the way."""
    rig = rig_for("unwrap", method)
    hide_proxies(rig)
    rig.poke("frame", FRAMES["ramp"])
    outputs = see_ball(rig, CENTER + 0.2 * np.array(axis))
    assert_sane(outputs)
    # The texel that looks back at the camera is seen, the one behind the ball is blind.
    theta, phi = np.arccos(axis[2]), np.arctan2(axis[1], axis[0])
    height = outputs["probe_confidence"].shape[0]
    row = min(int(theta / np.pi * height), height - 1)
    column = int((phi / np.pi + 1) * height) % (2 * height)
    assert outputs["probe_confidence"][row, column] > 0.5
    behind = outputs["probe_confidence"][height - 1 - row, (column + height) % (2 * height)]
    assert behind == 0.0


def hide_proxies(rig):
    """Move what could hide the ball far away."""
    proxies = rig.pipeline.inputs.host_scene.ray_scene.proxies
    records = proxies.numpy().copy()
    records["position"] += np.float32([0, 0, -1e4])
    proxies.assign(records)


@pytest.fixture(autouse=True)
def _proxies_back(request, rig_for):
    yield
    for method in EXACT:
        rig = rig_for("unwrap", method)
        records = rig.pipeline.inputs.host_scene._proxies
        rig.pipeline.inputs.host_scene.ray_scene.proxies.assign(records)


@pytest.mark.atlas(row=1, stage="unwrap")
@pytest.mark.atlas(row=2, stage="unwrap")
@pytest.mark.atlas(row=3, stage="unwrap")
@pytest.mark.parametrize("method", EXACT)
@given(
    log_distance=st.floats(-8, 8),
    direction=st.sampled_from(list(map(tuple, generators.directions().tolist()))),
    name=st.sampled_from(sorted(FRAMES)),
)
@example(log_distance=0.0, direction=(0.0, 0.0, 1.0), name="noise")
@example(log_distance=1e-6, direction=(0.0, -1.0, 0.0), name="white")
@example(log_distance=3.0, direction=(1.0, 0.0, 0.0), name="checkers")
def test_from_anywhere(rig_for, method, log_distance, direction, name):
    """From the ball's centre to far away, from every direction, touching it, whatever the frame shows."""
    rig = rig_for("unwrap", method)
    rig.poke("frame", FRAMES[name])
    linear = decode_table("srgb")[FRAMES[name].reshape(-1, 3), [0, 1, 2]]
    assert_sane(see_ball(rig, CENTER + RADIUS * 10.0**log_distance * np.array(direction)), linear.min(), linear.max())


@pytest.mark.atlas(row=18, stage="unwrap")
@pytest.mark.atlas(row=3, stage="unwrap")
@pytest.mark.parametrize("method", EXACT)
@pytest.mark.parametrize(
    "eye", [(0.02, -0.3, 0.35), (-0.09, 0.02, 0.1), (0.3, 0.02, 0.04), (-0.09, -2.0, 0.5)], ids=str
)
@pytest.mark.parametrize("code", [1, 128, 255])
def test_a_constant_frame_is_a_constant_map(rig_for, method, eye, code):
    """Near, far, cut by the frame and hidden in part: what is seen at all has the frame's radiance."""
    rig = rig_for("unwrap", method)
    rig.poke("frame", np.full((SIZE[1], SIZE[0], 3), code, np.uint8))
    outputs = see_ball(rig, eye)
    expected = decode_table("srgb")[code] / REFLECTANCE
    seen = outputs["probe_confidence"] > 0
    np.testing.assert_allclose(
        outputs["probe_radiance"][seen], np.broadcast_to(expected, (seen.sum(), 3)), rtol=FURNACE
    )


@pytest.mark.slow
@pytest.mark.atlas(row=3, stage="unwrap")
@pytest.mark.atlas(row=3, stage="fill")
@pytest.mark.parametrize("method", EXACT)
def test_a_ball_that_is_not_to_be_seen_leaves_the_light_alone(rig_for, method):
    """Documented fallback: no confidence, and the map stays as it was."""
    rig = rig_for("unwrap", method)
    outputs = see_ball(rig, CENTER + 0.5 * RADIUS)  # from inside the ball
    rig.run("fill")
    before = rig.written("fill")
    assert (outputs["probe_confidence"] == 0).all()
    np.testing.assert_allclose(rig.run("accumulate")["environment_radiance"], rig.get("environment_radiance"))
    for name, values in rig.run("fill").items():
        # What is not seen is trusted less and less: exp(-1 / 30 / FORGET_TIME) = 0.17 % a frame.
        np.testing.assert_allclose(values, before[name], atol=2e-3)
