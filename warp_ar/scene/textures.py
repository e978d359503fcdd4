"""Decoding of material pictures, and the linear values of their codes.

Linear pictures on emitting surfaces (Radiance, OpenEXR) are stored as sRGB codes of their values divided by the largest
value. Values below 1 / 6600 of it become black; above a twentieth of it, steps are 1 % or finer.
"""

from __future__ import annotations

import functools
import struct
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError
from warp_ar.exr_file import read_linear_picture
from warp_ar.pictures import decode_picture, in_srgb, read_picture
from warp_ar.srgb import decode_srgb

FloatArray = npt.NDArray[np.float32]
ByteArray = npt.NDArray[np.uint8]


def _decode_table() -> FloatArray:
    code = np.arange(256) / 255.0
    return np.concatenate([code, decode_srgb(code)]).astype(np.float32)


DECODE: Final = _decode_table()
"""Linear value of each code: 256 for linear, then 256 for sRGB-encoded pictures, (512,)."""


def linear_texture(texture: ByteArray) -> FloatArray:
    """Return the linear RGB of an sRGB-encoded picture, (h, w, 3)."""
    linear: FloatArray = DECODE[256:][texture]
    return linear


def encode_texture(linear: npt.NDArray[Any], *, encoded: bool) -> ByteArray:
    """Return the codes nearest to linear values, any shape."""
    if not encoded:
        return np.asarray(np.round(np.clip(linear, 0.0, 1.0) * 255.0), dtype=np.uint8)
    values = DECODE[256:]
    codes: ByteArray = np.searchsorted(0.5 * (values[1:] + values[:-1]), linear).astype(np.uint8)
    return codes


def decode_rgba(data: bytes, label: str, *, color: bool = False) -> ByteArray:
    """Decode a picture to 8-bit RGBA; EXIF orientation is ignored, as glTF requires.

    Args:
        data: The whole file.
        label: Name of the picture in messages.
        color: True to convert colours by the ICC profile; False to ignore it, as glTF requires.

    Returns:
        (h, w, 4); grey becomes RGB, missing alpha becomes 255.

    Raises:
        SceneError: The picture cannot be decoded.
    """
    picture = decode_picture(data, cv2.IMREAD_UNCHANGED, SceneError, label)
    if picture.dtype not in (np.uint8, np.uint16, np.float32, np.float64):
        raise SceneError(f"{label} has {picture.dtype} values; 8 or 16 bits are right")
    picture = picture[..., None] if picture.ndim == 2 else picture
    count = picture.shape[2]
    shown = picture[..., 2::-1] if count > 2 else np.repeat(picture[..., :1], 3, axis=2)
    if picture.dtype.kind == "f":
        shown = encode_texture(np.clip(np.nan_to_num(shown), 0.0, 1.0), encoded=True)
    alpha = picture[..., count - 1 :] if count in (2, 4) else np.ones_like(picture[..., :1])
    most = 1.0 if picture.dtype.kind == "f" or count not in (2, 4) else float(np.iinfo(picture.dtype).max)
    clear = _clear_code(data)
    if clear is not None:
        alpha = (shown != np.array(clear)).any(axis=2, keepdims=True)
    codes = np.asarray(np.round(shown / 257.0) if shown.dtype == np.uint16 else shown, dtype=np.uint8)
    if color:
        codes = in_srgb(codes, data)
    return np.concatenate([codes, encode_texture(np.nan_to_num(alpha / most), encoded=False)], axis=2)


def _clear_code(data: bytes) -> tuple[int, ...] | None:
    """Return the grey value or colour that a PNG declares as transparent, which OpenCV ignores.

    Return None if there is none.
    """
    if not data.startswith(b"\x89PNG") or data[25:26] not in (b"\0", b"\2"):
        return None
    at = data.find(b"tRNS", 33)
    count = 1 if data[25] == 0 else 3
    if at < 0 or at > data.find(b"IDAT") or len(data) < at + 4 + 2 * count:
        return None
    scale = 255 // ((1 << data[24]) - 1) if data[24] < 8 else 1  # grey of fewer bits was scaled to 8 bits
    return tuple(scale * code for code in struct.unpack_from(f">{count}H", data, at + 4))


def load_texture(path: str | Path) -> ByteArray:
    """Read a picture as a base colour texture.

    Args:
        path: PNG, JPEG, BMP, TIFF, WebP, GIF or PNM; deeper than 8 bits is reduced, alpha dropped, grey becomes RGB.

    Returns:
        (h, w, 3) RGB, sRGB-encoded, row 0 at the top.

    Raises:
        SceneError: The file is missing, no picture, or too large.
    """
    image = read_picture(path, cv2.IMREAD_COLOR_RGB, SceneError, f"{path}: the texture")
    if image.dtype.kind == "f":  # linear values
        return encode_texture(np.clip(np.nan_to_num(image), 0.0, 1.0), encoded=True)
    result: ByteArray = np.asarray(image / 257.0 if image.dtype == np.uint16 else image, dtype=np.uint8)
    return result


RADIANCE_SUFFIXES: Final = (".exr", ".hdr")
"""Suffixes of files with linear radiance."""


def file_stamp(path: Path) -> tuple[int, int]:
    """Return a stamp of a file that differs after the file has changed."""
    try:
        status = path.stat()
    except OSError:
        return 0, 0  # the reader reports the error
    return status.st_mtime_ns, status.st_size


def load_emission(path: Path) -> tuple[npt.NDArray[np.uint8], float]:
    """Return an emissive picture, cached until the file changes.

    Args:
        path: Linear picture (Radiance, OpenEXR with R, G and B), or a format of ``load_texture``.

    Returns:
        (h, w, 3) RGB, sRGB-encoded, row 0 at the top, and the radiance of code 255.

    Raises:
        SceneError: The file is missing, not such a picture, too large, or contains a negative or non-finite value.
    """
    return _load(path, file_stamp(path))


@functools.lru_cache(maxsize=4)
def _load(path: Path, stamp: tuple[int, int]) -> tuple[npt.NDArray[np.uint8], float]:
    if path.suffix.lower() not in RADIANCE_SUFFIXES:
        return load_texture(path), 1.0
    radiance = read_linear_picture(path, SceneError, str(path)).color
    if radiance.min(initial=0.0) < 0.0:
        raise SceneError(f"{path}: holds radiance that is negative; expected 0 or more everywhere")
    peak = max(float(radiance.max(initial=0.0)), 1e-6)
    return encode_texture(radiance / peak, encoded=True), peak
