"""Recovered light is no worse than light as captured: a few of the random tables of ``bench.bench_never_worse``."""

from __future__ import annotations

import functools

import cv2
import numpy as np
import pytest
from scipy.stats import binom

from bench.bench_never_worse import NO_WORSE, evaluate, summarise
from bench.environments import made_up_environment
from bench.random_tables import make_setup
from bench.table_world import FINE, Block, Bulb, World, latlong_directions

pytestmark = pytest.mark.slow

SEEDS = (3, 4, 5, 8, 9, 10)
"""Cards that are true, grey and absent, wrong responses, clutter and lamps."""
LEVEL = 0.95
"""Share of the intervals' numbers that are to hold the truth."""
UNLUCKY = 0.05
"""Chance that sound intervals miss the test's bound, over the choice of set-ups, which are the same in every run."""
DIRECTIONS = 6
"""Along the axes, in which irradiance is bounded."""
FURNACE = 0.03
"""2,048 directions for a cosine, a coarse bounce."""


set_up = functools.lru_cache(maxsize=1)(make_setup)


def test_the_renderer_lights_as_closed_forms_have_it():
    """A uniform sky gives pi times the radiance; a lamp its intensity over the squared distance, or its shadow."""
    sky = np.ones((*FINE, 3), np.float32)
    table = np.full((64, 64, 3), 0.5, np.float32)
    ball = (np.array([0.0, 0.0, 0.5]), 0.001, 0.9)
    lamp = Bulb(np.array([0.3, 0.0, 1.0]), 0.01, np.full(3, 4e4))
    up = np.array([0.0, 0.0, 1.0])
    point = np.array([[0.3, 0.0, 1e-4], [0.3, 0.3, 1e-4]])
    world = World(sky, ball, [], [], (table, np.ones(2)), None)
    assert world.irradiance(point, up) == pytest.approx(np.pi, rel=FURNACE)
    lit = World(sky, ball, [], [lamp], (table, np.ones(2)), None).irradiance(point, up) - world.irradiance(point, up)
    intensity = np.pi * 0.01**2 * 4e4
    assert lit[0] == pytest.approx(intensity, rel=1e-3)
    assert lit[1] == pytest.approx(intensity / 1.09**1.5, rel=1e-3)
    roof = Block(np.array([0.3, 0.0, 0.5]), np.array([0.1, 0.1, 0.1]), 0.0, np.zeros(3), modelled=False)
    dark = World(sky, ball, [roof], [lamp], (table, np.ones(2)), None).irradiance(point[:1], up)
    assert (dark < np.pi).all()
    # The table as the camera sees it.
    seen = world.trace(np.array([0.3, 0.0, 1.0]), -up[None])
    assert seen == pytest.approx(0.5, rel=FURNACE)
    d, area = latlong_directions(*FINE)
    assert area.sum() == pytest.approx(4.0 * np.pi, rel=1e-4)
    assert np.linalg.norm(d, axis=-1) == pytest.approx(1.0)


def test_surfaces_are_lit_by_what_the_picture_shows():
    """Irradiance at the ball's place is that of what is seen from there: a wall, a box and the table, each as lit."""
    center, cells = np.array([0.12, 0.05, 0.04]), 128
    sky = cv2.resize(np.asarray(made_up_environment(FINE[0]), np.float32), FINE[::-1], interpolation=cv2.INTER_AREA)
    table = np.full((64, 64, 3), 0.4, np.float32), np.full(2, 0.8)
    blocks = [
        Block(np.array([0.1, 0.55, 0.7]), np.array([4.0, 0.1, 1.6]), 0.0, np.array([0.7, 0.4, 0.2]), modelled=False),
        Block(np.array([-0.1, 0.15, 0.1]), np.array([0.1, 0.1, 0.2]), 20.0, np.array([0.2, 0.5, 0.7]), modelled=False),
    ]
    world = World(sky, (center, 1e-6, 0.9), blocks, [], table, None)
    d, area = (part.reshape(2 * cells**2, -1) for part in latlong_directions(cells, 2 * cells))
    seen = world.trace(center, d, ball=False)
    for normal in np.concatenate([np.eye(3), -np.eye(3)[:2]]):
        expected = (np.maximum(d @ normal, 0.0) * area[:, 0]) @ seen
        assert world.irradiance(center[None], normal)[0] == pytest.approx(expected, rel=FURNACE)


def test_set_ups_are_the_same_every_time():
    first, again = set_up(SEEDS[0]), make_setup(SEEDS[0])
    assert np.array_equal(first.image, again.image)
    assert first.scene == again.scene


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
