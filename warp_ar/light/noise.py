"""How far an equation of a surface point may be off, and which points share an error."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from warp_ar.light.config import CONFIG

Array = NDArray[np.float64]


def measured_noise(
    points: NDArray[Any], surface: NDArray[np.int64], kinds: NDArray[np.int64], light: Array, exact: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Relative standard deviation of one equation, by surface: how far its points scatter about a smooth course.

    The course is a quadratic in the surface's own coordinates, of the logarithm: an emitter's light falls off like
    that. An even box or card says more than a table's texture, and more than all boxes and cards would have it.

    Args:
        points: Records of ``SurfacePoint``, (n,).
        surface: That each lies on, (n,).
        kinds: ``Kind`` of each surface, (surfaces,).
        light: pi times the radiance that each shows, (n, 3).
        exact: Where that does not clip and says something, (n, 3).

    Returns:
        Between ``least_noise`` and what is usual for the kind, (surfaces,): cast shadows scatter as well, and they are
        what is looked for. And how far points scatter, at least what is usual, (surfaces,).
    """
    noise = np.array(CONFIG.surfaces.noise)[kinds]
    texture = noise.copy()
    for number in range(len(kinds)):
        own = np.flatnonzero((surface == number) & exact.all(axis=1))
        if len(own) < CONFIG.surfaces.scatter_points:
            continue
        at, normal, tangent = (points[name][own].astype(float) for name in ("position", "normal", "tangent"))
        places = np.column_stack([(at * axis).sum(axis=1) for axis in (tangent, np.cross(normal, tangent))])
        u, v = ((places - places.mean(axis=0)) / np.maximum(places.std(axis=0), 1e-9)).T
        terms = np.column_stack([np.ones(len(own)), u, v, u * u, u * v, v * v])
        logs = np.log(light[own]).mean(axis=1)
        weights = np.ones(len(own))
        for _ in range(CONFIG.surfaces.scatter_iterations):
            course = np.linalg.lstsq(terms * weights[:, None], logs * weights, rcond=None)[0]
            off = np.abs(logs - terms @ course)
            scatter = 1.4826 * float(np.median(off))
            weights = 1.0 / np.sqrt(1.0 + (off / (2.0 * scatter + 1e-6)) ** 2)
        scatter *= np.sqrt(len(own) / (len(own) - terms.shape[1]))
        texture[number] = max(scatter, noise[number])
        noise[number] = np.clip(scatter, CONFIG.surfaces.least_noise, noise[number])
    return noise, texture


def shared_errors(overlap: NDArray[np.float32], kind: NDArray[np.int64], seen: NDArray[np.bool_]) -> Array:
    """Number of equations that share the error of each of the points that are seen.

    Args:
        overlap: From ``texture_overlap``, (n, n).
        kind: ``Kind`` of each point's surface, (n,).
        seen: Points that have an equation, (n,).
    """
    return np.asarray(np.maximum(np.array(CONFIG.surfaces.shared)[kind], overlap @ seen.astype(np.float32))[seen])
