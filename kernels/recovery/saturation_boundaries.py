"""Weights of clipped texels at saturation boundaries, where a pixel shows only part of a light.

A pixel at a light's boundary clips if the light is bright, although it shows only part of the light. So the clipped
area is larger than the light by up to a pixel. ``weigh_boundaries`` lowers the weight of such texels.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.latlong import PI, direction_from_latlong, sample_latlong, sample_row
from warp_ar.kernels.launch import row_launcher
from warp_ar.kernels.structs import FrameParams, Probe

wp.set_module_options({"enable_backward": False})

MAX_HALF_PIXEL = wp.constant(wp.float32(0.1))
"""Largest angle of half a pixel, radians: balls of less than ten pixels are taken to have ten."""
WIDE = wp.constant(wp.float32(6.0))
"""Standard deviation of the wide mean, in half pixels. Wider lights (windows) are not much brighter than clipping, so
their clipped area hardly exceeds them."""
SHARPNESS = wp.constant(wp.float32(2.0))
"""Exponent of the mean clipped share around a texel, for the smallest emitter."""
BOUNDARY_REACH = wp.constant(2)
"""Samples of a Gaussian to each side, one standard deviation apart."""


@wp.func
def mean_around(
    clipped: wp.array2d[wp.vec3], i: wp.int32, j: wp.int32, deviation: wp.float32, near_pole: wp.float32
) -> wp.vec3:
    """Return the Gaussian mean of the clipped share around a texel; ``deviation`` in radians.

    Within ``near_pole`` standard deviations of a pole, samples are placed on the sphere, elsewhere along rows and
    columns.
    """
    height = wp.float32(clipped.shape[0])
    width = wp.float32(clipped.shape[1])
    sine = wp.sin(PI * (wp.float32(i) + 0.5) / height)
    total = wp.vec3(0.0, 0.0, 0.0)
    total_weight = wp.float32(0.0)
    a = wp.int32(-BOUNDARY_REACH)
    if sine < near_pole * deviation:
        # Near a pole a circle of latitude is strongly curved.
        direction = direction_from_latlong(wp.float32(i) + 0.5, wp.float32(j) + 0.5, clipped.shape[0], clipped.shape[1])
        across = wp.normalize(wp.cross(direction, wp.vec3(1.0, 0.0, 0.0)))
        upward = wp.cross(across, direction)
        while a <= BOUNDARY_REACH:
            b = wp.int32(-BOUNDARY_REACH)
            while b <= BOUNDARY_REACH:
                toward = direction + deviation * (wp.float32(a) * across + wp.float32(b) * upward)
                weight = wp.exp(-0.5 * wp.float32(a * a + b * b))
                total += weight * sample_latlong(clipped, toward)
                total_weight += weight
                b += 1
            a += 1
        return total / total_weight
    down_step = deviation * height / PI
    across_step = deviation * width / (2.0 * PI * sine)
    # The inner loop is unrolled, so that its loads do not wait for each other; the outer one is not.
    while a <= BOUNDARY_REACH:
        y = wp.float32(i) + down_step * wp.float32(a)
        row = wp.int32(wp.floor(y))
        part = y - wp.floor(y)
        for b in range(wp.static(-BOUNDARY_REACH), wp.static(BOUNDARY_REACH + 1)):
            x = wp.float32(j) + across_step * wp.float32(b)
            top = sample_row(clipped, row, x)
            weight = wp.exp(-0.5 * wp.float32(a * a + b * b))
            total += weight * (top + part * (sample_row(clipped, row + 1, x) - top))
            total_weight += weight
        a += 1
    return total / total_weight


@wp.kernel(enable_backward=False)
def weigh_boundaries_kernel(
    # In:
    row_start: wp.int32,
    clipped: wp.array2d[wp.vec3],
    params: wp.array[FrameParams],
    probes: wp.array[Probe],
    # Out:
    missing_out: wp.array2d[wp.vec3],
):
    """Weight one texel by a power of the mean around it."""
    i, j = wp.tid()
    i += row_start
    share = clipped[i, j]
    if not wp.max(share) > 0.0:
        missing_out[i, j] = wp.vec3(0.0, 0.0, 0.0)
        return
    to_ball = probes[0].center - params[0].camera_position
    pixels = params[0].focal[0] * probes[0].radius / wp.length(to_ball)
    # At the ball's centre a pixel covers 1 / pixels radians of normals, and twice that of reflected directions.
    half_pixel = wp.clamp(1.0 / pixels, 0.0, MAX_HALF_PIXEL)
    # One loop for both widths: two copies of the code would compile twice as long.
    around = wp.float32(0.0)
    turn = wp.int32(0)
    while turn < 2:
        # For the wide mean, sampling along rows and columns is exact enough nearly everywhere.
        deviation = wp.where(turn == 0, half_pixel, WIDE * half_pixel)
        mean = wp.max(mean_around(clipped, i, j, deviation, wp.where(turn == 0, wp.float32(6.0), wp.float32(1.5))))
        turn += 1
        if turn == 2:
            around = wp.pow(around, SHARPNESS * wp.max(1.0 - 2.0 * mean, 0.0))
        else:
            around = mean
            if not around < 0.999:
                turn = wp.int32(2)
    missing_out[i, j] = share * around


weigh_boundaries = row_launcher(weigh_boundaries_kernel, like=lambda clipped, *_: clipped)
"""Weight clipped texels by the probability that they show the light itself; saturation boundaries get less weight.

The weight of a texel is the mean clipped share around it, by a Gaussian of half a pixel's standard deviation and in
the channel that clips most, to the power

    2 max(0, 1 - 2 w),    w the same mean by a Gaussian of three pixels.

So an emitter of a few pixels gets its true size, and so do its shadows and highlights. Windows keep their clipped area
(w is 1/2 at their boundary): they are not bright enough that a pixel clips of which they cover a small part.

Args:
    clipped: Clipped share per channel, ``wp.vec3`` (h, w).
    params: ``FrameParams`` (1): the camera.
    probes: ``Probe`` (P), at least one: the ball.
    missing_out: ``wp.vec3`` (h, w), 0 where nothing clips.
"""
