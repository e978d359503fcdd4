"""The transfer of sRGB (IEC 61966-2-1)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt


def decode_srgb(encoded: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the linear values, 0 to 1, of sRGB-encoded values, 0 to 1."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def encode_srgb(linear: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the sRGB-encoded values, 0 to 1, of linear values, 0 to 1."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
