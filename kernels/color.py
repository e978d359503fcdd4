"""Conversion between a camera's codes (8-bit pixel values) and linear radiance, for a known transfer function.

A transfer is ``"srgb"``, ``"linear"``, ``"gamma:<exponent>"`` or the path of a measured response: a text file of 256
lines with three numbers, the linear red, green and blue value of each code. Linear values are camera values: 0 is
black, 1 is clipping.

Decoding is one look-up. Encoding rounds to the nearest code *in the encoded domain*, as a camera does. Between the
codes k and k + 1 lies one threshold in linear light, and the code of x is the number of thresholds that x reaches:

    t_k = T^-1((k + 1/2) / 255),   code(x) = #{k : t_k <= x}.

A formula T gives t_k in closed form; a measured response is interpolated linearly between codes, so t_k is the mean
of its neighbours. Each threshold is rounded *up* to float32: a float32 number reaches the rounded threshold exactly
if it reaches the real one, so the codes are those of real arithmetic for every float32 input, and the largest error
is half a code (ties go up). CPU and CUDA agree bit for bit.

The count is looked up in a table of ``ENCODE_KEYS`` intervals of sqrt(x). Each entry holds the number of thresholds
below the interval and the next threshold. One comparison with the latter usually completes the count, without a branch
or a power function. An interval with more than one threshold (a plateau of a measured response, an exponent above 3)
is marked by adding 1/2 to its count; there a loop continues the count.
"""

from __future__ import annotations

import pathlib

import numpy as np
import warp as wp

from warp_ar.errors import SceneError
from warp_ar.files import is_file, read_text
from warp_ar.srgb import TRANSFERS, decode_srgb, exponent_of, is_formula

wp.set_module_options({"enable_backward": False})

ENCODE_KEYS = 1024
"""Number of intervals in the encode table; for exponents up to 3 each holds at most one threshold."""
ENCODE_LENGTH = 2 * ENCODE_KEYS + 256
"""Length of an encode table: counts of the intervals, their next thresholds, all thresholds (the last infinite)."""

_KEY_SCALE = wp.constant(wp.float32(ENCODE_KEYS - 1))
_NEXT = wp.constant(ENCODE_KEYS)
_THRESHOLDS = wp.constant(2 * ENCODE_KEYS)

SATURATION_ENTRY = wp.constant(256)
"""Entry of a ``camera_table`` that holds the codes at which channels saturate."""
# Video codecs and JPEG sometimes decode a clipped 255 as 254.
BELOW_SATURATION = wp.constant(wp.float32(-1.0))
# Chroma at half the resolution (4:2:0) lowers the clipped blue of a small emitter to 239 to 252 (measured in H.264).
# If another channel clips, codes down to 7 below saturation count as clipped; lower codes are often true values.
NEAR_SATURATION = wp.constant(wp.float32(-7.0))


@wp.func
def luminance(radiance: wp.vec3) -> wp.float32:
    """Return the Rec. 709 luminance of linear RGB."""
    return 0.2126 * radiance[0] + 0.7152 * radiance[1] + 0.0722 * radiance[2]


@wp.func
def brightness(radiance: wp.vec3) -> wp.float32:
    """Return the mean of the channels, which weights changes of all colours equally."""
    return (radiance[0] + radiance[1] + radiance[2]) / 3.0


@wp.func
def decode(table: wp.array[wp.vec3], code: wp.vec3ub) -> wp.vec3:
    """Return the linear value of an 8-bit colour; ``table`` comes from ``decode_table``."""
    return wp.vec3(table[wp.int32(code[0])][0], table[wp.int32(code[1])][1], table[wp.int32(code[2])][2])


@wp.func
def saturation_codes(table: wp.array[wp.vec3]) -> wp.vec3:
    """Return the code at which each channel saturates: the last entry of a ``camera_table``, else 255."""
    if table.shape[0] > SATURATION_ENTRY:
        return table[SATURATION_ENTRY]
    return wp.vec3(255.0, 255.0, 255.0)


@wp.func
def below_saturation(code: wp.vec3ub, shown: wp.vec3ub, saturation: wp.vec3) -> wp.vec3ub:
    """Limit ``code`` to the code at which a channel saturates, or to the frame's code ``shown`` if that is higher."""
    return wp.vec3ub(
        wp.min(code[0], wp.max(shown[0], wp.uint8(saturation[0] + 0.5))),
        wp.min(code[1], wp.max(shown[1], wp.uint8(saturation[1] + 0.5))),
        wp.min(code[2], wp.max(shown[2], wp.uint8(saturation[2] + 0.5))),
    )


@wp.func
def is_saturated(code: wp.vec3ub, saturation: wp.vec3) -> wp.vec3:
    """Return 1 in each clipped channel and 0 in the others, for a camera that saturates at the codes ``saturation``."""
    r = wp.float32(code[0]) - saturation[0]
    g = wp.float32(code[1]) - saturation[1]
    b = wp.float32(code[2]) - saturation[2]
    least = wp.where(wp.max(wp.max(r, g), b) >= BELOW_SATURATION, NEAR_SATURATION, BELOW_SATURATION)
    return wp.vec3(wp.where(r >= least, 1.0, 0.0), wp.where(g >= least, 1.0, 0.0), wp.where(b >= least, 1.0, 0.0))


@wp.func
def is_clipped(code: wp.vec3ub) -> wp.vec3:
    """Return 1 in each clipped channel and 0 in the others, for a camera that saturates at 255."""
    return is_saturated(code, wp.vec3(255.0, 255.0, 255.0))


@wp.func
def encode_channel(table: wp.array[wp.vec3], value: wp.float32, channel: wp.int32) -> wp.uint8:
    """Return the code nearest to one linear value; values below 0 and NaN give 0, values above 1 give 255."""
    x = wp.where(value > 0.0, wp.min(value, 1.0), 0.0)  # NaN is not above 0
    key = wp.int32(wp.sqrt(x) * _KEY_SCALE)
    count = table[key][channel]
    code = wp.int32(count) + wp.where(x >= table[_NEXT + key][channel], 1, 0)
    if count != wp.floor(count):
        while x >= table[_THRESHOLDS + code][channel]:
            code += 1
    return wp.uint8(code)


@wp.func
def encode(table: wp.array[wp.vec3], radiance: wp.vec3) -> wp.vec3ub:
    """Return the nearest 8-bit colour of a linear colour; ``table`` comes from ``encode_table``."""
    return wp.vec3ub(
        encode_channel(table, radiance[0], 0),
        encode_channel(table, radiance[1], 1),
        encode_channel(table, radiance[2], 2),
    )


def decode_table(transfer: str | pathlib.Path) -> np.ndarray:
    """Return the linear value of every code.

    Args:
        transfer: ``"srgb"``, ``"linear"``, ``"gamma:2.2"`` or the path of a measured response. A response is known only
            up to a factor, so each of its channels is divided by its last value: clipping becomes 1.

    Returns:
        (256, 3) float32, non-decreasing from row to row, last row 1.

    Raises:
        SceneError: The name is not a transfer, or the file is not a measured response.
    """
    return _decode_values(transfer).astype(np.float32)


def decode_codes(transfer: str | pathlib.Path, encoded: np.ndarray) -> np.ndarray:
    """Return the linear values of codes of any bit depth.

    Args:
        transfer: See ``decode_table``; a measured response is interpolated linearly between its codes.
        encoded: Codes divided by the largest code, (n,), 0 to 1.

    Returns:
        (n, 3) float64.
    """
    name = str(transfer)
    if is_formula(name):
        return np.repeat(_formula(name, encoded)[:, None], 3, axis=1)
    values, codes = _decode_values(transfer), np.arange(256) / 255.0
    return np.stack([np.interp(encoded, codes, values[:, c]) for c in range(3)], -1)


def encode_codes(transfer: str | pathlib.Path, light: np.ndarray) -> np.ndarray:
    """Return codes of linear values, divided by the largest code and not rounded; the inverse of ``decode_codes``.

    Args:
        transfer: See ``decode_table``.
        light: Linear values, (..., 3), clamped to 0..1; NaN counts as 0.

    Returns:
        float64 of the same shape, 0 to 1.
    """
    name, x = str(transfer), np.clip(np.nan_to_num(np.asarray(light, np.float64), nan=0.0), 0.0, 1.0)
    if name == "srgb":
        return np.where(x <= 0.04045 / 12.92, 12.92 * x, 1.055 * x ** (1.0 / 2.4) - 0.055)
    if (gamma := exponent_of(name)) is not None:
        return x ** (1.0 / gamma)
    values, codes = _decode_values(transfer), np.arange(256) / 255.0
    return np.stack([np.interp(x[..., c], values[:, c], codes) for c in range(3)], -1)


def camera_table(
    transfer: str | pathlib.Path, saturation: np.ndarray | tuple[int, int, int] = (255, 255, 255), contrast: float = 0.0
) -> np.ndarray:
    """Return a ``decode_table`` followed by one row with the codes at which the camera's channels saturate.

    Args:
        transfer: See ``decode_table``.
        saturation: Code at which each channel saturates, (3,).
        contrast: Strength of the camera's S-shaped contrast curve, see ``without_contrast``.

    Returns:
        (257, 3) float32.
    """
    values = without_contrast(_decode_values(transfer), contrast, saturation).astype(np.float32)
    return np.concatenate([values, np.asarray(saturation, np.float32)[None]])


def without_contrast(
    values: np.ndarray, contrast: float, saturation: np.ndarray | tuple[int, int, int] = (255, 255, 255)
) -> np.ndarray:
    """Return the linear value of every code of a camera that applies a contrast curve after its transfer function.

    The curve maps an encoded value x, 0 to 1, to y = x + a x (1 - x) (x - 1/2). Both ends and the middle are fixed, and
    a = 2 is the smoothstep. The curve increases everywhere for -4 < a < 8. x and y are fractions of the code at which
    the channel saturates.

    Args:
        values: Linear value of every code without the curve, (256, 3).
        contrast: a.
        saturation: Code at which each channel saturates, (3,).

    Returns:
        (256, 3) float64.
    """
    if contrast == 0.0:
        return values
    x, codes = np.linspace(0.0, 1.0, 4097), np.arange(256) / 255.0
    bent, ends = x + contrast * x * (1.0 - x) * (x - 0.5), np.asarray(saturation, np.float64) / 255.0
    plain = [np.where(codes < end, end * np.interp(codes / end, bent, x), codes) for end in ends]
    return np.stack([np.interp(plain[c], codes, values[:, c]) for c in range(3)], -1)


def encode_table(
    transfer: str | pathlib.Path, contrast: float = 0.0, saturation: np.ndarray | tuple[int, int, int] = (255, 255, 255)
) -> np.ndarray:
    """Return the table for the device function ``encode``; see ``camera_table`` for arguments and errors.

    Returns:
        (``ENCODE_LENGTH``, 3) float32.
    """
    half_codes = (np.arange(255) + 0.5) / 255.0
    name = str(transfer)
    if contrast == 0.0 and is_formula(name):
        exact = np.repeat(_formula(name, half_codes)[:, None], 3, axis=1)
    else:
        values = without_contrast(_decode_values(transfer), contrast, saturation)
        exact = 0.5 * (values[:-1] + values[1:])
    thresholds = exact.astype(np.float32)
    thresholds = np.where(thresholds < exact, np.nextafter(thresholds, np.float32(np.inf)), thresholds)
    table = np.full((ENCODE_LENGTH, 3), np.inf, np.float32)
    table[2 * ENCODE_KEYS : -1] = thresholds
    # A threshold within rounding of an interval's edge counts in both intervals, as sqrt may round either way.
    low, high = (
        np.floor(np.sqrt(thresholds.astype(np.float64) * (1.0 + margin)) * (ENCODE_KEYS - 1))
        for margin in (-1e-6, 1e-6)
    )
    cells = np.arange(ENCODE_KEYS)
    for channel in range(3):
        below = np.searchsorted(high[:, channel], cells, side="left")
        reached = np.searchsorted(low[:, channel], cells, side="right")
        table[:ENCODE_KEYS, channel] = below + 0.5 * (reached > below + 1)
        table[ENCODE_KEYS : 2 * ENCODE_KEYS, channel] = table[2 * ENCODE_KEYS + below, channel]
    return table


def _formula(name: str, encoded: np.ndarray) -> np.ndarray:
    """Return the linear value of encoded values, 0 to 1, for a transfer that has a formula."""
    return decode_srgb(encoded) if name == "srgb" else encoded ** exponent_of(name)


def _decode_values(transfer: str | pathlib.Path) -> np.ndarray:
    """Return the linear values of all codes, (256, 3) float64."""
    name = str(transfer)
    if is_formula(name):
        return np.repeat(_formula(name, np.arange(256) / 255.0)[:, None], 3, axis=1)
    path = pathlib.Path(transfer)
    if not is_file(path):
        raise SceneError(f"camera.transfer = {name!r}: expected {TRANSFERS}")
    text = read_text(path, SceneError, expected="256 lines of three linear values")
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    expected = f"{path}: a measured response is 256 lines of three linear values"
    try:
        values = np.array([[float(word) for word in line.replace(",", " ").split()] for line in lines])
    except ValueError as error:
        raise SceneError(f"{expected}: {error}") from None
    if values.shape != (256, 3):
        raise SceneError(f"{expected}, this has shape {values.shape}")
    if not np.isfinite(values).all() or (values < 0.0).any():
        raise SceneError(f"{path}: the values of a measured response must be finite and not negative")
    falling = np.argwhere(np.diff(values, axis=0) < 0.0)
    if len(falling):
        line, channel = falling[0]
        raise SceneError(f"{path}: a measured response must not fall, but line {line + 2} does so in {'RGB'[channel]}")
    if not (values[-1] > values[0]).all():
        raise SceneError(f"{path}: a measured response must rise from its first to its last line in every channel")
    return values / values[-1]
