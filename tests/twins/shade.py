"""Float64 twin of ``kernels/objects/shade.py`` for Lambertian and mirror scenes: one ray per sample, brute force."""

from __future__ import annotations

import numpy as np

from tests.twins.visibility import Body, closest


def shade_point_light(bodies: list[Body], base, eye, directions, light, intensity):
    """Radiance (n, 3) and coverage (n,) of Lambertian bodies under one point light with hard shadows."""
    t, which, normal = closest(bodies, np.broadcast_to(eye, directions.shape), directions)
    radiance = np.zeros((len(directions), 3))
    hit = which >= 0
    points = eye + t[hit, None] * directions[hit]
    n = normal[hit] * -np.sign(np.sum(normal[hit] * directions[hit], -1, keepdims=True))
    to_light = light - points
    distance = np.linalg.norm(to_light, axis=-1, keepdims=True)
    wi = to_light / distance
    between, _, _ = closest(bodies, points + 1e-9 * n, to_light)
    cosine = np.maximum(np.sum(n * wi, -1), 0) * (between >= 1.0)
    radiance[hit] = base[which[hit]] / np.pi * (cosine / distance[:, 0] ** 2)[:, None] * intensity
    return radiance, hit.astype(float)
