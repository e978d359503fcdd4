"""Every pixel of a frame has one number; those of a rectangle come first, warp by warp in tiles."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from hypothesis import example, given
from hypothesis import strategies as st

from warp_ar.kernels.launch import launch_rows
from warp_ar.kernels.pixel_order import own_pixel, rectangle_first

LANES = 32


@wp.kernel(enable_backward=False)
def _number_kernel(rect: wp.vec4i, height: wp.int32, width: wp.int32, alone: wp.int32, out: wp.array[wp.vec2i]):
    index = wp.tid()
    out[index] = rectangle_first(index, rect, height, width, alone != 0)


def numbered(rect, height, width, device, alone=False):
    out = wp.empty(height * width, dtype=wp.vec2i, device=device)
    wp.launch(_number_kernel, height * width, [wp.vec4i(*rect), height, width, int(alone)], [out], device=device)
    return out.numpy()


edges = st.integers(-20, 90)


@given(st.integers(1, 70), st.integers(1, 70), st.tuples(edges, edges, edges, edges))
@example(64, 64, (3, 40, 5, 50))
@example(48, 64, (0, 48, 0, 64))
@example(50, 61, (3, 50, 5, 61))
@example(8, 8, (9, 20, 0, 8))
@example(8, 8, (4, 4, 0, 8))
def test_each_pixel_has_one_number(height, width, rect):
    found = numbered(rect, height, width, "cpu")
    assert len(np.unique(found[:, 0] * width + found[:, 1])) == height * width
    assert (found >= 0).all()
    assert (found < [height, width]).all()
    # Nothing of the rectangle comes after what tiles cut around it.
    row, column = found[:, 0], found[:, 1]
    inside = (row >= rect[0]) & (row < rect[1]) & (column >= rect[2]) & (column < rect[3])
    if inside.any():
        down, across = np.ptp(row[inside]) + 1, np.ptp(column[inside]) + 1
        last = np.flatnonzero(inside)[-1]
        assert last < (down + 6) * (across + 14)
    # Alone, they have the same numbers, and the others none.
    alone = numbered(rect, height, width, "cpu", alone=True)
    counted = alone[:, 0] >= 0
    np.testing.assert_array_equal(alone[counted], found[: counted.sum()])
    np.testing.assert_array_equal(alone[~counted], -1)
    assert not inside[counted.sum() :].any()


def test_a_warp_has_a_tile(device):
    found = numbered((10, 41, 19, 90), 96, 128, device)
    first = found[: 36 * 80].reshape(-1, LANES, 2)
    assert (np.ptp(first, axis=1) == [3, 7]).all()
    assert (first.min(axis=1) % [4, 8] == 0).all()


@wp.kernel(enable_backward=False)
def _own_kernel(row_start: wp.int32, rect: wp.vec4i, height: wp.int32, width: wp.int32, out: wp.array2d[wp.int32]):
    i, j = wp.tid()
    pixel = own_pixel(i, j, row_start, rect, height, width)
    out[pixel[0], pixel[1]] += pixel[0] * width + pixel[1] + 1


@pytest.mark.parametrize("rows", [None, (0, 90), (7, 31)])
def test_launches_reach_every_pixel_once(device, rows):
    """With fewer blocks than would be needed on CUDA, or a band of rows anywhere."""
    height, width = 90, 12_000
    out = wp.zeros((height, width), dtype=wp.int32, device=device)
    given_ = [wp.vec4i(11, 60, 100, 9_000), height, width]
    launch_rows(_own_kernel, (height, width), given_, [out], rows=rows, device=device, rectangle_first=True)
    expected = np.arange(1, height * width + 1).reshape(height, width)
    start, stop = rows or (0, height)
    expected[:start] = expected[stop:] = 0
    np.testing.assert_array_equal(out.numpy(), expected)
