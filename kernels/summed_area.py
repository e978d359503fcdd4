"""Summed-area table of a frame's intensity: the sum over any box from four look-ups [Cro84], exact at every size.

The table holds unsigned 32-bit integers and is meant to overflow: additions and subtractions modulo 2^32 undo each
other, so the sum over a box is exact whenever that sum itself is below 2^32, that is for boxes of up to 2^32 / 255 =
16.8 million pixels, in a frame of any size. (Float32 sums are wrong by 126 grey levels at 4K.)

    table[i, j] = sum of intensity[0..i, 0..j] mod 2^32

Two forms. *By slabs* (``sum_area``), for CPU: a thread takes a slab of whole rows, sixteen pixels of a row at a time in
a processor's vectors, and adds the row above; the slabs then add what those above them sum up to. There are as many
slabs as threads: one thread reads the frame once and writes the table once. On CUDA that would be a few threads, each
waiting for load after load.

*By strips* (``sum_area_by_strips``), for CUDA, in one launch that reads the frame once and writes the table once: a
block takes a strip of whole rows into its registers, a byte per pixel, and scans along them. With S_k(j) the sum of
strip k over its rows and the columns up to j,

    table[i, j] = sum of S_l(j) over the strips l above + sum over the strip's rows down to i and columns up to j.

Blocks run side by side and look back at what those above have found [MG16], in two steps, since a hundred sums of a row
each would be as much to read as the frame: strips form groups; a strip adds up the S of those above it in its group,
the last one of a group says what the whole group adds, and what lies above is a sum over groups and one within the
group. Strips are numbered in the order in which blocks begin, so nobody waits for a block that has not begun. What is
there already is said by marks that count launches: nothing has to be cleared between two. On CPU a block is one thread
and a strip's rows are its own: it is how the form is tested there.

References:
    [Cro84] Crow, "Summed-area tables for texture mapping", SIGGRAPH 1984.
    [MG16] Merrill, Garland, "Single-pass parallel prefix scan with decoupled look-back", NVIDIA NVR-2016-002.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import warp as wp

from warp_ar.kernels.launch import Rows, launch, launch_rows

wp.set_module_options({"enable_backward": False})

LEAST_SLAB = 16
"""Rows of a slab: fewer take longer to be joined than to be summed."""
STRIPS = 128
"""Strips of a frame: a block each, all of them on the device at once where it has as many multiprocessors."""
MAX_THREADS = 1024
"""Of a block."""
MAX_WORDS = 24
"""Words, of four pixels each, that a thread keeps in registers."""


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


vec4u = wp.types.vector(length=4, dtype=wp.uint32)


@wp.func_native("""
    return reinterpret_cast<const unsigned int*>(frame.data)[(size_t(row) * frame.shape[1] + column) / 4 * 3 + word];
""")
def load_word(frame: wp.array2d[wp.vec3ub], row: wp.int32, column: wp.int32, word: wp.int32) -> wp.uint32:
    """One of the three words of four pixels; columns and the frame's width are multiples of four."""


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


@dataclasses.dataclass(frozen=True)
class StripConfig:
    """How a strip is laid out over a block; all of it is compiled in, so that a strip stays in registers."""

    rows: int
    """Rows of a strip."""
    quads: int
    """Groups of four neighbouring columns that a thread takes."""
    threads: int
    """Of a block: a multiple of 32 on CUDA, 1 on CPU."""
    aligned: bool
    """Whether rows begin at words: the width is a multiple of four."""


# Four codes are a word, and one of them at most 255: a sum over a warp's columns, at most 128 x 255, is half a word, so
# two rows are scanned at a time.
_SUM_STRIP = """
    constexpr int ROWS = {rows}, QUADS = {quads}, THREADS = {threads};
    constexpr bool ALIGNED = {aligned:d};
#if defined(__CUDA_ARCH__)
    #define SHARED __shared__
    #define WAIT_FOR_BLOCK() __syncthreads()
    #define UNROLL _Pragma("unroll")
    constexpr int LANES = 32;
    const int thread = threadIdx.x;
#else
    #define SHARED
    #define WAIT_FOR_BLOCK()
    #define UNROLL
    constexpr int LANES = 1;
    const int thread = 0;
#endif
    constexpr int WARPS = THREADS / LANES;
    const int warp = thread / LANES, lane = thread % LANES;
    const int height = frame.shape[0], width = frame.shape[1], pitch = sums.shape[1], strips = sums.shape[0];
    SHARED unsigned int before[QUADS][ROWS][WARPS];
    SHARED unsigned int ticket, run;

    // Strips are handed out in order: whoever waits for one above waits for a block that is already running.
    unsigned int* done = state.data + 1;
    unsigned int* group_done = done + strips;
    if (thread == 0) {{
#if defined(__CUDA_ARCH__)
        ticket = atomicInc(state.data, strips - 1);
#else
        ticket = state.data[0];
        state.data[0] = ticket + 1 < strips ? ticket + 1 : 0;
#endif
        run = done[ticket] + 1;  // only this block writes it; all marks are equal between launches
    }}
    WAIT_FOR_BLOCK();
    const int strip = ticket;
    const unsigned int now = run;

    unsigned int codes[QUADS][ROWS], left[QUADS][(ROWS + 1) / 2];
    const unsigned char* bytes = reinterpret_cast<const unsigned char*>(frame.data);
    UNROLL
    for (int q = 0; q < QUADS; ++q) {{
        const int column = 4 * (q * THREADS + thread);
        if (ALIGNED) {{
            // Loads without conditions go out together; what lies outside is put to 0 afterwards.
            const int inside = column < width ? column : width - 4;
            UNROLL
            for (int r = 0; r < ROWS; ++r) {{
                const int row = strip * ROWS + r < height ? strip * ROWS + r : height - 1;
                // R0 G0 B0 R1, G1 B1 R2 G2, B2 R3 G3 B3 from the lowest byte up.
                const unsigned char* pixel = bytes + (size_t(row) * width + inside) * 3;
                const unsigned int* at = reinterpret_cast<const unsigned int*>(pixel);
                const unsigned int a = at[0], b = at[1], c = at[2];
#if defined(__CUDA_ARCH__)
                constexpr unsigned int WEIGHTS = 54 | 183 << 8 | 19 << 16;  // a sum of products, as in intensity
                const unsigned int y0 = __dp4a(a, WEIGHTS, 128u);
                const unsigned int y1 = __dp4a(__funnelshift_r(a, b, 24), WEIGHTS, 128u);
                const unsigned int y2 = __dp4a(__funnelshift_r(b, c, 16), WEIGHTS, 128u);
                const unsigned int y3 = __dp4a(c >> 8, WEIGHTS, 128u);
                codes[q][r] = __byte_perm(__byte_perm(y0, y1, 0x0051), __byte_perm(y2, y3, 0x0051), 0x5410);
#else
                const unsigned int pixels[4] = {{a, a >> 24 | b << 8, b >> 16 | c << 16, c >> 8}};
                codes[q][r] = 0;
                for (int k = 0; k < 4; ++k) {{
                    const unsigned int p = pixels[k];
                    const unsigned int y = 54 * (p & 255) + 183 * (p >> 8 & 255) + 19 * (p >> 16 & 255) + 128;
                    codes[q][r] |= (y >> 8) << 8 * k;
                }}
#endif
            }}
            UNROLL
            for (int r = 0; r < ROWS; ++r)
                if (strip * ROWS + r >= height || column >= width) codes[q][r] = 0;
        }} else {{
            UNROLL
            for (int r = 0; r < ROWS; ++r) {{
                codes[q][r] = 0;
                for (int k = 0; k < 4; ++k)
                    if (strip * ROWS + r < height && column + k < width) {{
                        const unsigned char* at = bytes + (size_t(strip * ROWS + r) * width + column + k) * 3;
                        codes[q][r] |= (54u * at[0] + 183u * at[1] + 19u * at[2] + 128u) >> 8 << 8 * k;
                    }}
            }}
        }}
    }}

    // Along the rows: within a warp, then from warp to warp.
    UNROLL
    for (int q = 0; q < QUADS; ++q)
        UNROLL
        for (int r = 0; r < ROWS; r += 2) {{
            unsigned int own[2] = {{0, 0}};
            for (int k = 0; k < 2 && r + k < ROWS; ++k) {{
                const unsigned int word = codes[q][r + k];
#if defined(__CUDA_ARCH__)
                own[k] = __dp4a(word, 0x01010101u, 0u);
#else
                own[k] = (word & 255) + (word >> 8 & 255) + (word >> 16 & 255) + (word >> 24);
#endif
            }}
            const unsigned int both = own[0] | own[1] << 16;
            unsigned int sum = both;
#if defined(__CUDA_ARCH__)
            for (int reach = 1; reach < LANES; reach *= 2) {{
                const unsigned int below = __shfl_up_sync(0xffffffffu, sum, reach);
                if (lane >= reach) sum += below;
            }}
#endif
            left[q][r / 2] = sum - both;
            if (lane == LANES - 1) {{
                before[q][r][warp] = sum & 0xffff;
                if (r + 1 < ROWS) before[q][r + 1][warp] = sum >> 16;
            }}
        }}
    WAIT_FOR_BLOCK();
    for (int r = warp; r < ROWS; r += WARPS) {{
        unsigned int carry = 0;
        for (int q = 0; q < QUADS; ++q) {{
            const unsigned int own = lane < WARPS ? before[q][r][lane] : 0;
            unsigned int sum = own;
#if defined(__CUDA_ARCH__)
            for (int reach = 1; reach < LANES; reach *= 2) {{
                const unsigned int below = __shfl_up_sync(0xffffffffu, sum, reach);
                if (lane >= reach) sum += below;
            }}
#endif
            if (lane < WARPS) before[q][r][lane] = carry + sum - own;
#if defined(__CUDA_ARCH__)
            carry += __shfl_sync(0xffffffffu, sum, LANES - 1);
#else
            carry += sum;
#endif
        }}
    }}
    WAIT_FOR_BLOCK();

    // What the strip adds to the table below it.
    unsigned int below[QUADS][4], above[QUADS][4];
    UNROLL
    for (int q = 0; q < QUADS; ++q) {{
        unsigned int sum = 0, even = 0, odd = 0;  // sums of columns 0 and 2, 1 and 3, two to a word
        UNROLL
        for (int r = 0; r < ROWS; ++r) {{
            sum += before[q][r][warp] + (left[q][r / 2] >> 16 * (r % 2) & 0xffff);
            even += codes[q][r] & 0x00ff00ff;
            odd += codes[q][r] >> 8 & 0x00ff00ff;
        }}
        below[q][0] = sum + (even & 0xffff);
        below[q][1] = below[q][0] + (odd & 0xffff);
        below[q][2] = below[q][1] + (even >> 16);
        below[q][3] = below[q][2] + (odd >> 16);
        for (int k = 0; k < 4; ++k) above[q][k] = 0;
    }}

#if defined(__CUDA_ARCH__)
    #define SET_FOUR(array, line, column, value) \\
        *reinterpret_cast<uint4*>(array.data + size_t(line) * pitch + column) = \\
            make_uint4(value[0], value[1], value[2], value[3])
    #define ADD_FOUR(array, line, column, value) {{ \\
        const uint4 four = __ldcg(reinterpret_cast<const uint4*>(array.data + size_t(line) * pitch + column)); \\
        value[0] += four.x; value[1] += four.y; value[2] += four.z; value[3] += four.w; }}
    #define PUBLISH(mark) {{ \\
        __threadfence(); \\
        __syncthreads(); \\
        if (thread == 0) *reinterpret_cast<volatile unsigned int*>(mark) = now; }}
    #define WAIT_FOR(marks, count) {{ \\
        for (int n = thread; n < (count); n += THREADS) \\
            while (*reinterpret_cast<volatile unsigned int*>((marks) + n) != now) {{}} \\
        __threadfence(); \\
        __syncthreads(); }}
#else
    #define SET_FOUR(array, line, column, value) \\
        for (int k = 0; k < 4; ++k) array.data[size_t(line) * pitch + column + k] = value[k]
    #define ADD_FOUR(array, line, column, value) \\
        for (int k = 0; k < 4; ++k) value[k] += array.data[size_t(line) * pitch + column + k]
    #define PUBLISH(mark) *(mark) = now
    #define WAIT_FOR(marks, count)
#endif
    const int group = strip / group_size, first = group * group_size;
    UNROLL
    for (int q = 0; q < QUADS; ++q) {{
        const int column = 4 * (q * THREADS + thread);
        if (column < pitch) SET_FOUR(sums, strip, column, below[q]);
    }}
    PUBLISH(done + strip);
    WAIT_FOR(done + first, strip - first);
    UNROLL
    for (int q = 0; q < QUADS; ++q) {{
        const int column = 4 * (q * THREADS + thread);
        if (column < pitch)
            for (int n = first; n < strip; ++n) ADD_FOUR(sums, n, column, above[q]);
    }}
    if (strip == first + group_size - 1) {{
        UNROLL
        for (int q = 0; q < QUADS; ++q) {{
            const int column = 4 * (q * THREADS + thread);
            for (int k = 0; k < 4; ++k) below[q][k] += above[q][k];
            if (column < pitch) SET_FOUR(group_sums, group, column, below[q]);
        }}
        PUBLISH(group_done + group);
    }}
    WAIT_FOR(group_done, group);

    UNROLL
    for (int q = 0; q < QUADS; ++q) {{
        const int column = 4 * (q * THREADS + thread);
        if (column >= width) continue;
        for (int n = 0; n < group; ++n) ADD_FOUR(group_sums, n, column, above[q]);
        UNROLL
        for (int r = 0; r < ROWS; ++r) {{
            unsigned int row_sum = before[q][r][warp] + (left[q][r / 2] >> 16 * (r % 2) & 0xffff);
            for (int k = 0; k < 4; ++k) {{
                row_sum += codes[q][r] >> 8 * k & 255;
                above[q][k] += row_sum;
            }}
            const int row = strip * ROWS + r;
            if (row >= height) continue;
            unsigned int* at = table.data + size_t(row) * width + column;
#if defined(__CUDA_ARCH__)
            if (ALIGNED) {{
                *reinterpret_cast<uint4*>(at) = make_uint4(above[q][0], above[q][1], above[q][2], above[q][3]);
                continue;
            }}
#endif
            for (int k = 0; k < 4 && column + k < width; ++k) at[k] = above[q][k];
        }}
    }}
    #undef SHARED
    #undef WAIT_FOR_BLOCK
    #undef UNROLL
    #undef SET_FOUR
    #undef ADD_FOUR
    #undef PUBLISH
    #undef WAIT_FOR
"""


@functools.cache
def make_sum_strips_kernel(config: StripConfig) -> wp.Kernel:
    """Kernel specialised to ``config``; equal configs share one kernel."""

    @wp.func_native(_SUM_STRIP.format(**dataclasses.asdict(config)))
    def sum_strip(
        frame: wp.array2d[wp.vec3ub],
        group_size: wp.int32,
        state: wp.array[wp.uint32],
        sums: wp.array2d[wp.uint32],
        group_sums: wp.array2d[wp.uint32],
        table: wp.array2d[wp.uint32],
    ):
        """The next strip of the table; for a whole block."""

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=(config.threads, 1))
    def sum_strips_kernel(
        # In:
        frame: wp.array2d[wp.vec3ub],
        group_size: wp.int32,
        # Out (and in: marks of the launch before):
        state_out: wp.array[wp.uint32],
        sums_out: wp.array2d[wp.uint32],
        group_sums_out: wp.array2d[wp.uint32],
        table_out: wp.array2d[wp.uint32],
    ):
        """One strip a block."""
        sum_strip(frame, group_size, state_out, sums_out, group_sums_out, table_out)

    return sum_strips_kernel


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


def strip_config(height: int, width: int, device: wp.DeviceLike) -> StripConfig:
    """Layout of strips for a frame of this size."""
    columns = -(-width // 4)
    rows, quads = _strip_size(height, width)
    if wp.get_device(device).is_cpu:
        return StripConfig(rows, columns, 1, width % 4 == 0)
    return StripConfig(rows, quads, 32 * -(-columns // (32 * quads)), width % 4 == 0)


def _strip_size(height: int, width: int) -> tuple[int, int]:
    """Rows of a strip, and columns of a thread in fours: as many strips as large devices have multiprocessors."""
    quads = -(-width // (4 * MAX_THREADS))
    return max(1, min(-(-height // STRIPS), MAX_WORDS // quads)), quads


def strip_shapes(height: int, width: int) -> tuple[tuple[int, ...], ...]:
    """Shapes of the scratch arrays of ``sum_area_by_strips`` for a frame of this size: sums, group sums, state."""
    strips, pitch = -(-height // _strip_size(height, width)[0]), 4 * -(-width // 4)
    groups = -(-strips // _group_size(strips))
    return (strips, pitch), (groups, pitch), (1 + strips + groups,)


def _group_size(strips: int) -> int:
    """Strips whose sums are added up for those below them: about as many as there are groups."""
    return math.isqrt(strips - 1) + 1


def sum_area_by_strips(
    frame: wp.array, sums_out: wp.array, group_sums_out: wp.array, state_out: wp.array, table_out: wp.array
) -> None:
    """Write the whole summed-area table of a frame's intensity, by strips.

    Args:
        frame: (H, W) vec3ub, RGB, contiguous.
        sums_out: Scratch, uint32, of ``strip_shapes(H, W)[0]``.
        group_sums_out: Scratch, uint32, of ``strip_shapes(H, W)[1]``.
        state_out: Scratch, uint32, of ``strip_shapes(H, W)[2]``: all 0 at first, then left alone between calls, which
            must not overlap.
        table_out: (H, W) uint32, contiguous; entry (i, j) is the sum over rows 0..i and columns 0..j modulo 2^32.

    Raises:
        ValueError: An array is not contiguous.
    """
    if not (frame.is_contiguous and table_out.is_contiguous):
        raise ValueError("sum_area_by_strips: frame and table_out must be contiguous; copy what is a view")
    config = strip_config(*frame.shape, frame.device)
    strips = sums_out.shape[0]
    launch(
        make_sum_strips_kernel(config),
        strips * config.threads,
        [frame, _group_size(strips)],
        [state_out, sums_out, group_sums_out, table_out],
        block_dim=config.threads,
        device=frame.device,
    )
