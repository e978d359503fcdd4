"""Float64 twins of ``recover.py`` and ``recover_cells.py``: one surface point at a time, without proxies."""

from __future__ import annotations

import numpy as np


def cell_directions(rows, columns):
    """Middle directions (m, 3) and exact solid angles (m,) of latlong cells."""
    edges = np.arange(rows + 1) * np.pi / rows
    theta = (np.arange(rows) + 0.5) * np.pi / rows
    phi = (2.0 * (np.arange(columns) + 0.5) / columns - 1.0) * np.pi
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    d = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    band = (np.cos(edges[:-1]) - np.cos(edges[1:])) * 2.0 * np.pi / columns
    return d, np.repeat(band, columns)


def hidden_share(center, radius, origin, direction, angle):
    """Share of a disc of angular radius ``angle`` that a ball hides."""
    to_center = center - origin
    away = np.linalg.norm(to_center)
    off = np.arccos(np.clip(direction @ to_center / away, -1.0, 1.0))
    t = np.clip((np.arcsin(radius / away) - off) / angle, -1.0, 1.0)
    return 0.5 + 0.25 * t * (3.0 - t * t)


def mirrored_irradiance(center, radius, grey, position, normal, light):
    """Irradiance by way of a ball per unit irradiance of a beam from ``light``, traced: a thin pencil of rays.

    Nothing of the closed form is used: the point of reflection is searched by halving, and the beam's width measured by
    mirroring rays beside it.
    """
    to_point = position - center

    def mirrored(n):
        leave = 2.0 * (light @ n) * n - light  # away from the ball
        return leave / np.linalg.norm(leave)

    # In the plane of both, n turns from the point toward the light, until it mirrors the light onto the point.
    axis = to_point / np.linalg.norm(to_point)
    side = light - (light @ axis) * axis
    if np.linalg.norm(side) < 1e-12:
        return 0.0
    side /= np.linalg.norm(side)
    psi = np.arccos(np.clip(light @ axis, -1.0, 1.0))
    low, high = 0.0, psi
    for _ in range(60):
        middle = 0.5 * (low + high)
        n = np.cos(middle) * axis + np.sin(middle) * side
        aim = to_point - radius * n
        r = mirrored(n)
        # Both in the plane: positive if the reflected ray passes on the light's side of the point.
        if (r @ side) * (aim @ axis) - (r @ axis) * (aim @ side) > 0.0:
            high = middle
        else:
            low = middle
    leave = to_point - radius * n
    cosine = -(leave @ normal) / np.linalg.norm(leave)
    if np.linalg.norm(np.cross(mirrored(n), leave)) > 1e-6 * np.linalg.norm(leave):
        return 0.0  # in the ball's shadow
    if light @ n < 1e-3 or cosine <= 0.0 or leave @ n <= 0.0:
        return 0.0
    # Landing points of three neighbouring rays on the plane through the point, across the reflected ray.
    axis = leave / np.linalg.norm(leave)
    u = np.cross(light, [0.3, 0.5, 0.8])
    u /= np.linalg.norm(u)
    v = np.cross(light, u)
    step = 1e-7 * radius
    start = radius * n
    landed = []
    for side in (0.0 * u, step * u, step * v):
        # The ray start + side - t light meets the sphere where |start + side + t light| = radius.
        at = start + side
        b, c = at @ light, at @ at - radius**2
        hit = at + (-b + np.sqrt(b * b - c)) * light
        m = hit / radius
        r = mirrored(m)
        landed.append(hit + ((to_point - hit) @ axis) / (r @ axis) * r)
    width = np.linalg.norm(np.cross(landed[1] - landed[0], landed[2] - landed[0])) / step**2
    return grey * cosine / width


def trace_transfer(position, normal, directions, solid_angles, center, radius, grey):
    """Irradiance per unit radiance of each cell, straight and by way of one ball, (m,) each."""
    straight, mirrored = np.zeros(len(directions)), np.zeros(len(directions))
    for m, (d, solid_angle) in enumerate(zip(directions, solid_angles, strict=True)):
        mirrored[m] = solid_angle * mirrored_irradiance(center, radius, grey, position, normal, d)
        if d @ normal > 0.0:
            hidden = hidden_share(center, radius, position, d, np.sqrt(solid_angle / np.pi))
            straight[m] = d @ normal * solid_angle * (1.0 - hidden)
    return straight, mirrored
