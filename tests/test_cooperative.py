"""Sums that lanes make together; on CPU a lane is alone."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from warp_ar.kernels.cooperative import of_lane, sum_beside

COUNT = 512


@wp.kernel(enable_backward=False)
def _sums_kernel(values: wp.array[wp.vec3], share: wp.int32, sum_out: wp.array[wp.vec3], last_out: wp.array[wp.vec3]):
    i = wp.tid()
    sum_out[i] = sum_beside(values[i], share)
    last_out[i] = of_lane(values[i], share - 1, share)


@pytest.mark.parametrize("share", [1, 2, 4, 16, 32])
def test_lanes_beside_each_other(device, share):
    """Each lane has the sum over its group, to the last bit as one thread would make it, and what another lane has."""
    share = 1 if device == "cpu" else share
    values = np.random.default_rng(1).uniform(-1.0, 1.0, (COUNT, 3)).astype(np.float32)
    total, last = (wp.zeros(COUNT, dtype=wp.vec3, device=device) for _ in range(2))
    wp.launch(
        _sums_kernel, COUNT, [wp.array(values, dtype=wp.vec3, device=device), share], [total, last], device=device
    )
    groups = values.reshape(-1, share, 3)
    expected = np.zeros((len(groups), 3), np.float32)
    for lane in range(share):
        expected += groups[:, lane]
    np.testing.assert_array_equal(total.numpy().reshape(groups.shape), np.repeat(expected[:, None], share, 1))
    np.testing.assert_array_equal(last.numpy().reshape(groups.shape), np.repeat(groups[:, -1:], share, 1))
