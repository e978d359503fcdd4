"""Picture of the path tracer, from samples: moments of each pixel, reflectance of its surface, and standard error.

Each sample of a pixel has three quantities: z, radiance that does not depend on the proxy's reflectance; g, the
difference that virtual content makes on a white surface; and e = E / pi, the radiance of a white surface without
virtual content.

A noisy pixel takes a hundred times the samples of another. If one thread traced all samples of its pixel, most of a GPU
would wait for a few threads. So the samples of all pixels are listed, those of a pixel one after another. Each is
traced by its own thread (``path_tracer.trace_paths``), and pixels then add their samples in order. So moments have the
same bits however samples are divided into rounds.

    list_samples -> trace_paths -> add_samples

References:
    [Bea62] Beale 1962, Some Uses of Computers in Operational Research (ratios of means with less bias).
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.color import encode
from warp_ar.kernels.launch import launch_rows, row_launcher
from warp_ar.kernels.receiver.receiver import reflectance_of
from warp_ar.kernels.reference.path_photons import UNIT, LightImage
from warp_ar.kernels.reference.path_vertices import LocalScene
from warp_ar.kernels.sampling import pcg3d_hash, uniform_from_bits

wp.set_module_options({"enable_backward": False})

SMOOTHED = wp.constant(2)
"""Half width, pixels, of the window over which irradiance is averaged for the map of reflectance."""


@wp.struct
class Moments:
    """Means of samples per pixel, and sums of products of deviations from them, (H, W) each."""

    fixed: wp.array2d[wp.vec3]  # z
    change: wp.array2d[wp.vec3]  # g
    light: wp.array2d[wp.vec3]  # e
    proxies: wp.array2d[wp.float32]  # share of samples that show a proxy
    fixed_fixed: wp.array2d[wp.vec3]
    change_change: wp.array2d[wp.vec3]
    light_light: wp.array2d[wp.vec3]
    fixed_change: wp.array2d[wp.vec3]
    fixed_light: wp.array2d[wp.vec3]
    change_light: wp.array2d[wp.vec3]
    rays: wp.array2d[wp.int32]  # number of rays traced so far
    samples: wp.array2d[wp.int32]  # number of samples so far


@wp.func
def sum_product(i: wp.int32, j: wp.int32, before: wp.vec3, after: wp.vec3, sums: wp.array2d[wp.vec3]):
    """Add the product of one quantity's deviation from its old mean and another's from its new one [Welford]."""
    sums[i, j] = sums[i, j] + wp.cw_mul(before, after)


@wp.func
def add_sample(i: wp.int32, j: wp.int32, z: wp.vec3, g: wp.vec3, e: wp.vec3, shows: wp.float32, moments: Moments):
    """Add one sample of a pixel to its moments."""
    number = moments.samples[i, j] + 1
    moments.samples[i, j] = number
    count = wp.float32(number)
    dz = z - moments.fixed[i, j]
    dg = g - moments.change[i, j]
    de = e - moments.light[i, j]
    moments.fixed[i, j] = moments.fixed[i, j] + dz / count
    moments.change[i, j] = moments.change[i, j] + dg / count
    moments.light[i, j] = moments.light[i, j] + de / count
    moments.proxies[i, j] = moments.proxies[i, j] + (shows - moments.proxies[i, j]) / count
    after_g = g - moments.change[i, j]
    after_e = e - moments.light[i, j]
    sum_product(i, j, dz, z - moments.fixed[i, j], moments.fixed_fixed)
    sum_product(i, j, dg, after_g, moments.change_change)
    sum_product(i, j, de, after_e, moments.light_light)
    sum_product(i, j, dz, after_g, moments.fixed_change)
    sum_product(i, j, dz, after_e, moments.fixed_light)
    sum_product(i, j, dg, after_e, moments.change_light)


@wp.struct
class Round:
    """N samples of H W pixels that are traced in one launch."""

    counts: wp.array[wp.int32]  # (H W) number of samples of each pixel
    ends: wp.array[wp.int32]  # (H W) one past the last sample of each pixel
    pixels: wp.array[wp.int32]  # (N) pixel i W + j of each sample; this array and those below may be longer
    z: wp.array[wp.vec3]  # z, g, e and shows: quantities of each sample, for ``add_sample``
    g: wp.array[wp.vec3]
    e: wp.array[wp.vec3]
    shows: wp.array[wp.float32]
    rays: wp.array[wp.int32]  # number of rays traced for each sample
    count: wp.int32  # N


# A pass adds ``share`` samples to a pixel on average: after n passes it has floor(n share + u), u a fixed random number
# of the pixel, 0 to 1. So the count does not depend on how passes are grouped, and pixels of small shares alternate.
@wp.func
def samples_after(passes: wp.int32, share: wp.float32, bits: wp.uint32) -> wp.int32:
    """Return the number of samples that a pixel has after ``passes`` passes; ``bits`` give its random number u."""
    return wp.int32(wp.floor(wp.float32(passes) * share + uniform_from_bits(bits)))


@wp.kernel(enable_backward=False)
def count_samples_kernel(
    # In:
    row_start: wp.int32,
    seed: wp.int32,
    begun: wp.int32,
    count: wp.int32,
    shares: wp.array2d[wp.float32],
    # Out:
    counts_out: wp.array[wp.int32],
):
    """Count the samples that each pixel takes in ``count`` passes after ``begun``."""
    i, j = wp.tid()
    i += row_start
    pixel = i * shares.shape[1] + j
    bits = pcg3d_hash(wp.uint32(pixel), ~wp.uint32(0), ~wp.uint32(seed))
    before = samples_after(begun, shares[i, j], bits[0])
    counts_out[pixel] = samples_after(begun + count, shares[i, j], bits[0]) - before


@wp.kernel(enable_backward=False)
def list_samples_kernel(
    # In:
    row_start: wp.int32,
    counts: wp.array[wp.int32],
    ends: wp.array[wp.int32],
    # Out:
    pixels_out: wp.array[wp.int32],
):
    """Write each pixel's index once for each of its samples."""
    pixel = wp.tid() + row_start
    for k in range(ends[pixel] - counts[pixel], ends[pixel]):
        pixels_out[k] = pixel


@wp.kernel(enable_backward=False)
def add_samples_kernel(
    # In:
    row_start: wp.int32,
    samples: Round,
    # Out:
    moments_out: Moments,
):
    """Add each pixel's samples to its moments, one after another."""
    i, j = wp.tid()
    i += row_start
    pixel = i * moments_out.samples.shape[1] + j
    end = samples.ends[pixel]
    for k in range(end - samples.counts[pixel], end):
        moments_out.rays[i, j] = moments_out.rays[i, j] + samples.rays[k]
        add_sample(i, j, samples.z[k], samples.g[k], samples.e[k], samples.shows[k], moments_out)


def make_round(shape: tuple[int, int], device: wp.DeviceLike) -> Round:
    """Return a round without samples, of (H, W) pixels."""
    made = Round()
    made.counts = wp.zeros(shape[0] * shape[1], dtype=wp.int32, device=device)
    made.ends = wp.zeros(shape[0] * shape[1], dtype=wp.int32, device=device)
    _make_room(made, 1)
    return made


def _make_room(samples_out: Round, count: int) -> None:
    """Enlarge the arrays of a round for ``count`` samples, if they are too short."""
    device = samples_out.counts.device
    for name in ("z", "g", "e"):
        setattr(samples_out, name, wp.empty(count, dtype=wp.vec3, device=device))
    samples_out.shows = wp.empty(count, dtype=wp.float32, device=device)
    samples_out.pixels = wp.empty(count, dtype=wp.int32, device=device)
    samples_out.rays = wp.empty(count, dtype=wp.int32, device=device)


def list_samples(shares: wp.array2d[wp.float32], samples_out: Round, *, seed: int, begun: int, count: int) -> None:
    """List the samples of some passes, and count them.

    Args:
        shares: (H, W) mean number of samples of each pixel in a pass.
        samples_out: From ``make_round``; enlarged if needed.
        seed: Seed of the random numbers.
        begun: Number of earlier passes with these shares.
        count: Number of passes.
    """
    device, counts, ends = shares.device, samples_out.counts, samples_out.ends
    inputs = [seed, begun, count, shares]
    launch_rows(count_samples_kernel, shares.shape, inputs, [counts], rows=None, device=device)
    wp.utils.array_scan(counts, ends, inclusive=True)
    samples_out.count = int(ends[-1:].numpy()[0])
    if samples_out.pixels.shape[0] < samples_out.count:
        _make_room(samples_out, samples_out.count)
    launch_rows(list_samples_kernel, counts.shape, [counts, ends], [samples_out.pixels], rows=None, device=device)


add_samples = row_launcher(add_samples_kernel, like=lambda samples, moments: moments.samples)
"""Add the samples of a round to the moments of their pixels, (H, W)."""


# Reflectance of a proxy's point is pi L0 / E, with E its irradiance without virtual content. The same paths gather E:
# light of the environment, and the radiance L0 of other surfaces. At later vertices of a path, reflectance is read from
# a map made before, with E averaged over 5 x 5 pixels of one surface. A point that no pixel shows has the mean
# reflectance of its proxy.
@wp.func
def reflectance_under(radiance: wp.vec3, light: wp.vec3) -> wp.vec3:
    """Return the reflectance of a surface of radiance ``radiance``; a white one in its place would have ``light``."""
    return wp.vec3(
        reflectance_of(radiance[0], wp.pi * light[0]),
        reflectance_of(radiance[1], wp.pi * light[1]),
        reflectance_of(radiance[2], wp.pi * light[2]),
    )


@wp.kernel(enable_backward=False)
def map_reflectance_kernel(
    # In:
    row_start: wp.int32,
    radiance: wp.array2d[wp.vec3],
    shown: wp.array2d[wp.int32],
    light: wp.array2d[wp.vec3],
    light_light: wp.array2d[wp.vec3],
    mirrored: wp.array2d[wp.vec3],
    proxies: wp.array2d[wp.float32],
    samples: wp.array2d[wp.int32],
    # Out:
    matt_out: wp.array2d[wp.vec3],
    reflectance_out: wp.array2d[wp.vec3],
):
    """Write the reflectance of a pixel that shows a proxy, by light averaged over neighbours on the same proxy.

    The specular reflection of a glossy proxy, averaged in the same way, is subtracted from the frame before;
    ``matt_out`` may be empty if no proxy is glossy.
    """
    i, j = wp.tid()
    i += row_start
    reflectance = wp.vec3(0.0, 0.0, 0.0)
    own = shown[i, j]
    if own >= 0:
        total = wp.vec3(0.0, 0.0, 0.0)
        variance = wp.vec3(0.0, 0.0, 0.0)
        seen = wp.vec3(0.0, 0.0, 0.0)
        count = float(0.0)
        for a in range(wp.max(i - SMOOTHED, 0), wp.min(i + SMOOTHED + 1, shown.shape[0])):
            for b in range(wp.max(j - SMOOTHED, 0), wp.min(j + SMOOTHED + 1, shown.shape[1])):
                if shown[a, b] == own:
                    total += light[a, b]
                    n = wp.float32(samples[a, b])
                    variance += light_light[a, b] / wp.max(n * (n - 1.0), 1.0)
                    seen += mirrored[a, b]
                    count += proxies[a, b]
        if count > 0.0:
            left = radiance[i, j]
            if matt_out.shape[0] > 0:
                left = wp.max(left - seen / count, wp.vec3(0.0, 0.0, 0.0))
                matt_out[i, j] = left
            # Corrected as in the picture: the reciprocal of a mean is too large by its relative variance.
            for c in range(3):
                if total[c] > 0.0:
                    total[c] += variance[c] / total[c]
            reflectance = reflectance_under(left, total / count)
    reflectance_out[i, j] = reflectance


@wp.func
def light_of_pixel(image: LightImage, place: wp.int32, followed: wp.float32) -> wp.vec2:
    """Return one channel of a pixel's light from ``followed`` paths from lights per pixel, and its variance."""
    total = wp.float32(image.sums[place]) / UNIT
    squares = wp.float32(image.squares[place]) / UNIT
    paths = followed * wp.float32(image.sums.shape[0] / 3)
    return wp.vec2(total / followed, wp.max(squares - total * total / paths, 0.0) / (followed * followed))


# In a pixel that shows a proxy, E and the difference are found by the same directions, so that much of their noise
# cancels in the ratio. With the means of g and e over samples, and L0 the frame's radiance,
#
#     picture = z + rho g,    rho = L0 / e.
#
# g includes the light found by ``path_photons``, if paths from lights are followed.
#
# A ratio of means is biased: to first order in 1 / n, the number of samples,
#
#     E[g / e] = G / E (1 + var(e) / (n E^2) - cov(g, e) / (n G E)).
#
# If few samples find light, the bias is large: 10 % with a standard deviation of 10 E and 1,000 samples. [Bea62]
# removes it:
#
#     g / e  ->  (g + cov(g, e) / (n e)) / (e (1 + var(e) / (n e^2))),
#
# which leaves an error in 1 / n^2 and, unlike subtraction of the bias, is bounded if a few samples have all the light.
# The variance is, to first order, that of z + rho g - b e, b = rho g / e (0 where reflectance is held at 1), over the
# number of samples, rho and b with the same corrections: so moments of the three are summed.
@wp.kernel(enable_backward=False)
def finish_picture_kernel(
    # In:
    row_start: wp.int32,
    radiance: wp.array2d[wp.vec3],
    encode_table: wp.array[wp.vec3],
    moments: Moments,
    image: LightImage,
    followed: wp.float32,
    exposure: wp.float32,
    # Out:
    radiance_out: wp.array2d[wp.vec3],
    error_out: wp.array2d[wp.vec3],
    sampled_out: wp.array2d[wp.vec3],
    image_out: wp.array2d[wp.vec3ub],
):
    """Write the picture and its standard error from the moments of each pixel's samples."""
    i, j = wp.tid()
    i += row_start
    count = wp.float32(moments.samples[i, j])
    z = moments.fixed[i, j]
    zz = moments.fixed_fixed[i, j]
    picture = z
    variance = zz
    of_lights = wp.vec3(0.0, 0.0, 0.0)  # variance of the light of paths from lights
    if moments.proxies[i, j] > 0.0:
        g = moments.change[i, j]
        e = moments.light[i, j]
        gg = moments.change_change[i, j]
        ee = moments.light_light[i, j]
        zg = moments.fixed_change[i, j]
        ze = moments.fixed_light[i, j]
        ge = moments.change_light[i, j]
        rho = reflectance_under(radiance[i, j], e / moments.proxies[i, j])
        for c in range(3):
            slope = float(0.0)
            factor = rho[c]
            brought = wp.vec2(0.0, 0.0)
            if followed > 0.0:
                brought = light_of_pixel(image, 3 * (i * radiance.shape[1] + j) + c, followed)
            change = g[c] + brought[0]
            if rho[c] < 1.0 and e[c] > 0.0:
                pairs = wp.max(count * (count - 1.0), 1.0)
                change += ge[c] / (pairs * e[c])
                light = e[c] + ee[c] / (pairs * e[c])
                factor = rho[c] * e[c] / light
                slope = factor * change / light
            of_lights[c] = factor * factor * brought[1]
            picture[c] = z[c] + factor * change
            variance[c] = (
                zz[c]
                + factor * factor * gg[c]
                + slope * slope * ee[c]
                + 2.0 * (factor * zg[c] - slope * ze[c] - factor * slope * ge[c])
            )
    radiance_out[i, j] = wp.max(picture, wp.vec3(0.0, 0.0, 0.0))
    error = wp.vec3(0.0, 0.0, 0.0)
    sampled = wp.vec3(0.0, 0.0, 0.0)
    for c in range(3):
        if count > 1.0:
            square = wp.max(variance[c], 0.0) / (count * (count - 1.0))
            sampled[c] = wp.sqrt(square)
            error[c] = wp.sqrt(square + of_lights[c])
    error_out[i, j] = error
    sampled_out[i, j] = sampled
    image_out[i, j] = encode(encode_table, exposure * radiance_out[i, j])


def make_moments(shape: tuple[int, int], device: wp.DeviceLike) -> Moments:
    """Return ``Moments`` of zeros, for (H, W) pixels."""
    moments = Moments()
    for name in Moments.vars:
        dtype = {"proxies": wp.float32, "rays": wp.int32, "samples": wp.int32}.get(name, wp.vec3)
        setattr(moments, name, wp.zeros(shape, dtype=dtype, device=device))
    return moments


def map_reflectance(scene: LocalScene, moments: Moments, reflectance_out: wp.array2d[wp.vec3]) -> None:
    """Write the reflectance of the proxy in every pixel, (H, W), from the task ``IRRADIANCE``'s moments; 0 without one.

    If proxies are glossy, ``scene.matt`` is written too.
    """
    shape, device = reflectance_out.shape, reflectance_out.device
    inputs = [scene.radiance, scene.shown, moments.light, moments.light_light]
    inputs += [moments.change, moments.proxies, moments.samples]
    outputs = [None if scene.gloss is None else scene.matt, reflectance_out]
    launch_rows(map_reflectance_kernel, shape, inputs, outputs, rows=None, device=device)


finish_picture = row_launcher(finish_picture_kernel, outputs=4)
"""Write the picture and its standard error from the moments.

Args:
    radiance: (H, W) ``LocalScene.matt``: the frame's radiance without specular reflections of proxies.
    encode_table: From ``color.encode_table``.
    moments: (H, W) moments of samples.
    image: (H, W) light of paths from virtual lights.
    followed: Number of paths from virtual lights per pixel; 0 for none.
    exposure: Factor on the radiance that is encoded.
    radiance_out: (H, W) linear radiance in camera values, not clipped.
    error_out: (H, W) standard error of the radiance, per channel.
    sampled_out: (H, W) radiance without the light of ``image``.
    image_out: (H, W) encoded.
"""
