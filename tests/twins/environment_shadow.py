"""Float64 twins of the environment's samples and of the shadows that spheres cast on a plane under them."""

import numpy as np


def sobol_second(index):
    """Second dimension of Sobol's sequence from its generator matrix: column k is column k - 1 xor itself shifted."""
    column, bits = 1 << 31, 0
    while index:
        if index & 1:
            bits ^= column
        index >>= 1
        column ^= column >> 1
    return bits / 2.0**32


def texel_directions(height, width):
    """Directions through the middle of each texel's band of cosines, and solid angles, (h, w, 3) and (h, w)."""
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    z = np.repeat(0.5 * (edges[:-1] + edges[1:])[:, None], width, 1)
    phi = np.broadcast_to((2 * (np.arange(width) + 0.5) / width - 1) * np.pi, z.shape)
    sine = np.sqrt(1 - z * z)
    solid_angle = np.repeat((edges[:-1] - edges[1:])[:, None], width, 1) * 2 * np.pi / width
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), z], -1), solid_angle


def meets_sphere(origin, directions, center, radius):
    """Whether rays (n, 3) from a point outside a sphere meet it."""
    to_center = np.asarray(center) - origin
    along = directions @ to_center
    return (along > 0) & (to_center @ to_center - along**2 < radius**2)


def clearance(origin, directions, center, radius):
    """How far from the rim rays pass, in radii."""
    to_center = np.asarray(center) - origin
    along = directions @ to_center
    return np.abs(np.sqrt(np.maximum(to_center @ to_center - along**2, 0)) - radius) / radius


def ratio_on_plane(points, directions, flux, spheres, balls):
    """E_with / E_without on z = 0, (n, 3); objects are black, balls hide light from both."""
    ratios = np.ones((len(points), 3))
    for index, point in enumerate(points):
        weight = np.maximum(directions[:, 2], 0)[:, None] * flux
        for center, radius in balls:
            weight = np.where(meets_sphere(point, directions, center, radius)[:, None], 0, weight)
        free = np.ones(len(directions), bool)
        for center, radius in spheres:
            free &= ~meets_sphere(point, directions, center, radius)
        ratios[index] = (weight * free[:, None]).sum(0) / weight.sum(0)
    return ratios


def sphere_form_factor(point, center, radius):
    """Share of an even sky that a sphere wholly above the horizon hides from a point of z = 0."""
    offset = np.asarray(center) - point
    distance = np.linalg.norm(offset, axis=-1)
    return (radius / distance) ** 2 * offset[..., 2] / distance


def cumulative_sums(environment, side_weight):
    """Brightness summed along rows (h, w), and over rows: (weighted brightness, weight) of whole rows, (h, 2)."""
    height, width = environment.shape[:2]
    along = environment.mean(-1).cumsum(1)
    wi, solid_angle = texel_directions(height, width)
    weight = (side_weight + np.maximum(wi[:, 0, 2], 0)) * solid_angle[:, 0]
    return along, np.stack([weight * along[:, -1], weight * width], -1).cumsum(0)
