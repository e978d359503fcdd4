"""How this program signs the files that it writes, and knows them again.

A PNG says it in its text, an OpenEXR and an HDR in their headers, a video in its comment, a report or a calibration in
its first key, a response in its first line, a glTF as its generator, a USD in text among its own data.
"""

from __future__ import annotations

import os
import re
import struct
import zlib

import av

from warp_ar.files import kind_of

PROGRAM = "warp_ar"
"""How this program signs what it writes."""

_HEAD = 4096
"""Bytes at the start of a file in which its signature stands, but for videos."""


# What stands before it in text: JSON's first key (OpenCV's JSON and YAML say their version first), a comment.
_LEADS = rb"""\s*\{\s*"program":\s*"|%YAML[: ][\d.]+\s*(?:---\s*)?program: "?|""" + (
    rb"""<\?xml version="1.0"\?>\s*<opencv_storage>\s*<program>"?|# """
)


def sign_png(data: bytes) -> bytes:
    """A PNG with the signature as its ``Software``, behind the header, which takes 33 bytes."""
    body = b"tEXtSoftware\0" + PROGRAM.encode()
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    return data[:33] + chunk + data[33:]


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
    if head.startswith(b"%PDF-"):
        return head.split(b"\n", 3)[2:3] == [b"% " + name]
    if head.startswith(b"#usda "):
        return b'string program = "' + name + b'"' in head
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
