"""Signature in the files that this program writes, by which it recognises them.

Its place by format: PNG, a text chunk; OpenEXR and HDR, the header; WebP, EXIF; video, the comment; report and
calibration, the first key; page, chart and text, a comment at the start; response, the first line; glTF, the generator;
USD, the layer's custom data.
"""

from __future__ import annotations

import importlib.metadata
import os
import re
import struct
import zlib
from collections.abc import Sequence
from typing import Any

import av
import cv2
import numpy.typing as npt
import PIL.Image

from warp_ar.files import kind_of

PROGRAM = "warp_ar"
"""Name of this program in signatures."""

_HEAD = 4096
"""Bytes at the start of a file within which the signature stands, except in videos."""

_NAME = PROGRAM.encode()
_MARKS = {
    b"\x89PNG": b"tEXtSoftware\0" + _NAME,
    b"%PDF-": b"\n% " + _NAME + b"\n",
    b"#usda ": b'string program = "' + _NAME + b'"',
    b"glTF": b'"generator":"' + _NAME + b'"',
    b"#?RADIANCE\n": b"#?RADIANCE\nSOFTWARE=" + _NAME + b"\n",
    b"\x76\x2f\x31\x01": b"software\0string\0" + struct.pack("<I", len(PROGRAM)) + _NAME,
}
"""First bytes of each format, and the signature in its head."""

# Text before the signature: JSON's first key (OpenCV's JSON and YAML begin with their version), or a comment.
_LEADS = rb"""\s*\{\s*"program":\s*"|%YAML[: ][\d.]+\s*(?:---\s*)?program: "?|""" + (
    rb"""<\?xml version="1.0"\?>\s*<opencv_storage>\s*<program>"?|# |(?:<!doctype html>\s*)?<!-- """
)
COMMENT = f"<!-- {PROGRAM} -->"
"""Comment at the start of a chart or a Markdown text, and after the document type of a page."""
_SOFTWARE_TAG = 0x0131
"""EXIF tag of the software's name."""


def installed_version(package: str) -> str:
    """Return the version of an installed package; a question mark if it is not installed, as in a checkout."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "?"


def sign_png(data: bytes) -> bytes:
    """Return a PNG with the signature as its ``Software`` text, inserted after the header of 33 bytes."""
    body = b"tEXtSoftware\0" + _NAME
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    return data[:33] + chunk + data[33:]


def encode_png(picture: npt.NDArray[Any], options: Sequence[int] = ()) -> bytes:
    """Return a signed PNG of 8 or 16 bits.

    Args:
        picture: Grey (height, width), RGB or RGBA (height, width, 3 or 4).
        options: Options of OpenCV's encoder.
    """
    if picture.ndim == 3:
        picture = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR if picture.shape[2] == 3 else cv2.COLOR_RGBA2BGRA)
    done, data = cv2.imencode(".png", picture, options)
    assert done
    return sign_png(data.tobytes())


def software_exif() -> bytes:
    """Return EXIF data with the signature as ``Software``, for a WebP."""
    exif = PIL.Image.Exif()
    exif[_SOFTWARE_TAG] = PROGRAM
    return exif.tobytes()


def _is_signed_crate(path: str | os.PathLike[str]) -> bool:
    """Return True if a binary USD has the signature in its custom data; False if USD is not installed."""
    try:
        from pxr import Sdf, Tf
    except ImportError:
        return False
    try:
        layer = Sdf.Layer.OpenAsAnonymous(str(path))
    except Tf.ErrorException:
        return False
    return layer is not None and layer.customLayerData.get("program") == PROGRAM


def is_signed(path: str | os.PathLike[str]) -> bool:
    """Return True if this program wrote a file; False also if it cannot be read."""
    try:
        if kind_of(path) != "file":
            return False
        with open(path, "rb") as stream:
            head = stream.read(_HEAD)
        for start, mark in _MARKS.items():
            if head.startswith(start):
                return mark in head
        if head[8:12] == b"WEBP":
            with PIL.Image.open(path, formats=["WEBP"]) as image:
                return image.getexif().get(_SOFTWARE_TAG) == PROGRAM
        if head.startswith(b"PXR-USDC"):
            return _is_signed_crate(path)
        if head[4:8] == b"ftyp" or head.startswith(b"\x1a\x45\xdf\xa3"):
            options = {"format_whitelist": "mov,mp4,matroska,webm", "protocol_whitelist": "file"}
            with av.open(str(path), options=options) as container:
                return str(container.metadata.get("comment", container.metadata.get("COMMENT", ""))) == PROGRAM
    except (OSError, ValueError, PIL.Image.DecompressionBombError):  # av.FFmpegError is one of them
        return False
    return re.match(rb"(?:%s)%s\b" % (_LEADS, _NAME), head) is not None
