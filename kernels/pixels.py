"""What a pixel of the camera's frame shows, as linear radiance.

A frame of 8-bit codes is decoded by its table. Of a frame that came with more than 8 bits the linear picture lies
beside the codes: where there is one, it is read in their place. The array is empty where there is none, which all
threads of a launch find alike, so that one kernel serves both.

A dark desk of radiance 0.0007 has the sRGB code 2.3: read as code 2 it is 0.00061, 13 % too dark.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.color import decode
from warp_ar.kernels.structs import Picture

wp.set_module_options({"enable_backward": False})

mat23 = wp.types.matrix(shape=(2, 3), dtype=wp.float32)


@wp.func
def pixel_radiance(
    frame: wp.array2d[wp.vec3ub],
    table: wp.array[wp.vec3],
    linear: wp.array2d[wp.vec3],
    row: wp.int32,
    column: wp.int32,
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
def keep_linear(table: wp.array[wp.vec3], value: wp.vec3) -> wp.vec3:
    """A pixel of a linear frame, in the place of ``decode``."""
    return value


@wp.func
def clip_levels(table: wp.array[wp.vec3]) -> mat23:
    """Where the channels of a linear frame clip, and where beside another one that does."""
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
