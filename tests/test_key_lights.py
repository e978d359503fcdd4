import numpy as np
import pytest
import warp as wp

from tests.error_model import check_error
from tests.reference import key_lights as reference
from tests.reference import latlong
from warp_ar.kernels.environment import key_lights
from warp_ar.kernels.structs import KeyLight

# Float32 sums over the texels of a map, relative to the sum of their sizes.
SUMS = 2e-5
# Radians: the same where all texels pull one way.
DIRECTION = 2e-4

SIZES = [(32, 64), (64, 128), (7, 14), (5, 9), (1, 2), (1, 7), (3, 1), (1, 1), (16, 33), (2, 4)]


def light_of(radiance):
    radiance = np.ascontiguousarray(radiance, np.float32)
    lights = wp.zeros(1, dtype=KeyLight)
    key_lights.find_key_light(wp.array(radiance, dtype=wp.vec3), wp.zeros(len(radiance), dtype=wp.vec4), lights)
    return lights.numpy()[0]


def cap(height, axis, degrees, value=1.0):
    """Light of ``value`` within ``degrees`` of an axis, anti-aliased by 4 x 4 samples."""
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    rows, columns = np.meshgrid((np.arange(4 * height) + 0.5) / 4, (np.arange(8 * height) + 0.5) / 4, indexing="ij")
    inside = latlong.directions(height, 2 * height, rows, columns) @ axis > np.cos(np.radians(degrees))
    share = inside.reshape(height, 4, 2 * height, 4).mean((1, 3))
    return value * np.repeat(share[..., None], 3, -1)


def angle(a, b):
    b = np.asarray(b, float) / np.linalg.norm(b)
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), np.dot(a, b)))


@pytest.mark.parametrize("value", [0.0, 1e-6, 0.7, 1e4])
@pytest.mark.parametrize(("height", "width"), [(64, 128), (32, 64), (5, 9), (1, 2)])
def test_a_uniform_environment_has_no_key_light(device, value, height, width):
    """Hard case 10: no dominant direction at all."""
    light = light_of(np.full((height, width, 3), value))
    assert light["directionality"] == pytest.approx(0, abs=SUMS)
    assert np.linalg.norm(light["direction"]) == pytest.approx(1, abs=SUMS)


def test_without_light_it_looks_up(device):
    assert (light_of(np.zeros((16, 32, 3)))["direction"] == [0, 0, 1]).all()


@pytest.mark.parametrize("row", [0, 1, 20, 31, 32, 63])
@pytest.mark.parametrize("column", [0, 63, 127])
def test_a_single_sun(device, row, column):
    """Hard case 6: one texel of 1e6 over 1e-4, at the poles, the seam and elsewhere: exactly there."""
    surroundings = np.full((64, 128, 3), 1e-4)
    surroundings[row, column] = [1e6, 5e5, 2e5]
    light = light_of(surroundings)
    assert np.radians(angle(light["direction"], latlong.directions(64, 128)[row, column])) < DIRECTION
    assert light["directionality"] == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("share", [0.1, 0.25, 0.4])
def test_a_lamp_in_a_uniform_environment_dominates_by_twice_its_share(device, share):
    lamp = cap(64, (0.3, -0.8, 0.5), 5)
    flow, total = reference.flow(lamp)
    light = light_of(lamp + total * (1 - share) / share / (4 * np.pi))
    assert np.radians(angle(light["direction"], flow)) < DIRECTION
    assert light["directionality"] == pytest.approx(2 * share * np.linalg.norm(flow) / total, abs=1e-3)


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_agrees_with_the_twin(device, height, width):
    surroundings = np.random.default_rng(13).random((height, width, 3)) ** 4
    light = light_of(surroundings)
    flow, total = reference.flow(surroundings)
    length = np.linalg.norm(flow)
    assert light["directionality"] == pytest.approx(min(2 * length / total, 1.0), abs=SUMS)
    np.testing.assert_allclose(light["direction"] * length, flow, atol=SUMS * total)
    check_error("key_lights", light["direction"] * length / total, flow / total)


@pytest.mark.parametrize("ratio", [1.0, 0.98, 0.5, 0.1])
def test_two_opposite_lights(device, ratio):
    """Hard case 10: of equal strength, neither dominates."""
    a = np.array([0.8, 0.5, 0.3])
    light = light_of(cap(64, a, 8) + cap(64, -a, 8, ratio))
    # The caps' texels are not quite opposite.
    assert light["directionality"] == pytest.approx(min(1.0, 2 * (1 - ratio) / (1 + ratio)), abs=0.02)
    if ratio < 0.9:
        assert angle(light["direction"], a) < 0.5


@pytest.mark.parametrize("apart", [20, 60, 120, 180])
def test_handing_over_to_another_light_does_not_jump(device, apart):
    """While one lamp fades and another comes up, directionality times direction moves in small steps."""
    t = np.radians(apart)
    a, b = cap(32, (1, 0, 0.2), 7), cap(32, (np.cos(t), np.sin(t), 0.2), 7)
    steps = []
    for share in np.linspace(0, 1, 81):
        light = light_of((1 - share) * a + share * b + 0.02)
        steps.append(light["directionality"] * light["direction"])
    assert np.linalg.norm(np.diff(steps, axis=0), axis=1).max() < 0.05


def test_same_input_same_output(device):
    """Hard case 17."""
    surroundings = np.random.default_rng(12).random((64, 128, 3)) ** 8
    assert light_of(surroundings).tobytes() == light_of(surroundings).tobytes()
