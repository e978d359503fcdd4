"""Order in which threads take pixels: on CUDA those of a rectangle come first, in tiles, and few blocks do all.

Much of what a frame shows lies in a rectangle that its virtual objects, lights or balls can reach; a pixel outside is
written and no more. A captured graph has no other size than the frame's, and a block with the registers that rays need
takes a place for a microsecond even if it does nothing. So the rectangle's pixels are numbered first: blocks with work
begin at once, side by side, and what follows is cleared by few threads in long runs. A warp takes a tile of 8 x 4
pixels, whose rays stay together for longer than those of 32 in a row.

On CPU, and where a band of rows is asked for, a thread takes the pixel of its own place.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

RECTANGLE_FIRST, RECTANGLE_ONLY = -1, -2
"""As a kernel's ``row_start``: all rows, the rectangle first; or no pixel but those of its tiles."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return true;
#else
    return false;
#endif
""")
def on_cuda() -> wp.bool:
    """Known when a kernel is compiled."""


@wp.func
def rectangle_first(index: wp.int32, rect: wp.vec4i, height: wp.int32, width: wp.int32, alone: wp.bool) -> wp.vec2i:
    """Row and column of a frame's pixel by number: the rectangle's first, tile by tile, then those around it.

    If the rectangle is ``alone``, those around it are (-1, -1).

    Tiles of 4 rows and 8 columns are aligned with the frame: the rectangle is taken as large as they make it. Where the
    frame cuts one, its rows follow one another. Each pixel has one number below ``height * width``.
    """
    top = (wp.clamp(rect[0], 0, height) / 4) * 4
    left = (wp.clamp(rect[2], 0, width) / 8) * 8
    high = wp.min((wp.clamp(rect[1], 0, height) + 3) / 4 * 4, height) - top
    wide = wp.min((wp.clamp(rect[3], 0, width) + 7) / 8 * 8, width) - left
    left_over = index - wp.max(high, 0) * wp.max(wide, 0)
    if alone and left_over >= 0:
        return wp.vec2i(-1, -1)
    if high <= 0 or wide <= 0:
        return wp.vec2i(index / width, index % width)
    if left_over < 0:
        if high % 4 != 0 or wide % 8 != 0:
            return wp.vec2i(top + index / wide, left + index % wide)
        tile = index / 32
        lane = index % 32
        across = wide / 8
        return wp.vec2i(top + tile / across * 4 + lane / 8, left + tile % across * 8 + lane % 8)
    if left_over < top * width:
        return wp.vec2i(left_over / width, left_over % width)
    left_over -= top * width
    beside = width - wide
    if left_over < high * beside:
        column = left_over % beside
        return wp.vec2i(top + left_over / beside, wp.where(column < left, column, column + wide))
    left_over -= high * beside
    return wp.vec2i(top + high + left_over / width, left_over % width)


@wp.func
def own_pixel(
    i: wp.int32, j: wp.int32, row_start: wp.int32, rect: wp.vec4i, height: wp.int32, width: wp.int32
) -> wp.vec2i:
    """Row and column of the pixel of thread (i, j), (-1, -1): it has none; ``row_start`` is that of ``launch_rows``."""
    if on_cuda():
        if row_start < 0:
            return rectangle_first(i * width + j, rect, height, width, row_start == RECTANGLE_ONLY)
    return wp.vec2i(row_start + i, j)
