"""Pictures of linear light: OpenEXR and Radiance files read; OpenEXRs written whole, or not at all.

OpenEXR writes through a buffer whose last part reaches the disk when the file is closed, and does not look at what
became of it: on a full disk a file may lack its end without a word. Here the end is looked at.
"""

from __future__ import annotations

import dataclasses
import errno
import functools
import os
import pathlib
import re
import struct
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import OpenEXR

from warp_ar.errors import WarpArError, reason, say
from warp_ar.files import is_file, limits, read_bytes, too_much
from warp_ar.signals import REC_709, are_primaries, converted

_LINES = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256)
"""Rows of a chunk, by the number of the compression: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB."""
LARGEST = 65504.0
"""Largest half float: what an infinite value is read as."""
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


@dataclasses.dataclass(frozen=True)
class LinearPicture:
    """Linear light from a file."""

    color: npt.NDArray[np.float32]
    """RGB in Rec. 709's primaries and white, (height, width, 3); finite, with the negative values of the file."""
    header: Mapping[str, Any]
    """Attributes of an OpenEXR; empty for Radiance's format."""
    others: Mapping[str, npt.NDArray[np.float32]]
    """Other channels of an OpenEXR by name, (height, width), finite."""


def read_linear_picture(path: pathlib.Path, error: type[WarpArError], label: str) -> LinearPicture:
    """Read a picture of linear light: Radiance's HDR by its ending, else OpenEXR.

    The one reader of frames, light, environments and emission. An OpenEXR's first part is read: channels R, G and B, or
    Y for grey, within its display window, black where it holds nothing. Chromaticities are followed, with the white
    adapted. NaN becomes 0 and infinity the largest half float, alike for all readers, and a line on stderr says so.

    Args:
        path: The file.
        error: Class of the error to raise.
        label: Name of the picture in messages.

    Raises:
        WarpArError: As ``error``: it is another kind of file, damaged, too large, or has other channels.
    """
    picture = _read_hdr(path, error, label) if path.suffix.lower() == ".hdr" else _read_exr(path, error, label)
    wrong = sum(values.size - int(np.isfinite(values).sum()) for values in (picture.color, *picture.others.values()))
    if not wrong:
        return picture
    say_once(f"{label}: {wrong:,} values are not finite; NaN is read as 0, infinity as {LARGEST:g}")
    finite = functools.partial(np.nan_to_num, nan=0.0, posinf=LARGEST, neginf=0.0)
    others = {name: finite(values) for name, values in picture.others.items()}
    return LinearPicture(finite(picture.color), picture.header, others)


def read_exr_header(path: pathlib.Path, error: type[WarpArError], label: str) -> dict[str, Any]:
    """Read the attributes of an OpenEXR's first part; arguments as `read_linear_picture`.

    Raises:
        WarpArError: As ``error``: there is no such file, it is too large or cannot be read.
    """
    if not is_file(path):
        raise error(f"there is no file {label}")
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            header = dict(file.header())
        for name in ("dataWindow", "displayWindow"):
            width, height = _size_of(header[name])
            if not (width > 0 and height > 0):
                raise error(f"{label} cannot be read as OpenEXR: its {name} is {width}x{height}")
            if width * height > limits().picture_pixels:
                raise error(too_much(f"{label} is {width}x{height}: it", width * height, "pixels", "picture_pixels"))
    except (RuntimeError, OSError, ValueError, KeyError) as problem:
        if isinstance(problem, WarpArError):
            raise
        raise error(f"{label} cannot be read as OpenEXR: {exr_problem(path, problem)}") from problem
    return header


@functools.cache
def say_once(text: str) -> None:
    """Print a line to stderr, the first time that it is to be said."""
    say(text)


def _read_exr(path: pathlib.Path, error: type[WarpArError], label: str) -> LinearPicture:
    header = read_exr_header(path, error, label)
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}
    except (RuntimeError, OSError, ValueError, KeyError) as problem:
        raise error(f"{label} cannot be read as OpenEXR: {exr_problem(path, problem)}") from problem
    names = "RGB" if {"R", "G", "B"} <= channels.keys() else "YYY"
    if names[0] not in channels:
        raise error(f"{label} has channels {', '.join(channels)}; R, G and B, or Y, are needed")
    shape = channels[names[0]].shape
    if any(channels[name].shape != shape for name in names):
        raise error(f"{label} has channels of several sizes; R, G and B of one size are needed")
    windows = header["dataWindow"], header["displayWindow"]
    with np.errstate(over="ignore"):
        color = np.stack([channels[name].astype(np.float32) for name in names], -1)
    color = _in_rec_709(color, header.get("chromaticities"), error, label)
    others = {
        name: _in_window(values.astype(np.float32), *windows)
        for name, values in channels.items()
        if name not in names and values.shape == shape
    }
    return LinearPicture(_in_window(color, *windows), header, others)


def _read_hdr(path: pathlib.Path, error: type[WarpArError], label: str) -> LinearPicture:
    data = read_bytes(path, "picture_bytes", error, label)
    size = re.search(rb"\n-Y (\d{1,9}) \+X (\d{1,9})\n", data[:4096])
    if not data.startswith(b"#?") or size is None:
        raise error(f"{label}: no Radiance picture with rows from the top (-Y ... +X ...)")
    height, width = int(size[1]), int(size[2])
    if width * height > limits().picture_pixels:
        raise error(too_much(f"{label} is {width}x{height}: it", width * height, "pixels", "picture_pixels"))
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.ndim != 3 or picture.dtype != np.float32:
        raise error(f"{label}: the Radiance picture is damaged")
    said = re.search(rb"\nPRIMARIES\s*=\s*([-+.\deE \t]+)\n", data[: size.start() + 1])
    chromaticities = tuple(map(float, said[1].split())) if said else None
    return LinearPicture(_in_rec_709(picture[..., 2::-1], chromaticities, error, label), {}, {})


def _in_rec_709(
    color: npt.NDArray[Any], chromaticities: Any, error: type[WarpArError], label: str
) -> npt.NDArray[np.float32]:
    """Return colours of a file's primaries in those of Rec. 709, finite where they were."""
    if chromaticities is None:
        return np.ascontiguousarray(color, np.float32)
    source: Any = tuple(map(float, chromaticities))
    if len(source) != 8 or not are_primaries(source):
        shown = " ".join(f"{value:g}" for value in source)
        raise error(f"{label}: its chromaticities are {shown}; expected x and y of red, green, blue and white")
    with np.errstate(invalid="ignore", over="ignore"):
        return converted(color, source, REC_709)


def _size_of(window: Any) -> tuple[int, int]:
    """Return width and height of a window: its first and its last pixel are inside."""
    first, last = (np.asarray(corner, np.int64) for corner in window)
    width, height = (int(side) for side in last - first + 1)
    return width, height


def _in_window(picture: npt.NDArray[np.float32], data: Any, display: Any) -> npt.NDArray[np.float32]:
    """Return the part of a picture of the data window that lies in the display window, with 0 around it."""
    left, top = (int(side) for side in np.asarray(data[0], np.int64) - np.asarray(display[0], np.int64))
    width, height = _size_of(display)
    rows, columns = picture.shape[:2]
    if (left, top, columns, rows) == (0, 0, width, height):
        return picture
    out = np.zeros((height, width, *picture.shape[2:]), np.float32)
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
