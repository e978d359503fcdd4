"""Recovered light is no worse than light as captured: a few of the random tables of ``bench.bench_never_worse``."""

from __future__ import annotations

import functools

import pytest
from scipy.stats import binom

from bench.bench_never_worse import NO_WORSE, evaluate, summarise
from bench.random_tables import make_setup

pytestmark = pytest.mark.slow

SEEDS = (3, 4, 5, 8, 9, 10)
"""Cards that are true, grey and absent, wrong responses, clutter and lamps."""
LEVEL = 0.95
"""Share of the intervals' numbers that are to hold the truth."""
UNLUCKY = 0.05
"""Chance that sound intervals miss the test's bound, over the choice of set-ups, which are the same in every run."""
DIRECTIONS = 6
"""Along the axes, in which irradiance is bounded."""


set_up = functools.lru_cache(maxsize=1)(make_setup)


def test_recovered_light_is_no_worse_than_captured():
    outcomes = [evaluate(set_up(seed)) for seed in SEEDS]
    for seed, outcome in zip(SEEDS, outcomes, strict=True):
        assert outcome.ratio <= NO_WORSE, seed
    summary = summarise(outcomes)
    # And is worth its while: nothing at all would be no worse either.
    assert summary["error_recovered"] < 0.95 * summary["error_clipped"]
    # Channels of a direction hold or fail together: what is drawn is directions.
    draws = DIRECTIONS * len(SEEDS)
    assert summary["interval_holds"] >= binom.ppf(UNLUCKY, draws, LEVEL) / draws
