"""Virtual lights: closed forms, the ends of their ranges, and shadows."""

from __future__ import annotations

import math

import numpy as np
import pytest
import warp as wp

from tests.kernel_rig import records, shape
from tests.test_visibility import GENERAL, World
from warp_ar.kernels.rays.shadow import (
    MIN_DISTANCE,
    SOFT_RAYS,
    LightSample,
    make_sample_light,
    make_shadow,
    make_visible_share,
    sample_light,
)
from warp_ar.kernels.structs import BOX, DIRECTIONAL, POINT, SPOT, Light, RayScene, Shape

# A dozen float32 roundings; a spot's fall divides the angle's rounding (1e-7) by the width of its rim.
TOLERANCE = 2e-6

sample_spot = make_sample_light((SPOT,))
is_lit = make_shadow(GENERAL)


@wp.kernel(enable_backward=False, module="unique")
def sample_kernel(
    # In:
    lights: wp.array[Light],
    points: wp.array[wp.vec3],
    # Out:
    samples_out: wp.array[LightSample],
    spots_out: wp.array[LightSample],
):
    i = wp.tid()
    samples_out[i] = sample_light(lights[0], points[i])
    spots_out[i] = sample_spot(lights[0], points[i])


@wp.kernel(enable_backward=False, module="unique")
def lit_kernel(
    # In:
    scene: RayScene,
    lights: wp.array[Light],
    points: wp.array[wp.vec3],
    normal: wp.vec3,
    error: wp.float32,
    # Out:
    lit_out: wp.array[wp.int32],
):
    i = wp.tid()
    lit_out[i] = wp.where(is_lit(scene, points[i], normal, error, sample_light(lights[0], points[i])), 1, 0)


def light(**fields):
    values = {"kind": POINT, "direction": (0, 0, -1), "intensity": 1.0, "attenuation": (0, 0, 1), **fields}
    return records(Light, values)


def samples(record, points, device):
    points = np.asarray(points, np.float32)
    outputs = [wp.zeros(len(points), dtype=LightSample, device=device) for _ in range(2)]
    inputs = [record.to(device), wp.array(points, dtype=wp.vec3, device=device)]
    wp.launch(sample_kernel, dim=len(points), inputs=inputs, outputs=outputs, device=device)
    return [output.numpy() for output in outputs]


def test_point_light(device):
    """I / d^2 on a surface that faces it; attenuation's three terms."""
    points = [(1, 0, 0), (0, 2, 0), (0, 0, -0.5)]
    result, _ = samples(light(intensity=(1, 2, 3), position=(0, 0, 0)), points, device)
    np.testing.assert_allclose(result["irradiance_normal"], np.outer([1, 0.25, 4], [1, 2, 3]), rtol=TOLERANCE)
    np.testing.assert_allclose(result["distance"], [1, 2, 0.5], rtol=TOLERANCE)
    np.testing.assert_allclose(result["wi"], [(-1, 0, 0), (0, -1, 0), (0, 0, 1)], atol=TOLERANCE)
    result, _ = samples(light(attenuation=(1, 2, 3)), points, device)
    np.testing.assert_allclose(result["irradiance_normal"][:, 0], [1 / 6, 1 / 17, 1 / 2.75], rtol=TOLERANCE)


def test_directional_light(device):
    """The same everywhere, from infinitely far."""
    record = light(kind=DIRECTIONAL, direction=(0.6, 0, -0.8), intensity=(1, 2, 3), position=(9, 9, 9))
    result, _ = samples(record, [(0, 0, 0), (1e3, -1e3, 5)], device)
    np.testing.assert_allclose(result["irradiance_normal"], [(1, 2, 3)] * 2)
    np.testing.assert_allclose(result["wi"], [(-0.6, 0, 0.8)] * 2, atol=TOLERANCE)
    assert (result["distance"] > 1e30).all()


def test_spot_light_falls_linearly_in_angle(device):
    """Full to the inner angle, zero from the outer, linear between; the specialised function agrees bit for bit."""
    angles = np.radians([0, 10, 19.99, 20, 23, 26, 29, 32, 32.01, 60, 90, 120, 180])
    points = np.stack([np.sin(angles), 0 * angles, -np.cos(angles)], -1)
    record = light(kind=SPOT, inner_angle=math.radians(20), outer_angle=math.radians(32))
    result, special = samples(record, points, device)
    expected = np.clip((32 - np.degrees(angles)) / 12, 0, 1)
    np.testing.assert_allclose(result["irradiance_normal"][:, 0], expected, atol=TOLERANCE)
    for field in ("wi", "distance", "irradiance_normal"):
        np.testing.assert_array_equal(special[field], result[field])


@pytest.mark.parametrize(
    ("inner", "outer", "expected"),
    [
        (0, 0, [1, 0, 0, 0]),  # a line
        (30, 30, [1, 1, 0, 0]),  # a step
        (90, 90, [1, 1, 1, 0]),  # a half space
        (0, 90, [1, 1 - 20 / 90, 1 - 40 / 90, 0]),
    ],
)
def test_cone_angles_at_their_ends(device, inner, outer, expected):
    """0, 90 and inner = outer give what their limits say, never NaN."""
    angles = np.radians([0, 20, 40, 91])
    points = np.stack([np.sin(angles), 0 * angles, -np.cos(angles)], -1)
    record = light(kind=SPOT, inner_angle=math.radians(inner), outer_angle=math.radians(outer))
    result, _ = samples(record, points, device)
    np.testing.assert_allclose(result["irradiance_normal"][:, 0], expected, atol=TOLERANCE)


@pytest.mark.parametrize("kind", [POINT, SPOT])
@pytest.mark.parametrize("radius", [0.0, 0.02])
def test_at_the_light_itself(device, kind, radius):
    """Distance 0 and next to it: finite, no more than at MIN_DISTANCE or the emitter's surface; colour 0 is dark."""
    record = light(kind=kind, intensity=(1e6, 1.0, 0.0), outer_angle=1.0, inner_angle=1.0, radius=radius)
    result, _ = samples(record, [(0, 0, 0), (0, 0, -1e-30), (0, 0, -1e-6), (0, 0, -0.01)], device)
    limit = 1 / max(radius, float(MIN_DISTANCE)) ** 2
    assert all(np.isfinite(result[field]).all() for field in ("wi", "distance", "irradiance_normal"))
    np.testing.assert_allclose(result["irradiance_normal"][:3, 1], limit, rtol=1e-5)
    np.testing.assert_allclose(result["irradiance_normal"][3, 1], min(limit, 1e4), rtol=1e-5)
    np.testing.assert_array_equal(result["irradiance_normal"][:, 2], 0.0)
    np.testing.assert_allclose(np.linalg.norm(result["wi"], axis=-1), 1.0, atol=1e-5)


def lit(scene, record, points, device, *, error=1e-6):
    points = np.asarray(points, np.float32)
    result = wp.zeros(len(points), dtype=wp.int32, device=device)
    inputs = [scene, record.to(device), wp.array(points, dtype=wp.vec3, device=device)]
    normal = wp.vec3(0.0, 0.0, 1.0)
    wp.launch(lit_kernel, dim=len(points), inputs=[*inputs, normal, error], outputs=[result], device=device)
    return result.numpy().tolist()


@pytest.mark.parametrize("proxies", [False, True])
def test_shadow_of_a_sphere(device, proxies):
    """The shadow of a ball under a point light ends where the tangent cone meets the ground."""
    scene = World(device).add("sphere", extent=(0.1, 0.1, 0.1), at=(0, 0, 1)).scene(proxies=proxies)
    edge = 2 * math.tan(math.asin(0.1))
    points = [(0, 0, 0), (0.999 * edge, 0, 0), (1.001 * edge, 0, 0), (0, 0, 1.5)]
    assert lit(scene, light(position=(0, 0, 2)), points, device) == [0, 0, 1, 1]
    # A directional light along -z: the shadow is as wide as the ball.
    points = [(0.0999, 0, 0), (0.1001, 0, 0), (0, 0, 1.2)]
    assert lit(scene, light(kind=DIRECTIONAL, direction=(0, 0, -1)), points, device) == [0, 1, 1]
    # Between the light and the point, not behind the light.
    assert lit(scene, light(position=(0, 0, 0.5)), [(0, 0, 0)], device) == [1]


# --- Sized lights -----------------------------------------------------------------------------------------------------


SHARE = make_visible_share(GENERAL)


@wp.kernel(enable_backward=False)
def share_kernel(
    scene: RayScene,
    lights: wp.array[Light],
    points: wp.array[wp.vec3],
    turn: wp.float32,
    share_out: wp.array[wp.float32],
):
    i = wp.tid()
    light = lights[0]
    share_out[i] = SHARE(scene, points[i], wp.vec3(0.0, 0.0, 1.0), 1.0e-6, light, sample_light(light, points[i]), turn)


def shares(points, radius, shapes=(), position=(0.0, 0.0, 1.0), turn=0.0):
    scene = RayScene()
    scene.objects, scene.proxies = records(Shape, *(shape(*each) for each in shapes)), wp.zeros(0, dtype=Shape)
    where = wp.array(np.asarray(points, np.float32), dtype=wp.vec3)
    out = wp.zeros(len(points), wp.float32)
    wp.launch(
        share_kernel,
        dim=len(points),
        inputs=[scene, light(position=position, radius=radius), where, turn],
        outputs=[out],
    )
    return out.numpy()


# An edge may cut one ray of the sunflower more or less than the area says, at a few places of its way across.
SUNFLOWER = 2.5 / SOFT_RAYS


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_half_plane_hides_the_area_that_it_covers(device, turn):
    # A wall half way up, over x > 0: seen from (x, 0, 0) its edge crosses the light's disk at 2 * 0 - x.
    radius = 0.1
    x = np.linspace(-0.14, 0.14, 57)
    got = shares(np.stack([x, 0 * x, 0 * x], -1), radius, [(BOX, (5, 0, 0.5), (5, 5, 1e-4))], turn=turn)
    edge = np.clip(-x / radius, -1, 1)  # the part of the disk below this is seen
    expected = 1 - (np.arccos(edge) - edge * np.sqrt(1 - edge**2)) / np.pi
    np.testing.assert_allclose(got, expected, atol=SUNFLOWER)
    assert got[0] == 1
    assert got[-1] == 0


def test_light_at_the_horizon_is_half_set(device):
    got = shares([(0, 0, 0)], 0.1, position=(1.0, 0.0, 0.0))
    assert got[0] == pytest.approx(0.5, abs=SUNFLOWER)
