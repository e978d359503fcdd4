"""The samples of a round: one thread each, whichever pixel they are of.

A noisy pixel takes a hundred samples where another takes one. If a thread did all those of its pixel, a GPU would wait
for a few of them with nearly all of it idle. So the samples of all pixels are listed, those of a pixel side by side;
each is traced into a place of its own (``path_tracer.trace_paths``), and pixels then add theirs in order. Their moments
have the same bits however a round is divided.

    list_samples -> trace_paths -> add_samples
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.launch import launch_rows
from warp_ar.kernels.reference.path_learning import learn_sample
from warp_ar.kernels.reference.path_picture import Moments, add_sample
from warp_ar.kernels.sampling import pcg3d_hash, uniform_from_bits

wp.set_module_options({"enable_backward": False})


@wp.struct
class Round:
    """Samples that are traced side by side: N of them, of H W pixels."""

    counts: wp.array[wp.int32]  # (H W) of each pixel
    ends: wp.array[wp.int32]  # (H W) one past the last of each pixel
    pixels: wp.array[wp.int32]  # (N) i W + j of each sample; this and all below may be longer
    z: wp.array[wp.vec3]  # what it tells, as ``add_sample`` takes it
    g: wp.array[wp.vec3]
    e: wp.array[wp.vec3]
    shows: wp.array[wp.float32]
    rays: wp.array[wp.int32]  # that were traced for it
    bins: wp.array[wp.int32]  # of ``path_learning``, in which its path leaves the first surface; or -1
    squares: wp.array[wp.float32]  # what it tells of this bin


# A pass adds ``share`` samples to a pixel: after n passes it has floor(n share + u), u its own number from 0 to 1. So
# what a pixel has does not depend on how many passes are made at a time, and pixels of small shares take turns.
@wp.func
def samples_after(passes: wp.int32, share: wp.float32, bits: wp.uint32) -> wp.int32:
    """Samples of a pixel after so many passes."""
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
    """How many samples each pixel takes in ``count`` passes after ``begun``."""
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
    """Write each pixel's number as often as it takes samples."""
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
    squares_out: wp.array2d[wp.int64],
):
    """Take each pixel's samples into its moments, one after another, and learn directions by them."""
    i, j = wp.tid()
    i += row_start
    pixel = i * moments_out.samples.shape[1] + j
    end = samples.ends[pixel]
    for k in range(end - samples.counts[pixel], end):
        moments_out.rays[i, j] = moments_out.rays[i, j] + samples.rays[k]
        add_sample(i, j, samples.z[k], samples.g[k], samples.e[k], samples.shows[k], moments_out)
        learn_sample(pixel, moments_out.samples.shape[1], samples.bins[k], samples.squares[k], squares_out)


def make_round(shape: tuple[int, int], device: wp.DeviceLike) -> Round:
    """A round without samples, of (H, W) pixels."""
    made = Round()
    made.counts = wp.zeros(shape[0] * shape[1], dtype=wp.int32, device=device)
    made.ends = wp.zeros(shape[0] * shape[1], dtype=wp.int32, device=device)
    _make_room(made, 1)
    return made


def _make_room(samples_out: Round, count: int) -> None:
    """Arrays for so many samples."""
    device = samples_out.counts.device
    for name in ("z", "g", "e"):
        setattr(samples_out, name, wp.empty(count, dtype=wp.vec3, device=device))
    samples_out.shows = wp.empty(count, dtype=wp.float32, device=device)
    samples_out.bins = wp.empty(count, dtype=wp.int32, device=device)
    samples_out.squares = wp.empty(count, dtype=wp.float32, device=device)
    samples_out.pixels = wp.empty(count, dtype=wp.int32, device=device)
    samples_out.rays = wp.empty(count, dtype=wp.int32, device=device)


def list_samples(shares: wp.array2d[wp.float32], samples_out: Round, *, seed: int, begun: int, count: int) -> int:
    """List the samples of some passes.

    Args:
        shares: (H, W) samples of a pixel in a pass.
        samples_out: Of ``make_round``; grows as it must.
        seed: Of the random numbers.
        begun: Passes with these shares that were made before.
        count: Passes.

    Returns:
        How many samples there are.
    """
    device, counts, ends = shares.device, samples_out.counts, samples_out.ends
    inputs = [seed, begun, count, shares]
    launch_rows(count_samples_kernel, shares.shape, inputs, [counts], rows=None, device=device)
    wp.utils.array_scan(counts, ends, inclusive=True)
    total = int(ends[-1:].numpy()[0])
    if samples_out.pixels.shape[0] < total:
        _make_room(samples_out, total)
    launch_rows(list_samples_kernel, counts.shape, [counts, ends], [samples_out.pixels], rows=None, device=device)
    return total


def add_samples(samples: Round, moments_out: Moments, squares_out: wp.array2d[wp.int64]) -> None:
    """Take the samples of a round into the moments of their pixels, (H, W), and the sums of ``path_learning``."""
    shape, device, outputs = moments_out.samples.shape, moments_out.samples.device, [moments_out, squares_out]
    launch_rows(add_samples_kernel, shape, [samples], outputs, rows=None, device=device)
