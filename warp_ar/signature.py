"""Signature of the files that this program writes, by which it knows them again.

A PNG says it in its text, an OpenEXR and an HDR in their headers, a WebP in its EXIF, a video in its comment, a report
or a calibration in its first key, a page, a chart or a text in a comment at its start, a response in its first line, a
glTF as its generator, a USD among its own data.
"""

from __future__ import annotations

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
"""Name by which this program signs what it writes."""

_HEAD = 4096
"""Bytes at the start of a file in which its signature stands, but for videos."""

_NAME = PROGRAM.encode()
_MARKS = {
    b"\x89PNG": b"tEXtSoftware\0" + _NAME,
    b"%PDF-": b"\n% " + _NAME + b"\n",
    b"#usda ": b'string program = "' + _NAME + b'"',
    b"glTF": b'"generator":"' + _NAME + b'"',
    b"#?RADIANCE\n": b"#?RADIANCE\nSOFTWARE=" + _NAME + b"\n",
    b"\x76\x2f\x31\x01": b"software\0string\0" + struct.pack("<I", len(PROGRAM)) + _NAME,
}
"""First bytes of a format, and the signature in its head."""

# What stands before it in text: JSON's first key (OpenCV's JSON and YAML say their version first), a comment.
_LEADS = rb"""\s*\{\s*"program":\s*"|%YAML[: ][\d.]+\s*(?:---\s*)?program: "?|""" + (
    rb"""<\?xml version="1.0"\?>\s*<opencv_storage>\s*<program>"?|# |(?:<!doctype html>\s*)?<!-- """
)
COMMENT = f"<!-- {PROGRAM} -->"
"""Start of a chart or a text in Markdown, and behind the document type of a page."""
_SOFTWARE_TAG = 0x0131
"""EXIF's tag of the software."""


def sign_png(data: bytes) -> bytes:
    """A PNG with the signature as its ``Software``, behind the header, which takes 33 bytes."""
    body = b"tEXtSoftware\0" + _NAME
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    return data[:33] + chunk + data[33:]


def encode_png(picture: npt.NDArray[Any], options: Sequence[int] = ()) -> bytes:
    """A signed PNG of 8 or 16 bits.

    Args:
        picture: Grey (height, width), RGB or RGBA (height, width, 3 or 4).
        options: OpenCV's, for its encoder.
    """
    if picture.ndim == 3:
        picture = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR if picture.shape[2] == 3 else cv2.COLOR_RGBA2BGRA)
    done, data = cv2.imencode(".png", picture, options)
    assert done
    return sign_png(data.tobytes())


def software_exif() -> bytes:
    """EXIF with the signature as its ``Software``, for a WebP."""
    exif = PIL.Image.Exif()
    exif[_SOFTWARE_TAG] = PROGRAM
    return exif.tobytes()


def _is_signed_crate(path: str | os.PathLike[str]) -> bool:
    """Tell whether a USD in binary has the signature among its own data; where USD is not installed nothing tells."""
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
    """Tell whether this program wrote a file; one that cannot be read, it did not."""
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
