"""Pictures of anyone's making: their size is read from the header, and limited, before anything is decoded."""

from __future__ import annotations

import contextlib
import io
import os
import re
import struct
import tempfile
from collections.abc import Callable
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
"""Formats that are read: those whose headers are known here."""

RAW = frozenset({".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"})
"""Raw photographs, by their names' endings."""
HEIF = frozenset({".heic", ".heif", ".hif", ".avif"})
"""Pictures of phones that nothing here decodes, by their names' endings."""
_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"mif1", b"msf1", b"avif")

_PRIMARIES = {1: REC_709, 9: REC_2020, 12: P3_D65}
_CURVES = {1: 0.0, 4: 2.2, 5: 2.8, 6: 0.0, 8: 1.0, 13: 0.0, 14: 0.0, 15: 0.0}
"""Primaries and gammas (0: sRGB's curve, as for videos) of a PNG's cICP by their numbers in ITU-T H.273."""

Size = tuple[int, int]

_HEAD = 1 << 16
"""Bytes within which a photograph has its EXIF."""
_SAME_GAMMA = 0.02
"""Share by which a gamma may differ from sRGB's 1/2.2 and is taken for it."""

# OpenCV 5.0 leaves TIFFs of more than 8 bits undecoded, or their channels in the other order, where it is to give RGB;
# as they lie, it gives those of three channels in the other order, and black of one bit as white.
_TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


def foreign_words(suffix: str, data: bytes = b"") -> str:
    """Why a photograph cannot be read, and what to do about it; empty if it is of none of the kinds known for that.

    Args:
        suffix: Its name's ending, in lower case.
        data: Its first bytes: phones' pictures are renamed to .jpg as they are.
    """
    if suffix in HEIF or (data[4:8] == b"ftyp" and data[8:12] in _BRANDS):
        return (
            "HEIC, which is not read: save it as JPEG (iPhone: Settings, Camera, Formats, Most Compatible; on a Mac: "
            "sips -s format jpeg *.HEIC --out jpegs; else: heif-convert or ImageMagick)"
        )
    if suffix in RAW:
        return "a raw photograph, which is not read: save it as JPEG, or as TIFF of 16 bits, in sRGB"
    return ""


def picture_size(data: bytes) -> Size | None:
    """(width, height) in pixels that a picture's header promises; None if it is of no known format or cut off.

    Of a TIFF the larger of the picture and its tiles, which is what its reader makes room for.
    """
    for start, read in _READERS.items():
        if data.startswith(start):
            with contextlib.suppress(struct.error, IndexError, ValueError, OSError, SyntaxError, EOFError):
                return read(data)
    return None


def read_picture(
    path: str | os.PathLike[str], flags: int, error: type[WarpArError], label: str | None = None
) -> npt.NDArray[Any]:
    """Decode a picture file; arguments and errors as `decode_picture`."""
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
        error: What to raise.
        label: What messages call the picture.

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
    """Return a picture that is asked for in RGB in sRGB, by the ICC profile of its file."""
    if not flags & cv2.IMREAD_COLOR_RGB or flags < 0 or picture.ndim != 3 or picture.dtype.kind != "u":
        return picture
    return in_srgb(picture, data)


def in_srgb(picture: npt.NDArray[Any], data: bytes) -> npt.NDArray[Any]:
    """Return a picture in sRGB, by what its file says of its codes.

    That is an ICC profile; else EXIF's mark of Adobe RGB, R03, which cameras write without a profile; else a PNG's
    gamma and chromaticities. Without any it is sRGB already.

    Args:
        picture: RGB, (height, width, 3), uint8 or uint16.
        data: The file.
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
    primaries = (*primaries[2:], *primaries[:2])  # a PNG names white first
    known = len(primaries) == 8 and are_primaries(primaries)
    return _srgb_of(picture, 1.0 / gamma if gamma > 0.0 else 1.0, primaries if known else REC_709)


def _cicp(data: bytes) -> re.Match[bytes] | None:
    """Return a PNG's chunk of coding-independent code points: bytes of primaries and transfer."""
    return re.search(b"\0\0\0\x04cICP(.)(.)", data[:_HEAD], re.DOTALL) if data.startswith(b"\x89PNG") else None


def _srgb_of(picture: npt.NDArray[Any], gamma: float, primaries: Chromaticities) -> npt.NDArray[Any]:
    """Return codes of sRGB of those whose power ``gamma``, or sRGB's curve (0), is light of other primaries."""
    most = float(np.iinfo(picture.dtype).max)
    codes = np.arange(most + 1) / most
    light = codes**gamma if gamma else decode_srgb(codes)
    shown = encode_srgb(np.clip(converted(light.astype(np.float32)[picture], primaries, REC_709), 0.0, 1.0))
    return np.asarray(np.round(most * shown), dtype=picture.dtype)


def srgb_by_profile(picture: npt.NDArray[Any], profile: bytes) -> npt.NDArray[Any]:
    """Return the codes of sRGB of a picture whose codes an ICC profile explains.

    Profiles of sRGB itself, of other spaces than RGB and grey (OpenCV has converted those), and damaged ones change
    nothing.
    Codes of 16 bits are converted by their upper 8, to within one code of 8 bits.

    Args:
        picture: RGB, (height, width, 3), uint8 or uint16.
        profile: The file's.
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
    """Return a TIFF in planes, of floats or with transparency, which OpenCV reads wrong or not at all; upright."""
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "picture.tif")  # OpenImageIO's Python reads files alone
        with open(path, "wb") as file:
            file.write(data)
        import OpenImageIO  # here: at the end of any process that has loaded it, it reports what it leaks

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
    """Check by its header whether a picture may be decoded.

    Raises:
        WarpArError: As ``error``: it is none, too large, or cut off.
    """
    if not data:
        raise error(f"{label} is empty (0 bytes); an image is needed")
    # libpng would refuse a file without its last chunk too, but writes to stderr when it does.
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
    """Return the first value of those tags of a TIFF's first picture that are whole numbers."""
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
    """Return the size by Pillow's reader of the format, itself: ``Image.open`` has a limit of its own."""
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
