"""Float64 twins of ``kernels/textures.py``."""

from __future__ import annotations

import numpy as np


def wrap(index, size, mode):
    """Texel inside a picture."""
    if mode == "clamp":
        return np.clip(index, 0, size - 1)
    if mode == "mirror":
        index = index % (2 * size)
        return np.where(index < size, index, 2 * size - 1 - index)
    return index % size


def sample_level(image, uv, wraps, *, nearest=False):
    """Bilinear or nearest; v points up; ``image`` (h, w, c) of linear values."""
    height, width = image.shape[:2]
    x, y = uv[:, 0] * width, (1 - uv[:, 1]) * height
    if nearest:
        return image[wrap(np.floor(y).astype(int), height, wraps[1]), wrap(np.floor(x).astype(int), width, wraps[0])]
    x, y = x - 0.5, y - 0.5
    j, i = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - j)[:, None], (y - i)[:, None]
    rows = [wrap(i + k, height, wraps[1]) for k in (0, 1)]
    columns = [wrap(j + k, width, wraps[0]) for k in (0, 1)]
    top = image[rows[0], columns[0]] * (1 - fx) + image[rows[0], columns[1]] * fx
    bottom = image[rows[1], columns[0]] * (1 - fx) + image[rows[1], columns[1]] * fx
    return top * (1 - fy) + bottom * fy


def sample_texture(levels, uv, transform, wraps, texels, *, nearest=False):
    """Between two levels; ``texels``: width of the footprint in texels of the first level."""
    a, b, c, d, e, f = transform
    at = np.stack([a * uv[:, 0] + b * uv[:, 1] + c, d * uv[:, 0] + e * uv[:, 1] + f], axis=-1)
    level = min(max(np.log2(texels), 0.0), len(levels) - 1) if texels > 0 else 0.0
    lower = int(level)
    first = sample_level(levels[lower], at, wraps, nearest=nearest and level == 0)
    if level == lower:
        return first
    return (1 - (level - lower)) * first + (level - lower) * sample_level(levels[lower + 1], at, wraps)
