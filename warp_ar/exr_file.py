"""OpenEXR files that are written whole, or not at all.

OpenEXR writes through a buffer whose last part reaches the disk when the file is closed, and does not look at what
became of it: on a full disk a file may lack its end without a word. Here the end is looked at.
"""

from __future__ import annotations

import errno
import os
import pathlib
import struct

import OpenEXR

_LINES = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256)
"""Rows of a chunk, by the number of the compression: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB."""
_MAGIC = b"\x76\x2f\x31\x01"
_SEVERAL_PARTS = 0x10
"""Bit of the second byte of the version's four."""


def write_exr(path: pathlib.Path, image: OpenEXR.File) -> None:
    """Write a picture of rows, or several.

    Args:
        path: The file, which is replaced.
        image: What it is to hold; its parts are of the type ``OpenEXR.scanlineimage``.

    Raises:
        OSError: Not all of it could be written.
        RuntimeError: OpenEXR cannot write this.
    """
    image.write(str(path))
    check_whole_exr(path)


def check_whole_exr(path: pathlib.Path) -> None:
    """Raise OSError if a file that was written ends before its last chunk does, with what the system says of the rest.

    Args:
        path: The file; its parts are of rows, not of tiles.
    """
    data = path.read_bytes()
    try:
        end = _end_of_chunks(data)
    except (struct.error, ValueError, IndexError):
        end = len(data) + 1  # not even the header is whole
    if end <= len(data):
        return
    with path.open("ab", buffering=0) as stream:
        written = stream.write(bytes(end - len(data)))
        # The first write beyond what fits is cut short, the next one fails and says why.
        while written < end - len(data):
            written += stream.write(bytes(end - len(data) - written))
    raise OSError(errno.EIO, os.strerror(errno.EIO))


def _end_of_chunks(data: bytes) -> int:
    """Where the last chunk ends, by the tables that point to chunks."""
    if data[:4] != _MAGIC:
        raise ValueError
    several = bool(data[5] & _SEVERAL_PARTS)
    count, at = _read_header(data, 8)
    chunks = count
    while several and data[at] != 0:
        count, at = _read_header(data, at)
        chunks += count
    at += several
    table = struct.unpack_from(f"<{chunks}Q", data, at)
    if min(table) < at + 8 * chunks:
        raise ValueError  # the table is written last
    last = int(max(table)) + (4 if several else 0)  # behind the number of the part
    _, size = struct.unpack_from("<ii", data, last)
    return last + 8 + int(size)


def _read_header(data: bytes, at: int) -> tuple[int, int]:
    """Chunks of a part by its header, and where that ends."""
    lines, rows = 0, 0
    while (name_end := data.index(b"\0", at)) > at:
        name = data[at:name_end]
        kind_end = data.index(b"\0", name_end + 1)
        (size,) = struct.unpack_from("<i", data, kind_end + 1)
        value, at = kind_end + 5, kind_end + 5 + size
        if name == b"compression":
            lines = _LINES[data[value]]
        elif name == b"dataWindow":
            _, low, _, high = struct.unpack_from("<4i", data, value)
            rows = high - low + 1
    if lines < 1 or rows < 1:
        raise ValueError
    return -(-rows // lines), at + 1
