"""Transfers by a formula: sRGB (IEC 61966-2-1) and powers."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt

TRANSFERS: Final = '"srgb", "linear", "gamma:2.2" (0.1 to 10), or the path of a measured response'
"""Description of valid transfers, for messages."""


def exponent_of(transfer: str) -> float | None:
    """Return G of "gamma:G", and 1 of "linear"; None for other transfers, and if G is no number from 0.1 to 10."""
    if transfer == "linear":
        return 1.0
    try:
        gamma = float(transfer.removeprefix("gamma:")) if transfer.startswith("gamma:") else 0.0
    except ValueError:
        return None
    return gamma if 0.1 <= gamma <= 10.0 else None


def is_formula(transfer: str) -> bool:
    """Return True for a transfer that is given by a formula, False if it can only be a file."""
    return transfer == "srgb" or exponent_of(transfer) is not None


def decode_srgb(encoded: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the linear values, 0 to 1, of sRGB-encoded values, 0 to 1."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def encode_srgb(linear: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the sRGB-encoded values, 0 to 1, of linear values, 0 to 1."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
