"""Float64 twin of ``warp_ar.kernels.mirrored_light``: rays that are thrown at a ball, and where they go."""

import numpy as np


def throw_rays(center, radius, place, origins, directions):
    """Rays (n, 3) that a ball mirrors onto a plane z = ``place``: points (n, 3), directions, and whether they arrive."""
    center = np.asarray(center, float)
    to_center = center - origins
    along = (to_center * directions).sum(-1)
    inside = radius**2 - (to_center**2).sum(-1) + along**2
    meets = (inside > 0) & (along > 0)
    t = along - np.sqrt(np.maximum(inside, 0))
    met = origins + t[:, None] * directions
    normals = (met - center) / radius
    leaving = directions - 2 * (directions * normals).sum(-1, keepdims=True) * normals
    down = leaving[:, 2] < -1e-9
    s = (place - met[:, 2]) / np.where(down, leaving[:, 2], 1.0)
    return met + s[:, None] * leaving, leaving, meets & down & (s > 0)


def thrown_irradiance(center, radius, place, light, edges, count, seed=0):
    """Irradiance of a plane by light that a ball mirrors onto it, per cell of a grid of ``edges``.

    Args:
        center: Of the ball.
        radius: Of the ball.
        place: Height of the plane.
        light: Position (3,) of a light of radiant intensity 1, or the direction that light of irradiance 1 travels in
            and the word ``"directional"``.
        edges: Of the cells along x and y.
        count: Of rays.
        seed: Of random numbers.

    Returns:
        Irradiance (x, y) and its standard error.
    """
    rng, center = np.random.default_rng(seed), np.asarray(center, float)
    is_directional = len(light) == 2
    axis = np.asarray(light[0], float) if is_directional else center - np.asarray(light, float)
    distance = np.linalg.norm(axis)
    axis = axis / distance
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    across = np.cross(axis, side)
    u, phi = rng.random(count), 2 * np.pi * rng.random(count)
    around = np.cos(phi)[:, None] * side + np.sin(phi)[:, None] * across
    if is_directional:
        origins = center - axis + radius * np.sqrt(u)[:, None] * around
        directions, flux = np.broadcast_to(axis, origins.shape), np.pi * radius**2
    else:
        lowest = np.sqrt(1 - (radius / distance) ** 2)
        cosine = 1 - u * (1 - lowest)
        directions = cosine[:, None] * axis + np.sqrt(1 - cosine**2)[:, None] * around
        origins, flux = np.broadcast_to(np.asarray(light, float), directions.shape), 2 * np.pi * (1 - lowest)
    points, _, arrive = throw_rays(center, radius, place, origins, directions)
    hits = np.histogram2d(points[arrive, 0], points[arrive, 1], edges)[0]
    area = np.diff(edges[0])[:, None] * np.diff(edges[1])
    return hits * flux / count / area, np.sqrt(np.maximum(hits, 1)) * flux / count / area
