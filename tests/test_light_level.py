"""Recovered light follows the card's brightness between estimates."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from warp_ar.kernels.recovery.light_level import MOST, STILL, apply_level, follow_level, sum_upward
from warp_ar.kernels.recovery.recover import Observation
from warp_ar.kernels.structs import Emitter

COUNT = 40
SHARE = 0.4
"""Of the card's light that the map does not show."""
ROUNDING = 1e-5
"""Of float32 ratios."""


def card(radiance=0.3):
    """What points of a card show."""
    observations = np.zeros(COUNT, np.dtype(Observation.numpy_dtype()))
    observations["visible"], observations["radiance"] = 1.0, np.asarray(radiance) * np.ones((COUNT, 3))
    return observations


def level(device, now, then, upward=1.0, share=SHARE, before=1.0):
    """The level that follows, by channel, from ``before``."""
    out = wp.full(3, before, dtype=wp.float32, device=device)
    sides = [wp.array(side, dtype=Observation, device=device) for side in (now, then)]
    sums = tuple(wp.full(3, value, dtype=wp.float32, device=device) for value in (upward, 1.0))
    follow_level(*sides, sums, wp.full(3, share, dtype=wp.float32, device=device), out)
    return out.numpy()


@pytest.mark.parametrize("factor", [0.0, 0.3, 0.8, 1.2, 1.45])
def test_what_the_map_does_not_show_is_followed(device, factor):
    """The card receives a share by light that the map shows, and the rest by light that has changed by a factor."""
    shown = 0.3 * (1.0 - SHARE + SHARE * factor)
    assert level(device, card(shown), card()) == pytest.approx(factor, abs=ROUNDING / SHARE)


@pytest.mark.parametrize("factor", [0.5, 1.4])
def test_light_that_the_map_shows_as_well_changes_no_level(device, factor):
    shown = 0.3 * (factor * (1.0 - SHARE) + SHARE)
    assert level(device, card(shown), card(), upward=factor) == pytest.approx(1.0, abs=1e-6)


def test_channels_have_levels_of_their_own(device):
    factors = np.array([0.4, 1.0, 1.3])
    shown = 0.3 * (1.0 - SHARE + SHARE * factors)
    assert level(device, card(shown), card()) == pytest.approx(factors, abs=ROUNDING / SHARE)


def test_noise_is_no_change(device):
    change = 0.9 * float(STILL)
    assert (level(device, card(0.3 * (1.0 + change)), card()) == 1.0).all()
    assert (level(device, card(0.3 * (1.0 - change)), card()) == 1.0).all()
    rng = np.random.default_rng(3)
    noisy = card(0.3 * (1.0 + 0.03 * rng.standard_normal((COUNT, 3))))
    assert (level(device, noisy, card()) == 1.0).all()


def test_a_hand_over_a_part_of_the_card_is_no_light(device):
    """Over a few points it does not count; over many the level stays what it was."""
    now = card(0.3 * (1.0 - SHARE + SHARE * 0.5))
    now["radiance"][:10] = 0.02
    assert level(device, now, card()) == pytest.approx(0.5, abs=ROUNDING / SHARE)
    now["radiance"][:16] = 0.02
    assert (level(device, now, card(), before=0.7) == np.float32(0.7)).all()
    # The median of a graded shadow tells nothing.
    graded = card(0.3 * np.linspace(0.2, 1.0, COUNT)[:, None])
    assert (level(device, graded, card(), before=0.7) == np.float32(0.7)).all()


@pytest.mark.parametrize(
    ("name", "value"), [("visible", 0.5), ("clipped", 0.5), ("radiance", 0.001)], ids=["hidden", "clipped", "dark"]
)
def test_a_card_that_does_not_tell_leaves_the_level(device, name, value):
    silent = card(0.1)
    silent[name] = value
    assert (level(device, silent, card(), before=0.7) == np.float32(0.7)).all()
    assert (level(device, card(), silent, before=0.7) == np.float32(0.7)).all()


def test_what_is_hardly_missing_has_no_level(device):
    assert (level(device, card(0.1), card(), share=0.05, before=0.7) == np.float32(0.7)).all()


def test_a_level_is_bounded(device):
    assert level(device, card(0.9), card(), share=0.1) == pytest.approx(float(MOST))
    assert level(device, card(0.01), card(), share=0.1) == pytest.approx(0.0)


def test_a_uniform_map_gives_pi(device):
    """The sum of cosines over the upper half, by rows: half a row's square off."""
    height = 64
    rows, out = wp.zeros(height // 2, dtype=wp.vec3, device=device), wp.zeros(3, dtype=wp.float32, device=device)
    uniform = wp.full((height, 2 * height), wp.vec3(1.0, 0.5, 0.0), dtype=wp.vec3, device=device)
    sum_upward(uniform, rows, out)
    assert out.numpy() == pytest.approx([np.pi, 0.5 * np.pi, 0.0], rel=(np.pi / height) ** 2)
    below = np.zeros((height, 2 * height, 3), np.float32)
    below[height // 2 :] = 1.0
    sum_upward(wp.array(below, dtype=wp.vec3, device=device), rows, out)
    assert not out.numpy().any()


def test_levels_apply_to_cells_and_emitters(device):
    rng = np.random.default_rng(4)
    cells = rng.uniform(0.0, 5.0, (8, 16, 3)).astype(np.float32)
    emitters = np.zeros(4, np.dtype(Emitter.numpy_dtype()))
    emitters["power"], emitters["distance"] = rng.uniform(0.0, 2.0, (4, 3)), [1.0, 2.0, np.inf, 0.0]
    levels = np.array([0.5, 1.0, 2.0], np.float32)
    shown, moved = wp.zeros((8, 16), dtype=wp.vec3, device=device), wp.zeros(4, dtype=Emitter, device=device)
    given = (wp.array(cells, dtype=wp.vec3, device=device), wp.array(emitters, dtype=Emitter, device=device))
    apply_level(*given, wp.array(levels, device=device), shown, moved)
    assert shown.numpy() == pytest.approx(cells * levels)
    found = moved.numpy()
    assert found["power"] == pytest.approx(emitters["power"] * levels)
    assert (found["distance"] == emitters["distance"]).all()
