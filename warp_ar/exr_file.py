"""OpenEXR files: pictures read as linear light; files that are written whole, or not at all.

OpenEXR writes through a buffer whose last part reaches the disk when the file is closed, and does not look at what
became of it: on a full disk a file may lack its end without a word. Here the end is looked at.
"""

from __future__ import annotations

import errno
import os
import pathlib
import struct
from typing import Any

import numpy as np
import numpy.typing as npt
import OpenEXR

from warp_ar.errors import WarpArError, reason
from warp_ar.files import limits, too_much
from warp_ar.signals import REC_709, converted

_LINES = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256)
"""Rows of a chunk, by the number of the compression: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB."""
_MAGIC = b"\x76\x2f\x31\x01"
_SEVERAL_PARTS = 0x10
"""Bit of the second byte of the version's four."""


def exr_problem(path: pathlib.Path, error: BaseException) -> str:
    """Why OpenEXR could not read a file that is there, in words."""
    try:
        with path.open("rb") as stream:
            start = stream.read(len(_MAGIC))
    except OSError as problem:
        return reason(problem)
    return reason(error) if start == _MAGIC else "it is another kind of file"


def read_linear_exr(path: pathlib.Path, error: type[WarpArError], label: str) -> npt.NDArray[np.float32]:
    """Linear RGB of an OpenEXR's first part, in Rec. 709's primaries.

    Args:
        path: The file; it has channels R, G and B, or Y for grey.
        error: What to raise.
        label: What messages call the picture.

    Returns:
        (height, width, 3) of the display window; black where the file holds nothing of it.

    Raises:
        WarpArError: As ``error``: it is no OpenEXR, damaged, too large, or has other channels.
    """
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            header = dict(file.header())
        windows = [
            [np.asarray(corner, np.int64) for corner in header[name]] for name in ("dataWindow", "displayWindow")
        ]
        sizes = [tuple(int(side) for side in high - low + 1) for low, high in windows]
    except (RuntimeError, OSError, ValueError, KeyError) as problem:
        raise error(f"{label} cannot be read as OpenEXR: {exr_problem(path, problem)}") from problem
    for width, height in sizes:
        if width * height > limits().picture_pixels:
            raise error(too_much(f"{label} is {width}x{height}: it", width * height, "pixels", "picture_pixels"))
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}
    except (RuntimeError, OSError, ValueError, KeyError) as problem:
        raise error(f"{label} cannot be read as OpenEXR: {exr_problem(path, problem)}") from problem
    names = "RGB" if {"R", "G", "B"} <= channels.keys() else "YYY"
    if names[0] not in channels:
        raise error(f"{label} has channels {', '.join(channels)}; R, G and B, or Y, are needed")
    if len({channels[name].shape for name in names}) > 1:
        raise error(f"{label} has channels of several sizes; R, G and B of one size are needed")
    picture = np.stack([channels[name].astype(np.float32) for name in names], -1)
    told = header.get("chromaticities")
    source: Any = REC_709 if told is None else tuple(map(float, told))
    return _in_window(converted(picture, source, REC_709), *windows)


def _in_window(picture: npt.NDArray[np.float32], data: Any, display: Any) -> npt.NDArray[np.float32]:
    """What of a picture of one window lies in another, which may hold more."""
    (low, _), (first, last) = data, display
    (left, top), (width, height) = low - first, last - first + 1
    rows, columns = picture.shape[:2]
    if (left, top, columns, rows) == (0, 0, width, height):
        return picture
    out = np.zeros((height, width, 3), np.float32)
    y0, y1, x0, x1 = max(top, 0), min(top + rows, height), max(left, 0), min(left + columns, width)
    if y0 < y1 and x0 < x1:
        out[y0:y1, x0:x1] = picture[y0 - top : y1 - top, x0 - left : x1 - left]
    return out


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
    """Check that a file that was written does not end before its last chunk does.

    Args:
        path: The file; its parts are of rows, not of tiles.

    Raises:
        OSError: It does, with what the system says of the rest.
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
