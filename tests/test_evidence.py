"""What recovered light rests on: the card's print, problems that are a little wrong, channels that agree."""

from __future__ import annotations

import numpy as np
import pytest

from tests.recover_rig import DistantLight, lit_environment, scene  # noqa: F401
from warp_ar.kernels.recovery.recover_cells import LOST
from warp_ar.light.config import CONFIG, Kind
from warp_ar.light.evidence import check_card, covered_card
from warp_ar.light.recovery import Recovery

pytestmark = pytest.mark.slow

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
    assert not check_card(points[few], kind[few], light[few]).holds


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
