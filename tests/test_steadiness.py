"""Means of estimates: noise averages out, light that changes is followed, and so is what tells it."""

import types

import numpy as np
import pytest

from warp_ar.light.channel import choose_channel, told_channel
from warp_ar.light.config import CONFIG
from warp_ar.light.estimate import Estimate, FoundEmitter
from warp_ar.light.steadiness import Steadiness
from warp_ar.light.stillness import Seen

SHAPE = (4, 8)
STILL = CONFIG.solver.still
VIEW = np.array([0.0, -0.6, 0.8])


def seen(level=1.0, told=True):
    """Light on surfaces at a level, in an environment that clips and stays as it is."""
    return Seen(np.ones((*SHAPE, 3)), np.full(20, 0.3 * level), np.full(20, told))


def estimate(value=1.0, power=None, cell=3):
    recovered = np.full((*SHAPE, 3), value, np.float32)
    emitters = ()
    if power is not None:
        emitters = (FoundEmitter(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.5, np.full(3, power), cell),)
    return Estimate(recovered, (False, False, False), emitters, "shading", 1.0)


def test_light_that_stays_becomes_the_mean():
    steadiness, values = Steadiness(), [3.0, 5.0, 4.0, 8.0]
    for count, value in enumerate(values, 1):
        found = steadiness.follow(estimate(value, power=10.0 * value), seen(), VIEW)
        np.testing.assert_allclose(found.recovered, np.mean(values[:count]), rtol=1e-6)
        np.testing.assert_allclose(found.emitters[0].power, 10.0 * np.mean(values[:count]))


def test_noise_is_averaged_out():
    rng, steadiness = np.random.default_rng(1), Steadiness()
    found = [
        steadiness.follow(
            estimate(1.0 + 0.1 * rng.standard_normal()), seen(1.0 + 0.1 * STILL * rng.standard_normal()), VIEW
        )
        for _ in range(100)
    ]
    steps = np.abs(np.diff([one.recovered.mean() for one in found[CONFIG.solver.remembered :]]))
    # One estimate moves the mean by its own deviation over their number, 3.5 standard deviations at most in 90.
    assert steps.max() < 0.1 * 3.5 / CONFIG.solver.remembered * 1.2
    assert found[-1].recovered.mean() == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("level", [1.0 + 1.1 * STILL, 1.0 - 1.1 * STILL, 2.0])
def test_light_that_changes_is_followed_at_once(level):
    steadiness = Steadiness()
    for _ in range(30):
        steadiness.follow(estimate(1.0), seen(), VIEW)
    assert steadiness.follow(estimate(5.0), seen(level), VIEW).recovered.max() == 5.0


def test_a_ball_seen_from_elsewhere_is_seen_anew():
    steadiness, aside = Steadiness(), np.array([1.0, 0.0, 0.0])
    for _ in range(5):
        steadiness.follow(estimate(1.0), seen(), VIEW)
    trembled = steadiness.follow(estimate(7.0), seen(), VIEW + 0.2 * STILL * aside)
    assert trembled.recovered.max() == pytest.approx(1.0 + 6.0 / 6.0)
    assert steadiness.follow(estimate(7.0), seen(), VIEW + 1.2 * STILL * aside).recovered.max() == 7.0


@pytest.mark.parametrize("rate", [0.001, 0.004, 0.01])
def test_light_that_changes_slowly_runs_ahead_by_no_more_than_counts(rate):
    """Each step is less than what counts as a change: the mean must not stay behind for all that."""
    steadiness = Steadiness()
    for step in range(200):
        level = np.exp(rate * step)
        found = steadiness.follow(estimate(level), seen(level), VIEW)
        assert found.recovered.mean() > (1.0 - 1.1 * STILL) * level


def test_another_emitter_is_another_light():
    steadiness = Steadiness()
    steadiness.follow(estimate(1.0, power=1.0), seen(), VIEW)
    assert steadiness.follow(estimate(2.0, power=2.0, cell=4), seen(), VIEW).emitters[0].power[0] == 2.0
    found = steadiness.follow(estimate(4.0), seen(), VIEW)
    assert found.emitters == ()
    assert found.recovered.max() == 4.0


def test_cells_that_begin_or_cease_to_clip_are_as_they_are_now():
    steadiness, before, now = Steadiness(), estimate(4.0), estimate(2.0)
    before.recovered[0], now.recovered[1] = 0.0, 0.0
    steadiness.follow(before, seen(), VIEW)
    recovered = steadiness.follow(now, seen(), VIEW).recovered
    np.testing.assert_array_equal(recovered[:, 0, 0], [2.0, 0.0, 3.0, 3.0])


def test_without_surfaces_nothing_is_averaged():
    steadiness = Steadiness()
    steadiness.follow(estimate(1.0), seen(), VIEW)
    assert steadiness.follow(estimate(2.0), seen(told=False), VIEW).recovered.max() == 2.0


def shown(exact, bound=(0, 0, 0), missing=(1.0, 1.0, 1.0), points=400):
    """A problem in which so many points show a channel, and so many clip in it."""
    numbers = np.arange(points)[:, None]
    return types.SimpleNamespace(
        exact=numbers < np.array(exact),
        bound=numbers >= points - np.array(bound),
        index=np.arange(points),
        solid_angle=np.ones(1),
        missing=np.array([missing]),
    )


def test_points_that_clip_count_against_their_channel():
    assert choose_channel(shown((257, 232, 259), (91, 122, 109))) == 0
    assert choose_channel(shown((385, 391, 413))) == 2
    assert choose_channel(shown((300, 300, 300))) == 1


def test_a_channel_in_which_nothing_is_missing_tells_nothing():
    problem = shown((300, 200, 400), missing=(1.0, 0.9, 0.2))
    assert told_channel(problem, 2) == 0
    assert told_channel(problem, 1) == 1
