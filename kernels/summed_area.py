"""Summed-area table of a frame's intensity: the sum over any box from four look-ups [Cro84], exact at every size.

The table holds unsigned 32-bit integers and is meant to overflow: additions and subtractions modulo 2^32 undo each
other, so the sum over a box is exact whenever that sum itself is below 2^32, that is for boxes of up to 2^32 / 255 =
16.8 million pixels, in a frame of any size. (Float32 sums are wrong by 126 grey levels at 4K.)

    table[i, j] = sum of intensity[0..i, 0..j] mod 2^32

Two forms. *By rows, then columns* (``sum_area``), for CPU: a row belongs to one thread; columns are taken in blocks of
neighbours that share cache lines. On CUDA that would be a few thousand threads, each waiting for load after load.

*By tiles* (``sum_area_tiled``), for CUDA: a tile is a strip of rows, and as many columns as a warp has lanes, times
four. (1) Every tile's row sums and column sums, and its total; (2) along each row the sums of the tiles to the left,
and along each strip the running sums of its columns; (3) every tile runs down its rows,

    table[i, j] = table[i - 1, j] + left[i, tile] + sum of intensity[i, first column of the tile .. j],

where the row above the tile is the sum over the strips above. The frame is read twice, the second time out of the
cache, and the table written once; sums along a row go from lane to lane. Rows are loaded some at a time, before the
first of them is needed: a warp that waits for every row takes five times as long. A tile of one lane, as on CPU, is the
same sum: it is how the form is tested there.

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


ROWS_AHEAD = wp.constant(8)
"""Rows that a tile loads at a time."""

vec4u = wp.types.vector(length=4, dtype=wp.uint32)
row_of_sums = wp.types.vector(length=8, dtype=wp.uint32)
rows_of_four = wp.types.matrix(shape=(8, 4), dtype=wp.uint32)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int reach = 1; reach < 32; reach *= 2) {
        const unsigned int below = __shfl_up_sync(0xffffffffu, value, reach);
        if ((threadIdx.x & 31) >= reach) value += below;
    }
#endif
    return value;
""")
def scan_lanes(value: wp.uint32) -> wp.uint32:
    """Sum of a value over the warp's lanes up to this one; on CPU a warp has one lane."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    value = __shfl_sync(0xffffffffu, value, 31);
#endif
    return value;
""")
def last_lane(value: wp.uint32) -> wp.uint32:
    """The last lane's value."""


@wp.func_native("""
    return reinterpret_cast<const unsigned int*>(frame.data)[(size_t(row) * frame.shape[1] + column) / 4 * 3 + word];
""")
def load_word(frame: wp.array2d[wp.vec3ub], row: wp.int32, column: wp.int32, word: wp.int32) -> wp.uint32:
    """One of the three words of four pixels; columns and the frame's width are multiples of four."""


@wp.func_native("""
    const unsigned int* at = table.data + size_t(row) * table.shape[1] + column;
#if defined(__CUDA_ARCH__)
    if (table.shape[1] % 4 == 0) {
        const uint4 four = *reinterpret_cast<const uint4*>(at);
        return wp::vec_t<4, wp::uint32>(four.x, four.y, four.z, four.w);
    }
#endif
    wp::vec_t<4, wp::uint32> value;
    for (int k = 0; k < 4 && column + k < table.shape[1]; ++k) value[k] = at[k];
    return value;
""")
def load_four(table: wp.array2d[wp.uint32], row: wp.int32, column: wp.int32) -> vec4u:
    """Four neighbours, in one piece where rows are aligned; 0 beyond the row's end."""


@wp.func_native("""
    unsigned int* at = table.data + size_t(row) * table.shape[1] + column;
#if defined(__CUDA_ARCH__)
    if (table.shape[1] % 4 == 0) {
        *reinterpret_cast<uint4*>(at) = make_uint4(value[0], value[1], value[2], value[3]);
        return;
    }
#endif
    for (int k = 0; k < 4 && column + k < table.shape[1]; ++k) at[k] = value[k];
""")
def store_four(table: wp.array2d[wp.uint32], row: wp.int32, column: wp.int32, value: vec4u):
    """Write four neighbours, in one piece where rows are aligned; those beyond the row's end are dropped."""


@wp.func
def packed_intensity(red: wp.uint32, green: wp.uint32, blue: wp.uint32) -> wp.uint32:
    """``intensity`` of the lowest bytes of three words."""
    byte = wp.uint32(255)
    return (
        wp.uint32(54) * (red & byte) + wp.uint32(183) * (green & byte) + wp.uint32(19) * (blue & byte) + wp.uint32(128)
    ) >> wp.uint32(8)


@wp.func
def aligned_intensities(frame: wp.array2d[wp.vec3ub], row: wp.int32, column: wp.int32) -> vec4u:
    """Intensity of four pixels; columns and the frame's width are multiples of four."""
    # R0 G0 B0 R1, G1 B1 R2 G2, B2 R3 G3 B3 from the lowest byte up.
    a = load_word(frame, row, column, 0)
    b = load_word(frame, row, column, 1)
    c = load_word(frame, row, column, 2)
    return vec4u(
        packed_intensity(a, a >> wp.uint32(8), a >> wp.uint32(16)),
        packed_intensity(a >> wp.uint32(24), b, b >> wp.uint32(8)),
        packed_intensity(b >> wp.uint32(16), b >> wp.uint32(24), c),
        packed_intensity(c >> wp.uint32(8), c >> wp.uint32(16), c >> wp.uint32(24)),
    )


@wp.func
def four_intensities(frame: wp.array2d[wp.vec3ub], row: wp.int32, column: wp.int32) -> vec4u:
    """Intensity of a pixel and the three to its right; 0 beyond the row's end."""
    width = frame.shape[1]
    value = vec4u()
    if width % 4 == 0:
        if column < width:
            value = aligned_intensities(frame, row, column)
    else:
        for k in range(4):
            if column + k < width:
                value[k] = intensity(frame[row, column + k])
    return value


@wp.func
def intensities_ahead(frame: wp.array2d[wp.vec3ub], first: wp.int32, column: wp.int32) -> rows_of_four:
    """``four_intensities`` of ``ROWS_AHEAD`` rows; 0 beyond the last row."""
    rows = rows_of_four()
    height = frame.shape[0]
    width = frame.shape[1]
    if width % 4 == 0:
        # Loads without conditions go out together; what lies outside is put to 0 afterwards.
        inside = wp.min(column, width - 4)
        for k in range(ROWS_AHEAD):
            rows[k] = aligned_intensities(frame, wp.min(first + k, height - 1), inside)
        for k in range(ROWS_AHEAD):
            if first + k >= height or column >= width:
                rows[k] = vec4u()
    else:
        for k in range(ROWS_AHEAD):
            if first + k < height:
                rows[k] = four_intensities(frame, first + k, column)
    return rows


@wp.kernel(enable_backward=False)
def sum_along_rows_kernel(
    # In:
    row_start: wp.int32,
    frame: wp.array2d[wp.vec3ub],
    # Out:
    table_out: wp.array2d[wp.uint32],
):
    """One thread per row, four columns at a time."""
    i = row_start + wp.tid()
    total = wp.uint32(0)
    for j in range(0, frame.shape[1], 4):
        value = four_intensities(frame, i, j)
        value[0] = value[0] + total
        value[1] = value[1] + value[0]
        value[2] = value[2] + value[1]
        value[3] = value[3] + value[2]
        store_four(table_out, i, j, value)
        total = value[3]


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


@wp.kernel(enable_backward=False)
def sum_tiles_kernel(
    # In:
    lanes: wp.int32,
    strip: wp.int32,
    frame: wp.array2d[wp.vec3ub],
    # Out:
    row_sums_out: wp.array2d[wp.uint32],
    column_sums_out: wp.array2d[wp.uint32],
    totals_out: wp.array2d[wp.uint32],
):
    """Row sums, column sums and total of every tile; a warp per tile, four columns per lane."""
    strip_index, t = wp.tid()
    column = 4 * t
    columns = vec4u()
    total = wp.uint32(0)
    for first in range(strip_index * strip, (strip_index + 1) * strip, ROWS_AHEAD):
        rows = intensities_ahead(frame, first, column)
        for k in range(ROWS_AHEAD):
            columns += rows[k]
            row = scan_lanes(rows[k, 0] + rows[k, 1] + rows[k, 2] + rows[k, 3])
            total += row
            if first + k < frame.shape[0] and t % lanes == lanes - 1:
                row_sums_out[first + k, t // lanes] = row
    if t % lanes == lanes - 1:
        totals_out[strip_index, t // lanes] = total
    if column < frame.shape[1]:
        store_four(column_sums_out, strip_index, column, columns)


@wp.kernel(enable_backward=False)
def scan_sums_kernel(
    # In:
    lanes: wp.int32,
    totals: wp.array2d[wp.uint32],
    # Out (and in: sums of every tile):
    row_sums_out: wp.array2d[wp.uint32],
    column_sums_out: wp.array2d[wp.uint32],
):
    """A warp per row: what lies left of each tile. A warp per tile: running sums along its strip's columns."""
    t = wp.tid()
    line = t // lanes
    lane = t % lanes
    width = column_sums_out.shape[1]
    tiles = (width + 4 * lanes - 1) // (4 * lanes)
    if line < row_sums_out.shape[0]:
        carry = wp.uint32(0)
        for first in range(0, tiles, lanes):
            own = wp.uint32(0)
            if first + lane < tiles:
                own = row_sums_out[line, first + lane]
            running = scan_lanes(own)
            if first + lane < tiles:
                row_sums_out[line, first + lane] = carry + running - own
            carry += last_lane(running)
    else:
        line -= row_sums_out.shape[0]
        row = line // tiles
        tile = line % tiles
        column = 4 * (tile * lanes + lane)
        sums = vec4u()
        for k in range(4):
            if column + k < width:
                sums[k] = column_sums_out[row, column + k]
        own = wp.uint32(0)
        for k in range(lane, tile, lanes):
            own += totals[row, k]
        sums[1] = sums[1] + sums[0]
        sums[2] = sums[2] + sums[1]
        sums[3] = sums[3] + sums[2]
        before = last_lane(scan_lanes(own)) + scan_lanes(sums[3]) - sums[3]
        if column < width:
            store_four(column_sums_out, row, column, sums + vec4u(before, before, before, before))


@wp.kernel(enable_backward=False)
def write_tiles_kernel(
    # In:
    lanes: wp.int32,
    strip: wp.int32,
    frame: wp.array2d[wp.vec3ub],
    row_sums: wp.array2d[wp.uint32],
    column_sums: wp.array2d[wp.uint32],
    # Out:
    table_out: wp.array2d[wp.uint32],
):
    """The table, tile by tile."""
    strip_index, t = wp.tid()
    column = 4 * t
    width = frame.shape[1]
    total = vec4u()
    inside = wp.where(width % 4 == 0, wp.min(column, width - 4), wp.min(column, width - 1))
    for first in range(0, strip_index, ROWS_AHEAD):
        strips = rows_of_four()
        for k in range(ROWS_AHEAD):
            strips[k] = load_four(column_sums, wp.min(first + k, strip_index - 1), inside)
        for k in range(ROWS_AHEAD):
            if first + k < strip_index:
                total += strips[k]
    for first in range(strip_index * strip, (strip_index + 1) * strip, ROWS_AHEAD):
        rows = intensities_ahead(frame, first, column)
        left = row_of_sums()
        for k in range(ROWS_AHEAD):
            left[k] = row_sums[wp.min(first + k, frame.shape[0] - 1), t // lanes]
        for k in range(ROWS_AHEAD):
            value = rows[k]
            value[1] = value[1] + value[0]
            value[2] = value[2] + value[1]
            value[3] = value[3] + value[2]
            before = left[k] + scan_lanes(value[3]) - value[3]
            total += value + vec4u(before, before, before, before)
            if first + k < frame.shape[0] and column < width:
                store_four(table_out, first + k, column, total)


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


def _lanes(device: wp.DeviceLike) -> int:
    return 1 if wp.get_device(device).is_cpu else 32


def tiled_shapes(height: int, width: int) -> tuple[tuple[int, int], ...]:
    """Shapes of the scratch arrays of ``sum_area_tiled`` for a frame of this size: row sums, column sums, totals."""
    strips, tiles = -(-height // strip_rows(height)), -(-width // 4)
    return (height, tiles), (strips, width), (strips, tiles)


def strip_rows(height: int) -> int:
    """Rows of a strip: enough strips to fill a device, few enough that summing those above a tile stays cheap."""
    return 16 if height <= 1200 else 32


def sum_area_tiled(
    frame: wp.array, row_sums_out: wp.array, column_sums_out: wp.array, totals_out: wp.array, table_out: wp.array
) -> None:
    """Write the whole summed-area table of a frame's intensity, by tiles.

    Args:
        frame: (H, W) vec3ub, RGB, contiguous.
        row_sums_out: Scratch, uint32, of ``tiled_shapes(H, W)[0]``.
        column_sums_out: Scratch, uint32, of ``tiled_shapes(H, W)[1]``.
        totals_out: Scratch, uint32, of ``tiled_shapes(H, W)[2]``.
        table_out: (H, W) uint32, contiguous; entry (i, j) is the sum over rows 0..i and columns 0..j modulo 2^32.

    Raises:
        ValueError: An array is not contiguous.
    """
    if not (frame.is_contiguous and table_out.is_contiguous):
        raise ValueError("sum_area_tiled: frame and table_out must be contiguous; copy what is a view")
    height, width = frame.shape
    device, strip = frame.device, strip_rows(height)
    lanes = 1 if device.is_cpu else 32
    strips, tiles = column_sums_out.shape[0], -(-width // (4 * lanes))
    grid = (strips, tiles * lanes)
    sums = [row_sums_out, column_sums_out]
    wp.launch(sum_tiles_kernel, grid, [lanes, strip, frame], [*sums, totals_out], device=device)
    wp.launch(scan_sums_kernel, (height + strips * tiles) * lanes, [lanes, totals_out], sums, device=device)
    wp.launch(write_tiles_kernel, grid, [lanes, strip, frame, *sums], [table_out], device=device)
