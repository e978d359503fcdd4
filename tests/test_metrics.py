"""Errors against closed forms; FLIP at its two ends."""

import numpy as np
import pytest

from warp_ar.accuracy import metrics
from warp_ar.accuracy.metrics import array_error, changed_region, clipped_region, flip_map, latlong_weights

# Sums in float64.
EXACT = 1e-12


def test_equal_arrays_have_no_error():
    values = np.random.default_rng(0).random((5, 7, 3))
    error = array_error(values, values)
    assert (error.relative_rmse, error.worst, error.energy_drift) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("gain", [0.0, 0.9, 1.25])
def test_a_gain_is_its_own_error(gain):
    reference = np.random.default_rng(1).random((6, 8, 3))
    weights = np.random.default_rng(2).random((6, 8))
    error = array_error(gain * reference, reference, weights)
    assert error.relative_rmse == pytest.approx(abs(gain - 1.0), abs=EXACT)
    assert error.energy_drift == pytest.approx(gain - 1.0, abs=EXACT)


def test_worst_is_one_element_over_the_mean():
    reference = np.full((4, 4), 2.0)
    values = reference.copy()
    values[1, 2] += 3.0
    assert array_error(values, reference).worst == pytest.approx(1.5, abs=EXACT)
    assert array_error(values, reference).relative_rmse == pytest.approx(1.5 / 4.0, abs=EXACT)


def test_weights_of_zero_hide_an_error():
    reference, values = np.ones((3, 4, 3)), np.ones((3, 4, 3))
    values[0] = 9.0
    weights = np.ones((3, 4))
    weights[0] = 0.0
    assert array_error(values, reference, weights).relative_rmse == 0.0


def test_light_where_none_should_be_is_infinitely_wrong():
    assert array_error(np.ones(3), np.zeros(3)).relative_rmse == np.inf
    assert array_error(np.zeros(3), np.zeros(3)).relative_rmse == 0.0


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match=r"shape \(2,\), their reference \(3,\)"):
        array_error(np.ones(2), np.ones(3))
    with pytest.raises(ValueError, match="finite"):
        array_error(np.array([np.nan]), np.ones(1))


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (64, 128)])
def test_solid_angles_sum_to_the_sphere(shape):
    assert latlong_weights(*shape).sum() == pytest.approx(4.0 * np.pi)


def test_flip_ends():
    pytest.importorskip("flip_evaluator")
    black, white = np.zeros((16, 24, 3), np.uint8), np.full((16, 24, 3), 255, np.uint8)
    assert flip_map(black, black).max() == 0.0
    assert flip_map(black, black).shape == (16, 24)
    assert flip_map(black, white).mean() > 0.9


def test_changed_region_takes_what_changed_and_no_noise():
    camera = np.random.default_rng(0).integers(100, 104, (60, 80, 3)).astype(np.uint8)
    truth = camera.copy()
    truth[20:40, 30:50] += 60
    region = changed_region(camera, truth)
    assert region[20:40, 30:50].all()
    assert not region[:5].any()
    assert not changed_region(camera, camera ^ 1).any()


def test_clipped_region_is_any_channel():
    camera = np.full((2, 3, 3), 253, np.uint8)
    camera[0, 1, 2] = 254
    assert clipped_region(camera).sum() == 1


@pytest.mark.parametrize("box", [np.s_[0:5, 0:5], np.s_[40:60, 70:100], np.s_[115:120, :]])
def test_flip_looks_only_where_pictures_differ(box):
    """Elsewhere it is 0; the same bits as of whole pictures."""
    rng = np.random.default_rng(5)
    reference = rng.integers(0, 256, (120, 160, 3)).astype(np.uint8)
    test = reference.copy()
    test[box] = rng.integers(0, 256, test[box].shape)
    errors = flip_map(reference, test)
    np.testing.assert_array_equal(errors, metrics._evaluate_flip(reference, test))
    assert flip_map(reference, test) is errors
    assert not flip_map(test, test).any()
