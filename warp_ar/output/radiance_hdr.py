"""Radiance's HDR: 8 bits of each channel and of an exponent that they share.

References:
    Ward 1991, Real Pixels, Graphics Gems II.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from warp_ar.signature import PROGRAM

REC_709 = "0.6400 0.3300 0.3000 0.6000 0.1500 0.0600 0.3127 0.3290"


def encode_hdr(radiance: npt.NDArray[np.float32], axes: str) -> bytes:
    """The file's bytes, its scanlines not run-length encoded: those of a camera hardly repeat.

    Channels are right to half a step, 1 part in 256 of a texel's brightest channel at most. What is negative or no
    number becomes 0, what is infinite the largest value.

    Args:
        radiance: Linear RGB, (height, width, 3), row 0 at the top.
        axes: What the header says of the directions.
    """
    height, width = radiance.shape[:2]
    values = np.clip(np.nan_to_num(radiance.astype(np.float64), nan=0.0, posinf=1e38), 0.0, 1e38)
    brightest = values.max(2)
    exponent = np.frexp(brightest)[1]
    # 256 after rounding needs the next exponent.
    exponent += np.rint(np.ldexp(brightest, 8 - exponent)) > 255
    mantissas = np.rint(np.ldexp(values, (8 - exponent)[..., None]))
    seen = (brightest > 0.0) & (exponent > -128)
    pixels = np.concatenate([mantissas, (exponent + 128)[..., None]], 2) * seen[..., None]
    # Readers of some programs expect FORMAT on the header's last line.
    header = [
        *("#?RADIANCE", f"SOFTWARE={PROGRAM}", f"VIEW_AXES={axes}", f"PRIMARIES={REC_709}"),
        *("FORMAT=32-bit_rle_rgbe", "", f"-Y {height} +X {width}", ""),
    ]
    return b"".join(["\n".join(header).encode(), pixels.astype(np.uint8).tobytes()])
