"""Summed-area table of a frame's intensity: the sum over any box from four look-ups [Cro84], exact at every size.

The table holds unsigned 32-bit integers, which may overflow: additions and subtractions modulo 2^32 undo each other.
So the sum over a box is exact if that sum is below 2^32, that is for boxes of up to 2^32 / 255 = 16.8 million pixels,
in a frame of any size. (Float32 sums are wrong by 126 grey levels at 4K.)

    table[i, j] = sum of intensity[0..i, 0..j] mod 2^32

It is written in two passes: along the rows, one thread per row, and then along the columns, one thread for a few
neighbouring columns.

A frame of more than 8 bits has a second table of the same kind, of the remainder that 8-bit intensities cut off
(``write_cut``), stored as bytes in steps of 1/64 code around 128. A mean is then the sum of both tables' means, exact
to 1/128 code. Where the remainder is 0, every byte is 128, and the mean equals the first table's to the bit.

References:
    [Cro84] Crow, "Summed-area tables for texture mapping", SIGGRAPH 1984.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.launch import Rows, launch_rows, row_launcher
from warp_ar.kernels.pixels import cut_luma

wp.set_module_options({"enable_backward": False})

NOT_CUT = wp.constant(wp.float32(128.0))
"""Byte that encodes a remainder of 0."""
CUT_STEPS = wp.constant(wp.float32(64.0))
"""Steps of the byte per 8-bit pixel value (code): it encodes remainders of -2 to almost 2 codes."""

COLUMNS = wp.constant(4)
"""Neighbouring columns that one thread sums: memory is read in whole words, and there are enough threads."""


@wp.func
def intensity(code: wp.vec3ub) -> wp.uint32:
    """Return the luma of an 8-bit colour, by Rec. 709 weights in 256ths; a grey keeps its value, white is 255."""
    return (
        wp.uint32(54) * wp.uint32(code[0])
        + wp.uint32(183) * wp.uint32(code[1])
        + wp.uint32(19) * wp.uint32(code[2])
        + wp.uint32(128)
    ) >> wp.uint32(8)


@wp.func
def box_sum(
    table: wp.array2d[wp.uint32], row_start: wp.int32, row_stop: wp.int32, col_start: wp.int32, col_stop: wp.int32
) -> wp.uint32:
    """Sum rows [row_start, row_stop) and columns [col_start, col_stop) inside the frame; an empty box gives 0."""
    r0 = wp.max(row_start, 0)
    r1 = wp.min(row_stop, table.shape[0])
    c0 = wp.max(col_start, 0)
    c1 = wp.min(col_stop, table.shape[1])
    if r1 <= r0 or c1 <= c0:
        return wp.uint32(0)
    total = table[r1 - 1, c1 - 1]
    if r0 > 0:
        total -= table[r0 - 1, c1 - 1]
    if c0 > 0:
        total -= table[r1 - 1, c0 - 1]
    if r0 > 0 and c0 > 0:
        total += table[r0 - 1, c0 - 1]
    return total


@wp.func
def box_mean(table: wp.array2d[wp.uint32], row: wp.int32, col: wp.int32, size: wp.int32) -> wp.float32:
    """Return the mean intensity, 0..255, of the box of ``size`` x ``size`` pixels around a pixel, cut by the frame.

    A box of even size reaches one pixel further up and left than down and right.
    """
    r0 = wp.max(row - size / 2, 0)
    c0 = wp.max(col - size / 2, 0)
    r1 = wp.min(row - size / 2 + size, table.shape[0])
    c1 = wp.min(col - size / 2 + size, table.shape[1])
    # A count in float32 is exact up to 2^24, which is the largest box that the table itself allows.
    return wp.float32(box_sum(table, r0, r1, c0, c1)) / wp.float32(wp.max((r1 - r0) * (c1 - c0), 1))


@wp.func
def fine_mean(
    table: wp.array2d[wp.uint32], cut_table: wp.array2d[wp.uint32], row: wp.int32, col: wp.int32, size: wp.int32
) -> wp.float32:
    """Return ``box_mean`` plus the mean remainder that 8 bits cut off; ``cut_table`` is empty for frames of 8 bits."""
    mean = box_mean(table, row, col, size)
    if cut_table.shape[0] > 0:
        mean += (box_mean(cut_table, row, col, size) - NOT_CUT) / CUT_STEPS
    return wp.clamp(mean, 0.0, 255.0)


@wp.kernel(enable_backward=False)
def write_cut_kernel(
    row_start: wp.int32,
    # In:
    frame: wp.array2d[wp.vec3ub],
    decode_table: wp.array[wp.vec3],
    linear: wp.array2d[wp.vec3],
    # Out:
    cut_out: wp.array2d[wp.vec3ub],
):
    """Write one pixel's encoded remainder as a grey, whose ``intensity`` equals its three bytes."""
    band_row, column = wp.tid()
    row = row_start + band_row
    steps = wp.round(CUT_STEPS * cut_luma(frame, decode_table, linear, row, column)) + NOT_CUT
    code = wp.uint8(wp.clamp(steps, 0.0, 255.0))
    cut_out[row, column] = wp.vec3ub(code, code, code)


write_cut = row_launcher(write_cut_kernel)
"""Write the part of a frame's intensity that rounding to 8 bits removed, as a grey frame to sum separately.

Args:
    frame: (H, W) vec3ub, RGB codes.
    decode_table: (256,) vec3, linear value of each code.
    linear: (H, W) vec3, linear radiance.
    cut_out: (H, W) vec3ub, greys: ``NOT_CUT`` plus ``CUT_STEPS`` times the remainder in codes.
"""


@wp.kernel(enable_backward=False)
def sum_rows_kernel(
    # In:
    row_start: wp.int32,
    frame: wp.array2d[wp.vec3ub],
    # Out:
    table_out: wp.array2d[wp.uint32],
):
    """Write the running sums of one row."""
    i = row_start + wp.tid()
    total = wp.uint32(0)
    for j in range(frame.shape[1]):
        total += intensity(frame[i, j])
        table_out[i, j] = total


@wp.kernel(enable_backward=False)
def sum_columns_kernel(
    # In:
    row_start: wp.int32,
    # Out:
    table_out: wp.array2d[wp.uint32],
):
    """Replace the sums along rows by their running sums down a few neighbouring columns."""
    first = (row_start + wp.tid()) * COLUMNS
    stop = wp.min(first + COLUMNS, table_out.shape[1])
    for i in range(1, table_out.shape[0]):
        for j in range(first, stop):
            table_out[i, j] = table_out[i, j] + table_out[i - 1, j]


sum_rows = row_launcher(sum_rows_kernel, like=lambda frame, _: frame.shape[:1])
"""Write the running sums along each row: the first pass.

Args:
    frame: (H, W) vec3ub, RGB.
    table_out: (H, W) uint32.
"""


def column_groups(width: int) -> int:
    """Return the number of threads of ``sum_columns`` for rows of ``width`` pixels."""
    return -(-width // int(COLUMNS))


def sum_columns(table_out: wp.array, *, rows: Rows | None = None) -> None:
    """Write the running sums down each column, in place: the second pass.

    Args:
        table_out: (H, W) uint32, from ``sum_rows``.
        rows: Band of threads, of ``column_groups(W)``; None means all.
    """
    shape = (column_groups(table_out.shape[1]),)
    launch_rows(sum_columns_kernel, shape, [], [table_out], rows=rows, device=table_out.device)


def sum_area(frame: wp.array, table_out: wp.array) -> None:
    """Write the whole summed-area table of a frame's intensity.

    Args:
        frame: (H, W) vec3ub, RGB.
        table_out: (H, W) uint32; entry (i, j) is the sum over rows 0..i and columns 0..j modulo 2^32.
    """
    sum_rows(frame, table_out)
    sum_columns(table_out)
