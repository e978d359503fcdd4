"""Receivers between mirror balls: reflectance, shadows and ambient visibility are by interpolated light."""

import numpy as np
import pytest
import warp as wp

from tests import test_near_field as near_field
from tests.environment_shadow_rig import SUM_ERROR, sky, sphere
from tests.environment_shadow_rig import run as run_shadow
from tests.kernel_rig import constant_environment
from tests.receiver_cells_rig import View, box, middles
from tests.relight_rig import DESK, FLOAT_ERROR, POINTS, point
from tests.relight_rig import run as run_relight
from tests.twins.probe_weights import weights
from warp_ar.kernels.environment import environment_samples
from warp_ar.kernels.environment.environment_samples import EnvironmentSample
from warp_ar.kernels.environment.interpolated_irradiance import OtherBalls
from warp_ar.kernels.receiver.receiver import PRIOR_WEIGHT

pytestmark = pytest.mark.slow

PLACES = ((-0.15, 0.02, 0.05, 1.0), (0.2, -0.05, 0.05, 1.0), (0.1, 0.15, 0.05, 0.6))
WHERE = np.array([[weights(PLACES[:2], point) for point in row] for row in POINTS])
"""What two balls count at the desk's points, (H, W, 2)."""


def skies(count):
    """Lit from another side each, differently bright."""
    made = []
    for ball in range(count):
        one = sky(0.1 + 0.2 * ball)
        one[3:11, 12 + 14 * ball : 24 + 14 * ball] = 2.0 + 3.0 * ball
        made.append(one)
    return made


def others_of(light, environments, places=PLACES):
    """The balls after the first: irradiance of constant environments, and maps."""
    balls = OtherBalls()
    balls.places = wp.array(np.float32(places[: len(light) + 1]), wp.vec4)
    balls.irradiance_sh = wp.array(np.stack([constant_environment((one,) * 3) for one in light]), wp.vec3)
    balls.environment = wp.array(np.stack(environments), wp.vec3)
    return balls


def sample_all(environments, *, texels, count=1024):
    """Samples of several balls' environments, in turn."""
    slots = 1 << (len(environments) - 1).bit_length()
    size = environments[0].shape[0] * environments[0].shape[1] * slots if texels else count
    out = wp.zeros(size, wp.vec3), wp.zeros(size, wp.vec3), wp.zeros(size, EnvironmentSample)
    for ball, one in enumerate(environments):
        source, turn = wp.array(one, dtype=wp.vec3), (ball, len(environments))
        if texels:
            environment_samples.list_texels(source, wp.vec3(), turn, *out)
        else:
            cumulative, sums = wp.zeros(source.shape, wp.float32), wp.zeros(source.shape[0], wp.vec2)
            environment_samples.sum_environment(source, cumulative, sums)
            environment_samples.draw_samples(source, cumulative, sums, wp.vec3(), turn, *out)
    return out


def upward(drawn, ball=0, balls=1):
    """Irradiance of what faces up, by a ball's samples."""
    slots = 1 << (balls - 1).bit_length()
    own = np.arange(len(drawn[0])) % slots % balls == ball
    return np.maximum(drawn[0].numpy()[own, 2], 0.0) @ drawn[1].numpy()[own, 0].astype(np.float64)


@pytest.mark.parametrize("balls", [1, 2, 3, 5])
@pytest.mark.parametrize("texels", [False, True])
def test_every_balls_samples_sum_to_its_own_irradiance(device, balls, texels):
    """In any first part that is a power of two as well, of random ones; every texel of a list exactly."""
    environments = skies(balls)
    drawn = sample_all(environments, texels=texels)
    for ball, one in enumerate(environments):
        exact = upward(sample_all([one], texels=True))
        # A few hundred stratified samples of an environment with edges: 512 for two balls, 128 for five.
        assert upward(drawn, ball, balls) == pytest.approx(exact, rel=1e-5 if texels else 0.03)


def test_a_shadow_is_that_of_the_balls_light_by_weight(device):
    """Irradiance with an object over that without, both summed over balls: the brighter one counts for more."""
    environments, item = skies(2), [sphere((0.02, 0.0, 0.05), 0.04)]
    single = []
    for one in environments:
        drawn = sample_all([one], texels=True)
        ratio, surface = run_shadow(drawn, item, count=2048, side=1, filtered=False)
        single.append((upward(drawn), ratio[..., 0]))
    whole = sum(WHERE[..., ball] * light for ball, (light, _) in enumerate(single))
    left = sum(WHERE[..., ball] * light * ratio for ball, (light, ratio) in enumerate(single))
    drawn, others = sample_all(environments, texels=True), others_of([0.0], environments[1:])
    found, _ = run_shadow(drawn, item, count=4096, side=1, filtered=False, others=others)
    seen = surface >= 0
    assert np.abs(single[0][1] - single[1][1])[seen].max() > 0.2
    np.testing.assert_allclose(found[..., 0][seen], (left / whole)[seen], atol=SUM_ERROR)


def test_objects_near_the_desk_take_each_sample_by_its_balls_weight(device):
    """Of light that is summed by samples: beyond the second ball as if the first one's samples had no light."""
    environments = skies(2)
    drawn, alone = (sample_all(environments, texels=False) for _ in range(2))
    values = alone[2].numpy()
    values["measure"][::2] = 0.0
    alone[2].assign(values)
    beside = others_of([0.0], environments[1:], [(x, 0.0, 0.0, 1.0) for x in (-0.9, -0.5)])
    item = [sphere(near_field.BALL, near_field.RADIUS)], [near_field.CHALK]
    expected, _, found, _, _ = near_field.run(*item, drawn=alone)
    several, *_ = near_field.run(*item, drawn=drawn, others=beside)
    # The same sums of the same terms, and zeros.
    np.testing.assert_allclose(several[found >= 0], expected[found >= 0], rtol=1e-6)
    one, *_ = near_field.run(*item, drawn=drawn)
    assert np.abs(one / np.maximum(expected, 1e-6) - 1.0)[found >= 0].max() > 0.1, "the other ball's light is another"


def test_reflectance_is_by_the_irradiance_that_is_interpolated(device):
    """L pi over it, with the prior of equation (3), at each point of a grey desk."""
    lights, frame = [point((0.0, 0.0, 0.25))], np.full((*POINTS.shape[:2], 3), 128, np.uint8)
    alone = run_relight("reflectance", lights, frame, sh=constant_environment((1.0,) * 3))
    both = run_relight(
        "reflectance", lights, frame, sh=constant_environment((1.0,) * 3), others=others_of([3.0], skies(1))
    )
    received = np.pi * (WHERE @ [1.0, 3.0])
    weight = float(PRIOR_WEIGHT)
    np.testing.assert_allclose(
        both / alone, np.repeat(((np.pi + weight) / (received + weight))[..., None], 3, -1), rtol=FLOAT_ERROR
    )


def test_ambient_visibility_is_of_the_balls_light_by_weight(device):
    """Before a black box; of each ball's light another part is hidden."""
    environments = skies(2)
    block = box((-0.05, 0.03, 0.0), (0.1, 0.09, 0.08))
    single = []
    for one in environments:
        drawn = sample_all([one], texels=True)
        share, surface = View(proxies=(DESK, block), surroundings=(0, 0, 0)).share(drawn[2])
        single.append((upward(drawn), share[..., 0]))
    view = View(proxies=(DESK, block), surroundings=(0, 0, 0), others=others_of([0.0], environments[1:]))
    found, again = view.share(sample_all(environments, texels=True)[2])
    np.testing.assert_array_equal(surface, again)
    at = WHERE[middles(4)]
    whole = sum(at[..., ball] * light for ball, (light, _) in enumerate(single))
    left = sum(at[..., ball] * light * share for ball, (light, share) in enumerate(single))
    desk = surface == 0
    assert np.abs(single[0][1] - single[1][1])[desk].max() > 0.1
    np.testing.assert_allclose(found[..., 0][desk], (left / whole)[desk], atol=SUM_ERROR)
