"""Float64 twins of ``kernels/environment/pyramid.py``."""

from __future__ import annotations

import numpy as np


def solid_angles(height, width):
    """(height, 1) exact solid angle of a texel of each row."""
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    return ((edges[:-1] - edges[1:]) * 2 * np.pi / width)[:, None]


def energy(radiance):
    """Integral over the sphere, per channel."""
    return (radiance * solid_angles(*radiance.shape[:2])[..., None]).sum((0, 1))


def overlap(source, count):
    """(count, source) share of each source interval in each of ``count`` equal intervals, 1 where wholly inside."""
    low = np.arange(count)[:, None] * source / count
    high = low + source / count
    start = np.arange(source)[None, :]
    return np.clip(np.minimum(high, start + 1) - np.maximum(low, start), 0, None)


def reduce_latlong(radiance, height, width):
    """Mean radiance over the solid angle of every texel of a smaller map."""
    source_height, source_width = radiance.shape[:2]
    cuts = np.unique(
        np.concatenate([np.arange(source_height + 1) / source_height, np.arange(height + 1) / height]).round(12)
    )
    middle = (cuts[:-1] + cuts[1:]) / 2
    weight = np.cos(np.pi * cuts[:-1]) - np.cos(np.pi * cuts[1:])
    rows = np.zeros((height, source_height))
    np.add.at(rows, ((middle * height).astype(int), (middle * source_height).astype(int)), weight)
    rows /= rows.sum(1, keepdims=True)
    columns = overlap(source_width, width)
    columns /= columns.sum(1, keepdims=True)
    return np.einsum("ir,jc,rck->ijk", rows, columns, radiance, optimize=True)
