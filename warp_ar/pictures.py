"""Decoding of untrusted pictures: the size in the header is checked before anything is decoded."""

from __future__ import annotations

import contextlib
import io
import os
import re
import struct
import tempfile
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import PIL.Image
from PIL import BmpImagePlugin, ExifTags, GifImagePlugin, ImageCms, JpegImagePlugin, PpmImagePlugin, WebPImagePlugin

from warp_ar.errors import WarpArError, reason
from warp_ar.files import check_size, read_bytes
from warp_ar.signals import ADOBE_RGB, P3_D65, REC_709, REC_2020, Chromaticities, are_primaries, converted
from warp_ar.srgb import decode_srgb, encode_srgb

FORMATS = "PNG, JPEG, BMP, TIFF, WebP, GIF or PNM"
"""Readable formats: the formats whose headers this module parses."""

RAW = frozenset({".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"})
"""Endings of raw photographs."""
SRGB_CURVE = 2.4, 12.92
"""Exponent of sRGB's curve, and the slope of its linear part."""
HEIF = frozenset({".heic", ".heif", ".hif", ".avif"})
"""Endings of phone pictures that cannot be decoded here."""
_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"mif1", b"msf1", b"avif")

_PRIMARIES = {1: REC_709, 9: REC_2020, 12: P3_D65}
_CURVES = {1: 0.0, 4: 2.2, 5: 2.8, 6: 0.0, 8: 1.0, 13: 0.0, 14: 0.0, 15: 0.0}
"""Primaries and gammas (0: sRGB's curve, as for videos) by their numbers in a PNG's cICP chunk (ITU-T H.273)."""

Size = tuple[int, int]

_HEAD = 1 << 16
"""Bytes at a photograph's start within which EXIF is searched for."""
_SAME_GAMMA = 0.02
"""Relative difference from sRGB's 1/2.2 up to which a gamma counts as sRGB's."""

# OpenCV 5.0 does not decode TIFFs of more than 8 bits if it is asked for RGB, or swaps their channels. If it is asked
# for the file's own layout, it swaps the order of three channels and inverts 1-bit pictures.
_TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


def foreign_words(suffix: str, data: bytes = b"") -> str:
    """Return why a photograph cannot be read and the remedy; empty if it is not of a known unreadable kind.

    Args:
        suffix: Ending of its name, in lower case.
        data: First bytes of the file: phone pictures are often renamed to .jpg without conversion.
    """
    if suffix in HEIF or (data[4:8] == b"ftyp" and data[8:12] in _BRANDS):
        return (
            "HEIC, which is not read: save it as JPEG (iPhone: Settings, Camera, Formats, Most Compatible; on a Mac: "
            "sips -s format jpeg *.HEIC --out jpegs; else: heif-convert or ImageMagick)"
        )
    return ""


@contextlib.contextmanager
def open_raw(path: str | os.PathLike[str], error: type[WarpArError]) -> Iterator[Any]:
    """Open a raw photograph with rawpy, whose pixels are not yet decoded.

    Raises:
        WarpArError: As ``error``: rawpy is not installed, or the file is too large, damaged or no raw photograph.
    """
    try:
        import rawpy
    except ImportError as problem:
        right = 'pip install "warp-ar[raw]" reads it; or save it as TIFF of 16 bits, in sRGB'
        raise error(f"{path} is a raw photograph: {right}") from problem
    data = read_bytes(path, "picture_bytes", error)
    try:
        with rawpy.RawPy() as raw:
            raw.open_buffer(io.BytesIO(data))
            check_size(raw.sizes.width, raw.sizes.height, error, str(path))
            yield raw
    except (rawpy.LibRawError, rawpy.NotSupportedError, ValueError, MemoryError) as problem:
        raise error(f"{path} cannot be read as a raw photograph: {reason(problem)}") from problem


def read_raw(path: str | os.PathLike[str], error: type[WarpArError]) -> npt.NDArray[np.uint16]:
    """Return a raw photograph, upright, as 16-bit sRGB codes of its linear values, (height, width, 3).

    The white balance is the camera's as shot. The largest code is the sensor's saturation, whatever the picture shows.

    Raises:
        WarpArError: As ``error``: rawpy is not installed, or the file is too large, damaged or no raw photograph.
    """
    with open_raw(path, error) as raw:
        raw.unpack()
        plain = {"use_camera_wb": True, "no_auto_bright": True, "adjust_maximum_thr": 0.0}
        return np.asarray(raw.postprocess(output_bps=16, gamma=SRGB_CURVE, **plain), np.uint16)


def picture_size(data: bytes) -> Size | None:
    """Return (width, height) in pixels from a picture's header; None if the format is unknown or the header cut off.

    For a TIFF, the larger of the picture and its tiles: its reader allocates the larger.
    """
    for start, read in _READERS.items():
        if data.startswith(start):
            with contextlib.suppress(struct.error, IndexError, ValueError, OSError, SyntaxError, EOFError):
                return read(data)
    return None


def read_picture(
    path: str | os.PathLike[str], flags: int, error: type[WarpArError], label: str | None = None
) -> npt.NDArray[Any]:
    """Decode a picture file; `decode_picture` describes arguments, result and errors."""
    label = str(path) if label is None else label
    return decode_picture(read_bytes(path, "picture_bytes", error, label), flags, error, label)


def decode_picture(data: bytes, flags: int, error: type[WarpArError], label: str) -> npt.NDArray[Any]:
    """Decode a picture.

    Follows:
        8 and 16 bits; TIFF: floats, planes; EXIF: orientation, Adobe RGB; ICC profiles: RGB, grey (16 bits: to one code
        of 8); PNG: gamma, chromaticities, cICP.

    Args:
        data: The whole file.
        flags: OpenCV's for ``imdecode``.
        error: Class of the error to raise.
        label: Name of the picture in messages.

    Returns:
        OpenCV's array: (height, width) or (height, width, channels).

    Raises:
        WarpArError: As ``error``: damaged; PNG of PQ or HLG.
    """
    check_picture(data, error, label)
    asked = flags
    if data[:4] in _TIFF_STARTS:
        tags = _tiff_tags(data)
        if flags < 0 and tags.get(262) == 6:
            flags = cv2.IMREAD_COLOR_BGR  # of Y'CbCr OpenImageIO applies half of the orientation
        elif flags < 0 or tags.get(284) == 2 or tags.get(339) == 3 or tags.get(277, 1) not in (1, 3):
            return _in_color(_read_tiff(data, tags.get(274, 1), flags, error, label), data, flags)
    turns = bool(flags & cv2.IMREAD_COLOR_RGB) and data[:4] in _TIFF_STARTS
    if turns:
        flags = flags & ~cv2.IMREAD_COLOR_RGB | cv2.IMREAD_COLOR_BGR
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        if turns and picture is not None:
            picture = np.ascontiguousarray(picture[..., ::-1])
    except (cv2.error, MemoryError) as problem:
        raise error(f"{label} cannot be decoded: {reason(problem)}") from problem
    if picture is None:
        raise error(f"{label} cannot be decoded: damaged, cut off, or no image")
    return _in_color(np.asarray(picture), data, asked)


def _in_color(picture: npt.NDArray[Any], data: bytes, flags: int) -> npt.NDArray[Any]:
    """Return a decoded picture converted to sRGB by the ICC profile of its file, if RGB was requested."""
    if not flags & cv2.IMREAD_COLOR_RGB or flags < 0 or picture.ndim != 3 or picture.dtype.kind != "u":
        return picture
    return in_srgb(picture, data)


def in_srgb(picture: npt.NDArray[Any], data: bytes) -> npt.NDArray[Any]:
    """Return a picture converted to sRGB from the colour space that its file states.

    The colour space is that of the ICC profile; else Adobe RGB if EXIF marks it (R03), as cameras do without a profile;
    else that of a PNG's gamma and chromaticities. Without any of them the picture is taken for sRGB.

    Args:
        picture: RGB, (height, width, 3), uint8 or uint16.
        data: Content of the file.
    """
    try:
        with PIL.Image.open(io.BytesIO(data)) as header:
            said = header.info
            adobe = b"R03\0" in data[:_HEAD] and header.getexif().get_ifd(ExifTags.IFD.Interop).get(1) == "R03"
    except (OSError, ValueError, SyntaxError, PIL.Image.DecompressionBombError, struct.error):
        return picture
    if coding := _cicp(data):
        primaries, curve = _PRIMARIES[coding[1][0]], _CURVES[coding[2][0]]
        return picture if (primaries, curve) == (REC_709, 0.0) else _srgb_of(picture, curve, primaries)
    if profile := said.get("icc_profile"):
        return srgb_by_profile(picture, profile)
    if adobe:
        return _srgb_of(picture, 563 / 256, ADOBE_RGB)
    gamma, primaries = said.get("gamma"), tuple(said.get("chromaticity", ()))
    if gamma is None or "srgb" in said or abs(gamma * 2.2 - 1.0) < _SAME_GAMMA:
        return picture
    primaries = (*primaries[2:], *primaries[:2])  # PNG stores white first
    known = len(primaries) == 8 and are_primaries(primaries)
    return _srgb_of(picture, 1.0 / gamma if gamma > 0.0 else 1.0, primaries if known else REC_709)


def _cicp(data: bytes) -> re.Match[bytes] | None:
    """Return the bytes of primaries and transfer in a PNG's cICP chunk (coding-independent code points)."""
    return re.search(b"\0\0\0\x04cICP(.)(.)", data[:_HEAD], re.DOTALL) if data.startswith(b"\x89PNG") else None


def _srgb_of(picture: npt.NDArray[Any], gamma: float, primaries: Chromaticities) -> npt.NDArray[Any]:
    """Return the sRGB codes of a picture in other primaries and with a power ``gamma``; 0: with sRGB's own curve."""
    most = float(np.iinfo(picture.dtype).max)
    codes = np.arange(most + 1) / most
    light = codes**gamma if gamma else decode_srgb(codes)
    shown = encode_srgb(np.clip(converted(light.astype(np.float32)[picture], primaries, REC_709), 0.0, 1.0))
    return np.asarray(np.round(most * shown), dtype=picture.dtype)


def srgb_by_profile(picture: npt.NDArray[Any], profile: bytes) -> npt.NDArray[Any]:
    """Return a picture converted to sRGB by its ICC profile.

    A picture is unchanged if its profile is damaged, is sRGB itself, or is of a space other than RGB and grey, which
    OpenCV has already converted. Codes of 16 bits are converted by their upper 8 bits, to within one 8-bit code.

    Args:
        picture: RGB, (height, width, 3), uint8 or uint16.
        profile: The ICC profile in the file.
    """
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        name = ImageCms.getProfileDescription(source)
        kind = {"RGB": "RGB", "GRAY": "L"}.get(source.profile.xcolor_space.strip())
        if kind is None or "sRGB" in name:
            return picture
        way = ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), kind, "RGB")
    except (ImageCms.PyCMSError, OSError, ValueError):
        return picture
    deep = picture.dtype == np.uint16
    codes = (picture >> 8).astype(np.uint8) if deep else picture
    shown = codes if kind == "RGB" else codes[..., 0]
    image = ImageCms.applyTransform(PIL.Image.fromarray(np.ascontiguousarray(shown)), way)
    converted = np.array(image, np.uint8)
    if not deep:
        return converted
    rest = picture.astype(np.int32) - 257 * codes.astype(np.int32)
    return np.clip(257 * converted.astype(np.int32) + rest, 0, 65535).astype(np.uint16)


def _read_tiff(data: bytes, orientation: int, flags: int, error: type[WarpArError], label: str) -> npt.NDArray[Any]:
    """Return a TIFF in planes, of floats or with transparency, upright; OpenCV reads these wrongly or not at all."""
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "picture.tif")  # the Python interface of OpenImageIO reads files only
        with open(path, "wb") as file:
            file.write(data)
        import OpenImageIO  # here: a process that has loaded it prints a report of leaks when it ends

        config = OpenImageIO.ImageSpec()
        config["oiio:UnassociatedAlpha"] = 1
        reader = OpenImageIO.ImageInput.open(path, config)
        if reader is None:
            raise error(f"{label} cannot be decoded: {' '.join(OpenImageIO.geterror().split())}")
        pixels = reader.read_image(OpenImageIO.UNKNOWN)
        problem = " ".join(reader.geterror().split())
        reader.close()
    if pixels is None:
        raise error(f"{label} cannot be decoded: {problem or 'damaged or cut off'}")
    pixels = np.asarray(pixels)
    if orientation >= 5:
        pixels = pixels.swapaxes(0, 1)
    rows = slice(None, None, -1 if orientation in (3, 4, 7, 8) else 1)
    columns = slice(None, None, -1 if orientation in (2, 3, 6, 7) else 1)
    pixels = pixels[rows, columns]
    if flags < 0:
        order = [2, 1, 0, *range(3, pixels.shape[2])] if pixels.shape[2] > 2 else slice(None)
        return np.ascontiguousarray(pixels[..., order])
    color = pixels[..., :3] if pixels.shape[2] > 2 else np.repeat(pixels[..., :1], 3, 2)
    return np.ascontiguousarray(color if flags & cv2.IMREAD_COLOR_RGB else color[..., ::-1])


def check_picture(data: bytes, error: type[WarpArError], label: str) -> None:
    """Check a picture's header before it is decoded.

    Raises:
        WarpArError: As ``error``: the data are no picture, too large, or cut off.
    """
    if not data:
        raise error(f"{label} is empty (0 bytes); an image is needed")
    # libpng would also refuse a file without its last chunk, but prints to stderr then.
    if data.startswith(b"\x89PNG") and b"IEND\xaeB`\x82" not in data:
        raise error(f"{label} is cut off after {len(data)} bytes; copy the whole file")
    coding = _cicp(data)
    if coding is not None and not (coding[1][0] in _PRIMARIES and coding[2][0] in _CURVES):
        told = f"cICP of primaries {coding[1][0]} and transfer {coding[2][0]}"
        raise error(f"{label} has a {told}; save it as SDR of Rec. 709, P3 or Rec. 2020 (PQ and HLG: as OpenEXR)")
    size = picture_size(data)
    if size is None and (words := foreign_words("", data)):
        raise error(f"{label} is {words}")
    if size is None:
        raise error(f"{label} cannot be decoded: damaged, cut off, or no image; use {FORMATS}")
    check_size(*size, error, label)


def _png(data: bytes) -> Size:
    width, height = struct.unpack_from(">II", data, 16)
    return width, height


def _tiff_tags(data: bytes) -> dict[int, int]:
    """Return the first value of each integer tag of a TIFF's first picture."""
    order = "<" if data[:2] == b"II" else ">"
    big = struct.unpack_from(order + "H", data, 2)[0] == 43
    start = struct.unpack_from(order + ("Q" if big else "I"), data, 8 if big else 4)[0]
    count = struct.unpack_from(order + ("Q" if big else "H"), data, start)[0]
    room, tags, at = 8 if big else 4, {}, start + (8 if big else 2)
    for _ in range(min(count, 4096)):
        tag, kind = struct.unpack_from(order + "HH", data, at)
        (length,) = struct.unpack_from(order + ("Q" if big else "I"), data, at + 4)
        form = {1: "B", 3: "H", 4: "I", 16: "Q"}.get(kind)
        if form is not None and length:
            place = at + 4 + room
            if length * struct.calcsize(form) > room:
                (place,) = struct.unpack_from(order + ("Q" if big else "I"), data, place)
            tags[tag] = struct.unpack_from(order + form, data, place)[0] if place + 8 <= len(data) else 0
        at += 20 if big else 12
    return tags


def _tiff(data: bytes) -> Size | None:
    tags = _tiff_tags(data)
    if 256 not in tags or 257 not in tags:
        return None
    return max(tags[256], tags.get(322, 0)), max(tags[257], tags.get(323, 0))


def _by_pillow(data: bytes) -> Size:
    """Return the size by the format's own reader in Pillow, because ``Image.open`` has its own limit of size."""
    kind = next(kind for start, kind in _PILLOW.items() if data.startswith(start))
    with kind(io.BytesIO(data)) as header:
        return int(header.width), int(header.height)


_PILLOW: dict[bytes, Any] = {
    b"\xff\xd8": JpegImagePlugin.JpegImageFile,
    b"BM": BmpImagePlugin.BmpImageFile,
    b"RIFF": WebPImagePlugin.WebPImageFile,
    b"GIF8": GifImagePlugin.GifImageFile,
    **dict.fromkeys((b"P1", b"P2", b"P3", b"P4", b"P5", b"P6"), PpmImagePlugin.PpmImageFile),
}
_READERS: dict[bytes, Callable[[bytes], Size | None]] = {
    b"\x89PNG\r\n\x1a\n": _png,
    **dict.fromkeys(_TIFF_STARTS, _tiff),
    **dict.fromkeys(_PILLOW, _by_pillow),
}
