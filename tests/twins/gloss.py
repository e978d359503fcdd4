"""Float64 twin of ``gloss.py``: a receiver at z = 0, objects and surroundings of even radiance."""

from __future__ import annotations

import numpy as np

from tests.twins.sampling import ggx_distribution
from tests.twins.visibility import closest


def schlick(f0, cosine):
    """Reflectance of a facet."""
    return f0 + (1.0 - f0) * (1.0 - np.clip(cosine, 0.0, 1.0))[..., None] ** 5


def primary(eye, directions):
    """Where rays meet z = 0, and the unit vector back."""
    t = -eye[2] / directions[:, 2]
    return eye + t[:, None] * directions, -directions / np.linalg.norm(directions, axis=1, keepdims=True)


def mirror(eye, directions, objects, difference, f0):
    """Change of radiance in a plane mirror, (n, 3); ``difference`` is an object's radiance over what is behind it."""
    points, wo = primary(eye, directions)
    wi = wo * [-1.0, -1.0, 1.0]
    hit = closest(objects, points, wi)[1] >= 0
    return hit[:, None] * schlick(np.asarray(f0), wo[:, 2]) * difference, hit


def masking(cosine, alpha):
    """Smith's Lambda [Heitz14] eq. 72."""
    tan2 = 1.0 / cosine**2 - 1.0
    return 0.5 * (np.sqrt(1.0 + alpha**2 * tan2) - 1.0)


def lobe(wo, wi, f0, alpha):
    """f cos_i of GGX with height-correlated masking, as printed: D F G2 / (4 cos_o), (n, 3)."""
    half = wo + wi
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    cos_o, cos_i = np.broadcast_to(wo, wi.shape)[:, 2], wi[:, 2]
    shadowing = 1.0 / (1.0 + masking(cos_o, alpha) + masking(cos_i, alpha))
    scale = ggx_distribution(half[:, 2], alpha) * shadowing / (4.0 * cos_o)
    return schlick(np.asarray(f0), (half * wo).sum(1)) * scale[:, None]


def rough(eye, direction, center, radius, difference, f0, alpha, steps=400):
    """Change of radiance by a sphere in a rough plane, (3,): midpoints over the cone that it fills."""
    point, wo = (values[0] for values in primary(eye, direction[None]))
    to = center - point
    distance = np.linalg.norm(to)
    axis = to / distance
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    across = np.cross(axis, side)
    least = np.sqrt(1.0 - (radius / distance) ** 2)
    cosine = least + (1.0 - least) * (np.arange(steps) + 0.5) / steps
    turn = 2.0 * np.pi * (np.arange(steps) + 0.5) / steps
    cosine, turn = (values.ravel() for values in np.meshgrid(cosine, turn))
    sine = np.sqrt(1.0 - cosine**2)
    wi = cosine[:, None] * axis + (sine * np.cos(turn))[:, None] * side + (sine * np.sin(turn))[:, None] * across
    wi = wi[wi[:, 2] > 0.0]
    area = 2.0 * np.pi * (1.0 - least) / steps**2
    return area * lobe(wo[None], wi, f0, alpha).sum(0) * difference
