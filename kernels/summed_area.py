"""Summed-area table of a frame's intensity: the sum over any box from four look-ups [Cro84], exact at every size.

The table holds unsigned 32-bit integers and is meant to overflow: additions and subtractions modulo 2^32 undo each
other, so the sum over a box is exact whenever that sum itself is below 2^32, that is for boxes of up to 2^32 / 255 =
16.8 million pixels, in a frame of any size. (Float32 sums are wrong by 126 grey levels at 4K.)

    table[i, j] = sum of intensity[0..i, 0..j] mod 2^32

Rows are summed first, then columns. A row belongs to one thread; columns are taken in blocks of neighbours, which on
CPU share cache lines and on CUDA are one column wide, so that neighbouring threads read neighbouring addresses.

References:
    [Cro84] Crow, "Summed-area tables for texture mapping", SIGGRAPH 1984.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.launch import Rows, launch_rows

wp.set_module_options({"enable_backward": False})

CPU_COLUMN_BLOCK = 64
"""Columns that one CPU thread sums side by side: four cache lines of the table."""


@wp.func
def intensity(code: wp.vec3ub) -> wp.uint32:
    """Luma of an 8-bit colour with Rec. 709 weights in 256ths; a grey keeps its value, white is 255."""
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
    """Sum over rows [row_start, row_stop) and columns [col_start, col_stop) inside the frame; an empty box gives 0."""
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
    """Mean intensity, 0..255, of the part inside the frame of the box of ``size`` x ``size`` pixels around a pixel.

    An even box reaches one pixel further up and left than down and right.
    """
    r0 = wp.max(row - size / 2, 0)
    c0 = wp.max(col - size / 2, 0)
    r1 = wp.min(row - size / 2 + size, table.shape[0])
    c1 = wp.min(col - size / 2 + size, table.shape[1])
    # A count in float32 is exact up to 2^24, which is the largest box that the table itself allows.
    return wp.float32(box_sum(table, r0, r1, c0, c1)) / wp.float32(wp.max((r1 - r0) * (c1 - c0), 1))


@wp.kernel(enable_backward=False)
def sum_along_rows_kernel(
    # In:
    row_start: wp.int32,
    frame: wp.array2d[wp.vec3ub],
    # Out:
    table_out: wp.array2d[wp.uint32],
):
    """One thread per row."""
    i = row_start + wp.tid()
    total = wp.uint32(0)
    for j in range(frame.shape[1]):
        total += intensity(frame[i, j])
        table_out[i, j] = total


@wp.kernel(enable_backward=False)
def sum_along_columns_kernel(
    # In:
    column_start: wp.int32,
    column_stop: wp.int32,
    block: wp.int32,
    # Out:
    table_out: wp.array2d[wp.uint32],
):
    """One thread per block of columns; it adds whole rows, so the previous one is in the cache."""
    start = column_start + wp.tid() * block
    stop = wp.min(start + block, column_stop)
    for i in range(1, table_out.shape[0]):
        for j in range(start, stop):
            table_out[i, j] = table_out[i - 1, j] + table_out[i, j]


def sum_along_rows(frame: wp.array, table_out: wp.array, *, rows: Rows | None = None) -> None:
    """Write the running sums of every row's intensity; first half of the table.

    Args:
        frame: (H, W) vec3ub, RGB.
        table_out: (H, W) uint32.
        rows: Band of rows; None means all.
    """
    launch_rows(sum_along_rows_kernel, (frame.shape[0],), [frame], [table_out], rows=rows, device=frame.device)


def sum_along_columns(table_out: wp.array, *, columns: Rows | None = None) -> None:
    """Sum row sums down every column, in place; second half of the table.

    Args:
        table_out: (H, W) uint32, row sums.
        columns: Band of columns; None means all.
    """
    start, stop = columns if columns is not None else (0, table_out.shape[1])
    block = CPU_COLUMN_BLOCK if table_out.device.is_cpu else 1
    if stop > start:
        wp.launch(
            sum_along_columns_kernel,
            dim=-(-(stop - start) // block),
            inputs=[start, stop, block],
            outputs=[table_out],
            device=table_out.device,
        )


def sum_area(frame: wp.array, table_out: wp.array) -> None:
    """Write the whole summed-area table of a frame's intensity.

    Args:
        frame: (H, W) vec3ub, RGB.
        table_out: (H, W) uint32; entry (i, j) is the sum over rows 0..i and columns 0..j modulo 2^32.
    """
    sum_along_rows(frame, table_out)
    sum_along_columns(table_out)
