"""Sums that lanes make together; on CPU a lane is alone."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from warp_ar.kernels.cooperative import sum_beside, sum_of_lanes

COUNT = 512


@wp.kernel(enable_backward=False)
def _sums_kernel(values: wp.array[wp.vec4], share: wp.int32, out: wp.array[wp.vec4], ordered_out: wp.array[wp.vec3]):
    i = wp.tid()
    value = values[i]
    out[i] = sum_beside(value, share)
    more = wp.vec3(value[3], 0.0, 0.0)
    ordered_out[i] = sum_of_lanes(wp.vec3(value[0], value[1], value[2]), more, share)


@pytest.mark.parametrize("share", [1, 2, 4, 16])
def test_lanes_beside_each_other(device, share):
    """Each lane has the sum over its group; the ordered one to the last bit as one thread would make it."""
    share = 1 if device == "cpu" else share
    values = np.random.default_rng(1).uniform(-1.0, 1.0, (COUNT, 4)).astype(np.float32)
    out, ordered = wp.zeros(COUNT, dtype=wp.vec4, device=device), wp.zeros(COUNT, dtype=wp.vec3, device=device)
    wp.launch(
        _sums_kernel, COUNT, [wp.array(values, dtype=wp.vec4, device=device), share], [out, ordered], device=device
    )
    groups = values.reshape(-1, share, 4)
    np.testing.assert_allclose(out.numpy().reshape(groups.shape), groups.sum(1, keepdims=True) + 0 * groups, atol=1e-5)
    expected = np.zeros((len(groups), 3), np.float32)
    for lane in range(share):
        expected += groups[:, lane, :3]
        expected += groups[:, lane, 3:] * np.float32([1.0, 0.0, 0.0])
    np.testing.assert_array_equal(ordered.numpy().reshape(-1, share, 3), np.repeat(expected[:, None], share, 1))
