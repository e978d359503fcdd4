import numpy as np
import pytest
import warp as wp

from tests.error_model import check_error
from tests.reference import fill as reference
from tests.reference import latlong
from warp_ar.kernels.environment import fill

# Float32 sums and exponentials, a few roundings each.
ROUNDING = 2e-6
# The same accumulated over the levels of a pyramid, or over a hundred frames.
SUMS = 2e-5

SIZES = [(32, 64), (64, 128), (7, 14), (5, 9), (1, 2), (1, 7), (3, 1), (1, 1), (16, 33), (2, 4)]


def filled(radiance, confidence, **options):
    height, width = np.shape(confidence)
    levels = wp.zeros(fill.fill_level_offsets(height, width)[-1], dtype=wp.vec4)
    out = wp.full((height, width), wp.vec3(-1.0), dtype=wp.vec3)
    radiance = wp.array(np.ascontiguousarray(radiance, np.float32), dtype=wp.vec3)
    fill.seed_fill(radiance, wp.array(np.ascontiguousarray(confidence, np.float32), dtype=wp.float32), levels)
    fill.push_pull(levels, height, width, **options)
    fill.finish_fill(levels, out)
    return out.numpy()


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_a_constant_environment_stays_constant_under_any_mask(device, height, width):
    """Hard case 18, to the bit; what is masked out holds garbage."""
    rng = np.random.default_rng(4)
    surroundings = np.float32([0.1, 7.3, 1.2e-5])
    one = np.zeros((height, width))
    one[height // 2, width - 1] = 0.001
    masks = [one, rng.random((height, width)), (rng.random((height, width)) > 0.9) * 1.0, np.ones((height, width))]
    masks[2][0, 0] = 1.0
    for mask in masks:
        radiance = np.where(mask[..., None] > 0, surroundings, np.float32(1e6))
        radiance[(mask == 0) & (rng.random((height, width)) < 0.3)] = np.nan
        assert (filled(radiance, mask) == surroundings).all()


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_fill_matches_twin(device, height, width):
    rng = np.random.default_rng(5)
    radiance = np.float32(rng.uniform(0, 2, (height, width, 3)))
    confidence = np.float32(rng.random((height, width)) * (rng.random((height, width)) > 0.5))
    expected = reference.fill(radiance.astype(float), confidence.astype(float))
    check_error("fill", filled(radiance, confidence), expected)


@pytest.mark.parametrize(("height", "width"), [(32, 64), (128, 256)])
def test_no_share_of_an_emitter_is_spread_over_what_is_unseen(device, height, width):
    """The emitter stays; beside it the unseen gets what it would if the emitter were as bright as ``most``."""
    confidence = np.ones((height, width))
    confidence[: height // 2, : width // 2] = 0.0
    dim = np.full((height, width, 3), 0.3)
    dim[height // 2 + 1, width // 4] = 2.0
    lit = np.where(dim > 1.0, [900.0, 4000.0, 2.0], dim)
    known = confidence > 0.0
    out = filled(lit, confidence, most=2.0)
    assert (out[known] == np.float32(lit[known])).all()
    assert (out[~known] == filled(dim, confidence)[~known]).all()
    assert filled(lit, confidence)[~known].max() > 2.0, "without a bound it would be spread"


def test_confident_texels_are_kept_as_they_are(device):
    rng = np.random.default_rng(6)
    radiance = np.float32(rng.uniform(0, 1e5, (32, 64, 3)))
    confidence = rng.uniform(0.5, 1, (32, 64))
    confidence[10:14, 20:30] = 0
    out = filled(radiance, confidence)
    assert (out[confidence > 0] == radiance[confidence > 0]).all()


def test_nothing_known_is_no_light(device):
    assert (filled(np.full((16, 32, 3), 5.0), np.zeros((16, 32))) == 0).all()
    assert (filled(np.full((16, 32, 3), np.nan), np.ones((16, 32))) == 0).all()


@pytest.mark.parametrize(("height", "width"), [(32, 64), (31, 62), (15, 33)])
def test_a_hole_in_a_ramp_is_bridged_without_shift(device, height, width):
    """Hard case 4: holes at both poles, across the seam and in the middle of a map of its own directions."""
    ramp = 1.0 + latlong.directions(height, width)
    holes = {
        "north": (0, 0, 1),
        "south": (0, 0, -1),
        "seam": (-1, 0, 0),
        "middle": (1, 0, 0),
        "slant": (0.6, -0.5, 0.4),
    }
    for name, axis in holes.items():
        axis = np.array(axis) / np.linalg.norm(axis)
        inside = latlong.directions(height, width) @ axis > np.cos(np.radians(25))
        out = filled(ramp, np.where(inside, 0.0, 1.0))
        error = (out - ramp)[inside]
        # The cap bulges 0.09 over its rim, and push-pull fills it from patches as wide as the hole.
        assert np.abs(error).max() < 0.3, name
        across = error - (error @ axis)[:, None] * axis
        weight = latlong.solid_angles(height, width)[inside][:, None]
        # On average it leans nowhere: half a texel of the coarsest level that fits the hole would be 0.2.
        assert np.abs((across * weight).sum(0) / weight.sum()).max() < 0.05, name


def test_rotating_the_environment_rotates_the_fill(device):
    """The seam is nowhere special: turned by a multiple of the coarsest texels used, the result turns along to the
    bit."""
    rng = np.random.default_rng(7)
    radiance, confidence = rng.uniform(0, 1, (16, 32, 3)), (rng.random((16, 32)) > 0.7) * 1.0
    turned = filled(np.roll(radiance, 16, 1), np.roll(confidence, 16, 1))
    np.testing.assert_allclose(turned, np.roll(filled(radiance, confidence), 16, 1), atol=ROUNDING)


def test_low_confidence_blends_smoothly(device):
    """From 0 to 0.5 a texel moves from its neighbours' value to its own without a jump."""
    values = []
    for c in np.linspace(0, 0.6, 25):
        radiance, confidence = np.full((16, 32, 3), 0.2), np.ones((16, 32))
        radiance[8, 16], confidence[8, 16] = 1.0, c
        values.append(filled(radiance, confidence)[8, 16, 0])
    steps = np.diff(values)
    assert values[0] == pytest.approx(0.2, abs=1e-6)
    assert values[-1] == pytest.approx(1.0, abs=1e-6)
    assert (steps >= -1e-6).all()
    assert steps.max() < 0.1


def test_extreme_values_stay_finite_and_not_negative(device):
    """Hard case 6: a sun of 1e6 over 1e-4, negative and broken pixels."""
    radiance = np.full((32, 64, 3), 1e-4)
    radiance[5, 7], radiance[6, 9], radiance[7, 11], radiance[8, 3] = 1e6, -3281.0, np.nan, np.inf
    rng = np.random.default_rng(8)
    out = filled(radiance, rng.random((32, 64)))
    assert np.isfinite(out).all()
    assert (out >= 0).all()
    assert out.max() <= 1e6
