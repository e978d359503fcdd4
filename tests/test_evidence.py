"""What recovered light rests on: the card's print, problems that are a little wrong, channels that agree."""

from __future__ import annotations

import types

import numpy as np
import pytest

from tests.recover_rig import DistantLight, lit_environment, scene  # noqa: F401
from warp_ar.kernels.recovery.recover_cells import CELL_ROWS, LOST
from warp_ar.light.card import check_card, covered_card
from warp_ar.light.config import CONFIG, Kind
from warp_ar.light.evidence import (
    allowed_factor,
    doubt_of,
    fitting_share,
    greyer,
    held_to_card,
    known_share,
    likely_gain,
    share_by_card,
    spread_directions,
)
from warp_ar.light.problem import Candidate, Problem
from warp_ar.light.recovery import Recovery, tie_channels

EMITTER = ((-0.5, -0.6, 0.6), 0.985, 30.0)


def printed(ink, *, paper=0.5, gradient=0.0):
    """An 8 x 8 checkerboard of paper and ink, lit ``gradient`` times stronger from one side to the other."""
    x, y = np.meshgrid(np.arange(8.0), np.arange(8.0))
    points = np.column_stack([0.01 * x.ravel(), 0.01 * y.ravel(), np.zeros(64)])
    kind = np.where((x + y).ravel() % 2 > 0, Kind.INK, Kind.CARD)
    light = np.where(kind == Kind.INK, ink, paper) * (1.0 + gradient * x.ravel() / 7.0)
    return points, kind, light[:, None] * np.ones(3)


def test_print_shows_in_any_light():
    assert check_card(*printed(0.05)).contrast == pytest.approx(10.0)
    assert check_card(*printed(0.05)).holds
    assert check_card(*printed(0.05, gradient=5.0)).holds


def test_a_table_or_a_stool_is_no_card():
    """Even, or brighter from one side to the other, or speckled: the print is not in it."""
    assert not check_card(*printed(0.5)).holds
    assert not check_card(*printed(0.5, gradient=5.0)).holds
    points, kind, light = printed(0.5)
    assert not check_card(points, kind, light * np.random.default_rng(0).lognormal(0.0, 0.6, (64, 1))).holds


@pytest.mark.parametrize("skin", [0.03, 0.15, 0.6])
def test_a_hand_over_a_part_of_the_card_is_told(skin):
    """Of a quarter of the card, whatever the brightness of what covers it; all but cells at its border."""
    points, kind, light = printed(0.05)
    under = points[:, 0] > 0.055
    light[under] = skin
    covered = covered_card(points, kind, light)
    border = np.abs(points[:, 0] - 0.055) < 0.006
    assert covered[under & ~border].all()
    assert not covered[~under & ~border].any()


@pytest.mark.parametrize("shade", [0.02, 0.2, 0.5])
def test_a_shadow_over_a_part_of_the_card_covers_nothing(shade):
    points, kind, light = printed(0.05, gradient=2.0)
    light[points[:, 0] > 0.055] *= shade
    assert not covered_card(points, kind, light)[np.abs(points[:, 0] - 0.055) > 0.006].any()


def test_a_card_of_which_nothing_would_be_left_is_not_covered():
    assert not covered_card(*printed(0.5)).any()
    points, kind, light = printed(0.05)
    few = np.concatenate([np.flatnonzero(kind == Kind.INK)[:3], np.flatnonzero(kind == Kind.CARD)])
    assert not covered_card(points[few], kind[few], light[few]).any()


def test_too_few_cells_are_no_card():
    points, kind, light = printed(0.05)
    few = np.concatenate([np.flatnonzero(kind == Kind.INK)[:3], np.flatnonzero(kind == Kind.CARD)])
    assert not check_card(points[few], kind[few], light[few]).holds


def test_directions_are_spread_evenly():
    d = spread_directions(64)
    assert np.linalg.norm(d, axis=1) == pytest.approx(1.0)
    assert np.abs(d.mean(axis=0)).max() < 0.01
    assert d.T @ d / 64 == pytest.approx(np.eye(3) / 3, abs=0.01)


def test_a_factor_is_what_nearly_all_draws_allow():
    added = np.array([1.0, 1.0])
    agreed = np.ones((20, 2))
    assert allowed_factor(added, agreed) == 1.0
    assert allowed_factor(added, 0.2 * agreed) == pytest.approx(0.4)
    # A quarter of the draws find nothing: then nothing is added.
    assert allowed_factor(added, np.repeat([0.0, 1.0], [5, 15])[:, None] * agreed) == 0.0
    # Light from elsewhere is no evidence.
    assert allowed_factor(np.array([1.0, 0.0]), agreed * [0.0, 5.0]) == 0.0
    assert allowed_factor(np.zeros(2), agreed) == 0.0


def test_what_does_not_fit_is_believed_less():
    """By the worst channel's cost per equation; costs that modelled light has take nothing."""

    def fits(*costs, rows=200):
        return [types.SimpleNamespace(cost=rows * cost, rows=np.arange(rows)) for cost in costs]

    fitted = CONFIG.evidence.fitted
    assert fitting_share(fits(0.1, 0.5 * fitted, fitted)) == 1.0
    expected = 1.0 / (1.0 + CONFIG.evidence.misfit)
    assert fitting_share(fits(0.1, fitted + 1.0, 0.2)) == pytest.approx(expected)
    assert fitting_share(fits(0.1, 0.2, fitted + 1.0, rows=3)) == pytest.approx(expected)
    assert fitting_share(fits(*np.full(3, 1e9))) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("share", [0.1, 0.3, 0.6])
def test_what_a_factor_leaves_is_no_worse_than_nothing(share):
    """The bound that it is made from, for every draw above the share that may be missed."""
    rng = np.random.default_rng(3)
    added, missing = rng.uniform(0.5, 2.0, 32), share * rng.uniform(0.2, 2.0, (200, 32))
    taken = allowed_factor(added, missing) * added
    worse = np.linalg.norm(taken - missing, axis=1) > np.linalg.norm(missing, axis=1)
    assert worse.mean() <= CONFIG.evidence.share + 1.0 / 200
    assert likely_gain(taken, missing) >= -1e-9


def test_light_is_known_by_how_it_meets_the_card():
    """The best mean of two estimates of light at a cosine: one errs by s / cosine, the other by 1."""
    config, doubt = CONFIG.evidence, 0.1
    s = (doubt**2 + config.response**2 + config.ball**2 + (0.5 * np.pi / CELL_ROWS) ** 2) ** 0.5
    cosine = np.array([-0.3, 0.0, s, 3.0 * s, 1.0])
    assert share_by_card(cosine, doubt) == pytest.approx([0.0, 0.0, 0.5, 0.9, 1.0 / (1.0 + s * s)])


@pytest.mark.parametrize(("found", "taken"), [(0.4, 0.4), (4.0, 1.0)])
def test_no_more_comes_from_below_the_card_than_half_of_what_it_shows(found, taken):
    """The card shows 2; a part above it and one below, and an emitter below, of which half is the part's."""
    problem = types.SimpleNamespace(
        parts=2,
        member=np.eye(2),
        solid_angle=np.array([1.0, 0.5]),
        missing=np.ones((2, 3)),
        card_irradiance=lambda: np.full(3, 2.0),
    )
    solution = np.repeat([[7.0], [1.0 + found], [0.5 * found]], 3, axis=1)  # the card alone says 1 of each part
    cosines = np.array([1.0, -0.5]), np.array([-0.5])
    recovered, powers = held_to_card(problem, solution, np.ones((2, 3)), cosines, 0.0)
    beyond = 6.0 * (1.0 - float(share_by_card(np.array(1.0), 0.0)))  # not known of light from straight above
    less = 1.0 - min(CONFIG.evidence.unseen * 2.0 / (beyond + found), 1.0)
    assert recovered[0] == pytest.approx(7.0 - less * beyond)
    assert recovered[1] == pytest.approx(1.0 + (1.0 - less) * found)
    assert powers[0] == pytest.approx((1.0 - less) * 0.5 * found)
    assert 0.5 * (recovered[1, 0] - 1.0) + powers[0, 0] == pytest.approx(taken, rel=0.01)


def test_cosines_of_light_at_the_card():
    """A distant emitter has its direction's, a near one that of the way from the card to where it stands."""
    problem = Problem.__new__(Problem)
    problem.kind = np.array([Kind.CARD, Kind.CARD, Kind.PLANE])
    problem.points = np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0], [9.0, 9.0, 9.0]])
    problem.direction = np.array([[1.0, 0.0, 0.0], [0.6, 0.0, 0.8]])
    problem.aim = problem.direction
    problem.origin = np.array([[0.0, 0.0, 0.3], [0.0, 0.0, 0.3]])
    problem.candidates = [Candidate(1, np.inf), Candidate(0, 0.4)]
    cells, candidates = problem.card_cosines()
    assert cells == pytest.approx([0.0, 0.8])
    assert candidates == pytest.approx([0.8, 0.6])


def sky(recovered, *, hidden=0.0):
    """Two cells, overhead and low over the horizon, of one steradian each; light of one of them is recovered."""
    low = np.array([np.cos(0.2), 0.0, np.sin(0.2)])
    problem = types.SimpleNamespace(
        direction=np.stack([[0.0, 0.0, 1.0], low]), solid_angle=np.ones(2), missing=np.ones((2, 3)), white=0.85
    )
    problem.hidden, problem.kind = np.array([hidden, 0.0]), np.zeros(0, int)
    problem.exact = np.ones((0, 3), bool)
    return problem, np.array(recovered, float)[:, None] * np.ones(3)


NONE_CLIPS = (False, False, False)


def test_what_may_come_from_the_unseen_is_left_out():
    problem, light = sky([1.0, 0.0], hidden=0.5)
    assert known_share(problem, light, light, NONE_CLIPS) == pytest.approx(1.0 - 0.5 / (1.0 + np.sin(0.2)))
    assert known_share(sky([1.0, 0.0])[0], light, light, NONE_CLIPS) == 1.0


def test_flat_light_is_no_more_than_some_times_what_the_card_needs():
    problem, flat = sky([0.0, 1.0])
    steep = sky([1.0, 0.0])[1]
    assert known_share(problem, flat, steep, NONE_CLIPS) == pytest.approx(CONFIG.evidence.flatter * np.sin(0.2))
    assert known_share(problem, steep, flat, NONE_CLIPS) == 1.0
    assert known_share(problem, 0.0 * flat, steep, NONE_CLIPS) == 1.0


@pytest.mark.parametrize(("ink", "share"), [(0.2, 1.0), (0.1, None), (0.01, 0.0)])
def test_clipped_paper_is_no_brighter_than_print_allows(ink, share):
    problem, light = sky([6.0, 0.0])
    problem.kind, problem.exact = np.array([Kind.CARD, Kind.INK]), np.ones((2, 3), bool)
    problem.transfer, problem.captured = np.array([[1.0, 0.0], [1.0, 0.0]]), np.ones((2, 3))
    problem.light = np.array([[3.0] * 3, [ink] * 3])
    if share is None:
        share = (CONFIG.evidence.most_contrast * ink / 0.85 - 1.0) / 6.0
        assert 0.0 < share < 1.0
    assert known_share(problem, light, light, (True, True, True)) == pytest.approx(share)
    assert known_share(problem, light, light, NONE_CLIPS) == 1.0


def test_print_of_low_contrast_may_be_on_grey_paper():
    usual = CONFIG.surfaces.reflectance[Kind.INK]
    assert greyer(0.85 / usual, 0.85) == pytest.approx(1.0)
    assert greyer(0.5 * 0.85 / usual, 0.85) == pytest.approx(2.0)
    assert greyer(30.0, 0.85) == 1.0
    assert greyer(0.0, 0.85) == 1.0


def test_contrast_beyond_print_makes_the_card_doubtful():
    assert doubt_of(20.0) == doubt_of(CONFIG.evidence.usual_contrast) == CONFIG.evidence.white
    assert doubt_of(60.0) > 0.5


@pytest.mark.parametrize(
    ("missing", "expected"),
    [((1.0, 1.0, 1.0), (1.0, 0.5, 3.0)), ((0.1, 0.1, 1.0), (1.0, 0.5, 20.0)), ((1.0, 0.2, 1.0), (1.0, 0.5, 3.0))],
)
def test_no_emitter_is_of_one_colour_unless_one_channel_clips(missing, expected):
    problem = types.SimpleNamespace(
        parts=1, candidates=[], part=np.zeros(1, int), solid_angle=np.ones(1), missing=np.array([missing])
    )
    assert tie_channels(problem, np.array([[1.0, 0.5, 20.0]]))[0] == pytest.approx(expected)


def test_without_a_card_what_clips_is_raised_by_the_least_that_is_missing(device, scene):
    """The table alone shows a shadow; its reflectance is a guess, and so would be the emitter: none is found."""
    light = DistantLight(device, scene)
    light.reflectance = np.full_like(light.reflectance, 0.4)
    radiance, _, _ = lit_environment(EMITTER)
    estimate, values = light.estimate(radiance)
    assert (estimate.method, estimate.factor, estimate.emitters) == ("least", 1.0, ())
    assert not estimate.card.holds
    clipped = values["clipped"].max(axis=-1) - values["hidden"] > LOST
    assert estimate.recovered[clipped].any()
    assert not estimate.recovered[~clipped].any()
    interval = estimate.irradiance
    truth = true_irradiance(interval.normals, values, radiance)
    captured = true_irradiance(interval.normals, values, values["radiance"].reshape(-1, 3))
    assert np.linalg.norm(interval.value - truth) < np.linalg.norm(captured - truth)
    assert (interval.low <= truth).all()
    assert (truth <= interval.high).all()
    assert (interval.high[4] > 5.0 * interval.value[4]).all()


def true_irradiance(normals, cells, radiance):
    d, area = cells["direction"].reshape(-1, 3), cells["solid_angle"].ravel()
    return (np.maximum(normals @ d.T, 0.0) * area) @ radiance


def test_with_a_card_all_is_taken_and_the_interval_holds_the_truth(device, scene):
    radiance, _, _ = lit_environment(EMITTER)
    estimate, values = DistantLight(device, scene, noise=0.1).estimate(radiance)
    assert estimate.factor == 1.0
    assert estimate.method in ("shading", "white_card")
    assert estimate.card.contrast == pytest.approx(scene.marker.white / 0.04, rel=0.3)
    interval = estimate.irradiance
    truth = true_irradiance(interval.normals, values, radiance)
    assert interval.value == pytest.approx(truth, rel=0.1)
    assert (interval.low <= truth).all()
    assert (truth <= interval.high).all()
    assert (interval.high < (2.0 + CONFIG.evidence.overlooked) * interval.value).all()


def test_light_holds_while_a_hand_hides_the_card(device, scene):
    """And no longer: what hides it for good may have changed the light."""
    light = DistantLight(device, scene)
    radiance, _, _ = lit_environment(EMITTER)
    problem = {}
    original = Recovery.update

    def kept(self, cells, straight, mirrored, observed, *rest):
        problem.update(self=self, args=(cells, straight, mirrored), observed=observed, rest=rest)
        return original(self, cells, straight, mirrored, observed, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Recovery, "update", kept)
        seen, _ = light.estimate(radiance)
    hidden = problem["observed"].copy()
    hidden["visible"][light.surfaces.kinds[light.surfaces.surface] <= Kind.INK] = 0.0
    for _ in range(CONFIG.card.held):
        assert problem["self"].update(*problem["args"], hidden, *problem["rest"]) is seen
    left = problem["self"].update(*problem["args"], hidden, *problem["rest"])
    # What nearly every place lacks is all that is left: nothing that shading found.
    assert left.method == "least"
    assert not left.emitters
    assert left.recovered.max() < 0.5 * seen.recovered.max()
