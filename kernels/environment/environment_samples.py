"""The environment as a set of directions, each with the light that it stands for.

The environment becomes ``count * sets`` samples, drawn again whenever it changes. A surface's irradiance is the sum

    E = sum over samples of  measure * radiance * max(n.w, 0) * visible,   measure = 1 / (number of samples * pdf).

Density. Half of the samples follow what arrives at the receiver, radiance times the weight of the direction, so that a
emitter of one texel and the sky around it get samples by their light; half follow the weight alone, so that no sample
stands for more than twice its share of the hemisphere and what objects reflect is sampled evenly. The weight is 0.3 +
max(w.z, 0): mostly directions above the receiver, some for surfaces of other orientations. Texels are picked by
inverting the cumulative sums of rows and of the texels in a row; within a texel a sample is uniform.

Points. The first two dimensions of Sobol's sequence are a (0, 2)-sequence in base 2: every aligned block of 2^m
consecutive points, and all blocks together, have one point in each elementary interval of their size. A block is a set:
pixels of a tile take one set each, their mean has the error of all sets together [KH01].

Several balls. Where the light is interpolated between the environments of several mirror balls, each has samples of its
own, in turn: of every ``slots`` samples, the least power of two that is no less than the number of balls, each ball has
one or two. So the first part of a set, and all sets together, hold aligned blocks of every ball's sequence. A ball's
samples sum to its own irradiance; ``probe_weights`` says what it counts at a point.

Near emitters. A sample carries the distance at which its light starts; infinity for an environment. An emitter at a
known distance is thereby an emitter at its place: see ``sample_toward``.

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
from warp_ar.kernels.structs import Emitter

wp.set_module_options({"enable_backward": False})

PI = wp.constant(wp.float32(math.pi))
SIDE_WEIGHT = wp.constant(wp.float32(0.3))
"""Weight of directions that the receiver does not see, beside the cosine of those that it does."""
FAR_AWAY = wp.constant(wp.float32(1.0e30))
"""Distance of light that is part of the environment."""
EMITTER_COSINE = wp.constant(wp.float32(math.cos(math.radians(12.0))))
"""Cosine of the largest angle between an emitter's direction and light that belongs to it."""
MIN_EMITTER_DISTANCE = wp.constant(wp.float32(0.05))
"""Metres from the ball within which no emitter is taken to be."""
# Typed: literals above 2^31 in a kernel make the compiler warn.
TOP_BIT = wp.constant(wp.uint32(0x80000000))


@wp.struct
class EnvironmentSample:
    """One direction of the environment."""

    direction: wp.vec3  # unit, world, as seen from where the environment was captured
    radiance: wp.vec3
    measure: wp.float32  # solid angle that the sample stands for
    distance: wp.float32  # metres from ``origin`` to the light; FAR_AWAY for the environment
    origin: wp.vec3  # where it was captured: the ball's centre, or for an emitter the place that mirrors it


@wp.struct
class SampleSets:
    """Samples of the environment, set after set; each is known in two forms."""

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
    """A sample as ``point`` sees it: an emitter at a known distance d0 from the ball turns, and grows by (d0 / d)^2."""
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
    """Samples after which it is the first ball's turn again."""
    slots = wp.int32(1)
    while slots < balls:
        slots *= 2
    return slots


@wp.func
def ball_of_sample(index: wp.int32, balls: wp.int32) -> wp.int32:
    """Whose environment a sample is of."""
    return (index % slots_of(balls)) % balls


@wp.func
def turns_of(ball: wp.int32, balls: wp.int32) -> wp.int32:
    """Samples of ``slots_of`` that are a ball's."""
    return 1 + (slots_of(balls) - 1 - ball) / balls


@wp.func
def sobol_second(index: wp.uint32) -> wp.float32:
    """Second dimension of Sobol's sequence; the first is ``radical_inverse``."""
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
    """Return the weight of directions at an angle to +z."""
    return SIDE_WEIGHT + wp.max(cos_theta, 0.0)


@wp.func
def row_edge(row: wp.int32, height: wp.int32) -> wp.float32:
    """Cosine of the polar angle where a row of a map begins."""
    return wp.cos(PI * wp.float32(row) / wp.float32(height))


@wp.func
def row_weight(row: wp.int32, height: wp.int32, width: wp.int32) -> wp.float32:
    """Weight of one texel of a row: its solid angle times that of its middle direction."""
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
    """Running sums of brightness along one row; compensated, so that a sun does not swallow the sky beside it."""
    i = wp.tid()
    total = float(0.0)
    lost = float(0.0)
    for j in range(environment.shape[1]):
        term = brightness(safe_radiance(environment[i, j])) - lost
        after = total + term
        lost = (after - total) - term
        total = after
        cumulative_out[i, j] = total


@tile_kernel
def sum_rows_kernel(
    # In:
    cumulative: wp.array2d[wp.float32],
    # Out:
    rows_out: wp.array[wp.vec2],
):
    """Sum of (weighted brightness, weight) over the rows up to one, by one block."""
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
    """Invert the cumulative sums of the mixture for one point, if it is this ball's turn."""
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
    # Each kind of density gives half; a black environment gives all to the weight alone.
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
    """Every texel of a map as a sample at its centre, as often as it is this ball's turn."""
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
    """Give the samples that show an emitter the distance of the emitter that they are nearest to."""
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
"""Turn the samples of near emitters from directions into places.

A sample shows an emitter if it is as bright as clipping and within ``EMITTER_COSINE`` of its direction.

Args:
    emitters: (k,) emitters; those without direction are none, those at infinity stay directions.
    turn: As for ``draw_samples``.
    samples_out: (n,) samples, drawn from an environment captured where the emitters' distances are from.
"""


def sum_environment(
    environment: wp.array2d[wp.vec3], cumulative_out: wp.array2d[wp.float32], rows_out: wp.array[wp.vec2]
) -> None:
    """Cumulative sums that ``draw_samples`` inverts.

    Args:
        environment: (h, w) radiance; NaN and negative values count as none.
        cumulative_out: (h, w) brightness summed along each row.
        rows_out: (h,) weighted brightness and weight, summed over rows.
    """
    height = environment.shape[0]
    launch(sum_along_rows_kernel, height, [environment], [cumulative_out])
    launch_tiles(sum_rows_kernel, [height], [cumulative_out], [rows_out], block_dim=32)


draw_samples = row_launcher(draw_samples_kernel, outputs=3)
"""Draw as many samples as ``samples_out`` holds, the same for the same environment.

Args:
    environment: (h, w) radiance.
    cumulative: From ``sum_environment``.
    rows_sums: From ``sum_environment``.
    origin: Where the environment was captured, world.
    turn: Number of the ball that the environment is of, and how many balls share the samples.
    directions_out: (n,) unit directions of the samples, by themselves for culling.
    flux_out: (n,) their radiance times solid angle, likewise.
    samples_out: (n,), n a power of two.
"""


list_texels = row_launcher(list_texels_kernel, outputs=3, like=lambda environment, *_: environment)
"""Write every texel of a map as a sample: the reference.

Args:
    environment: (h, w) radiance.
    origin: Where the environment was captured, world.
    turn: As for ``draw_samples``.
    directions_out: (h * w * slots,) directions of the samples.
    flux_out: As many, their radiance times solid angle.
    samples_out: As many.
"""
