"""A case at one quality, and what its stages wrote."""

from __future__ import annotations

import time

import numpy as np
import pytest

from tests.accuracy_rig import case, frames, setting  # noqa: F401  (fixtures)
from warp_ar.accuracy import runs
from warp_ar.stages.quality import PRESETS

# Bilinear resampling of a cosine lobe from 32 rows.
MAP = 3e-3


def test_sparse_runs_keep_the_light(case, device):
    """Frames before the one that counts may run at another quality without a trace."""
    other = PRESETS["low"].with_methods(irradiance="sh2")
    full = runs.run(case, PRESETS["low"], device, setting("recover"))
    sparse = runs.run(case, PRESETS["low"], device, setting("recover"), between=other)
    np.testing.assert_array_equal(sparse.output, full.output)
    assert np.abs(sparse.images[3].astype(int) - full.images[3]).max() <= 1


def test_in_turn_is_alone(case, device):
    """Qualities that run in turn do not touch each other."""
    qualities = {"a": PRESETS["low"], "b": PRESETS["low"].with_methods(irradiance="sh2")}
    times, images = runs.run_in_turn(case, qualities, device, time.perf_counter)
    for label, quality in qualities.items():
        alone = runs.run(case, quality, device)
        np.testing.assert_array_equal(images[label][3], alone.images[3])
        assert len(times[label]) == len(case.frames) - runs.WARM_UP


@pytest.mark.parametrize("shape", [(4, 8), (32, 64), (7, 14)])
def test_resampling_keeps_a_constant_map(shape):
    np.testing.assert_allclose(runs.resample(np.full((*shape, 3), 2.0, np.float32), runs.NORMALS), 2.0)


def test_irradiance_of_both_forms_agrees():
    """Order 1, which a small map holds to its bilinear error: E = pi (1 + d / 2) for radiance 1 + 3/4 d, d one axis."""
    coefficients = np.zeros((9, 3))
    coefficients[0] = np.pi / 0.28209479
    for channel, index in enumerate((3, 1, 2)):  # x, y, z
        coefficients[index, channel] = 0.5 * np.pi / 0.48860251
    from_sh = runs.irradiance_from_sh(coefficients)
    exact = np.pi * (1.0 + 0.5 * runs._directions(32, 64))
    np.testing.assert_allclose(from_sh, np.pi * (1.0 + 0.5 * runs._directions(*runs.NORMALS)), rtol=1e-6)
    np.testing.assert_allclose(runs.resample(exact, runs.NORMALS), from_sh, rtol=MAP)


def test_a_kept_light_changes_no_picture(case, device):
    """What further qualities go on from is as if each had lit the frames before by itself."""
    between = PRESETS["low"].with_methods(irradiance="sh2")
    with runs.LightBefore() as before:
        for method in ("sphere_mip", "clusters"):
            quality = PRESETS["low"].with_methods(irradiance=method)
            alone = runs.run(case, quality, device, setting("recover"), between=between, timed=2)
            kept = runs.run(case, quality, device, setting("recover"), between=between, timed=2, before=before)
            np.testing.assert_array_equal(kept.images[3], alone.images[3])
            np.testing.assert_array_equal(kept.output, alone.output)
        kept_for = before.light(case, 2, between, device, time.perf_counter)
        assert before.light(case, 2, between, device, time.perf_counter) is kept_for
        assert before.light(case, 2, PRESETS["low"], device, time.perf_counter) is not kept_for
