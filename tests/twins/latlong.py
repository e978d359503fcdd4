"""Float64 twin of ``warp_ar.kernels.latlong``."""

import numpy as np


def directions(height, width, rows=None, columns=None):
    """Directions of texel centres, or of given continuous coordinates, (..., 3)."""
    if rows is None:
        rows, columns = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    theta = np.pi * rows / height
    phi = (2.0 * columns / width - 1.0) * np.pi
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def solid_angles(height, width):
    """Solid angle of every texel, (height, width)."""
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    return np.repeat((edges[:-1] - edges[1:])[:, None] * 2.0 * np.pi / width, width, axis=1)


def coordinates(direction, height, width):
    """Continuous row and column of directions."""
    x, y, z = np.moveaxis(np.asarray(direction, np.float64), -1, 0)
    theta = np.arctan2(np.hypot(x, y), z)
    return theta / np.pi * height, (np.arctan2(y, x) / np.pi + 1.0) * 0.5 * width


def sample_latlong(radiance, direction):
    """Bilinear samples of a map, across the seam and the poles."""
    height, width = radiance.shape[:2]
    row, column = coordinates(direction, height, width)
    return sample_at(radiance, row - 0.5, column - 0.5)


def sample_at(values, y, x):
    """Bilinear samples at coordinates in texel centres."""
    i = np.floor(y).astype(int)
    fy = (y - i)[..., None]
    return _sample_row(values, i, x) * (1.0 - fy) + _sample_row(values, i + 1, x) * fy


def _sample_row(values, row, x):
    height, width = values.shape[:2]
    beyond = (row < 0) | (row >= height)
    row = np.where(row < 0, -1 - row, np.where(row >= height, 2 * height - 1 - row, row))
    x = np.where(beyond, x + 0.5 * width, x)
    j = np.floor(x).astype(int)
    fx = (x - j)[..., None]
    return values[row, j % width] * (1.0 - fx) + values[row, (j + 1) % width] * fx
