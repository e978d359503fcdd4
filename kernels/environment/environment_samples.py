"""Samples of the environment: directions, each with the radiance and the solid angle that it stands for.

``count * sets`` samples are drawn whenever the environment changes. A surface's irradiance is the sum

    E = sum over samples of  measure * radiance * max(n.w, 0) * visible,   measure = 1 / (number of samples * pdf).

Density. The density of half of the samples is proportional to radiance times a weight of the direction, so that an
emitter of one texel and the sky around it get samples by their light. That of the other half is proportional to the
weight alone, so that no sample stands for more than twice its share of the hemisphere, and objects that reflect light
are sampled evenly. The weight is 0.3 + max(w.z, 0): mostly directions above the receiver, some for surfaces of other
orientations. Texels are picked by inverting the cumulative sums of rows and of the texels in a row; within a texel
samples are uniform.

Points. The first two dimensions of Sobol's sequence are a (0, 2)-sequence in base 2: every aligned block of 2^m
consecutive points, and all blocks together, have one point in each elementary interval of their size. A block is a set.
The pixels of a tile use one set each, and their mean has the error of all sets together [KH01].

Several balls. If the light is interpolated between several mirror balls, their samples alternate. ``slots`` is the
least power of two that is not less than the number of balls; of every ``slots`` samples each ball has one or two. So
the first part of a set, and all sets together, hold aligned blocks of every ball's sequence. The samples of a ball sum
to its own irradiance; ``probe_weights`` gives the ball's weight at a point.

Near emitters. A sample stores the distance of its source, infinite for the environment. The direction of an emitter at
a known distance depends on the lit point: see ``sample_toward``.

References:
    [KH01] Keller, Heidrich 2001, Interleaved Sampling.
    [PBRT] Pharr, Jakob, Humphreys, Physically Based Rendering, 4th edition, section 12.5: environments by inversion.
"""

from __future__ import annotations

import math

import warp as wp

from warp_ar.kernels.color import brightness
from warp_ar.kernels.launch import launch, launch_tiles, row_launcher, tile_kernel
from warp_ar.kernels.safe_math import safe_radiance
from warp_ar.kernels.sampling import BELOW_ONE, radical_inverse, uniform_from_bits
from warp_ar.kernels.structs import Emitter, vec8

wp.set_module_options({"enable_backward": False})

PI = wp.constant(wp.float32(math.pi))
SIDE_WEIGHT = wp.constant(wp.float32(0.3))
"""Weight that all directions have in addition to the cosine of those above the receiver."""
FAR_AWAY = wp.constant(wp.float32(1.0e30))
"""Distance of the environment's light, metres."""
EMITTER_COSINE = wp.constant(wp.float32(math.cos(math.radians(12.0))))
"""Cosine of the largest angle between an emitter's direction and light that belongs to it."""
MIN_EMITTER_DISTANCE = wp.constant(wp.float32(0.05))
"""Least distance of an emitter from the ball, metres."""
# Typed: literals above 2^31 in a kernel make the compiler warn.
TOP_BIT = wp.constant(wp.uint32(0x80000000))


@wp.struct
class EnvironmentSample:
    """One direction of the environment."""

    direction: wp.vec3  # unit, world, from ``origin``
    radiance: wp.vec3
    measure: wp.float32  # solid angle that the sample stands for
    distance: wp.float32  # metres from ``origin`` to the light; FAR_AWAY for the environment
    origin: wp.vec3  # the ball's centre, or for an emitter the point of the ball that reflects it to the camera


@wp.struct
class SampleSets:
    """Samples of the environment, set after set, as records and, for culling, as separate arrays."""

    directions: wp.array[wp.vec3]
    flux: wp.array[wp.vec3]  # radiance times solid angle
    samples: wp.array[EnvironmentSample]


@wp.struct
class Incidence:
    """A sample seen from a point."""

    direction: wp.vec3  # unit, toward the light
    distance: wp.float32
    measure: wp.float32


@wp.func
def sample_toward(sample: EnvironmentSample, point: wp.vec3) -> Incidence:
    """Return a sample seen from ``point``; an emitter at distance d0 gets a new direction, and measure (d0 / d)^2."""
    result = Incidence()
    result.direction = sample.direction
    result.distance = FAR_AWAY
    result.measure = sample.measure
    if sample.distance < FAR_AWAY:
        to_light = sample.origin + sample.distance * sample.direction - point
        distance = wp.max(wp.length(to_light), 1.0e-3)
        result.direction = to_light / distance
        result.distance = distance
        result.measure = sample.measure * sample.distance * sample.distance / (distance * distance)
    return result


@wp.func
def slots_of(balls: wp.int32) -> wp.int32:
    """Return the number of samples after which the order of balls repeats: the least power of two >= ``balls``."""
    slots = wp.int32(1)
    while slots < balls:
        slots *= 2
    return slots


@wp.func
def ball_of_sample(index: wp.int32, balls: wp.int32) -> wp.int32:
    """Return the index of the ball whose environment sample ``index`` belongs to."""
    return (index % slots_of(balls)) % balls


@wp.func
def turns_of(ball: wp.int32, balls: wp.int32) -> wp.int32:
    """Return a ball's number of samples in each period of ``slots_of``."""
    return 1 + (slots_of(balls) - 1 - ball) / balls


@wp.func
def sobol_second(index: wp.uint32) -> wp.float32:
    """Return coordinate 2 of point ``index`` of Sobol's sequence; coordinate 1 is ``radical_inverse``."""
    bits = wp.uint32(0)
    direction = TOP_BIT
    i = index
    while i != wp.uint32(0):
        if (i & wp.uint32(1)) != wp.uint32(0):
            bits = bits ^ direction
        i = i >> wp.uint32(1)
        direction = direction ^ (direction >> wp.uint32(1))
    return uniform_from_bits(bits)


@wp.func
def direction_weight(cos_theta: wp.float32) -> wp.float32:
    """Return the weight of directions at the angle theta to +z."""
    return SIDE_WEIGHT + wp.max(cos_theta, 0.0)


@wp.func
def row_edge(row: wp.int32, height: wp.int32) -> wp.float32:
    """Return the cosine of the polar angle of the upper edge of a latlong map's row."""
    return wp.cos(PI * wp.float32(row) / wp.float32(height))


@wp.func
def row_weight(row: wp.int32, height: wp.int32, width: wp.int32) -> wp.float32:
    """Return the weight of one texel of a row: its solid angle times the weight of its central direction."""
    top = row_edge(row, height)
    bottom = row_edge(row + 1, height)
    return direction_weight(0.5 * (top + bottom)) * (top - bottom) * 2.0 * PI / wp.float32(width)


@wp.kernel(enable_backward=False)
def sum_along_rows_kernel(
    # In:
    environment: wp.array2d[wp.vec3],
    # Out:
    cumulative_out: wp.array2d[wp.float32],
):
    """Write the running sums of brightness along one row. Compensated summation keeps a dim sky next to a sun.

    Several texels are read before they are added, so that a CUDA thread waits for memory once, not for each texel.
    """
    i = wp.tid()
    width = environment.shape[1]
    total = float(0.0)
    lost = float(0.0)
    for start in range(0, width, 8):
        bright = vec8()
        for k in range(8):
            bright[k] = brightness(safe_radiance(environment[i, wp.min(start + k, width - 1)]))
        for k in range(8):
            if start + k < width:
                term = bright[k] - lost
                after = total + term
                lost = (after - total) - term
                total = after
                cumulative_out[i, start + k] = total


@tile_kernel
def sum_rows_kernel(
    # In:
    cumulative: wp.array2d[wp.float32],
    # Out:
    rows_out: wp.array[wp.vec2],
):
    """Write (weighted brightness, weight) summed over all rows up to one, by one block of threads."""
    i, lane = wp.tid()
    height = cumulative.shape[0]
    width = cumulative.shape[1]
    total = wp.vec2(0.0, 0.0)
    for row in range(lane, i + 1, wp.block_dim()):
        total += row_weight(row, height, width) * wp.vec2(cumulative[row, width - 1], wp.float32(width))
    sums = wp.tile_sum(wp.tile(total, preserve_type=True))
    if lane == 0:
        rows_out[i] = sums[0]


@wp.kernel(enable_backward=False)
def draw_samples_kernel(
    # In:
    row_start: wp.int32,
    environment: wp.array2d[wp.vec3],
    cumulative: wp.array2d[wp.float32],
    rows: wp.array[wp.vec2],
    origin: wp.vec3,
    turn: wp.vec2i,
    # Out:
    directions_out: wp.array[wp.vec3],
    flux_out: wp.array[wp.vec3],
    samples_out: wp.array[EnvironmentSample],
):
    """Draw one sample of this ball by inverting cumulative sums; samples of other balls are left unchanged."""
    index = wp.tid() + row_start
    if ball_of_sample(index, turn[1]) != turn[0]:
        return
    slots = slots_of(turn[1])
    turns = turns_of(turn[0], turn[1])
    count = samples_out.shape[0] / slots * turns
    number = wp.uint32(index / slots * turns + index % slots / turn[1])
    height = environment.shape[0]
    width = environment.shape[1]
    total = rows[height - 1]
    # Half of the samples have each density; in a black environment all have the weight alone.
    bright_share = wp.where(total[0] > 0.0, 0.5 / wp.max(total[0], 1.0e-37), 0.0)
    even_share = wp.where(total[0] > 0.0, 0.5, 1.0) / total[1]
    u = radical_inverse(number) + 0.5 / wp.float32(count)
    v = wp.min(sobol_second(number) + 0.5 / wp.float32(count), BELOW_ONE)

    low = wp.int32(0)
    high = wp.int32(height - 1)
    while low < high:
        middle = (low + high) / 2
        if bright_share * rows[middle][0] + even_share * rows[middle][1] > u:
            high = middle
        else:
            low = middle + 1
    row = low
    before = float(0.0)
    if row > 0:
        before = bright_share * rows[row - 1][0] + even_share * rows[row - 1][1]
    row_share = bright_share * rows[row][0] + even_share * rows[row][1] - before
    fraction = wp.clamp((u - before) / wp.max(row_share, 1.0e-37), 0.0, 1.0)

    weight = row_weight(row, height, width)
    line = weight * (bright_share * cumulative[row, width - 1] + even_share * wp.float32(width))
    target = v * line
    low = wp.int32(0)
    high = wp.int32(width - 1)
    while low < high:
        middle = (low + high) / 2
        if weight * (bright_share * cumulative[row, middle] + even_share * wp.float32(middle + 1)) > target:
            high = middle
        else:
            low = middle + 1
    column = low
    before = float(0.0)
    if column > 0:
        before = weight * (bright_share * cumulative[row, column - 1] + even_share * wp.float32(column))
    radiance = safe_radiance(environment[row, column])
    share = weight * (bright_share * brightness(radiance) + even_share)
    within = wp.clamp((target - before) / wp.max(share, 1.0e-37), 0.0, 1.0)

    top = row_edge(row, height)
    bottom = row_edge(row + 1, height)
    z = top + fraction * (bottom - top)
    phi = (2.0 * (wp.float32(column) + within) / wp.float32(width) - 1.0) * PI
    sine = wp.sqrt(wp.max((1.0 - z) * (1.0 + z), 0.0))
    sample = EnvironmentSample()
    sample.direction = wp.vec3(sine * wp.cos(phi), sine * wp.sin(phi), z)
    sample.radiance = radiance
    solid_angle = (top - bottom) * 2.0 * PI / wp.float32(width)
    sample.measure = solid_angle / (wp.max(share, 1.0e-37) * wp.float32(count))
    sample.distance = FAR_AWAY
    sample.origin = origin
    directions_out[index] = sample.direction
    flux_out[index] = sample.measure * sample.radiance
    samples_out[index] = sample


@wp.kernel(enable_backward=False)
def list_texels_kernel(
    # In:
    row_start: wp.int32,
    environment: wp.array2d[wp.vec3],
    origin: wp.vec3,
    turn: wp.vec2i,
    # Out:
    directions_out: wp.array[wp.vec3],
    flux_out: wp.array[wp.vec3],
    samples_out: wp.array[EnvironmentSample],
):
    """Write one texel of a map as a sample at its centre, once for each of the ball's samples in a period."""
    i, j = wp.tid()
    i += row_start
    height = environment.shape[0]
    width = environment.shape[1]
    top = row_edge(i, height)
    bottom = row_edge(i + 1, height)
    z = 0.5 * (top + bottom)
    phi = (2.0 * (wp.float32(j) + 0.5) / wp.float32(width) - 1.0) * PI
    sine = wp.sqrt(wp.max((1.0 - z) * (1.0 + z), 0.0))
    sample = EnvironmentSample()
    sample.direction = wp.vec3(sine * wp.cos(phi), sine * wp.sin(phi), z)
    sample.radiance = safe_radiance(environment[i, j])
    slots = slots_of(turn[1])
    sample.measure = (top - bottom) * 2.0 * PI / wp.float32(width * turns_of(turn[0], turn[1]))
    sample.distance = FAR_AWAY
    sample.origin = origin
    for slot in range(turn[0], slots, turn[1]):
        index = (i * width + j) * slots + slot
        directions_out[index] = sample.direction
        flux_out[index] = sample.measure * sample.radiance
        samples_out[index] = sample


@wp.kernel(enable_backward=False)
def place_emitters_kernel(
    # In:
    row_start: wp.int32,
    emitters: wp.array[Emitter],
    turn: wp.vec2i,
    # Out:
    samples_out: wp.array[EnvironmentSample],
):
    """Give a sample that shows an emitter the distance of the emitter nearest to its direction."""
    index = wp.tid() + row_start
    if ball_of_sample(index, turn[1]) != turn[0]:
        return
    sample = samples_out[index]
    if wp.max(sample.radiance) < 1.0:
        return
    nearest = EMITTER_COSINE
    for k in range(emitters.shape[0]):
        emitter = emitters[k]
        cosine = wp.dot(emitter.direction, sample.direction)
        if cosine > nearest:
            nearest = cosine
            samples_out[index].origin = emitter.origin
            samples_out[index].distance = wp.clamp(emitter.distance, MIN_EMITTER_DISTANCE, FAR_AWAY)


place_emitters = row_launcher(place_emitters_kernel)
"""Give the samples of near emitters a distance.

A sample shows an emitter if it is as bright as clipping and within ``EMITTER_COSINE`` of the emitter's direction.

Args:
    emitters: (k,) emitters. One without direction is ignored; samples of one at infinity stay distant.
    turn: Index of the environment's ball, and number of balls that share the samples.
    samples_out: (n,) samples, drawn from the environment of the ball to which the emitters' distances refer.
"""


def sum_environment(
    environment: wp.array2d[wp.vec3], cumulative_out: wp.array2d[wp.float32], rows_out: wp.array[wp.vec2]
) -> None:
    """Compute the cumulative sums that ``draw_samples`` inverts.

    Args:
        environment: (h, w) radiance; NaN and negative values count as none.
        cumulative_out: (h, w) brightness summed along each row.
        rows_out: (h,) weighted brightness and weight, summed over rows.
    """
    height = environment.shape[0]
    launch(sum_along_rows_kernel, height, [environment], [cumulative_out], block_dim=32)
    launch_tiles(sum_rows_kernel, [height], [cumulative_out], [rows_out], block_dim=32)


draw_samples = row_launcher(draw_samples_kernel, outputs=3)
"""Draw as many samples as ``samples_out`` holds, the same for the same environment.

Args:
    environment: (h, w) radiance.
    cumulative: From ``sum_environment``.
    rows_sums: From ``sum_environment``.
    origin: Position at which the environment was captured, world.
    turn: Index of the environment's ball, and number of balls that share the samples.
    directions_out: (n,) unit directions of the samples, for culling.
    flux_out: (n,) radiance times solid angle of the samples, for culling.
    samples_out: (n,), n a power of two.
"""


list_texels = row_launcher(list_texels_kernel, outputs=3, like=lambda environment, *_: environment)
"""Write every texel of a map as a sample: the reference.

Args:
    environment: (h, w) radiance.
    origin: Position at which the environment was captured, world.
    turn: As for ``draw_samples``.
    directions_out: (h * w * slots,) directions of the samples.
    flux_out: (h * w * slots,) radiance times solid angle of the samples.
    samples_out: (h * w * slots,) samples.
"""
