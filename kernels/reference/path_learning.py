"""Directions from a matt surface that the frame shows toward virtual objects, by what earlier samples brought.

What rough metal throws of a lamp onto a desk comes by few directions, which nothing tells beforehand. So the cone of
the sphere around an object (``path_guides``) is divided into bins of equal solid angle, and for every tile of the
picture each bin has a chance. A sample tells of the bin in which its path left the first surface. With F what the path
brought from there, in which the density q of its direction divides, F^2 q is an estimate of the integral of f^2 over
the bin, f what the surface sends to the camera of light by a direction. Where a bin of solid angle V has the chance p,
its directions have the density p / V, and samples the second moment

    sum over bins of  V / p  integral f^2,    which is least where    p is proportional to the root of V integral f^2.

A part of all directions stays even, so that none is left without samples. Chances are learned from the samples of
passes before; those of a pass do not change while it lasts, so each of its samples has the mean that it had without.
Sums are integers: threads may add to them in any order.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.launch import launch_rows
from warp_ar.kernels.reference.path_guides import BINS

wp.set_module_options({"enable_backward": False})

TILE = wp.constant(8)
"""Width and height of a tile in pixels."""
EVEN = wp.constant(wp.float32(0.25))
"""Chance of a direction to be drawn without regard to what was learned."""
UNIT = wp.constant(wp.float32(65536.0))
"""Of what is summed."""
MOST = wp.constant(wp.float32(1.0e9))
"""That a sample adds at most."""


@wp.func
def tile_of(pixel: wp.int32, width: wp.int32) -> wp.int32:
    """The tile in which a pixel lies."""
    across = (width + TILE - 1) / TILE
    return pixel / width / TILE * across + pixel % width / TILE


@wp.func
def learn_sample(
    pixel: wp.int32, width: wp.int32, bin: wp.int32, square: wp.float32, squares_out: wp.array2d[wp.int64]
):
    """Add what a sample tells of its bin (-1: of none), F^2 q, to the sums of its tile."""
    if bin >= 0 and square > 0.0:
        wp.atomic_add(squares_out, tile_of(pixel, width), bin, wp.int64(wp.min(square, MOST) * UNIT))


@wp.kernel(enable_backward=False)
def learn_directions_kernel(
    # In:
    row_start: wp.int32,
    squares: wp.array2d[wp.int64],
    across: wp.int32,
    # Out:
    learned_out: wp.array2d[wp.float32],
):
    """Cumulative chances of the bins of every tile, by the sums of 3 x 3 tiles."""
    tile = wp.tid() + row_start
    row = tile / across
    column = tile % across
    bins = squares.shape[1]
    total = float(0.0)
    for k in range(bins):
        around = float(0.0)
        for i in range(wp.max(row - 1, 0), wp.min(row + 2, squares.shape[0] / across)):
            for j in range(wp.max(column - 1, 0), wp.min(column + 2, across)):
                weight = wp.float32((2 - wp.abs(i - row)) * (2 - wp.abs(j - column)))
                around += weight * wp.float32(squares[i * across + j, k])
        around = wp.sqrt(around)
        learned_out[tile, k + 1] = around
        total += around
    learned_out[tile, 0] = 0.0
    even = 1.0 / wp.float32(bins)
    reached = float(0.0)
    for k in range(bins):
        chance = even
        if total > 0.0:
            chance = EVEN * even + (1.0 - EVEN) * learned_out[tile, k + 1] / total
        reached += chance
        learned_out[tile, k + 1] = wp.where(k == bins - 1, 1.0, wp.min(reached, 1.0))


def make_squares(shape: tuple[int, int], objects: int, device: wp.DeviceLike) -> wp.array2d[wp.int64]:
    """Sums of no samples, (tiles, bins of all objects), for a picture of (H, W) pixels."""
    tiles = -(-shape[0] // int(TILE)) * -(-shape[1] // int(TILE))
    return wp.zeros((tiles, objects * int(BINS)), dtype=wp.int64, device=device)


def learn_directions(squares: wp.array2d[wp.int64], learned_out: wp.array2d[wp.float32], *, width: int) -> None:
    """Write the chances of bins, as ``Guides.learned`` has them.

    Args:
        squares: (tiles, bins) of ``make_squares``, summed by ``learn_sample``.
        learned_out: (tiles, bins + 1) cumulative, from 0 to 1.
        width: Of the picture, in pixels.
    """
    inputs = [squares, -(-width // int(TILE))]
    shape = (squares.shape[0],)
    launch_rows(learn_directions_kernel, shape, inputs, [learned_out], rows=None, device=squares.device)
