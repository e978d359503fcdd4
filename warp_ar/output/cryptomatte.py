"""Names of surfaces as Cryptomatte has them: a hash that is a float, a manifest that tells names by hashes.

The layer is called ``CryptoObject``: channels ``CryptoObject00.R`` (hash), ``.G`` (share), ``.B``, ``.A``, then
``CryptoObject01``; the header says how hashes were made.

References:
    [Cry] Friedman, Jones, "Cryptomatte Specification" 1.2, Psyop, 2016.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

LAYER = "CryptoObject"
"""Name of the layer of mattes."""

_MASK = 0xFFFFFFFF


def murmur3(data: bytes) -> int:
    """MurmurHash3 x86, 32 bits, seed 0."""

    def rotate(value: int, bits: int) -> int:
        return ((value << bits) | (value >> (32 - bits))) & _MASK

    def mix(block: int) -> int:
        return rotate(block * 0xCC9E2D51 & _MASK, 15) * 0x1B873593 & _MASK

    state, whole = 0, len(data) // 4 * 4
    for at in range(0, whole, 4):
        state ^= mix(int.from_bytes(data[at : at + 4], "little"))
        state = (rotate(state, 13) * 5 + 0xE6546B64) & _MASK
    if data[whole:]:
        state ^= mix(int.from_bytes(data[whole:], "little"))
    state ^= len(data)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        state = (state ^ state >> shift) * factor & _MASK
    return state ^ state >> 16


def matte_bits(name: str) -> int:
    """Bits of the float that stands for a name: its hash, kept off denormal, infinite and NaN ones [Cry]."""
    bits = murmur3(name.encode())
    return bits ^ 1 << 23 if bits >> 23 & 255 in (0, 255) else bits


def matte_header(names: Sequence[str]) -> Mapping[str, str]:
    """Attributes of an OpenEXR that holds the mattes of surfaces of these names."""
    key = f"cryptomatte/{murmur3(LAYER.encode()):08x}"[: len("cryptomatte/") + 7]
    manifest = {name: f"{matte_bits(name):08x}" for name in names}
    return {
        f"{key}/name": LAYER,
        f"{key}/hash": "MurmurHash3_32",
        f"{key}/conversion": "uint32_to_float32",
        f"{key}/manifest": json.dumps(manifest),
    }


def matte_channels(coverage: npt.NDArray[np.float32], names: Sequence[str]) -> dict[str, npt.NDArray[np.float32]]:
    """Channels of the mattes.

    Args:
        coverage: (height, width, 2 n) number of a surface (-1: none) and its share in turn, as the layer ``coverage``.
        names: Of the surfaces, by number.
    """
    hashes = np.array([*map(matte_bits, names), 0], np.uint32).view(np.float32)  # the last for -1
    channels: dict[str, npt.NDArray[np.float32]] = {}
    for rank in range(coverage.shape[2] // 2):
        which, share = coverage[..., 2 * rank], coverage[..., 2 * rank + 1]
        layer = f"{LAYER}{rank // 2:02d}"
        for channel, values in zip("BA" if rank % 2 else "RG", (hashes[which.astype(int)], share), strict=True):
            channels[f"{layer}.{channel}"] = np.ascontiguousarray(values)
    return channels
