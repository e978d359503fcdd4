"""Summed-area table of a frame's intensity: the sum over any box from four look-ups [Cro84], exact at every size.

The table holds unsigned 32-bit integers and is meant to overflow: additions and subtractions modulo 2^32 undo each
other, so the sum over a box is exact whenever that sum itself is below 2^32, that is for boxes of up to 2^32 / 255 =
16.8 million pixels, in a frame of any size. (Float32 sums are wrong by 126 grey levels at 4K.)

    table[i, j] = sum of intensity[0..i, 0..j] mod 2^32

It is written in one of two forms. *By slabs* (here), for CPU: a thread takes a slab of whole rows, sixteen pixels of a
row at a time in a processor's vectors, and adds the row above; the slabs then add what those above them sum up to.
There are as many slabs as threads: one thread reads the frame once and writes the table once. On CUDA that would be a
few threads, each waiting for load after load: there it is *by strips* (``kernels/picture/summed_area_strips.py``).

A frame of more than 8 bits has a second table, in the same way, of what the 8 bits of its intensity cut off
(``write_cut``), as bytes of 1/64 code around 128: a mean is then the sum of both tables' means, exact to 1/128 code.
Where nothing was cut off every byte is 128, and the mean is the first table's to the bit.

References:
    [Cro84] Crow, "Summed-area tables for texture mapping", SIGGRAPH 1984.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.launch import Rows, launch, launch_rows
from warp_ar.kernels.pixels import cut_luma

wp.set_module_options({"enable_backward": False})

NOT_CUT = wp.constant(wp.float32(128.0))
"""Byte of a pixel off which nothing was cut."""
CUT_STEPS = wp.constant(wp.float32(64.0))
"""Steps of such bytes in a code: two codes at most to either side."""

LEAST_SLAB = 16
"""Rows of a slab: fewer take longer to be joined than to be summed."""


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


@wp.func
def fine_mean(
    table: wp.array2d[wp.uint32], cut_table: wp.array2d[wp.uint32], row: wp.int32, col: wp.int32, size: wp.int32
) -> wp.float32:
    """``box_mean`` with what 8 bits cut off; ``cut_table`` is empty where nothing was."""
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
    """One pixel, as a grey whose ``intensity`` is its code."""
    band_row, column = wp.tid()
    row = row_start + band_row
    steps = wp.round(CUT_STEPS * cut_luma(frame, decode_table, linear, row, column)) + NOT_CUT
    code = wp.uint8(wp.clamp(steps, 0.0, 255.0))
    cut_out[row, column] = wp.vec3ub(code, code, code)


def write_cut(
    frame: wp.array, decode_table: wp.array, linear: wp.array, cut_out: wp.array, *, rows: Rows | None = None
) -> None:
    """Write what 8 bits cut off a frame's intensity as a frame of its own, to be summed like one.

    Args:
        frame: (H, W) vec3ub, RGB codes.
        decode_table: (256,) vec3, linear value of each code.
        linear: (H, W) vec3, linear radiance.
        cut_out: (H, W) vec3ub, greys: ``NOT_CUT`` and ``CUT_STEPS`` for each code that is cut off.
        rows: Band of rows; None means all.
    """
    inputs = [frame, decode_table, linear]
    launch_rows(write_cut_kernel, frame.shape, inputs, [cut_out], rows=rows, device=frame.device)


# Luma fits 16 bits before the shift, and so do sums of sixteen; sums along a row need 32. Loads and stores of sixteen
# neighbours are single ones, colours are told apart by shuffles, and a sum over sixteen is four steps of shifted adds.
@wp.func_native("""
    const int width = frame.shape[1];
    const unsigned char* line = reinterpret_cast<const unsigned char*>(frame.data) + size_t(row) * frame.strides[0];
    unsigned int* sums = table.data + size_t(row) * width;
    const unsigned int* above = first ? nullptr : sums - width;
    unsigned int total = 0;
    int j = 0;
#if !defined(__CUDA_ARCH__)
    typedef unsigned char Bytes __attribute__((ext_vector_type(16), aligned(1)));
    typedef unsigned short Halves __attribute__((ext_vector_type(16)));
    typedef unsigned int Words __attribute__((ext_vector_type(16), aligned(4)));
    const Halves none = 0;
    for (; j + 16 <= width; j += 16) {
        const unsigned char* at = line + 3 * j;
        const auto front = __builtin_shufflevector(*(const Bytes*)at, *(const Bytes*)(at + 16),
            0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15,
            16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31);
        const Bytes last = *(const Bytes*)(at + 32);
        const auto back = __builtin_shufflevector(last, last,
            0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15,
            -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1);
        const auto red = __builtin_shufflevector(front, back,
            0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 33, 36, 39, 42, 45);
        const auto green = __builtin_shufflevector(front, back,
            1, 4, 7, 10, 13, 16, 19, 22, 25, 28, 31, 34, 37, 40, 43, 46);
        const auto blue = __builtin_shufflevector(front, back,
            2, 5, 8, 11, 14, 17, 20, 23, 26, 29, 32, 35, 38, 41, 44, 47);
        Halves value = (__builtin_convertvector(red, Halves) * 54 + __builtin_convertvector(green, Halves) * 183
            + __builtin_convertvector(blue, Halves) * 19 + 128) >> 8;
        value += __builtin_shufflevector(none, value, 0, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30);
        value += __builtin_shufflevector(none, value, 0, 1, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29);
        value += __builtin_shufflevector(none, value, 0, 1, 2, 3, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27);
        value += __builtin_shufflevector(none, value, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23);
        Words sum = __builtin_convertvector(value, Words) + total;
        total += value[15];
        if (above != nullptr) sum += *(const Words*)(above + j);
        *(Words*)(sums + j) = sum;
    }
#endif
    for (; j < width; ++j) {
        total += (54u * line[3 * j] + 183u * line[3 * j + 1] + 19u * line[3 * j + 2] + 128u) >> 8;
        sums[j] = total + (above != nullptr ? above[j] : 0u);
    }
""")
def sum_row(frame: wp.array2d[wp.vec3ub], table: wp.array2d[wp.uint32], row: wp.int32, first: wp.bool):
    """Write a row of a slab's table; ``first`` of the slab: there is none above.

    The table is contiguous, and rows of the frame are.
    """


@wp.func_native("""
    unsigned int* sums = table.data + size_t(row) * table.shape[1];
    const unsigned int* more = offsets.data + size_t(slab) * offsets.shape[1];
    for (int j = 0; j < table.shape[1]; ++j) sums[j] += more[j];
""")
def add_row(table: wp.array2d[wp.uint32], row: wp.int32, offsets: wp.array2d[wp.uint32], slab: wp.int32):
    """Add a row of sums to a row of the table."""


@wp.func
def slab_start(slab: wp.int32, slabs: wp.int32, height: wp.int32) -> wp.int32:
    """First row of a slab: they differ by a row at most."""
    return slab * height / slabs


@wp.kernel(enable_backward=False)
def sum_slabs_kernel(
    # In:
    row_start: wp.int32,
    frame: wp.array2d[wp.vec3ub],
    # Out:
    table_out: wp.array2d[wp.uint32],
    ends_out: wp.array2d[wp.uint32],
):
    """One thread per slab: its own table, whose last row is kept for those below."""
    slab = row_start + wp.tid()
    height = frame.shape[0]
    start = slab_start(slab, ends_out.shape[0], height)
    stop = slab_start(slab + 1, ends_out.shape[0], height)
    for i in range(start, stop):
        sum_row(frame, table_out, i, i == start)
    for j in range(frame.shape[1]):
        ends_out[slab, j] = table_out[stop - 1, j]


@wp.kernel(enable_backward=False)
def add_ends_kernel(
    # In:
    slabs: wp.int32,
    # Out:
    ends_out: wp.array2d[wp.uint32],
):
    """One thread: the last rows of slabs become sums over all slabs down to each."""
    for slab in range(1, slabs - 1):
        for j in range(ends_out.shape[1]):
            ends_out[slab, j] = ends_out[slab, j] + ends_out[slab - 1, j]


@wp.kernel(enable_backward=False)
def join_slabs_kernel(
    # In:
    row_start: wp.int32,
    ends: wp.array2d[wp.uint32],
    # Out:
    table_out: wp.array2d[wp.uint32],
):
    """One thread per slab but the first: adds what all above it sum up to."""
    slab = row_start + wp.tid() + 1
    height = table_out.shape[0]
    for i in range(slab_start(slab, ends.shape[0], height), slab_start(slab + 1, ends.shape[0], height)):
        add_row(table_out, i, ends, slab - 1)


def slab_shape(height: int, width: int, threads: int) -> tuple[int, int]:
    """Shape of the scratch array of ``sum_slabs`` for so many threads: a row per slab."""
    return max(1, min(threads, height // LEAST_SLAB)), width


def sum_slabs(frame: wp.array, table_out: wp.array, ends_out: wp.array, *, rows: Rows | None = None) -> None:
    """Write the table of each slab by itself; first part of the table.

    Args:
        frame: (H, W) vec3ub, RGB; pixels of a row side by side.
        table_out: (H, W) uint32, contiguous.
        ends_out: Last row of each slab, uint32, of ``slab_shape``.
        rows: Band of slabs; None means all.
    """
    launch_rows(sum_slabs_kernel, ends_out.shape[:1], [frame], [table_out, ends_out], rows=rows, device=frame.device)


def add_ends(ends_out: wp.array) -> None:
    """Sum the last rows of slabs, in place; second part of the table."""
    launch(add_ends_kernel, 1, [ends_out.shape[0]], [ends_out], device=ends_out.device)


def join_slabs(ends: wp.array, table_out: wp.array, *, rows: Rows | None = None) -> None:
    """Add to each slab what those above it sum up to; last part of the table.

    Args:
        ends: From ``add_ends``.
        table_out: From ``sum_slabs``.
        rows: Band of slabs but the first; None means all.
    """
    launch_rows(join_slabs_kernel, (ends.shape[0] - 1,), [ends], [table_out], rows=rows, device=table_out.device)


def sum_area(frame: wp.array, table_out: wp.array) -> None:
    """Write the whole summed-area table of a frame's intensity, by one thread.

    Args:
        frame: (H, W) vec3ub, RGB; pixels of a row side by side.
        table_out: (H, W) uint32; entry (i, j) is the sum over rows 0..i and columns 0..j modulo 2^32.
    """
    ends = wp.empty(slab_shape(*frame.shape, 1), dtype=wp.uint32, device=frame.device)
    sum_slabs(frame, table_out, ends)
