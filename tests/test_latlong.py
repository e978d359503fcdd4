import numpy as np
import pytest
import warp as wp

from tests.twins import latlong as reference
from warp_ar.kernels import latlong

# A float32 angle of up to pi has an error of 1e-7; sine, cosine and arc tangent add as much each.
ANGLE = 1e-6
# The same in texels, for maps of up to 128 columns.
TEXEL = 128 * ANGLE

SIZES = [(64, 128), (7, 14), (5, 9), (1, 2), (1, 7), (3, 1), (16, 33)]


@wp.kernel(enable_backward=False)
def direction_kernel(height: wp.int32, width: wp.int32, at: wp.array[wp.vec2], direction_out: wp.array[wp.vec3]):
    i = wp.tid()
    direction_out[i] = latlong.direction_from_latlong(at[i][0], at[i][1], height, width)


@wp.kernel(enable_backward=False)
def coordinates_kernel(height: wp.int32, width: wp.int32, direction: wp.array[wp.vec3], at_out: wp.array[wp.vec2]):
    i = wp.tid()
    at_out[i] = latlong.latlong_from_direction(direction[i], height, width)


@wp.kernel(enable_backward=False)
def solid_angle_kernel(area_out: wp.array2d[wp.float32]):
    i, j = wp.tid()
    area_out[i, j] = latlong.texel_solid_angle(i, area_out.shape[0], area_out.shape[1])


@wp.kernel(enable_backward=False)
def sample_kernel(radiance: wp.array2d[wp.vec3], direction: wp.array[wp.vec3], value_out: wp.array[wp.vec3]):
    i = wp.tid()
    value_out[i] = latlong.sample_latlong(radiance, direction[i])


def run(kernel, scalars, values, dtype, out_dtype):
    values = wp.array(np.ascontiguousarray(values), dtype=dtype)
    out = wp.zeros(len(values), dtype=out_dtype)
    wp.launch(kernel, len(values), [*scalars, values], [out])
    return out.numpy()


def sample(radiance, directions):
    image = wp.array(np.ascontiguousarray(radiance, np.float32), dtype=wp.vec3)
    return run(sample_kernel, [image], np.asarray(directions, np.float32), wp.vec3, wp.vec3)


def random_directions(count, seed=1):
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_conventions(device):
    """Row 0 looks up, the centre column along +x, columns grow toward +y."""
    at = np.array([[0, 3], [32, 64], [32, 96], [32, 32], [32, 0], [64, 9]], np.float32)
    expected = [[0, 0, 1], [1, 0, 0], [0, 1, 0], [0, -1, 0], [-1, 0, 0], [0, 0, -1]]
    got = run(direction_kernel, [64, 128], at, wp.vec2, wp.vec3)
    np.testing.assert_allclose(got, expected, atol=ANGLE)


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_directions_match_twin_and_return(device, height, width):
    rng = np.random.default_rng(2)
    at = rng.uniform([0.02 * height, 0.02 * width], [0.98 * height, 0.98 * width], (500, 2)).astype(np.float32)
    got = run(direction_kernel, [height, width], at, wp.vec2, wp.vec3)
    expected = reference.directions(height, width, at[:, 0].astype(float), at[:, 1].astype(float))
    np.testing.assert_allclose(got, expected, atol=ANGLE)
    back = run(coordinates_kernel, [height, width], got, wp.vec3, wp.vec2)
    # Near the poles (here 0.02 pi away) a column's error is that of the direction over its sine.
    np.testing.assert_allclose(back, at, atol=TEXEL / 0.06)


def test_coordinates_of_poles_and_of_more_than_unit_length(device):
    """Hard case 5: z of 1 + ulp, normals exactly along z, no direction at all."""
    one_up = np.nextafter(np.float32(1), np.float32(2))
    d = np.array(
        [[0, 0, 1], [0, 0, -1], [0, 0, one_up], [1e-20, 0, -one_up], [0, 0, 0], [-1, 0, 0], [-1, -0.0, 0]], np.float32
    )
    at = run(coordinates_kernel, [64, 128], d, wp.vec3, wp.vec2)
    assert np.isfinite(at).all()
    np.testing.assert_allclose(at[:4, 0], [0, 64, 0, 64], atol=TEXEL)
    np.testing.assert_allclose(at[5:, 0], 32, atol=TEXEL)
    assert set(np.round(at[5:, 1]).tolist()) <= {0.0, 128.0}
    # A hundredth of a milliradian from a pole, where the cosine is 1: atan2's own rounding, no more.
    beside = run(coordinates_kernel, [64, 128], np.array([[1e-5, 0, 1], [0, 3e-5, 1]], np.float32), wp.vec3, wp.vec2)
    np.testing.assert_allclose(beside[:, 0], 64 / np.pi * np.array([1e-5, 3e-5]), rtol=1e-6)


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_solid_angles(device, height, width):
    area = wp.zeros((height, width), dtype=wp.float32)
    wp.launch(solid_angle_kernel, area.shape, [], [area])
    np.testing.assert_allclose(area.numpy(), reference.solid_angles(height, width), rtol=1e-5)
    assert area.numpy().astype(np.float64).sum() == pytest.approx(4 * np.pi, rel=1e-6)


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_a_constant_map_samples_to_the_bit(device, height, width):
    value = np.float32([0.1, 1.7e-5, 12345.678])
    got = sample(np.broadcast_to(value, (height, width, 3)), random_directions(2000))
    assert (got == value).all()


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_samples_match_twin(device, height, width):
    radiance = np.random.default_rng(3).uniform(0, 1, (height, width, 3))
    d = np.concatenate([random_directions(2000), [[0, 0, 1], [0, 0, -1], [-1, 0, 0], [-1, 1e-7, 0], [-1, -1e-7, 0]]])
    d = d.astype(np.float32)
    np.testing.assert_allclose(sample(radiance, d), reference.sample_latlong(radiance, d), atol=2 * TEXEL)


def test_ramp_has_no_shift(device):
    """A map of its own directions gives every direction back: a half-texel shift would be off by 0.012."""
    height, width = 128, 256
    d = random_directions(5000)
    got = sample(reference.directions(height, width), d)
    # Bilinear interpolation of a sphere errs by (pi / 128)^2 / 8 per axis.
    np.testing.assert_allclose(got, d, atol=2.5 * (np.pi / height) ** 2 / 8)
