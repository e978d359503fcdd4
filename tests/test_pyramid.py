import numpy as np
import pytest
import warp as wp

from tests.twins import pyramid as reference
from warp_ar.kernels.environment import pyramid
from warp_ar.kernels.latlong import direction_from_latlong, latlong_from_direction

# Float32: sums of a few texels per level, a dozen levels at most, relative to the largest value around.
ROUNDING = 3e-6
# Sizes of a level: square numbers, odd ones, single rows, columns and texels.
SIZES = [
    (64, 128),
    (8, 64),
    (7, 13),
    (33, 66),
    (1, 9),
    (9, 1),
    (1, 1),
]


@wp.kernel(enable_backward=False)
def sample_kernel(
    levels: wp.array[wp.vec3],
    level: wp.float32,
    height: wp.int32,
    width: wp.int32,
    coordinates: wp.array[wp.vec2],
    out: wp.array[wp.vec3],
):
    i = wp.tid()
    d = direction_from_latlong(coordinates[i][0], coordinates[i][1], height, width)
    at = latlong_from_direction(d, height, width)
    last = pyramid.last_mip(height, width)
    out[i] = pyramid.sample_mips(
        levels, at[0] / wp.float32(height), at[1] / wp.float32(width), level, last, height, width
    )


@wp.kernel(enable_backward=False)
def smooth_kernel(levels: wp.array[wp.vec3], height: wp.int32, coordinates: wp.array[wp.vec2], out: wp.array[wp.vec3]):
    i = wp.tid()
    out[i] = pyramid.sample_packed_smooth(levels, 0, height, 2 * height, coordinates[i][0], coordinates[i][1])


def build(radiance):
    height, width = radiance.shape[:2]
    levels = wp.full(pyramid.packed_texels(height, width), wp.vec3(np.nan), dtype=wp.vec3)
    environment = wp.array(radiance.astype(np.float32), dtype=wp.vec3)
    pyramid.build_pyramid(environment, levels)
    return levels


def unpack(levels, height, width):
    texels = levels.numpy()
    for level in range(pyramid.level_count(height, width)):
        size = pyramid.level_size(height, width, level)
        start = pyramid.level_offset(height, width, level)
        yield texels[start : start + size[0] * size[1]].reshape(*size, 3).astype(np.float64)


def sample(radiance, coordinates, level):
    out = wp.zeros(len(coordinates), dtype=wp.vec3)
    points = wp.array(np.asarray(coordinates, np.float32), dtype=wp.vec2)
    wp.launch(sample_kernel, len(coordinates), [build(radiance), float(level), *radiance.shape[:2], points], [out])
    return out.numpy()


@pytest.mark.parametrize("size", SIZES)
def test_a_constant_map_stays_constant(device, size):
    for level in unpack(build(np.full((*size, 3), (0.5, 2.0, 7.0))), *size):
        np.testing.assert_allclose(level, np.broadcast_to((0.5, 2.0, 7.0), level.shape), rtol=ROUNDING)


@pytest.mark.parametrize("size", SIZES)
def test_every_level_keeps_the_energy(device, size):
    # One-texel sun of 1e6 over 1e-4, in every place: atlas rows 6 and 18.
    for row in sorted({0, size[0] // 2, size[0] - 1}):
        radiance = np.full((*size, 3), 1e-4, np.float32).astype(np.float64)
        radiance[row, size[1] // 3] = 1e6
        whole = reference.energy(radiance)
        for level in unpack(build(radiance), *size):
            np.testing.assert_allclose(reference.energy(level), whole, rtol=1e-5)


def test_isotropic_footprints_are_as_wide_as_high(device):
    height = 64
    for row in (3, 9, 20, 32):
        radiance = np.zeros((height, 2 * height, 3))
        radiance[row, 60] = 1.0
        level = list(unpack(build(radiance), height, 2 * height))[3]  # texels of 8 x 8
        weight = level[row // 8, :, 0]
        sine = np.sin(np.pi * (row // 8 + 0.5) / 8)
        position = (np.arange(16) + 0.5) * np.pi / 8 - (60.5 * np.pi / 64)
        position = (position + np.pi) % (2 * np.pi) - np.pi
        spread = np.sqrt((weight * position**2).sum() / weight.sum() + (np.pi / 8) ** 2 / 12) * sine
        # A box as wide as a row is high has this spread; a bare texel's would be sin theta times it. Texels are
        # counted whole, and the sun is not in the middle of one: a quarter.
        assert spread == pytest.approx(np.pi / 8 / np.sqrt(12), rel=0.35)


@pytest.mark.parametrize("level", [0, 1, 2, 3])
def test_sampling_follows_a_ramp_without_a_shift(device, level):
    # A half-texel shift passes every furnace: theta itself as radiance, read at many latitudes.
    height, width = 32, 64
    theta = np.pi * (np.arange(height) + 0.5) / height
    radiance = np.repeat(np.repeat(theta[:, None, None], width, 1), 3, 2)
    rows = np.linspace(8, 24, 33)
    values = sample(radiance, np.stack([rows, np.full(33, 20.0)], 1), level)[:, 0]
    # The mean over a texel is weighted by sin theta: off by cot(theta) T^2 / 12 at the outermost texel's centre.
    texel = np.pi / (height >> level)
    bias = texel**2 / 12 / np.tan(np.pi / 4 - texel / 2)
    np.testing.assert_allclose(values, np.pi * rows / height, atol=bias + 1e-5)
    # And a ramp in longitude, away from the seam.
    radiance = np.broadcast_to(np.arange(width)[None, :, None] + 0.5, (height, width, 3))
    columns = np.linspace(12, 52, 41)
    values = sample(radiance, np.stack([np.full(41, 16.0), columns], 1), level)[:, 0]
    np.testing.assert_allclose(values, columns, atol=1e-4)


def test_smooth_sampling_reproduces_a_ramp_and_wraps(device):
    height, width = 8, 16
    radiance = np.broadcast_to(np.arange(height)[:, None, None] + 0.5, (height, width, 3)).astype(np.float32)
    levels = wp.array(np.ascontiguousarray(radiance).reshape(-1, 3), dtype=wp.vec3)
    rows = np.linspace(2, 6, 17)
    points = np.array([[r, c] for c in (0.0, 0.4, 8.0, 15.9) for r in rows], np.float32)
    out = wp.zeros(len(points), dtype=wp.vec3)
    wp.launch(smooth_kernel, len(points), [levels, height, wp.array(points, dtype=wp.vec2)], [out])
    np.testing.assert_allclose(out.numpy()[:, 0], points[:, 0], atol=1e-5)


@pytest.mark.parametrize(
    ("source", "target"), [((64, 128), (4, 8)), ((13, 26), (4, 8)), ((9, 20), (9, 20)), ((5, 7), (2, 3))]
)
def test_reducing_at_once_is_the_twin_s(device, source, target):
    radiance = np.random.default_rng(5).random((*source, 3)).astype(np.float32)
    out = wp.zeros(target, dtype=wp.vec3)
    pyramid.reduce_latlong(wp.array(radiance, dtype=wp.vec3), out, scale=2.0)
    np.testing.assert_allclose(
        out.numpy(), 2 * reference.reduce_latlong(radiance.astype(np.float64), *target), rtol=1e-5
    )
