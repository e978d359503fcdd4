"""Edges of shadows, cones and proxies in virtual light: means over pixels."""

import numpy as np
import pytest

from tests.kernel_rig import shape
from tests.relight_rig import COLUMNS, DESK, ROWS, H, W, pixel_means, point, run_edges, turn_z, unit
from warp_ar.kernels.structs import BOX, DIRECTIONAL, SPOT

pytestmark = pytest.mark.slow

# --- edges

HANGING = {**shape(BOX, (0.02, 0.01, 0.15), (0.06, 0.04, 0.01)), "rotation": turn_z(0.4)}
"""Throws a slanted shadow; nearer to the camera than the desk."""


def test_edges_of_shadows_are_means_over_pixels(device):
    """Against 256 times as many pixels: n samples err less than n random ones would, by 1 / sqrt n of what one does."""
    samples = 4
    lights = [point((-0.1, 0.05, 0.5)), {**point((0.2, 0.1, 0.4)), "kind": DIRECTIONAL, "direction": unit(1, 0.5, -2)}]
    hard = run_edges(1, lights, [HANGING])
    truth = pixel_means(run_edges(1, lights, [HANGING], rect=(0, 16 * H, 0, 16 * W), detail=16), 16)
    smooth = run_edges(samples, lights, [HANGING])
    edges = np.abs(hard - truth).max(-1) > 0.02 * truth.max()
    assert edges.sum() > 50
    before, after = (np.sqrt(((picture - truth)[edges] ** 2).mean()) for picture in (hard, smooth))
    assert after < before / np.sqrt(samples)
    changed = (hard != smooth).any(-1)
    assert changed.sum() < 0.25 * H * W
    assert np.abs(smooth - truth)[~edges].max() < 0.02 * truth.max()


def test_edges_of_proxies_are_means_over_pixels(device):
    """A lit box before the desk: where neither is lit, or one surface goes on, nothing changes."""
    box = shape(BOX, (0.0, 0.0, 0.04), (0.1, 0.06, 0.04)) | {"rotation": turn_z(0.3)}
    lights = [point((0.0, 0.0, 0.5))]
    hard = run_edges(1, lights, proxies=(DESK, box))
    truth = pixel_means(run_edges(1, lights, proxies=(DESK, box), rect=(0, 16 * H, 0, 16 * W), detail=16), 16)
    smooth = run_edges(4, lights, proxies=(DESK, box))
    edges = np.abs(hard - truth).max(-1) > 0.02 * truth.max()
    assert edges.sum() > 50
    before, after = (np.sqrt(((picture - truth)[edges] ** 2).mean()) for picture in (hard, smooth))
    assert after < before / np.sqrt(4), "no better than as many random samples"
    assert (hard == smooth).all(-1).mean() > 0.7
    dark = run_edges(4, [point((0.0, 0.0, -1.0))], proxies=(DESK, box))
    assert not dark.any()


def test_edges_of_cones_and_penumbrae_stay(device):
    """Both are smooth already: samples there would be wasted."""
    spot = {**point((0.05, 0.0, 0.4)), "kind": SPOT, "direction": (0, 0, -1), "inner_angle": 0.1, "outer_angle": 0.3}
    assert (run_edges(1, [spot]) == run_edges(4, [spot])).all()
    wide = [point((-0.1, 0.05, 0.5), radius=0.05)]
    hard, smooth = (run_edges(samples, wide, [HANGING], soft=True) for samples in (1, 4))
    assert (hard == smooth).all()
    assert len(np.unique(hard)) > 100, "no penumbra"


def test_edges_leave_balls_to_themselves(device):
    """Pixels of a ball stay black; those beside it are not darkened by what they see of it."""
    ball = {"center": (0.0, 0.0, 0.03), "radius": 0.03, "reflectance": (0.6, 0.6, 0.6)}
    lights = [point((0.0, 0.0, 0.55))]
    hard, smooth = (run_edges(samples, lights, probes=[ball]) for samples in (1, 4))
    shown = np.hypot(COLUMNS, ROWS) < 0.03 / np.sqrt(0.57**2 - 0.03**2)
    assert shown.sum() > 20
    assert not smooth[shown].any()
    outside = run_edges(1, lights)
    beside = smooth[~shown].max(-1)
    lit = beside > 0
    assert lit.any()
    assert (beside[lit] <= outside[~shown].max(-1)[lit] * (1 + 1e-4)).all()
    assert (smooth == hard)[~shown].all(-1).mean() > 0.9


def test_listed_edges_are_the_same(device):
    """Sampled on their own, or in place where the list does not hold them all."""
    lights = [point((-0.1, 0.05, 0.5))]
    box = shape(BOX, (0.0, 0.1, 0.04), (0.1, 0.06, 0.04)) | {"rotation": turn_z(0.3)}
    ball = {"center": (0.1, -0.05, 0.03), "radius": 0.03, "reflectance": (0.6, 0.6, 0.6)}
    expected, got = (run_edges(4, lights, [HANGING], (DESK, box), [ball], listed=n) for n in (0, 5))
    hard = run_edges(1, lights, [HANGING], (DESK, box), [ball])
    assert (expected != hard).any(-1).sum() > 50
    np.testing.assert_allclose(got, expected, rtol=0 if device == "cpu" else 1e-6)
