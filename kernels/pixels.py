"""Linear radiance of a pixel of the camera's frame.

A frame of 8-bit codes is decoded by its table. A frame of more than 8 bits has its linear radiance in a second array,
which is read in place of the codes; for 8-bit frames the array is empty. All threads of a launch take the same branch,
so one kernel serves both. More bits matter in the dark: a desk of radiance 0.0007 has the sRGB code 2.3, and read as
code 2 it is 0.00061, 13 % too dark.

For methods that need codes (a mean of codes is less affected by highlights), ``cut_luma`` returns the difference
between the luma of a pixel's linear radiance and its 8-bit luma.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.color import decode
from warp_ar.kernels.structs import Picture

wp.set_module_options({"enable_backward": False})

MOST_CUT = wp.constant(wp.float32(2.0))
"""Largest result of ``cut_luma``, in codes: rounding of channels and luma is 1, converters differ by 1 more."""

mat23 = wp.types.matrix(shape=(2, 3), dtype=wp.float32)


@wp.func
def pixel_radiance(
    frame: wp.array2d[wp.vec3ub], table: wp.array[wp.vec3], linear: wp.array2d[wp.vec3], row: wp.int32, column: wp.int32
) -> wp.vec3:
    """Return the radiance of a pixel, from the linear array or, if that is empty, from the codes."""
    if linear.shape[0] > 0:
        return linear[row, column]
    return decode(table, frame[row, column])


@wp.func
def shown_radiance(picture: Picture, row: wp.int32, column: wp.int32) -> wp.vec3:
    """Return the linear radiance, RGB, of a pixel of the camera's frame."""
    return pixel_radiance(picture.frame, picture.decode_table, picture.linear, row, column)


@wp.func
def between_codes(table: wp.array[wp.vec3], value: wp.float32, code: wp.uint8, channel: wp.int32) -> wp.float32:
    """Return the difference of a linear value from that of its code (8-bit pixel value), in steps between codes."""
    here = wp.int32(code)
    neighbour = wp.where(value > table[here][channel], wp.min(here + 1, 255), wp.max(here - 1, 0))
    step = wp.abs(table[neighbour][channel] - table[here][channel])
    if not step > 0.0:
        return wp.float32(0.0)  # the end of the range, or a plateau of a measured response
    return (value - table[here][channel]) / step


@wp.func
def cut_luma(
    frame: wp.array2d[wp.vec3ub], table: wp.array[wp.vec3], linear: wp.array2d[wp.vec3], row: wp.int32, column: wp.int32
) -> wp.float32:
    """Return the luma of a pixel's linear radiance less its 8-bit luma (``summed_area.intensity``), in codes.

    It is exactly 0 for frames of 8 bits, and where the radiance equals that of the codes. Radiance above 1 counts as 1.
    """
    if linear.shape[0] == 0:
        return wp.float32(0.0)
    code = frame[row, column]
    value = linear[row, column]
    red = between_codes(table, value[0], code[0], 0)
    green = between_codes(table, value[1], code[1], 1)
    blue = between_codes(table, value[2], code[2], 2)
    if red == 0.0 and green == 0.0 and blue == 0.0:
        return wp.float32(0.0)
    weighted = 54 * wp.int32(code[0]) + 183 * wp.int32(code[1]) + 19 * wp.int32(code[2])
    rounded = (weighted + 128) >> 8
    exact = wp.float32(weighted - 256 * rounded) + 54.0 * red + 183.0 * green + 19.0 * blue
    return wp.clamp(exact / 256.0, -MOST_CUT, MOST_CUT)


@wp.func
def keep_linear(table: wp.array[wp.vec3], value: wp.vec3) -> wp.vec3:
    """Return a pixel of a linear frame unchanged; replaces ``decode`` in kernels for linear frames."""
    return value


@wp.func
def clip_levels(table: wp.array[wp.vec3]) -> mat23:
    """Return two rows of RGB values from which channels of a linear frame clip: alone, and if another channel clips."""
    return mat23(table[0][0], table[0][1], table[0][2], table[1][0], table[1][1], table[1][2])


@wp.func
def is_at_clipping(value: wp.vec3, levels: mat23) -> wp.vec3:
    """Return 1 in the clipped channels of a linear pixel, else 0; replaces ``is_saturated`` for linear frames."""
    any_clipped = wp.bool(False)
    for channel in range(3):
        any_clipped = any_clipped or value[channel] >= levels[0, channel]
    least = levels[0]
    if any_clipped:
        least = levels[1]
    return wp.vec3(
        wp.where(value[0] >= least[0], 1.0, 0.0),
        wp.where(value[1] >= least[1], 1.0, 0.0),
        wp.where(value[2] >= least[2], 1.0, 0.0),
    )
