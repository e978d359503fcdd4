"""How this program signs the files that it writes, and knows them again.

A PNG says it in its text, an OpenEXR and an HDR in their headers, a WebP in its EXIF, a video in its comment, a report
or a calibration in its first key, a page, a chart or a text in a comment at its start, a response in its first line, a
glTF as its generator, a USD among its own data.
"""

from __future__ import annotations

import os
import re
import struct
import zlib

import av
from PIL import Image

from warp_ar.files import kind_of

PROGRAM = "warp_ar"
"""How this program signs what it writes."""

_HEAD = 4096
"""Bytes at the start of a file in which its signature stands, but for videos."""


# What stands before it in text: JSON's first key (OpenCV's JSON and YAML say their version first), a comment.
_LEADS = rb"""\s*\{\s*"program":\s*"|%YAML[: ][\d.]+\s*(?:---\s*)?program: "?|""" + (
    rb"""<\?xml version="1.0"\?>\s*<opencv_storage>\s*<program>"?|# |(?:<!doctype html>\s*)?<!-- """
)
COMMENT = f"<!-- {PROGRAM} -->"
"""What stands at the start of a chart or a text in Markdown, and behind the document type of a page."""
_SOFTWARE_TAG = 0x0131
"""Of EXIF."""


def sign_png(data: bytes) -> bytes:
    """A PNG with the signature as its ``Software``, behind the header, which takes 33 bytes."""
    body = b"tEXtSoftware\0" + PROGRAM.encode()
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    return data[:33] + chunk + data[33:]


def software_exif() -> bytes:
    """EXIF with the signature as its ``Software``, for a WebP."""
    exif = Image.Exif()
    exif[_SOFTWARE_TAG] = PROGRAM
    return exif.tobytes()


def _is_signed_webp(path: str | os.PathLike[str]) -> bool:
    """Whether a WebP's chunks, of which EXIF is among the last, hold the signature."""
    with open(path, "rb") as stream:
        stream.seek(12)
        while len(head := stream.read(8)) == 8:
            kind, size = head[:4], int.from_bytes(head[4:], "little")
            if kind == b"EXIF":
                return PROGRAM.encode() + b"\0" in stream.read(min(size, _HEAD))
            stream.seek(size + size % 2, os.SEEK_CUR)
    return False


def _is_signed_crate(path: str | os.PathLike[str]) -> bool:
    """Whether a USD in binary has the signature among its own data; where USD is not installed nothing tells."""
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
    """Whether this program wrote a file; what cannot be read, it did not."""
    try:
        if kind_of(path) != "file":
            return False
        with open(path, "rb") as stream:
            head = stream.read(_HEAD)
    except OSError:
        return False
    name = PROGRAM.encode()
    if head.startswith(b"\x89PNG"):
        return b"tEXtSoftware\0" + name in head
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return _is_signed_webp(path)
    if head.startswith(b"%PDF-"):
        return head.split(b"\n", 3)[2:3] == [b"% " + name]
    if head.startswith(b"#usda "):
        return b'string program = "' + name + b'"' in head
    if head.startswith(b"PXR-USDC"):
        return _is_signed_crate(path)
    if head.startswith(b"glTF"):
        return b'"generator":"' + name + b'"' in head
    if head.startswith(b"#?RADIANCE\n"):
        return head.split(b"\n", 2)[1:2] == [b"SOFTWARE=" + name]
    if head.startswith(b"\x76\x2f\x31\x01"):
        return b"software\0string\0" + struct.pack("<I", len(name)) + name in head
    if head[4:8] == b"ftyp" or head.startswith(b"\x1a\x45\xdf\xa3"):
        try:
            options = {"format_whitelist": "mov,mp4,matroska,webm", "protocol_whitelist": "file"}
            with av.open(str(path), options=options) as container:
                return str(container.metadata.get("comment", container.metadata.get("COMMENT", ""))) == PROGRAM
        except (av.FFmpegError, OSError, ValueError):
            return False
    return re.match(rb"(?:%s)%s\b" % (_LEADS, name), head) is not None
