"""What the codes of pictures stand for."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from warp_ar.srgb import decode_srgb

FloatArray = npt.NDArray[np.float32]
ByteArray = npt.NDArray[np.uint8]


def _decode_table() -> FloatArray:
    code = np.arange(256) / 255.0
    return np.concatenate([code, decode_srgb(code)]).astype(np.float32)


DECODE: Final = _decode_table()
"""Value of each linear code, then of each sRGB-encoded one, (512,)."""


def linear_texture(texture: ByteArray) -> FloatArray:
    """Linear RGB of an sRGB-encoded picture, (h, w, 3)."""
    linear: FloatArray = DECODE[256:][texture]
    return linear


def encode_texture(linear: npt.NDArray[Any], *, encoded: bool) -> ByteArray:
    """Codes whose values are nearest to linear ones, any shape."""
    if not encoded:
        return np.asarray(np.round(np.clip(linear, 0.0, 1.0) * 255.0), dtype=np.uint8)
    values = DECODE[256:]
    codes: ByteArray = np.searchsorted(0.5 * (values[1:] + values[:-1]), linear).astype(np.uint8)
    return codes
