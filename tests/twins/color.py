"""Float64 twins of ``warp_ar.kernels.color``."""

import numpy as np


def decode(table, codes):
    return np.stack([table[codes[..., c], c] for c in range(3)], -1).astype(np.float64)


def encoded_srgb(x):
    return 255.0 * np.where(x <= 0.04045 / 12.92, 12.92 * x, 1.055 * np.maximum(x, 1e-300) ** (1 / 2.4) - 0.055)


def encoded_gamma(x, gamma):
    return 255.0 * x ** (1.0 / gamma)


def encoded_measured(x, values):
    """Piecewise linear between the codes of one channel (strictly rising values)."""
    return np.interp(x, values, np.arange(256.0))


def encode(x, encoded):
    """Nearest code, ties up; ``encoded`` maps 0..1 to 0..255, unrounded."""
    x = np.clip(np.nan_to_num(x.astype(np.float64), nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
    return np.floor(encoded(x) + 0.5).astype(np.uint8)
