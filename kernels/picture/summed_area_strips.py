"""Summed-area table by strips: the form for CUDA, in one launch that reads the frame once and writes the table once.

A block takes a strip of whole rows into its registers, a byte per pixel, and scans along them. With S_k(j) the sum of
strip k over its rows and the columns up to j,

    table[i, j] = sum of S_l(j) over the strips l above + sum over the strip's rows down to i and columns up to j.

Blocks run side by side and look back at what those above have found [MG16], in two steps, since a hundred sums of a row
each would be as much to read as the frame: strips form groups; a strip adds up the S of those above it in its group,
the last one of a group says what the whole group adds, and what lies above is a sum over groups and one within the
group. Strips are numbered in the order in which blocks begin, so nobody waits for a block that has not begun. What is
there already is said by marks that count launches: nothing has to be cleared between two. On CPU a block is one thread
and a strip's rows are its own: it is how the form is tested there.

References:
    [MG16] Merrill, Garland, "Single-pass parallel prefix scan with decoupled look-back", NVIDIA NVR-2016-002.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import warp as wp

from warp_ar.kernels.launch import launch

wp.set_module_options({"enable_backward": False})

STRIPS = 128
"""Strips of a frame: a block each, all of them on the device at once where it has as many multiprocessors."""
MAX_THREADS = 1024
"""Of a block."""
MAX_WORDS = 24
"""Words, of four pixels each, that a thread keeps in registers."""


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
