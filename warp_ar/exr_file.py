"""OpenEXR files that are written whole, or not at all.

OpenEXR writes through a buffer whose last part reaches the disk when the file is closed, and does not look at what
became of it: on a full disk a file may lack its end without a word. Here the end is looked at.
"""

from __future__ import annotations

import errno
import os
import pathlib
import struct
from collections.abc import Mapping
from typing import Any

import numpy.typing as npt
import OpenEXR

_LINES = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256)
"""Rows of a chunk, by the number of the compression: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB."""
_MAGIC = b"\x76\x2f\x31\x01"


def write_exr(path: pathlib.Path, header: Mapping[str, Any], channels: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write one picture of rows.

    Args:
        path: The file, which is replaced.
        header: Attributes; ``type`` must be ``OpenEXR.scanlineimage``.
        channels: By name, (height, width) or (height, width, 3 or 4).

    Raises:
        OSError: Not all of it could be written.
        RuntimeError: OpenEXR cannot write this.
    """
    OpenEXR.File(dict(header), dict(channels)).write(str(path))
    check_whole_exr(path)


def check_whole_exr(path: pathlib.Path) -> None:
    """Raise OSError if a file that was written ends before its last chunk does, with what the system says of the rest.

    Args:
        path: The file: one part, rows, no tiles.
    """
    with path.open("rb") as stream:
        data = stream.read()
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
    """Where the last chunk ends, by the table that points to chunks."""
    if data[:4] != _MAGIC:
        raise ValueError
    at, lines, rows = 8, 0, 0
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
    count = -(-rows // lines)
    table = struct.unpack_from(f"<{count}Q", data, at + 1)
    if min(table) < at + 1 + 8 * count:
        raise ValueError  # the table is written last
    last = int(max(table))
    _, size = struct.unpack_from("<ii", data, last)
    return last + 8 + int(size)
