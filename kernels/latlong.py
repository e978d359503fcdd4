"""Latlong maps: directions, texels, solid angles and samples.

A map has H rows and W columns. Maps made by the program have W = 2H; maps of users may have any size. Continuous
coordinates ``(row, column)`` run over [0, H] x [0, W]; texel (i, j) covers [i, i + 1] x [j, j + 1], with its centre at
half-integers. Row 0 is toward +z, the centre column toward +x, and columns increase toward +y:

    theta = pi row / H,  phi = (2 column / W - 1) pi,  d = (sin theta cos phi, sin theta sin phi, cos theta).
"""

from __future__ import annotations

import math

import warp as wp

PI = wp.constant(wp.float32(math.pi))


@wp.func
def direction_from_latlong(row: wp.float32, column: wp.float32, height: wp.int32, width: wp.int32) -> wp.vec3:
    """Return the unit direction of continuous map coordinates."""
    theta = PI * row / wp.float32(height)
    phi = (2.0 * column / wp.float32(width) - 1.0) * PI
    sin_theta = wp.sin(theta)
    return wp.vec3(sin_theta * wp.cos(phi), sin_theta * wp.sin(phi), wp.cos(theta))


@wp.func
def latlong_from_direction(direction: wp.vec3, height: wp.int32, width: wp.int32) -> wp.vec2:
    """Return the continuous (row, column) of a direction of any length; the poles have phi = 0, never NaN.

    theta comes from atan2(|xy|, z), not acos(z): exact near the poles and safe for a z of 1 + ulp.
    """
    radial = wp.sqrt(direction[0] * direction[0] + direction[1] * direction[1])
    theta = wp.atan2(radial, direction[2])
    phi = wp.atan2(direction[1], direction[0])
    return wp.vec2(theta / PI * wp.float32(height), (phi / PI + 1.0) * 0.5 * wp.float32(width))


@wp.func
def texel_solid_angle(row: wp.int32, height: wp.int32, width: wp.int32) -> wp.float32:
    """Return the solid angle of each texel of a row: (cos theta0 - cos theta1) 2 pi / W.

    It is computed as a product of sines, with the angle from the nearer pole, so that it is exact near both poles.
    """
    half_step = 0.5 * PI / wp.float32(height)
    middle = wp.float32(wp.min(2 * row + 1, 2 * (height - row) - 1))
    return 2.0 * wp.sin(middle * half_step) * wp.sin(half_step) * 2.0 * PI / wp.float32(width)


@wp.func
def wrap_texel(row: wp.int32, column: wp.int32, height: wp.int32, width: wp.int32) -> wp.vec2i:
    """Return the texel of an index outside the map.

    The row may lie up to one row beyond a pole, which continues half a turn away; the column may be any integer.
    """
    r = row
    c = column
    if r < 0:
        r = -1 - r
        c += width / 2
    elif r >= height:
        r = 2 * height - 1 - r
        c += width / 2
    c = c % width
    if c < 0:
        c += width
    return wp.vec2i(wp.clamp(r, 0, height - 1), c)


@wp.func
def neighbours_in_row(row: wp.int32, x: wp.float32, height: wp.int32, width: wp.int32):
    """Return the two texels next to x in a row, and the fraction of the way from the first to the second.

    x counts from the centre of texel 0. A row beyond a pole continues half a turn away.
    """
    r = row
    at = x
    if r < 0:
        r = -1 - r
        at += 0.5 * wp.float32(width)
    elif r >= height:
        r = 2 * height - 1 - r
        at += 0.5 * wp.float32(width)
    left = wp.floor(at)
    first = wrap_texel(r, wp.int32(left), height, width)
    second = wrap_texel(r, wp.int32(left) + 1, height, width)
    return first, second, at - left


@wp.func
def sample_row(radiance: wp.array2d[wp.vec3], row: wp.int32, x: wp.float32) -> wp.vec3:
    """Return the linearly interpolated radiance in one row at x; see ``neighbours_in_row``."""
    first, second, t = neighbours_in_row(row, x, radiance.shape[0], radiance.shape[1])
    a = radiance[first[0], first[1]]
    return a + t * (radiance[second[0], second[1]] - a)


@wp.func
def sample_latlong(radiance: wp.array2d[wp.vec3], direction: wp.vec3) -> wp.vec3:
    """Return the bilinearly interpolated radiance of a direction: continuous across seam and poles for any size."""
    height = radiance.shape[0]
    width = radiance.shape[1]
    at = latlong_from_direction(direction, height, width)
    y = at[0] - 0.5
    x = at[1] - 0.5
    row = wp.floor(y)
    left = wp.floor(x)
    i = wp.int32(row)
    j = wp.int32(left)
    above_left = wp.vec2i(i, j)
    above_right = wp.vec2i(i, j + 1)
    below_left = wp.vec2i(i + 1, j)
    below_right = wp.vec2i(i + 1, j + 1)
    above = x - left
    below = above
    # Across the border: a loop over both rows, so that the wrapping code is compiled once.
    if i < 0 or i + 1 >= height or j < 0 or j + 1 >= width:
        part = wp.int32(0)
        while part < 2:
            first, second, t = neighbours_in_row(i + part, x, height, width)
            if part == 0:
                above_left = first
                above_right = second
                above = t
            else:
                below_left = first
                below_right = second
                below = t
            part += 1
    a = radiance[above_left[0], above_left[1]]
    top = a + above * (radiance[above_right[0], above_right[1]] - a)
    b = radiance[below_left[0], below_left[1]]
    bottom = b + below * (radiance[below_right[0], below_right[1]] - b)
    return top + (y - row) * (bottom - top)
