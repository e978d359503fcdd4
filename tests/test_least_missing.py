"""What clips is raised, where nothing but the map tells, by how much clips, how many channels do, and how it ends."""

from __future__ import annotations

import numpy as np
import pytest

from bench.bench_clipping_prior import errors_of
from warp_ar.kernels.recovery.recover_cells import CELL_COLUMNS, CELL_ROWS
from warp_ar.light.captured import texel_solid_angles
from warp_ar.light.config import CONFIG
from warp_ar.light.least_missing import least_missing

SHAPE = (CELL_ROWS, CELL_COLUMNS)
AREA = np.broadcast_to(texel_solid_angles(CELL_ROWS), SHAPE)
LEVEL = 1.2
ROUNDING = 1e-6
EVERYWHERE = np.ones(SHAPE, bool)
WINDOW = np.zeros(SHAPE, bool)
WINDOW[8:12, 20:26] = True


def room(clips: np.ndarray = WINDOW, channels: tuple[int, ...] = (0, 1, 2)) -> tuple[np.ndarray, np.ndarray]:
    """Radiance and clipped share of dark walls with something that clips."""
    radiance, clipped = np.full((*SHAPE, 3), 0.1), np.zeros((*SHAPE, 3))
    for channel in channels:
        radiance[clips, channel], clipped[clips, channel] = LEVEL, 1.0
    return radiance, clipped


def test_a_window_is_raised_by_the_root_of_how_much_clips() -> None:
    """Even, in all of it, and nothing else is; a quarter of the solid angle has less by the rule's power."""
    config, half = CONFIG.least, WINDOW.copy()
    half[:, 23:] = False
    found = least_missing(*room(), AREA, EVERYWHERE)
    expected = config.least * AREA[WINDOW].sum() ** config.exponent * LEVEL
    assert found[WINDOW] == pytest.approx(expected, rel=ROUNDING)
    assert not found[~WINDOW].any()
    less = least_missing(*room(half), AREA, EVERYWHERE)[half]
    assert less == pytest.approx(expected * 0.5**config.exponent, rel=ROUNDING)


def test_beyond_a_steradian_no_more_is_added() -> None:
    """A sky that clips in whole has no more than a steradian of it."""
    wide = np.zeros(SHAPE, bool)
    wide[:14] = True
    assert AREA[wide].sum() > 2.0 * CONFIG.least.most
    found = least_missing(*room(wide), AREA, EVERYWHERE)
    assert found[wide] == pytest.approx(CONFIG.least.least * CONFIG.least.most**CONFIG.least.exponent * LEVEL)


def test_one_channel_alone_is_hardly_raised() -> None:
    """A lamp of one colour has a twentieth of a white one's."""
    white, red = (least_missing(*room(channels=own), AREA, EVERYWHERE) for own in ((0, 1, 2), (0,)))
    assert red[WINDOW][:, 0] == pytest.approx(CONFIG.priors.least_alike * white[WINDOW][:, 0], rel=ROUNDING)


def test_what_fades_may_be_at_clipping_and_stays() -> None:
    """A sky that is nearly at clipping beside what clips; half way between the bounds half is added."""
    radiance, clipped = room()
    below, nearly = CONFIG.priors.fades
    for brightness, share in ((0.9, 0.0), (0.5 * (below + nearly), 0.5), (0.3, 1.0)):
        sky = np.where(WINDOW[..., None], radiance, brightness * LEVEL)
        found = least_missing(sky, clipped, AREA, EVERYWHERE)
        dark = least_missing(radiance, clipped, AREA, EVERYWHERE)
        assert found[WINDOW] == pytest.approx(share * dark[WINDOW], abs=ROUNDING)


def test_nothing_is_added_to_surfaces_or_where_nothing_clips() -> None:
    """What clips of a modelled plane is lit; what was not seen is unknown."""
    assert not least_missing(*room(), AREA, ~WINDOW).any()
    assert not least_missing(*room(np.zeros(SHAPE, bool)), AREA, EVERYWHERE).any()


@pytest.mark.parametrize(("radiance", "better"), [(50.0, True), (3.0, True), (1.02, False)])
def test_no_worse_where_half_of_it_is_missing(radiance: float, better: bool) -> None:
    """A lamp far above clipping gains; one that hardly clips, which nearly no place has, would lose."""
    lamp = np.full((64, 128, 3), 0.2, np.float32)
    lamp[4:12, 20:40] = radiance
    found = errors_of(lamp, 1.0)
    assert (found["least"] < found["clipped"]) == better
    assert (found["allowed"] > CONFIG.least.least) == better
