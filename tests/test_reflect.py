"""Where the camera's picture shows a point of the desk, and where it does not; near lamps in the environment."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import warp as wp

from tests.kernel_rig import records, shape
from tests.relight_rig import H, W
from warp_ar.kernels.environment.lobes import lobe_texels
from warp_ar.kernels.objects.reflect import (
    DistantLight,
    DistantLightConfig,
    make_distant_irradiance,
    make_find_in_frame,
    make_reflected_radiance,
)
from warp_ar.kernels.rays.trace import TraceConfig
from warp_ar.kernels.structs import (
    BOX,
    LAMBERT,
    MIRROR,
    PLANE,
    Emitter,
    FrameParams,
    Hit,
    Picture,
    Probe,
    RayScene,
    Shape,
    make_picture,
)

FOCAL = 60.0
UP, DOWN = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
# Pixels: a position is projected through a dozen roundings of 1e-7 of the frame's width.
FLOAT = 1e-4


@functools.cache
def make_find_kernel():
    find_in_frame = make_find_in_frame(TraceConfig((), (PLANE, BOX)))

    @wp.kernel(module="unique", enable_backward=False)
    def find_kernel(
        # In:
        params: wp.array[FrameParams],
        picture: Picture,
        scene: RayScene,
        balls: wp.array[Probe],
        points: wp.array[wp.vec3],
        normals: wp.array[wp.vec3],
        # Out:
        found_out: wp.array[wp.vec2],
    ):
        i = wp.tid()
        hit = Hit()
        hit.point = points[i]
        hit.geometric_normal = normals[i]
        found_out[i] = find_in_frame(params[0], picture, scene, balls, hit)

    return find_kernel


def find(points, normals, scale=1.0, shift=(0.0, 0.0, 0.0), proxies=(), ball=None):
    """Pixels of points for a camera ``scale`` above the desk that looks straight down; x = -1 where not seen."""
    shift = np.asarray(shift, float)
    desk = shape(PLANE, shift, scale * np.array([5.0, 5.0, 0.0]))
    scene = RayScene()
    scene.objects = wp.zeros(0, Shape)
    scene.proxies = records(
        Shape, desk, *(shape(BOX, scale * np.array(at) + shift, scale * np.array(half)) for at, half in proxies)
    )
    camera = records(
        FrameParams,
        {
            "camera_position": np.add(shift, (0.0, 0.0, scale)),
            "world_from_camera": np.diag([1.0, -1.0, -1.0]),
            "focal": (FOCAL, FOCAL),
            "principal": ((W - 1) / 2, (H - 1) / 2),
        },
    )
    balls = [] if ball is None else [{"center": scale * np.array(ball[0]) + shift, "radius": scale * ball[1]}]
    out = wp.zeros(len(points), wp.vec2)
    wp.launch(
        make_find_kernel(),
        dim=len(points),
        inputs=[
            camera,
            make_picture(wp.zeros((H, W), wp.vec3ub), None, None),
            scene,
            records(Probe, *balls),
            wp.array((scale * np.array(points) + shift).astype(np.float32), dtype=wp.vec3),
            wp.array(np.array(normals, np.float32), dtype=wp.vec3),
        ],
        outputs=[out],
    )
    return out.numpy()


@pytest.mark.parametrize(
    ("scale", "shift"),
    [(1.0, (0, 0, 0)), (1e-3, (0, 0, 0)), (1e3, (0, 0, 0)), (30.0, (600.0, -800.0, 0.0))],
    ids=["1 m", "1 mm", "1 km", "1 km away"],
)
def test_points_of_the_desk_are_where_they_project_at_any_scale(device, scale, shift):
    """The desk itself is in the way of no point that lies on it."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.5, 0.5, 200), rng.uniform(-0.38, 0.38, 200), np.zeros(200)])
    found = find(points, [UP] * 200, scale, shift)
    expected = np.array([(W - 1) / 2, (H - 1) / 2]) + FOCAL * points[:, :2] * (1, -1)
    # A kilometre away a point of float32 is known to 6e-5 m, of 30 m.
    np.testing.assert_allclose(found, expected, atol=FLOAT if shift == (0, 0, 0) else 1e-3)


def test_a_face_turned_away_is_not_in_the_picture(device):
    along = [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0)]  # seen edge-on from above the point, exactly
    found = find([(0.0, 0.0, 0.0)] * 4, [DOWN, *along, UP])
    assert (found[:3, 0] == -1).all()
    assert found[3] == pytest.approx([(W - 1) / 2, (H - 1) / 2], abs=FLOAT)


def test_what_a_proxy_hides_is_not_in_the_picture(device):
    """A box floats above the desk's middle: it hides what is below it, and is seen itself from above."""
    box = ((0.0, 0.0, 0.5), (0.1, 0.1, 0.05))
    points = [(0.0, 0.0, 0.0), (0.15, 0.1, 0.0), (0.3, 0.0, 0.0), (0.0, 0.0, 0.55), (0.0, 0.0, 0.45)]
    found = find(points, [UP, UP, UP, UP, DOWN], proxies=[box])
    assert (found[:, 0] >= 0).tolist() == [False, False, True, True, False]
    assert (find(points[:3], [UP] * 3)[:, 0] >= 0).all(), "without the box nothing is hidden"


def test_what_a_ball_hides_is_not_in_the_picture(device):
    points = [(0.0, 0.0, 0.0), (0.35, 0.0, 0.0)]
    assert (find(points, [UP] * 2, ball=((0.0, 0.0, 0.5), 0.1))[:, 0] >= 0).tolist() == [False, True]


def test_outside_the_picture_and_behind_the_camera(device):
    half = 0.5 * (W - 1) / FOCAL
    points = [(half - 1e-3, 0.0, 0.0), (half + 1e-3, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 2.0), (0.0, 0.0, 1.0)]
    found = find(points, [UP, UP, UP, DOWN, UP])
    assert (found[:, 0] >= 0).tolist() == [True, False, False, False, False]
    assert np.isfinite(found).all()


LAMP_AT = np.array([0.3, 0.2, 0.5])
LEVEL_HEIGHT = 16


@functools.cache
def make_environment_kernel(lamps):
    config = DistantLightConfig(TraceConfig((), ()), (LAMBERT, MIRROR), False, "sh", True, False, lamps)
    mirrored, irradiance = make_reflected_radiance(config), make_distant_irradiance(config)

    @wp.kernel(module="unique", enable_backward=False)
    def environment_kernel(
        # In:
        surroundings: DistantLight,
        point: wp.vec3,
        direction: wp.vec3,
        # Out:
        shown_out: wp.array[wp.vec3],
    ):
        shown_out[0] = mirrored(surroundings, wp.static(MIRROR), 0.0, 0.0, point, direction, 0.0)
        shown_out[1] = irradiance(surroundings, point, direction)

    return environment_kernel


def test_near_lamps_are_mirrored_and_light_from_where_they_are(device):
    """A lamp of a texel in a dim environment: seen from the ball in one direction, from beside it in another."""
    direction = LAMP_AT / np.linalg.norm(LAMP_AT)
    distance = float(np.linalg.norm(LAMP_AT))
    power = 0.7
    row = int(np.arccos(direction[2]) / np.pi * LEVEL_HEIGHT)
    column = int((np.arctan2(direction[1], direction[0]) / np.pi + 1.0) * LEVEL_HEIGHT)
    level = np.full((LEVEL_HEIGHT, 2 * LEVEL_HEIGHT, 3), 0.1, np.float32)
    level[row, column] = 9.0
    packed = np.full((lobe_texels(LEVEL_HEIGHT), 3), 0.1, np.float32)
    packed[: 2 * LEVEL_HEIGHT**2] = level.reshape(-1, 3)
    surroundings = DistantLight()
    surroundings.irradiance_sh = wp.zeros(9, wp.vec3)  # of which more than there is cannot be taken
    surroundings.levels, surroundings.level_height = wp.array(packed, dtype=wp.vec3), LEVEL_HEIGHT
    lamp = {"direction": direction, "distance": distance, "power": 3 * [power]}
    surroundings.emitters = records(Emitter, lamp)
    aside = np.array([0.25, 0.2, 0.0])
    there = (LAMP_AT - aside) / np.linalg.norm(LAMP_AT - aside)

    def shown(lamps, point, toward):
        out = wp.zeros(2, wp.vec3)
        wp.launch(
            make_environment_kernel(lamps),
            dim=1,
            inputs=[surroundings, wp.vec3(*point), wp.vec3(*toward)],
            outputs=[out],
        )
        return out.numpy()[:, 0]

    for known in (False, True):
        assert shown(known, (0.0, 0.0, 0.0), direction)[0] > 1.0
    # The middle of the texel that holds the lamp is up to half its diagonal away: a quarter of it is the least.
    assert shown(False, aside, there)[0] == pytest.approx(0.1, abs=1e-5)
    assert shown(True, aside, there)[0] == pytest.approx(shown(True, (0.0, 0.0, 0.0), direction)[0], rel=1e-3)
    assert shown(True, aside, direction)[0] == pytest.approx(0.1, abs=1e-5)
    gain = (distance / np.linalg.norm(LAMP_AT - aside)) ** 2 - direction @ there
    assert shown(False, aside, there)[1] == 0.0
    assert shown(True, aside, there)[1] == pytest.approx(power * gain, rel=1e-4)
