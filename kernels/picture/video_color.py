"""Codes of video as RGB and back: 4:2:0 Y'CbCr of 8 bits in FFmpeg's fixed-point arithmetic, to the bit.

A decoder gives Y'CbCr of 12 bits a pixel, an encoder takes it. Where the device converts, half as many bytes go over
the bus, and no thread of the host converts. Files must not depend on who converted, so sums, shifts and truncations are
those of libswscale with ``accurate_rnd`` and bilinear filters, as ``warp_ar.sources.video_file`` and
``warp_ar.output.video_sink`` ask for them.

To RGB. Chroma lies between two rows of pixels, and between two columns or, as most video has it, at the left one. Of
the two nearest samples one has the weight 3/4, the other 1/4; where it lies at the left one, a left pixel has its
sample alone and a right one half of each of two. Beyond the border the last one stands again. Columns are summed first,
to 7 bits behind the binary point, then rows, to 9. With factors of 13 bits behind the point,

    r = floor(clamp((y - y_offset) y_scale + cr r_of_cr + 2^21, 0, 2^30 - 1) / 2^22),

and g and b alike. The sum has 32 bits and wraps around, as FFmpeg's: of codes that no camera writes (luma and chroma
of 255) b is 0.

From RGB, BT.709 of limited range, by factors of 15 bits behind the point. Chroma of each pixel is cut to 6 bits;
columns are summed by (1/4, 1/2, 1/4) about the left pixel of each pair and cut to 7 bits, rows by (1/8, 3/8, 3/8, 1/8)
and rounded to a code. Luma is cut to 6 bits and rounded to a code.

References:
    ITU-R BT.601-7 and BT.709-6: matrices and ranges.
"""

from __future__ import annotations

import functools

import warp as wp

from warp_ar.kernels.launch import launch

wp.set_module_options({"enable_backward": False})

_OF_CHROMA = {"bt709": (117489, 138438, 13975, 34925), "bt601": (104597, 132201, 25675, 53279)}
"""Red of Cr, blue of Cb, green of Cb and green of Cr, negative, of limited range: 16 bits behind the point."""

_TO_LUMA = wp.constant(wp.vec3i(5983, 20127, 2032))
_TO_CB = wp.constant(wp.vec3i(-3298, -11094, 14392))
_TO_CR = wp.constant(wp.vec3i(14392, -13073, -1320))


@wp.struct
class YuvLayout:
    """Where the codes of a 4:2:0 picture lie: those of luma in one array of bytes, those of chroma in another."""

    height: wp.int32
    """Rows of luma, an even number."""
    width: wp.int32
    """Columns of luma, an even number."""
    cr: wp.int32
    """Place of the first Cr; the first Cb is at 0."""
    step: wp.int32
    """Bytes from a sample of chroma to the next of its kind."""
    pitch: wp.int32
    """Bytes from a row of chroma to the next."""
    left: wp.int32
    """1: chroma lies at the left one of two columns; 0: between them."""


@wp.struct
class RgbFactors:
    """From Y'CbCr to RGB, 13 bits behind the binary point."""

    y_offset: wp.int32
    """Luma of black, 9 bits behind the point."""
    y_scale: wp.int32
    r_of_cr: wp.int32
    g_of_cb: wp.int32
    g_of_cr: wp.int32
    b_of_cb: wp.int32


def yuv_layout(height: int, width: int, *, interleaved: bool = False, left: bool = True) -> YuvLayout:
    """Rows without gaps; Cb and Cr one plane after the other or, ``interleaved``, in turn (NV12).

    Args:
        height: Rows of luma.
        width: Columns of luma.
        interleaved: Whether Cb and Cr lie in turn.
        left: Whether chroma lies at the left one of two columns, else between them.
    """
    layout = YuvLayout()
    layout.height, layout.width, layout.left = height, width, int(left)
    layout.cr = 1 if interleaved else height * width // 4
    layout.step, layout.pitch = (2, width) if interleaved else (1, width // 2)
    return layout


@functools.cache
def rgb_factors(matrix: str, *, full_range: bool) -> RgbFactors:
    """Factors of a matrix, ``bt709`` or ``bt601``, for codes of full or of limited range."""
    scale, offset, chroma = 65536 * 255 // 219, 16 << 9, _OF_CHROMA[matrix]
    if full_range:
        scale, offset = 65536, 0
        chroma = tuple(value * 224 // 255 for value in chroma)  # type: ignore[assignment]
    r_of_cr, b_of_cb, g_of_cb, g_of_cr = chroma
    factors = RgbFactors()
    factors.y_offset, factors.y_scale = offset, _rounded(scale)
    factors.r_of_cr, factors.b_of_cb = _rounded(r_of_cr), _rounded(b_of_cb)
    factors.g_of_cb, factors.g_of_cr = _rounded(-g_of_cb), _rounded(-g_of_cr)
    return factors


def _rounded(value: int) -> int:
    """16 bits behind the point as 13, halves up."""
    return (value + 4) >> 3


@wp.func
def code_of(bits: wp.int64) -> wp.uint8:
    """The code of a sum of 22 bits behind the binary point, which has wrapped around at 32 bits."""
    return wp.uint8(wp.clamp(wp.int32(bits), 0, (1 << 30) - 1) >> 22)


@wp.kernel
def rgb_from_yuv_kernel(
    # In:
    luma: wp.array[wp.uint8],
    chroma: wp.array[wp.uint8],
    layout: YuvLayout,
    factors: RgbFactors,
    # Out:
    rgb_out: wp.array2d[wp.vec3ub],
):
    """Convert a pixel to RGB."""
    row, column = wp.tid()
    near_row, near_column = row / 2, column / 2
    far_row = wp.clamp(near_row - 1 + 2 * (row % 2), 0, layout.height / 2 - 1)
    far_column = wp.clamp(near_column - 1 + 2 * (column % 2), 0, layout.width / 2 - 1)
    weight = 32  # of the far column, of 128
    if layout.left == 1:
        weight = 64 * (column % 2)
    near = near_row * layout.pitch
    far = far_row * layout.pitch
    left = near_column * layout.step
    right = far_column * layout.step
    cb = 3072 * _column_sum(chroma, near, left, right, weight)
    cb += 1024 * _column_sum(chroma, far, left, right, weight)
    cr = 3072 * _column_sum(chroma, layout.cr + near, left, right, weight)
    cr += 1024 * _column_sum(chroma, layout.cr + far, left, right, weight)
    cb = (cb + 512 - (128 << 19)) >> 10
    cr = (cr + 512 - (128 << 19)) >> 10
    level = (wp.int32(luma[row * layout.width + column]) << 9) - factors.y_offset
    y = wp.int64(level) * wp.int64(factors.y_scale) + wp.int64(1 << 21)
    rgb_out[row, column] = wp.vec3ub(
        code_of(y + wp.int64(cr) * wp.int64(factors.r_of_cr)),
        code_of(y + wp.int64(cr) * wp.int64(factors.g_of_cr) + wp.int64(cb) * wp.int64(factors.g_of_cb)),
        code_of(y + wp.int64(cb) * wp.int64(factors.b_of_cb)),
    )


@wp.func
def _column_sum(
    codes: wp.array[wp.uint8], start: wp.int32, near: wp.int32, far: wp.int32, weight: wp.int32
) -> wp.int32:
    """Two samples of a row of chroma, the far one with a weight of 128, 7 bits behind the binary point."""
    return (128 - weight) * wp.int32(codes[start + near]) + weight * wp.int32(codes[start + far])


@wp.func
def _weighed(code: wp.vec3ub, weights: wp.vec3i) -> wp.int32:
    """A product of 15 bits behind the binary point."""
    return weights[0] * wp.int32(code[0]) + weights[1] * wp.int32(code[1]) + weights[2] * wp.int32(code[2])


@wp.func
def _chroma_of(code: wp.vec3ub, weights: wp.vec3i) -> wp.int32:
    """Cb or Cr of a pixel, 6 bits behind the binary point."""
    return (_weighed(code, weights) + (128 << 15) + (1 << 8)) >> 9


@wp.func
def _of_row(rgb: wp.array2d[wp.vec3ub], row: wp.int32, column: wp.int32, weights: wp.vec3i) -> wp.int32:
    """Cb or Cr about a column of a row, 7 bits behind the binary point."""
    before = _chroma_of(rgb[row, wp.max(column - 1, 0)], weights)
    here = _chroma_of(rgb[row, column], weights)
    behind = _chroma_of(rgb[row, column + 1], weights)
    return (before + 2 * here + behind) >> 1


@wp.func
def _chroma_code(rgb: wp.array2d[wp.vec3ub], row: wp.int32, column: wp.int32, weights: wp.vec3i) -> wp.uint8:
    """Cb or Cr of two rows and two columns, of which the first are given."""
    outer = _of_row(rgb, wp.max(row - 1, 0), column, weights)
    outer += _of_row(rgb, wp.min(row + 2, rgb.shape[0] - 1), column, weights)
    inner = _of_row(rgb, row, column, weights) + _of_row(rgb, row + 1, column, weights)
    return wp.uint8(wp.clamp((outer + 3 * inner + 512) >> 10, 0, 255))


@wp.func
def _luma_code(code: wp.vec3ub) -> wp.uint8:
    luma = (_weighed(code, _TO_LUMA) + (16 << 15) + (1 << 8)) >> 9
    return wp.uint8((luma + 32) >> 6)


@wp.kernel
def yuv_from_rgb_kernel(
    # In:
    rgb: wp.array2d[wp.vec3ub],
    layout: YuvLayout,
    # Out:
    luma_out: wp.array[wp.uint8],
    chroma_out: wp.array[wp.uint8],
):
    """Convert two by two pixels to Y'CbCr."""
    pair_row, pair_column = wp.tid()
    row, column = 2 * pair_row, 2 * pair_column
    for k in range(4):
        at_row, at_column = row + k / 2, column + k % 2
        luma_out[at_row * layout.width + at_column] = _luma_code(rgb[at_row, at_column])
    place = pair_row * layout.pitch + pair_column * layout.step
    chroma_out[place] = _chroma_code(rgb, row, column, _TO_CB)
    chroma_out[layout.cr + place] = _chroma_code(rgb, row, column, _TO_CR)


def rgb_from_yuv(
    # In:
    luma: wp.array[wp.uint8],
    chroma: wp.array[wp.uint8],
    layout: YuvLayout,
    factors: RgbFactors,
    # Out:
    rgb_out: wp.array2d[wp.vec3ub],
    *,
    device: wp.DeviceLike = None,
    stream: wp.Stream | None = None,
) -> None:
    """RGB of a 4:2:0 picture of ``layout``, as FFmpeg converts it."""
    given = {"device": device, "stream": stream}
    launch(rgb_from_yuv_kernel, rgb_out.shape, [luma, chroma, layout, factors], [rgb_out], **given)


def yuv_from_rgb(
    # In:
    rgb: wp.array2d[wp.vec3ub],
    layout: YuvLayout,
    # Out:
    luma_out: wp.array[wp.uint8],
    chroma_out: wp.array[wp.uint8],
    *,
    device: wp.DeviceLike = None,
    stream: wp.Stream | None = None,
) -> None:
    """A 4:2:0 picture of ``layout``, BT.709 of limited range with chroma at the left, as FFmpeg converts it."""
    given = {"device": device, "stream": stream}
    launch(yuv_from_rgb_kernel, (layout.height // 2, layout.width // 2), [rgb, layout], [luma_out, chroma_out], **given)
