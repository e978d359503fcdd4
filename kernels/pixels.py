"""Linear radiance of a pixel of the camera's frame.

A frame of 8-bit codes is decoded by its table. Of a frame that came with more than 8 bits the linear picture lies
beside the codes: where there is one, it is read in their place. The array is empty where there is none, which all
threads of a launch find alike, so that one kernel serves both.

A dark desk of radiance 0.0007 has the sRGB code 2.3: read as code 2 it is 0.00061, 13 % too dark.

Where codes themselves are asked for (a mean of codes is not swayed by a few highlights), ``cut_luma`` gives what the
8-bit luma of a pixel lacks of that of its linear radiance.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.color import decode
from warp_ar.kernels.structs import Picture

wp.set_module_options({"enable_backward": False})

MOST_CUT = wp.constant(wp.float32(2.0))
"""Codes that ``cut_luma`` gives at most: rounding of channels and luma is 1, converters differ by 1 more."""

mat23 = wp.types.matrix(shape=(2, 3), dtype=wp.float32)


@wp.func
def pixel_radiance(
    frame: wp.array2d[wp.vec3ub], table: wp.array[wp.vec3], linear: wp.array2d[wp.vec3], row: wp.int32, column: wp.int32
) -> wp.vec3:
    """Radiance of a pixel: of the linear picture, or of the codes where that is empty."""
    if linear.shape[0] > 0:
        return linear[row, column]
    return decode(table, frame[row, column])


@wp.func
def shown_radiance(picture: Picture, row: wp.int32, column: wp.int32) -> wp.vec3:
    """Radiance of a pixel of a picture."""
    return pixel_radiance(picture.frame, picture.decode_table, picture.linear, row, column)


@wp.func
def between_codes(table: wp.array[wp.vec3], value: wp.float32, code: wp.uint8, channel: wp.int32) -> wp.float32:
    """Distance of a linear value from its 8-bit code, in codes; exactly 0 where it is that code's value."""
    here = wp.int32(code)
    beside = wp.where(value > table[here][channel], wp.min(here + 1, 255), wp.max(here - 1, 0))
    step = wp.abs(table[beside][channel] - table[here][channel])
    if not step > 0.0:
        return wp.float32(0.0)  # the end of the range, or a plateau of a measured response
    return (value - table[here][channel]) / step


@wp.func
def cut_luma(
    frame: wp.array2d[wp.vec3ub], table: wp.array[wp.vec3], linear: wp.array2d[wp.vec3], row: wp.int32, column: wp.int32
) -> wp.float32:
    """Return the part of a linear picture's luma that its 8-bit luma (``summed_area.intensity``) lacks, in codes.

    Exactly 0 without a linear picture, and where that is what the codes say. Light above 1 counts as 1.
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
    """A pixel of a linear frame, in the place of ``decode``."""
    return value


@wp.func
def clip_levels(table: wp.array[wp.vec3]) -> mat23:
    """Levels at which the channels of a linear frame clip, alone and beside another one that does."""
    return mat23(table[0][0], table[0][1], table[0][2], table[1][0], table[1][1], table[1][2])


@wp.func
def is_at_clipping(value: wp.vec3, levels: mat23) -> wp.vec3:
    """1 in the channels of a linear pixel that clip, in the place of ``is_saturated``."""
    beside = wp.bool(False)
    for channel in range(3):
        beside = beside or value[channel] >= levels[0, channel]
    least = levels[0]
    if beside:
        least = levels[1]
    return wp.vec3(
        wp.where(value[0] >= least[0], 1.0, 0.0),
        wp.where(value[1] >= least[1], 1.0, 0.0),
        wp.where(value[2] >= least[2], 1.0, 0.0),
    )
