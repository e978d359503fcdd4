"""Light that a mirror ball throws on the desk: against rays that are thrown at the ball, and where nothing may arrive."""


import numpy as np
import pytest
import warp as wp

from tests.kernel_rig import records, shape
from tests.receiver_cells_rig import View, ball
from tests.reference.mirrored_light import thrown_irradiance
from tests.relight_rig import DESK, point
from warp_ar.kernels.mirrored_light import REACH, Mirroring, find_mirroring
from warp_ar.kernels.structs import DIRECTIONAL, PLANE, SPOT, Light, Probe
from warp_ar.scene import Camera, Proxy, Scene
from warp_ar.scene import Light as VirtualLight
from warp_ar.scene import Probe as Ball
from warp_ar.scene.ray_scene import HostScene

BALL = ball((0.02, -0.01, 0.035), 0.035)
LAMP = (-0.25, 0.1, 0.35)


@wp.kernel(enable_backward=False)
def mirroring_kernel(
    lights: wp.array[Light], probes: wp.array[Probe], points: wp.array[wp.vec3], out: wp.array[Mirroring]
):
    k = wp.tid()
    out[k] = find_mirroring(lights[0], probes[0], points[k])


def mirrorings(light, probe, points):
    points = np.float32(np.atleast_2d(points))
    out = wp.zeros(len(points), dtype=Mirroring)
    inputs = [records(Light, light), records(Probe, probe), wp.array(points, dtype=wp.vec3)]
    wp.launch(mirroring_kernel, len(points), inputs=inputs, outputs=[out])
    return out.numpy()


def directional(direction, irradiance=1.0):
    direction = np.asarray(direction, float) / np.linalg.norm(direction)
    return {"kind": DIRECTIONAL, "direction": tuple(direction), "intensity": (irradiance,) * 3}


@pytest.mark.parametrize("light", [point(LAMP), directional((0.6, -0.2, -0.5))], ids=["lamp", "sun"])
def test_light_leaves_the_ball_as_it_came(device, light):
    rng = np.random.default_rng(4)
    points = np.stack([rng.uniform(-0.3, 0.3, 500), rng.uniform(-0.3, 0.3, 500), rng.uniform(0.0, 0.3, 500)], -1)
    found = mirrorings(light, BALL, points)
    seen = found["found"].astype(bool)
    assert 100 < seen.sum() < 500
    center, place, normal = np.array(BALL["center"]), found["place"][seen], found["normal"][seen]
    np.testing.assert_allclose(np.linalg.norm(place - center, axis=-1), BALL["radius"], rtol=1e-5)
    toward = -np.array(light["direction"]) if light["kind"] == DIRECTIONAL else np.array(LAMP) - place
    toward = toward / np.linalg.norm(toward, axis=-1, keepdims=True)
    back = -found["wi"][seen]
    np.testing.assert_allclose(2 * (toward * normal).sum(-1)[:, None] * normal - toward, back, atol=2e-4)
    assert ((back * normal).sum(-1) > 0).all()
    np.testing.assert_allclose(place + found["distance"][seen][:, None] * back, points[seen], atol=1e-6)
    # Where none is found the light's place on the ball is turned away from the point, or the point lies in the ball.
    inside = np.linalg.norm(points - center, axis=-1) < BALL["radius"]
    assert not found["found"][inside].any()


@pytest.mark.parametrize("light", ["lamp", "sun"])
def test_as_much_arrives_as_is_thrown(device, light):
    """Irradiance of cells of a desk against two million rays, within four standard errors and the cells' curvature."""
    edges = np.linspace(-0.1, 0.14, 25), np.linspace(-0.13, 0.11, 25)
    sun = (0.5, -0.2, -0.6)
    thrown, error = thrown_irradiance(
        BALL["center"], BALL["radius"], 0.0, LAMP if light == "lamp" else (sun, "directional"), edges, 2_000_000
    )
    fine = [np.linspace(edge[0], edge[-1], 4 * 24 + 1) for edge in edges]
    middles = np.stack(np.meshgrid(*((e[1:] + e[:-1]) / 2 for e in fine), [0.0], indexing="ij"), -1).reshape(-1, 3)
    record = point(LAMP, (1.0,) * 3) if light == "lamp" else directional(sun)
    found = mirrorings(record, BALL, middles)
    seen = found["found"].astype(bool)
    arriving = np.ones(len(middles))
    if light == "lamp":
        arriving = 1.0 / ((np.array(LAMP) - found["place"]) ** 2).sum(-1)
    irradiance = np.where(seen, found["spread"] * arriving * np.maximum(found["wi"][:, 2], 0), 0.0)
    irradiance = irradiance.reshape(24, 4, 24, 4).mean((1, 3))
    away = np.hypot(*np.meshgrid(*((e[1:] + e[:-1]) / 2 - c for e, c in zip(edges, BALL["center"], strict=False))))
    away = away.T / BALL["radius"]
    told = (thrown > 10 * error) & (away > 1.3) & (away < 0.7 * REACH)
    assert told.sum() > 100
    assert (np.abs(irradiance - thrown) < 4 * error + 0.03 * thrown)[told].mean() > 0.99
    assert abs(irradiance[told].sum() / thrown[told].sum() - 1) < 0.005


def added(lights, probes=(BALL,), proxies=(DESK,), frame=None, **forms):
    view = View(proxies, list(probes), tuple(lights), frame=frame, **forms)
    return view.light(), view.light(mirrored=True)


def test_the_desk_is_brighter_beside_the_ball_by_what_it_mirrors(device):
    """Radiance that is added is reflectance times irradiance over pi, of both ways that light takes."""
    without, with_ball = added([point(LAMP)])
    gained = with_ball - without
    assert gained.min() >= -1e-7
    assert gained.max() > 0.05 * without.max()
    sent, silver = added([point(LAMP)], [{**BALL, "reflectance": (0.85, 0.425, 0.0)}])
    np.testing.assert_allclose((silver - sent)[..., 1], 0.5 * gained[..., 0], atol=1e-6)
    assert (silver == sent)[..., 2].all()


def test_nothing_is_thrown_where_the_light_does_not_fall_on_the_ball(device):
    spot = {"kind": SPOT, "direction": (0, 0, -1), "inner_angle": 0.1, "outer_angle": 0.2}
    without, with_ball = added([{**point((0.25, 0.1, 0.4)), **spot}])
    assert without.max() > 0.01
    np.testing.assert_array_equal(without, with_ball)
    lid = shape(PLANE, (0.02, -0.01, 0.12), (0.2, 0.2, 0))
    without, with_ball = added([point((0.02, -0.01, 0.5))], proxies=(DESK, lid), camera=(0, 0, 0.1))
    np.testing.assert_array_equal(without, with_ball)


def test_another_ball_stands_in_the_way(device):
    """A ball right before the lamp takes its light from the first one; what it mirrors itself is its own."""
    middle, lamp = np.array(BALL["center"]), np.array(LAMP)
    screen = ball(tuple(middle + 0.35 * (lamp - middle)), 0.05, 0.0)
    without, with_ball = added([point(LAMP)], [BALL, screen])
    np.testing.assert_array_equal(without, with_ball)


def test_far_from_the_ball_nothing_changes(device):
    """Beyond ``REACH`` to the bit, and no step on the way: light fades."""
    small = ball((0.0, 0.0, 0.01), 0.01)
    line = np.stack([np.linspace(0.02, 0.2, 400), np.zeros(400), np.zeros(400)], -1)
    found = mirrorings(directional((1, 0, -1.0)), small, line)
    far = np.linalg.norm(line - small["center"], axis=-1) >= 1.00001 * REACH * small["radius"]
    assert far.any()
    assert not found["found"][far].any()
    assert found["spread"][~far][-5:].max() < 2e-4
    assert np.abs(np.diff(found["spread"])).max() < 0.2 * found["spread"].max()


@pytest.mark.parametrize(
    "light",
    [
        point((0.02, -0.01, 0.035)),
        point((0.02, -0.01, 0.0700001)),
        point((np.nan, 0, 1)),
        point((0, 0, 1e30)),
        directional((0, 0, 1.0)),
        {"kind": DIRECTIONAL, "direction": (np.nan,) * 3, "intensity": (1.0,) * 3},
        point(LAMP, (1e6,) * 3),
    ],
    ids=["middle", "skin", "nan", "far", "below", "nan_sun", "bright"],
)
def test_hard_lights_stay_finite(device, light):
    rng = np.random.default_rng(0)
    points = [*rng.uniform(-0.1, 0.1, (200, 3)), BALL["center"], (0.02, -0.01, 0.0), (0.02, -0.01, 0.07)]
    found = mirrorings(light, BALL, points)
    seen = found["found"].astype(bool)
    assert np.isfinite(found["spread"][seen]).all()
    assert ((found["spread"][seen] >= 0) & (found["spread"][seen] <= 1.0001)).all()


def test_what_is_thrown_lies_in_the_rectangle_that_is_asked(device):
    """The outline holds every point of the desk and of a box that light is found for."""
    scene = Scene(
        camera=Camera(64, 48, 60.0, 60.0, 31.5, 23.5),
        probes=(Ball(center=BALL["center"], radius=BALL["radius"]),),
        proxies=(Proxy("plane", size=(4.0, 4.0)), Proxy("box", at=(0.2, 0.0, 0.05), size=(0.1, 0.1, 0.1))),
        lights=(VirtualLight("spot", 1.0, at=LAMP, target=BALL["center"], outer_angle=3.0, inner_angle=2.0),),
    )
    host = HostScene(scene, "cpu")
    lit, thrown = host.light_outline(), host.light_outline(mirrored=True)
    assert thrown is host.light_outline(mirrored=True)
    assert len(thrown.polygons) > len(lit.polygons)
    desk = [part for part in thrown.polygons if np.ptp(part[:, 2]) < 1e-6 and abs(part[0, 2]) < 1e-6]
    corners = np.concatenate(desk)
    reach = REACH * BALL["radius"]
    assert corners[:, 0].min() <= BALL["center"][0] - 0.99 * reach
    assert corners[:, 0].max() >= BALL["center"][0] + 0.99 * reach
