"""The ball in the picture: closed forms, the float64 twin, what hides what, methods, garbage, and the stage."""

from __future__ import annotations

import numpy as np
import pytest

from tests.error_model import check_error
from tests.kernel_rig import look_at, shape
from tests.mirror_ball_rig import (
    BALL,
    BESIDE,
    CENTER,
    CHALK,
    DESK,
    DOWN,
    ENVIRONMENT,
    EYE,
    FLOAT_ERROR,
    FOCAL,
    HALF_CODE,
    LAMP,
    MET,
    NUDGE,
    ON_BALL,
    OUTWARD,
    POINTS,
    POSE,
    PRIOR,
    RADIUS,
    RAYS,
    RHO,
    SUN,
    H,
    W,
    grey_frame,
    linear,
    noise_frame,
    on_desk,
    run,
)
from tests.twins import color as reference_color
from tests.twins import mirror_ball as reference
from tests.twins import relight as reference_relight
from tests.twins.visibility import Body
from warp_ar.kernels.structs import BOX, PLANE, SPHERE
from warp_ar.stages.mirror_ball import SIDES

# --- closed forms


@pytest.mark.parametrize(("rho", "kd"), [(0.4, 0.9), (0.85, 0.5), (1.0, 0.3)])
def test_light_above_a_desk_seen_in_the_ball(device, rho, kd):
    """A matt desk under an even environment, and a sun straight above it: rho kd E / pi, but in the ball's own
    shadow."""
    code = reference_color.encode(rho * kd * ENVIRONMENT, reference_color.encoded_srgb)
    frame = np.broadcast_to(code, (H, W, 3)).copy()
    ball = {**BALL, "reflectance": (rho,) * 3}
    got = run(frame, lights=[SUN], balls=[ball], method="reflectance")
    shadow = np.linalg.norm(MET[..., :2] - CENTER[:2], axis=-1)
    sure = np.abs(shadow - RADIUS) > 1e-3
    lit = ON_BALL & DOWN & (shadow > RADIUS)
    added = linear(frame) / ENVIRONMENT * SUN["intensity"] / np.pi
    np.testing.assert_allclose(got[lit & sure], added[lit & sure], rtol=PRIOR)
    np.testing.assert_allclose(got[lit & sure].mean(0), rho * kd * np.array(SUN["intensity"]) / np.pi, rtol=HALF_CODE)
    np.testing.assert_array_equal(got[~lit & sure], 0.0)
    assert (ON_BALL & DOWN & (shadow < RADIUS) & sure).any(), "some of the shadow must be seen"


def test_an_opaque_item_replaces_what_the_camera_saw(device):
    """A white shell around everything, in an even environment: what looks up shows rho times its radiance, whatever
    was."""
    shell = shape(SPHERE, (0.0, 0.0, 0.0), (3.0,) * 3, 0)
    frame, surroundings = noise_frame(), np.array([0.5, 0.4, 0.3])
    got = linear(frame) + run(frame, objects=[shell], irradiance=surroundings)
    _, near = on_desk(POINTS, OUTWARD)
    near &= np.linalg.norm(np.nan_to_num(MET), axis=-1) < 3.0
    item = ON_BALL & ~near
    expected = np.array(RHO) * CHALK["base_color"] * surroundings
    np.testing.assert_allclose(got[item], np.broadcast_to(expected, got[item].shape), rtol=FLOAT_ERROR)
    np.testing.assert_array_equal(got[~item], linear(frame)[~item].astype(np.float32))


# --- the twin


def project(from_camera):
    p = from_camera @ POSE.rotation.T
    with np.errstate(divide="ignore", invalid="ignore"):
        at = FOCAL * p[..., :2] / p[..., 2:]
    return at + np.array([(W - 1) / 2, (H - 1) / 2]), p[..., 2]


# Linear in the pixel's place, so that a bilinear look-up is exact.
SLOPE, START = np.array([[0.004, 0.003, 0.002], [-0.005, 0.002, 0.004]]), np.array([0.5, 0.6, 0.4])


def ramp(at):
    return np.nan_to_num(at) @ SLOPE + START


def body(one):
    kind = {SPHERE: "sphere", BOX: "box", PLANE: "plane"}[one["kind"]]
    return Body(kind, np.eye(3), np.asarray(one["position"], float), 1.0, np.asarray(one["extent"], float))


def respond(method):
    """The desk's answer: from its radiance and E cos / pi, radiance."""

    def answer(radiance, light):
        facing = np.ones((len(radiance), 1))
        kd, response = reference_relight.respond(method, None, radiance, facing, 0.0, 0.0, np.pi * ENVIRONMENT)
        return kd * response * light

    return answer


TWO = (BALL, {"center": (0.13, 0.05, 0.04), "radius": 0.04, "reflectance": (0.6, 0.6, 0.9)})
BLOCK = shape(BOX, (-0.12, -0.02, 0.03), (0.02, 0.03, 0.03))
CUBE = shape(BOX, (0.02, -0.12, 0.015), (0.015, 0.02, 0.015), 0)


@pytest.mark.parametrize("method", ["flat", "reflectance"])
@pytest.mark.parametrize("lit", [True, False], ids=["lit", "dark"])
def test_matches_twin(device, method, lit):
    """Two balls, desk and block, a ball and a box of chalk, a lamp, shadows; rays close to an edge are left out."""
    frame, objects, proxies = noise_frame(1), [BESIDE, CUBE], [DESK, BLOCK]
    rows, columns = np.mgrid[:H, :W]
    ratio = ramp(np.stack([columns, rows], -1).astype(float))
    world = reference.World(
        EYE,
        [reference.ball(one["center"], one["radius"]) for one in TWO],
        np.array([one["reflectance"] for one in TWO]),
        list(map(body, proxies)),
        list(map(body, objects)),
        np.array([CHALK["base_color"]] * 2),
        np.array(LAMP["position"]) if lit else None,
        np.array(LAMP["intensity"]),
    )
    seen = linear(frame).reshape(-1, 3)

    def twin(offset):
        rays = RAYS.astype(float) + np.array(offset) / FOCAL
        directions = np.concatenate([rays, np.ones_like(rays[..., :1])], -1) @ POSE.inverse().rotation.T
        return reference.mirror(world, directions.reshape(-1, 3), seen, respond(method), project, ramp, (H, W))

    expected, label = twin((0.0, 0.0))
    sure = np.ones(len(label), bool)
    for offset in ((NUDGE, 0), (-NUDGE, 0), (0, NUDGE), (0, -NUDGE)):
        sure &= twin(offset)[1] == label
    got = run(
        frame, objects=objects, proxies=proxies, balls=TWO, lights=[LAMP] if lit else (), ratio=ratio, method=method
    ).reshape(-1, 3)
    assert sure.mean() > 0.98
    # A desk, a block, both objects and another ball are mirrored; the desk lit and in shadow, in the picture and not.
    assert len(set(label[sure].tolist())) > (12 if lit else 8), set(label.tolist())
    np.testing.assert_allclose(got[sure], expected[sure], atol=FLOAT_ERROR)
    check_error("mirror_ball", got[sure], expected[sure])


# --- what hides what

BUSY = {"objects": (BESIDE, CUBE), "lights": (LAMP, SUN), "proxies": (DESK, BLOCK), "ratio": np.full((H, W, 3), 0.5)}


def test_a_ball_behind_a_proxy_is_not_changed(device):
    """A wall between camera and ball hides all of it; half a wall, what is behind that half."""
    towards = EYE - CENTER
    wall = shape(BOX, CENTER + 0.4 * towards, (0.2, 0.005, 0.2))
    np.testing.assert_array_equal(run(**{**BUSY, "proxies": (DESK, wall)}), 0.0)
    half = {**wall, "position": wall["position"] + np.array([0.2, 0.0, 0.0])}
    got, plain = run(**{**BUSY, "proxies": (DESK, half)}), run(**BUSY)
    assert not got[:, W // 2 + 4 :].any()
    assert got[:, : W // 2 - 4].any()
    assert plain[:, W // 2 + 4 :].any()


@pytest.mark.parametrize("away", [(0.0, 0.0, -1.0), (0.4, 0.0, 0.06)], ids=["under the desk", "behind a wall"])
def test_a_ball_behind_what_is_mirrored_hides_nothing(device, away):
    """What a ray meets first counts, not what lies in its way beyond."""
    other = {"center": away, "radius": 0.15, "reflectance": RHO}
    wall = shape(BOX, (0.2, 0.0, 0.25), (0.01, 0.5, 0.25))
    scene = {**BUSY, "lights": [LAMP], "proxies": (DESK, wall)}
    # Neither lies in the camera's way nor in the lamp's.
    np.testing.assert_array_equal(run(**{**scene, "balls": [BALL, other]}), run(**scene))


@pytest.mark.parametrize(
    "eye",
    [CENTER, CENTER + np.array([0.03, 0.0, 0.0]), CENTER + np.array([0.0, RADIUS * (1 - 1e-6), 0.0])],
    ids=["middle", "inside", "under the skin"],
)
def test_a_camera_inside_the_ball_sees_no_mirror(device, eye):
    np.testing.assert_array_equal(run(**BUSY, pose=look_at(eye, CENTER + np.array([0.3, 0.1, 0.0]))), 0.0)


@pytest.mark.parametrize("gap", [1e-6, 1e-4, 1e-2])
@pytest.mark.parametrize("side", SIDES.values())
def test_a_camera_close_to_the_ball(device, gap, side):
    """Touching the near plane, looking at it and along its skin: finite, and no more than what is there to be seen."""
    outside = CENTER + np.array([0.0, -(1.0 + gap) * RADIUS, 0.0])
    shell = {"objects": [shape(SPHERE, (0, 0, 0), (3.0,) * 3, 0)], "irradiance": ENVIRONMENT, "samples": side**2}
    for target in (CENTER, outside + np.array([1.0, 0.0, 0.0]), outside + np.array([1.0, 0.3 * gap, 0.0])):
        got = linear(grey_frame()) + run(**shell, pose=look_at(outside, target))
        assert np.isfinite(got).all()
        assert ((got > -1e-6) & (got <= 1.0)).all()


# --- methods


def test_smooth_is_the_mean_over_the_pixel(device):
    """At edges and all: ``n`` rays per pixel give the mean of ``n`` pictures of one ray, moved within the pixel."""
    frame, scene = noise_frame(), {**BUSY, "method": "reflectance"}
    for samples in (4, 16):
        side = round(samples**0.5)
        mean = np.zeros((H, W, 3))
        for k in range(samples):
            a, b = k % side, k // side
            offset = np.array([(a + (b + 0.5) / side) / side - 0.5, (b + (side - 0.5 - a) / side) / side - 0.5])
            mean += run(frame, **scene, rays=RAYS + np.float32(offset) / np.float32(FOCAL)) / samples
        got = run(frame, **scene, samples=samples)
        # A ray is moved before or after its rounding: one of many may fall on the other side of an edge.
        assert np.isclose(got, mean, atol=1e-5).all(-1).mean() > 0.997
        assert abs(got - mean).mean() < 1e-5


# --- garbage


def test_a_pixel_of_the_frame_changes_itself_alone(device):
    frame, scene = grey_frame(), {**BUSY, "method": "reflectance"}
    clean = run(frame, **scene)
    for row, column in np.argwhere(clean.any(-1))[::40]:
        for code in ((255, 0, 7), (0, 0, 0), (255, 255, 255)):
            broken = frame.copy()
            broken[row, column] = code
            touched = (run(broken, **scene) != clean).any(-1)
            assert touched[row, column]
            touched[row, column] = False
            assert not touched.any()
