"""Pictures of video with more than 8 bits, or of HDR, as plates.

A standard signal of 10 to 16 bits becomes codes of 16 bits, which the camera's transfer decodes as it does 8-bit ones.
A PQ or HLG signal becomes linear light, reference white 1, and wide primaries (BT.2020, P3) Rec. 709's. FFmpeg only
brings chroma to the pixels' places; what the numbers mean is computed here, for its own way to 16-bit RGB is off by
four tenths of a percent.
"""

from __future__ import annotations

import fractions
import functools
from typing import Any, Final, TypeVar

import av
import cv2
import numpy as np
import numpy.typing as npt
from av.sidedata.sidedata import Type as SideDataType
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc, Interpolation, VideoReformatter

from warp_ar.signals import P3_D65, REC_709, REC_2020, converted, light_of_hlg, light_of_pq, light_of_srgb
from warp_ar.sources.deep_frame import CLIP_MARGINS, Plate, srgb8

Float = npt.NDArray[np.float32]
_Picture = TypeVar("_Picture", bound=npt.NDArray[Any])

_LUMA: Final = {
    int(Colorspace.ITU709): (0.2126, 0.0722),
    int(Colorspace.BT2020): (0.2627, 0.0593),
    int(Colorspace.ITU601): (0.299, 0.114),
    6: (0.299, 0.114),  # SMPTE 170M, the same matrix
}
"""Shares of red and blue in luma."""
_WIDE: Final = {
    int(ColorPrimaries.BT2020): REC_2020,
    int(ColorPrimaries.SMPTE432): P3_D65,
}
HD_HEIGHT = 720
"""Rows from which a video that names no colour matrix is BT.709."""

# Nearest-neighbour chroma shifts coloured edges by up to a pixel, and truncated products darken by a level or two.
TO_RGB = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT

_STEPS = 65536

# Encoders tell the rounding of a size as a pixel's shape: 854x480 for 16:9 has pixels of 1280:1281.
_NEARLY_SQUARE = 0.005


def depth_of(context: Any) -> str:
    """What pictures of a stream are beside 8-bit codes, as ``Source.deep`` says it.

    Args:
        context: PyAV's, of the stream's codec.
    """
    components = () if context.format is None else context.format.components
    bits = components[0].bits if components else 0  # pictures that stay on a decoding unit say nothing of theirs
    if not 8 <= bits <= 16:
        return ""  # floats, and what has no picture yet
    if context.color_trc in (ColorTrc.SMPTE2084, ColorTrc.ARIB_STD_B67):
        return "light"
    wide = context.color_primaries in _WIDE
    return "" if bits == 8 else "light" if wide else "codes"


def curve_of(context: Any) -> str:
    """Transfer of a stream of HDR, as ``Source.curve`` says it; argument as that of ``depth_of``."""
    return {int(ColorTrc.SMPTE2084): "pq", int(ColorTrc.ARIB_STD_B67): "hlg"}.get(int(context.color_trc), "")


def pixel_shape(stream: Any) -> fractions.Fraction:
    """Return the width of a stream's pixels over their height; 1 where that is unknown or a rounding away from it."""
    shape = fractions.Fraction(stream.sample_aspect_ratio or 1)
    return shape if shape > 0 and abs(shape - 1) > _NEARLY_SQUARE else fractions.Fraction(1)


def square_width(width: int, shape: fractions.Fraction) -> int:
    """Return the columns of a picture whose pixels have been made square."""
    return max(1, round(width * shape))


def turn_of(picture: Any) -> tuple[bool, bool, bool]:
    """Return what brings a decoded picture upright: transpose it, then flip its columns, then its rows.

    The display matrix of its container or stream takes (x, y) to (a x + c y, b x + d y); the nearest of the eight that
    keep pixels is taken.
    """
    said = next((data for data in picture.side_data if data.type == SideDataType.DISPLAYMATRIX), None)
    if said is None:
        return False, False, False
    a, b, _, c, d = (int(value) for value in np.frombuffer(bytes(said), np.int32)[:5])
    transposed = abs(b) + abs(c) > abs(a) + abs(d)
    return (True, c < 0, b < 0) if transposed else (False, a < 0, d < 0)


def presented(image: _Picture, picture: Any, shape: fractions.Fraction) -> _Picture:
    """Return an image as its container presents it: of square pixels, turned and mirrored by its display matrix.

    Args:
        image: Of the decoded picture, (height, width, 3).
        picture: PyAV's, decoded.
        shape: As ``pixel_shape`` has it.
    """
    height, width = image.shape[:2]
    if shape != 1:
        how = cv2.INTER_LINEAR if shape > 1 else cv2.INTER_AREA
        image = cv2.resize(image, (square_width(width, shape), height), interpolation=how)
    transposed, columns, rows = turn_of(picture)
    turned = image.swapaxes(0, 1) if transposed else image
    return np.ascontiguousarray(turned[:: -1 if rows else 1, :: -1 if columns else 1])  # type: ignore[return-value]


def plate_from_video(
    reformatter: VideoReformatter, picture: Any, shape: fractions.Fraction = fractions.Fraction(1)
) -> Plate:
    """Return the plate of a decoded picture, by the picture's own matrix, range, transfer and primaries.

    Args:
        reformatter: The thread's.
        picture: PyAV's.
        shape: As ``pixel_shape`` has it.
    """
    signal = presented(_signal(reformatter, picture), picture, shape)
    transfer, wide = picture.color_trc, _WIDE.get(picture.color_primaries)
    if transfer not in (ColorTrc.SMPTE2084, ColorTrc.ARIB_STD_B67) and wide is None:
        return Plate(_steps(signal).astype(np.uint16))
    light = _light_table(int(transfer))[_steps(signal)]
    clip = float("inf") if transfer == ColorTrc.SMPTE2084 else float(_light_table(int(transfer))[_last_code()])
    light = converted(light, REC_709 if wide is None else wide, REC_709)
    return Plate(light, clip, srgb8(light))


def _last_code() -> int:
    return round((1.0 - CLIP_MARGINS[0] / 255.0) * (_STEPS - 1))


def _steps(signal: Float) -> npt.NDArray[np.int32]:
    """Nearest of 65536 steps from 0 to 1; what is beyond is cut."""
    return (np.clip(signal, 0.0, 1.0) * np.float32(_STEPS - 1) + np.float32(0.5)).astype(np.int32)


@functools.cache
def _light_table(transfer: int) -> Float:
    """Light of 65536 steps of a signal."""
    curve = {int(ColorTrc.SMPTE2084): light_of_pq, int(ColorTrc.ARIB_STD_B67): light_of_hlg}.get(
        transfer, light_of_srgb
    )
    return curve(np.arange(_STEPS) / (_STEPS - 1.0)).astype(np.float32)


def _signal(reformatter: VideoReformatter, picture: Any) -> Float:
    """R'G'B' of a picture, (height, width, 3), 0 to 1 but for what its coding allows beyond."""
    bits = picture.format.components[0].bits
    kind = "gbrp" if picture.format.is_rgb else "yuv444p"
    wanted = kind if bits == 8 else f"{kind}{bits}le"
    if picture.format.name != wanted:
        picture = reformatter.reformat(picture, format=wanted, interpolation=TO_RGB, threads=1)
    planes = [_plane(plane, np.uint8 if bits == 8 else np.uint16) for plane in picture.planes[:3]]
    if kind == "gbrp":
        green, blue, red = planes
        return np.stack([red, green, blue], -1) / np.float32(2**bits - 1)
    return _rgb_of_yuv(planes, picture, bits)


def _rgb_of_yuv(planes: list[Float], picture: Any, bits: int) -> Float:
    """R'G'B' of Y'CbCr without subsampling (BT.709-6 and BT.2020-2, quantisation and non-constant luminance)."""
    unit = float(2 ** (bits - 8))
    if picture.color_range == ColorRange.JPEG:
        black, luma, chroma = 0.0, 2.0**bits - 1.0, 2.0**bits - 1.0
    else:
        black, luma, chroma = 16.0 * unit, 219.0 * unit, 224.0 * unit
    kr, kb = _LUMA.get(picture.colorspace, _LUMA[1 if picture.height >= HD_HEIGHT else 5])
    y = (planes[0] - np.float32(black)) / np.float32(luma)
    cb, cr = ((plane - np.float32(128.0 * unit)) / np.float32(chroma) for plane in planes[1:])
    red, blue = y + np.float32(2.0 * (1.0 - kr)) * cr, y + np.float32(2.0 * (1.0 - kb)) * cb
    green = (y - np.float32(kr) * red - np.float32(kb) * blue) / np.float32(1.0 - kr - kb)
    return np.stack([red, green, blue], -1)


def _plane(plane: av.video.plane.VideoPlane, kind: Any) -> Float:
    rows = np.frombuffer(plane, kind).reshape(plane.height, -1)
    return rows[:, : plane.width].astype(np.float32)
