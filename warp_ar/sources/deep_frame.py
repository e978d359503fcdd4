"""Frames with more than 8 bits, called deep frames, and their 8-bit versions.

A deep frame holds 16-bit codes or linear radiance. Codes are pixel values as the camera encodes them; they are decoded
by the camera's transfer function. Linear radiance has Rec. 709 primaries and is not decoded; 1 is the value at which an
8-bit camera would clip, and values may exceed it. The two versions of a frame are used for:

    8-bit codes    marker detection, and averages over a pixel's neighbourhood
    deep frame     measurement of radiance: mirror ball, surfaces, and the picture itself
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_ar.errors import UsageError
from warp_ar.kernels.color import decode_codes, encode_codes
from warp_ar.srgb import encode_srgb

Radiance = npt.NDArray[np.float32]

CLIP_MARGINS = (1.5, 7.5)
"""Distance below saturation, in 8-bit codes, within which a channel counts as clipped. The first number applies to a
channel on its own, the second if another channel is clipped. Both are half a code more than for 8-bit frames, whose
codes are rounded."""

_STEPS = 65536


@dataclasses.dataclass(frozen=True)
class DeepFrame:
    """Frame at full bit depth."""

    picture: npt.NDArray[Any]
    """(height, width, 3) RGB: uint16 codes of the camera's transfer, or float32 linear radiance."""
    clip: float = math.inf
    """Radiance above which a channel of a linear picture counts as clipped."""
    codes: npt.NDArray[np.uint8] | None = None
    """The 8-bit frame, if the source has already computed it."""

    def radiance(self, transfer: str) -> Radiance:
        """Return the linear radiance as a new float32 array."""
        if self.picture.dtype == np.uint16:
            return decode_deep(self.picture, deep_table(transfer))
        return np.array(self.picture, np.float32, order="C")

    def codes_at(
        self, rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64], transfer: str
    ) -> npt.NDArray[np.float64]:
        """Return the codes of some pixels, scaled to 0..255 and not rounded, (..., 3).

        Args:
            rows: Rows of the pixels, (...).
            columns: Columns of the pixels, (...).
            transfer: Transfer function of the camera.
        """
        pixels = self.picture[rows, columns]
        if pixels.dtype == np.uint16:
            return np.asarray(pixels / 257.0)
        return np.asarray(255.0 * encode_codes(transfer, pixels))

    def clip_levels(self, transfer: str, saturation: npt.ArrayLike = (255, 255, 255)) -> npt.NDArray[np.float32]:
        """Return the radiance above which each channel counts as clipped, (2, 3).

        The first row is for a channel on its own, the second for a channel of a pixel in which another one is clipped.

        Args:
            transfer: Transfer function of the camera.
            saturation: 8-bit codes at which the channels saturate, (3,).
        """
        if self.picture.dtype != np.uint16:
            return np.full((2, 3), self.clip, np.float32)
        codes = np.asarray(saturation) - np.asarray(CLIP_MARGINS)[:, None]
        steps = np.ceil(np.maximum(codes, 0.0) * ((_STEPS - 1) / 255.0)).astype(np.int64)
        return np.take_along_axis(deep_table(transfer), steps, 0)


@functools.lru_cache(4)
def deep_table(transfer: str) -> Radiance:
    """Return the linear value of every 16-bit code, (65536, 3)."""
    return np.asarray(decode_codes(transfer, np.arange(_STEPS) / (_STEPS - 1.0)), np.float32)


def decode_deep(codes: npt.NDArray[np.uint16], table: Radiance) -> Radiance:
    """Return the linear values of 16-bit codes, (height, width, 3).

    Args:
        codes: Codes, (height, width, 3).
        table: Result of ``deep_table`` for the camera's transfer.
    """
    return np.stack([table[codes[..., channel], channel] for channel in range(3)], -1)


@functools.cache
def _srgb_steps() -> npt.NDArray[np.uint8]:
    """Return 8-bit sRGB codes for 65536 equal steps of the square root of radiance from 0 to 1.

    Equal steps of radiance itself would skip dark codes.
    """
    return np.rint(255.0 * encode_srgb((np.arange(_STEPS) / (_STEPS - 1.0)) ** 2)).astype(np.uint8)


def srgb8(radiance: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """Return 8-bit sRGB codes of linear radiance; NaN and negative values become 0, values above 1 become 255."""
    root = np.sqrt(np.clip(np.nan_to_num(radiance, nan=0.0), 0.0, 1.0))
    return np.asarray(_srgb_steps()[(root * np.float32(_STEPS - 1) + np.float32(0.5)).astype(np.int32)])


def finite_light(picture: npt.NDArray[Any]) -> Radiance:
    """Return linear radiance with finite values.

    NaN and negative infinity become 0, and positive infinity the largest half float. Finite negative values stay.
    """
    return np.ascontiguousarray(np.nan_to_num(picture, nan=0.0, posinf=65504.0, neginf=0.0), np.float32)


def as_deep_frame(image: npt.NDArray[Any], size: tuple[int, int]) -> DeepFrame:
    """Return a copy of a caller's array as a deep frame.

    Args:
        image: RGB (height, width, 3): uint16 codes, or linear float32, float16 or float64.
        size: Required width and height.

    Raises:
        UsageError: The array has another size or type.
    """
    check_deep_frame(image, size)
    return DeepFrame(image.copy() if image.dtype == np.uint16 else finite_light(image))


def check_deep_frame(image: npt.NDArray[Any], size: tuple[int, int]) -> None:
    """Check the array of a deep frame.

    Args:
        image: RGB (height, width, 3): uint16 codes, or linear floats.
        size: Required width and height.

    Raises:
        UsageError: The array has another size or type.
    """
    expected = (size[1], size[0], 3)
    if image.shape != expected or (image.dtype != np.uint16 and image.dtype.kind != "f"):
        raise UsageError(
            f"frame is {image.dtype} {image.shape}; expected {expected} RGB: uint8 or uint16 codes, or linear floats"
        )


def codes8(deep: DeepFrame, transfer: str) -> npt.NDArray[np.uint8]:
    """Return the 8-bit version of a deep frame: 16-bit codes rounded, or linear radiance encoded.

    Raises:
        UsageError: The frame is linear, and the camera's transfer is not sRGB.
    """
    if deep.picture.dtype == np.uint16:
        return np.asarray(((deep.picture.astype(np.uint32) + 128) // 257).astype(np.uint8))
    check_linear(transfer)
    return srgb8(deep.picture)


def check_linear(transfer: str) -> None:
    """Check that the camera's transfer is sRGB, because linear frames are encoded as sRGB for display.

    Raises:
        UsageError: The transfer is another one.
    """
    if transfer != "srgb":
        raise UsageError(f'camera.transfer = "{transfer}": frames of linear light are encoded as srgb; remove the key')
