"""Frames of more than 8 bits: a camera's codes of 16 bits, or linear light, beside the 8-bit frame that is tracked.

    8-bit codes    what markers are found in, and means of a pixel's surroundings
    plate          where the frame becomes light: the mirror ball, surfaces, and the picture's own radiance

Codes of 16 bits become light by the camera's transfer; linear light is taken as it stands, 1 being where a camera of 8
bits would clip, Rec. 709 primaries, and may be above.
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
"""8-bit codes below saturation from which on a channel counts as clipped: by itself, and beside another one that does;
half a code more than in 8 bits, where codes are rounded."""

_STEPS = 65536


@dataclasses.dataclass(frozen=True)
class Plate:
    """A frame at its full depth."""

    picture: npt.NDArray[Any]
    """(height, width, 3) RGB: uint16 codes of the camera's transfer, or float32 linear radiance."""
    clip: float = math.inf
    """Radiance from which on a channel of a linear picture counts as clipped."""
    codes: npt.NDArray[np.uint8] | None = None
    """The 8-bit frame, where a source has made it already."""

    def radiance(self, transfer: str) -> Radiance:
        """Linear radiance, float32, an array of its own."""
        if self.picture.dtype == np.uint16:
            return decode_deep(self.picture, deep_table(transfer))
        return np.array(self.picture, np.float32, order="C")

    def codes_at(
        self, rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64], transfer: str
    ) -> npt.NDArray[np.float64]:
        """The camera's codes of some pixels in steps of 8 bits, not rounded, 0 to 255, (..., 3).

        Args:
            rows: Of the pixels, (...).
            columns: Of the pixels, (...).
            transfer: The camera's.
        """
        pixels = self.picture[rows, columns]
        if pixels.dtype == np.uint16:
            return np.asarray(pixels / 257.0)
        return np.asarray(255.0 * encode_codes(transfer, pixels))

    def clip_levels(self, transfer: str, saturation: npt.ArrayLike = (255, 255, 255)) -> npt.NDArray[np.float32]:
        """Radiance from which on each channel counts as clipped: by itself, and beside another one that does, (2, 3).

        Args:
            transfer: The camera's.
            saturation: 8-bit codes at which its channels saturate, (3,).
        """
        if self.picture.dtype != np.uint16:
            return np.full((2, 3), self.clip, np.float32)
        codes = np.asarray(saturation) - np.asarray(CLIP_MARGINS)[:, None]
        steps = np.ceil(np.maximum(codes, 0.0) * ((_STEPS - 1) / 255.0)).astype(np.int64)
        return np.take_along_axis(deep_table(transfer), steps, 0)


@functools.lru_cache(4)
def deep_table(transfer: str) -> Radiance:
    """Linear value of every 16-bit code, (65536, 3)."""
    return np.asarray(decode_codes(transfer, np.arange(_STEPS) / (_STEPS - 1.0)), np.float32)


def decode_deep(codes: npt.NDArray[np.uint16], table: Radiance) -> Radiance:
    """Linear value of 16-bit codes, (height, width, 3), by a table of `deep_table`'s shape."""
    return np.stack([table[codes[..., channel], channel] for channel in range(3)], -1)


@functools.cache
def _srgb_steps() -> npt.NDArray[np.uint8]:
    """8-bit sRGB codes over the square root of light, which keeps dark codes apart."""
    return np.rint(255.0 * encode_srgb((np.arange(_STEPS) / (_STEPS - 1.0)) ** 2)).astype(np.uint8)


def srgb8(radiance: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """8-bit sRGB codes of linear light; NaN and what is below 0 become 0, what is above 1 becomes 255."""
    root = np.sqrt(np.clip(np.nan_to_num(radiance, nan=0.0), 0.0, 1.0))
    return np.asarray(_srgb_steps()[(root * np.float32(_STEPS - 1) + np.float32(0.5)).astype(np.int32)])


def finite_light(picture: npt.NDArray[Any]) -> Radiance:
    """Linear light without what no light is: NaN becomes 0, infinities the largest half float; negatives stay."""
    return np.ascontiguousarray(np.nan_to_num(picture, nan=0.0, posinf=65504.0, neginf=0.0), np.float32)


def as_plate(image: npt.NDArray[Any], size: tuple[int, int]) -> Plate:
    """A caller's array as a plate of its own.

    Args:
        image: RGB (height, width, 3): uint16 codes, or linear float32, float16 or float64.
        size: Width and height that it must have.

    Raises:
        UsageError: It has another size or type.
    """
    check_plate(image, size)
    return Plate(image.copy() if image.dtype == np.uint16 else finite_light(image))


def check_plate(image: npt.NDArray[Any], size: tuple[int, int]) -> None:
    """Check an array that is to be a plate's picture; arguments as those of `as_plate`.

    Raises:
        UsageError: It has another size or type.
    """
    expected = (size[1], size[0], 3)
    if image.shape != expected or (image.dtype != np.uint16 and image.dtype.kind != "f"):
        raise UsageError(
            f"frame is {image.dtype} {image.shape}; expected {expected} RGB: uint8 or uint16 codes, or linear floats"
        )


def codes8(plate: Plate, transfer: str) -> npt.NDArray[np.uint8]:
    """The 8-bit frame of a plate: 16-bit codes rounded, or linear light encoded.

    Raises:
        UsageError: The light is linear, and the camera's transfer is not sRGB.
    """
    if plate.picture.dtype == np.uint16:
        return np.asarray(((plate.picture.astype(np.uint32) + 128) // 257).astype(np.uint8))
    check_linear(transfer)
    return srgb8(plate.picture)


def check_linear(transfer: str) -> None:
    """Check that linear frames fit the camera's transfer: they are shown as sRGB.

    Raises:
        UsageError: It is another one.
    """
    if transfer != "srgb":
        raise UsageError(
            f'camera.transfer = "{transfer}": frames of linear light are encoded as srgb; take the key out'
        )
