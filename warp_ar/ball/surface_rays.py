"""Intersection of rays with planes and boxes."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from warp_ar.scene import Proxy
from warp_ar.scene.geometry import rotation_matrix

Array = NDArray[np.float64]
Shape = tuple[Array, Array, Array]
"""Centre, axes as columns, and half sizes; the third half size of a plane is 0."""

NEAR = 1e-6
"""Smallest distance of a hit along a ray, metres."""


def shapes_of(proxies: Iterable[Proxy]) -> list[Shape]:
    """Return planes and boxes as shapes."""
    return [
        (np.array(p.at), rotation_matrix(p.rotate), 0.5 * np.array([*p.size[:2], *(p.size[2:] or (0.0,))]))
        for p in proxies
    ]


def dot(a: Array, b: Array) -> Array:
    """Return the dot products of vectors (n, 3), (n,); NumPy's sum over three columns takes five times as long."""
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2])


def nearest_shape(shapes: Iterable[Shape], origin: Array, direction: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return the distance to the nearest shape, (n,), infinite without a hit, and its index.

    Maxima over columns are unrolled: NumPy is several times slower along a short last axis.
    """
    nearest, which = np.full(len(direction), np.inf), np.full(len(direction), -1)
    for number, (at, rotation, half) in enumerate(shapes):
        o, d = (origin - at) @ rotation, direction @ rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            if half[2] == 0.0:
                t = -o[:, 2] / d[:, 2]
                p = o + t[:, None] * d
                hit = (np.abs(p[:, 0]) <= half[0]) & (np.abs(p[:, 1]) <= half[1])
            else:
                a, b = (-half - o) / d, (half - o) / d
                first, last = np.minimum(a, b), np.maximum(a, b)
                t = np.maximum(np.maximum(first[:, 0], first[:, 1]), first[:, 2])
                hit = t <= np.minimum(np.minimum(last[:, 0], last[:, 1]), last[:, 2])
        hit &= (t > NEAR) & (t < nearest)
        nearest[hit], which[hit] = t[hit], number
    return nearest, which
