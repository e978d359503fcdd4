import numpy as np
import pytest
import warp as wp

from tests.error_model import check_error
from tests.reference import key_lights as reference
from tests.reference import latlong
from warp_ar.kernels.environment import key_lights
from warp_ar.kernels.structs import KeyLight

# Float32 sums and exponentials, a few roundings each.
ROUNDING = 2e-6
# The same accumulated over the levels of a pyramid, or over a hundred frames.
SUMS = 2e-5
# Radians: directions are stepped along a row by rotation, 6e-8 a step over up to 64 texels, then averaged.
DIRECTION = 2e-4

SIZES = [(32, 64), (64, 128), (7, 14), (5, 9), (1, 2), (1, 7), (3, 1), (1, 1), (16, 33), (2, 4)]
# Degrees: the core of a lamp a few texels wide is a handful of whole texels of 2.8 degrees; its centroid errs by a
# quarter of one.
CORE_CENTROID = 0.7
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def lights_of(radiance, count=key_lights.KEY_LIGHT_COUNT):
    radiance = np.ascontiguousarray(radiance, np.float32)
    lights = wp.zeros(count, dtype=KeyLight)
    sums = wp.zeros(radiance.shape[0], dtype=wp.vec4)
    cells = wp.zeros(key_lights.SECTOR_SUMS, dtype=wp.vec4)
    key_lights.find_key_lights(wp.array(radiance, dtype=wp.vec3), sums, cells, lights)
    return lights.numpy()


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
    for light in lights_of(np.full((height, width, 3), value)):
        assert light["directionality"] == pytest.approx(0, abs=SUMS)
        assert np.linalg.norm(light["direction"]) == pytest.approx(1, abs=ROUNDING)
        np.testing.assert_allclose(light["irradiance"], 0, atol=SUMS * value * np.pi)


def test_an_empty_place_looks_up(device):
    assert (lights_of(np.zeros((16, 32, 3)))["direction"] == [0, 0, 1]).all()


@pytest.mark.parametrize("row", [0, 1, 20, 31, 32, 63])
@pytest.mark.parametrize("column", [0, 63, 127])
def test_a_single_sun(device, row, column):
    """Hard case 6: one texel of 1e6 over 1e-4, at the poles, the seam and elsewhere: all of it, exactly there."""
    surroundings = np.full((64, 128, 3), 1e-4)
    surroundings[row, column] = [1e6, 5e5, 2e5]
    light = lights_of(surroundings)[0]
    direction = latlong.directions(64, 128)[row, column]
    assert np.radians(angle(light["direction"], direction)) < DIRECTION
    assert light["directionality"] == pytest.approx(1, abs=1e-3)
    mean = reference.flow(surroundings)[1] / (4 * np.pi)
    expected = (
        latlong.solid_angles(64, 128)[row, column]
        * surroundings[row, column]
        * (1 - mean / (surroundings[row, column] @ LUMINANCE))
    )
    np.testing.assert_allclose(light["irradiance"], expected, rtol=1e-4)


@pytest.mark.parametrize("share", [0.1, 0.25, 0.4])
def test_a_lamp_in_a_uniform_environment_dominates_by_twice_its_share(device, share):
    lamp = cap(64, (0.3, -0.8, 0.5), 5)
    flow, total = reference.flow(lamp)
    surroundings = lamp + share_to_ambient(share, total)
    light = lights_of(surroundings)[0]
    assert angle(light["direction"], (0.3, -0.8, 0.5)) < CORE_CENTROID
    assert light["directionality"] == pytest.approx(2 * share * np.linalg.norm(flow) / total, abs=0.01)


def share_to_ambient(share, total):
    """Radiance of a uniform environment in which light with scalar irradiance ``total`` is a ``share`` of all."""
    return total * (1 - share) / share / (4 * np.pi)


@pytest.mark.parametrize("degrees", [3, 15, 30, 60, 90])
def test_windows_up_to_half_the_sky(device, degrees):
    """The centre of the window, wide as it may be; over a black rest it dominates."""
    axis = np.array([0.5, 0.6, 0.62])
    light = lights_of(cap(64, axis, degrees))[0]
    # What is inside of a wide lobe is cut by texels; a degree is a third of one.
    assert angle(light["direction"], axis) < 1.0
    assert light["directionality"] > 0.95


@pytest.mark.parametrize("ratio", [1.0, 0.98, 0.5, 0.1])
def test_two_opposite_lights(device, ratio):
    """Hard case 10: of equal strength, neither dominates; both are found."""
    a, b = np.array([0.8, 0.5, 0.3]), -np.array([0.8, 0.5, 0.3])
    lights = lights_of(cap(64, a, 8) + cap(64, b, 8, ratio))
    found = sorted(angle(light["direction"], a) for light in lights[:2])
    assert found[0] < 0.5
    assert found[1] > 179.5
    expected = min(1.0, 2 * (1 - ratio) / (1 + ratio)) * (1 - ratio)
    assert lights[0]["directionality"] == pytest.approx(expected, abs=0.02)
    if ratio < 1:
        assert angle(lights[0]["direction"], a) < 0.5
        assert lights[1]["directionality"] == pytest.approx(0, abs=1e-3)


def test_four_lights_brightest_first(device):
    axes = [(1, 0, 0.3), (-0.2, 1, 0.5), (-1, -0.4, 0.2), (0.1, -0.8, 0.9)]
    surroundings = sum(cap(64, axis, 6, value) for axis, value in zip(axes, (0.4, 0.9, 0.2, 0.6), strict=True)) + 0.01
    lights = lights_of(surroundings)
    assert [int(np.argmin([angle(light["direction"], axis) for axis in axes])) for light in lights] == [1, 3, 0, 2]
    for light in lights:
        assert min(angle(light["direction"], axis) for axis in axes) < CORE_CENTROID
    one = lights_of(surroundings, 1)[0]
    assert angle(one["direction"], axes[1]) < 0.5


def test_irradiance_is_that_of_a_facing_surface(device):
    """A cap of half angle a gives pi sin^2 a; above the mean of the environment, which the key light leaves to it."""
    for degrees in (5, 10, 18):
        surroundings = cap(64, (0.2, 0.9, 0.4), degrees)
        mean = reference.flow(surroundings)[1] / (4 * np.pi)
        light = lights_of(surroundings)[0]
        expected = np.pi * np.sin(np.radians(degrees)) ** 2 * (1 - mean)
        check_error("key_lights", light["irradiance"], np.broadcast_to(expected, 3))


def test_continuous_while_a_lamp_moves(device):
    """Around the environment, over the seam, past the pole: the found direction follows within a third of a texel,
    without a jump."""
    last = None
    for t in np.linspace(0, 2 * np.pi, 150):
        axis = np.array([np.cos(t), np.sin(t) * 0.4, np.sin(t) * 0.9])
        light = lights_of(cap(32, axis, 7) + 0.05)[0]
        assert angle(light["direction"], axis) < 2.0
        if last is not None:
            assert angle(light["direction"], last["direction"]) < 5.0
            assert abs(light["directionality"] - last["directionality"]) < 0.05
        last = light


@pytest.mark.parametrize("apart", [20, 40, 60, 90, 120, 180])
def test_handing_over_to_another_light_does_not_pop(device, apart):
    """While one lamp fades and another comes up, directionality times direction moves in small steps, and never points
    between them."""
    t = np.radians(apart)
    a, b = cap(32, (1, 0, 0.2), 7), cap(32, (np.cos(t), np.sin(t), 0.2), 7)
    last = None
    for share in np.linspace(0, 1, 81):
        light = lights_of((1 - share) * a + share * b + 0.02)[0]
        weighted = light["directionality"] * light["direction"]
        if apart > 40 and abs(share - 0.5) > 0.02:
            brighter = (1, 0, 0.2) if share < 0.5 else (np.cos(t), np.sin(t), 0.2)
            assert angle(light["direction"], brighter) < 2.0
        if last is not None:
            assert np.linalg.norm(weighted - last) < 0.2
        last = weighted


def test_noise_does_not_shake_a_broad_window(device):
    rng = np.random.default_rng(11)
    window = cap(64, (0.5, 0.6, 0.62), 60) + 0.05
    for _ in range(5):
        light = lights_of(window * rng.normal(1, 0.03, window.shape))[0]
        assert angle(light["direction"], (0.5, 0.6, 0.62)) < 4.0


def test_same_input_same_output(device):
    """Hard case 17."""
    surroundings = np.random.default_rng(12).random((64, 128, 3)) ** 8
    assert lights_of(surroundings).tobytes() == lights_of(surroundings).tobytes()


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_every_size_gives_finite_lights(device, height, width):
    surroundings = np.random.default_rng(13).random((height, width, 3)) ** 4
    for light in lights_of(surroundings):
        assert np.isfinite(light["direction"]).all()
        assert np.isfinite(light["irradiance"]).all()
        assert 0 <= light["directionality"] <= 1


def test_too_many_lights(device):
    with pytest.raises(ValueError, match="expected 1 to 4"):
        lights_of(np.ones((4, 8, 3)), 5)
