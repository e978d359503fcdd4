"""Linear pictures: reads OpenEXR and Radiance files, and writes complete OpenEXR files or none.

OpenEXR buffers its output, writes the last part when the file is closed, and ignores errors of that write. On a full
disk a file may thus be cut off without an error, so the end of each written file is checked here.
"""

from __future__ import annotations

import dataclasses
import errno
import functools
import os
import pathlib
import re
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import OpenEXR

from warp_ar.errors import WarpArError, reason, say
from warp_ar.files import check_size, is_file, read_bytes, store
from warp_ar.signals import AP0, AP1, P3_D65, REC_709, REC_2020, are_primaries, converted
from warp_ar.signature import PROGRAM

LARGEST = 65504.0
"""Largest half float; infinite values are replaced by it."""
_HDR_HEAD = 1 << 16
"""Bytes within which the size of a Radiance picture must stand; its header lists all programs that processed it."""
_MAGIC = b"\x76\x2f\x31\x01"
_SPACES = {
    "lin_rec709_scene": REC_709,
    "lin_rec2020_scene": REC_2020,
    "lin_p3d65_scene": P3_D65,
    "lin_ap0_scene": AP0,
    "lin_ap1_scene": AP1,
}
"""Primaries by the value of the attribute ``colorInteropID`` (ASWF, Color Interop Forum)."""


@dataclasses.dataclass(frozen=True)
class LinearPicture:
    """Linear radiance from a file."""

    color: npt.NDArray[np.float32]
    """Finite RGB with the primaries and white of Rec. 709, (height, width, 3); negative values are kept."""
    header: Mapping[str, Any]
    """Attributes of an OpenEXR file; empty for a Radiance file."""
    others: Mapping[str, npt.NDArray[np.float32]]
    """Other channels of an OpenEXR file by name, (height, width), finite."""


def read_linear_picture(path: pathlib.Path, error: type[WarpArError], label: str) -> LinearPicture:
    """Read a picture of linear light: Radiance's HDR by its ending, else OpenEXR.

    All frames, lights, environments and emission maps are read by this function.

    Follows:
        OpenEXR: first part with R G B or Y, half or float, display window (black without data), chromaticities,
        colorInteropID, ACES containers, envmap; HDR: PRIMARIES, EXPOSURE, COLORCORR, rows and columns in any order.

    Names:
        axes taken; parts not taken; EXPOSURE, COLORCORR; VIEW, PIXASPECT; pixelAspectRatio,
        adoptedNeutral, another colorInteropID; values not finite (NaN: 0, infinity: 65,504).

    Args:
        path: The file.
        error: Class of the error to raise.
        label: Name of the picture in messages.

    Raises:
        WarpArError: As ``error``: damaged; other channels; deep pixels; HDR of CIE XYZ or a GAMMA.
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
    """Return the attributes of an OpenEXR picture; `read_linear_picture` describes the arguments.

    Raises:
        WarpArError: As ``error``: the file does not exist, is too large or cannot be read.
    """
    return _picture_part(path, error, label, header_only=True)[0]


def _picture_part(
    path: pathlib.Path, error: type[WarpArError], label: str, **how: bool
) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
    """Return attributes and channels of an OpenEXR's first part with R, G and B, or Y, else of its first part."""
    if not is_file(path):
        raise error(f"there is no file {label}")
    try:
        with path.open("rb") as stream:
            if stream.read(len(_MAGIC)) != _MAGIC:
                raise ValueError("it is another kind of file")
        with OpenEXR.File(str(path), **how) as file:
            headers = [dict(part.header) for part in file.parts]
            for window in (header[name] for header in headers for name in ("dataWindow", "displayWindow")):
                check_size(*_size_of(window), error, label)
            names = [{channel.name for channel in header["channels"]} for header in headers]
            number = next((k for k, own in enumerate(names) if {"R", "G", "B"} <= own or "Y" in own), 0)
            channels = {name: np.asarray(one.pixels) for name, one in file.parts[number].channels.items()}
    except (RuntimeError, OSError, ValueError, LookupError) as problem:
        if isinstance(problem, WarpArError):
            raise
        raise error(f"{label} cannot be read as OpenEXR: {reason(problem)}") from problem
    if len(headers) > 1:
        shown = [str(header.get("name")) for header in headers]
        every = path.with_stem("*")  # one message for a folder of frames
        say_once(f"{every} has the parts {', '.join(shown)}; {shown[number]} is taken")
    if headers[number].get("type") in (OpenEXR.deepscanline, OpenEXR.deeptile):
        raise error(f"{label} is a deep OpenEXR; save it flat, with one value of each channel for a pixel")
    return headers[number], channels


@functools.cache
def say_once(text: str) -> None:
    """Print a line to stderr unless it was printed before."""
    say(text)


def _read_exr(path: pathlib.Path, error: type[WarpArError], label: str) -> LinearPicture:
    _picture_part(path, error, label, header_only=True)  # checks sizes before pixels are read
    header, channels = _picture_part(path, error, label, separate_channels=True)
    names = "RGB" if {"R", "G", "B"} <= channels.keys() else "YYY"
    mixed = bool({"RY", "BY"} & channels.keys()) or {"X", "Z"} <= channels.keys()  # chroma, CIE XYZ
    if names[0] not in channels or (names == "YYY" and mixed):
        raise error(f"{label} has channels {', '.join(channels)}; R, G and B, or Y, are needed")
    windows = header["dataWindow"], header["displayWindow"]
    shape = _size_of(windows[0])[::-1]
    if any(channels[name].shape != shape for name in names):
        raise error(f"{label} has channels of several sizes; R, G and B of its window's size are needed")
    said, space = header.get("chromaticities"), str(header.get("colorInteropID", ""))
    if said is None:
        said = AP0 if header.get("acesImageContainerFlag") == 1 else _SPACES.get(space)
        if said is None and space not in ("", "data", "unknown"):
            say_once(f"{label}: its colorInteropID {space} is not followed; expected one of {', '.join(_SPACES)}")
    white = np.asarray(REC_709 if said is None else said)[6:]
    neutral = np.asarray(header.get("adoptedNeutral", white))
    if header.get("pixelAspectRatio", 1.0) != 1.0 or not np.allclose(neutral, white, atol=1e-3):
        say_once(f"{label}: pixelAspectRatio and adoptedNeutral of its header are not followed; it is taken as it lies")
    with np.errstate(over="ignore"):
        color = np.stack([channels[name].astype(np.float32) for name in names], -1)
    color = _in_rec_709(color, said, error, label)
    others = {
        name: _in_window(values.astype(np.float32), *windows)
        for name, values in channels.items()
        if name not in names and values.shape == shape
    }
    return LinearPicture(_in_window(color, *windows), header, others)


def _read_hdr(path: pathlib.Path, error: type[WarpArError], label: str) -> LinearPicture:
    data = read_bytes(path, "picture_bytes", error, label)
    size = re.search(rb"\n([-+])([XY]) (\d{1,9}) ([-+])([XY]) (\d{1,9})\n", data[:_HDR_HEAD])
    if not data.startswith(b"#?") or size is None or size[2] == size[5]:
        raise error(f"{label}: no Radiance picture with a line of its size, such as -Y 512 +X 1024")
    head = data[: size.start() + 1].decode("latin-1")
    if "_xyze" in head:
        raise error(f"{label}: the Radiance picture holds CIE XYZ; save it as RGB (FORMAT=32-bit_rle_rgbe)")
    lines, length = int(size[3]), int(size[6])
    check_size(length, lines, error, label)
    # OpenCV reads this order of pixels only.
    plain = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (lines, length)
    picture = cv2.imdecode(np.frombuffer(plain + data[size.end() :], np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.ndim != 3 or picture.dtype != np.float32:
        raise error(f"{label}: the Radiance picture is damaged")
    signs = {size[2]: size[1], size[5]: size[4]}
    picture = picture.swapaxes(0, 1) if size[2] == b"X" else picture
    picture = picture[:: 1 if signs[b"Y"] == b"-" else -1, :: 1 if signs[b"X"] == b"+" else -1, ::-1]

    def numbers(key: str, count: int) -> npt.NDArray[np.float64]:
        """Return the numbers of all header lines with a key, (lines, count)."""
        said = re.findall(rf"(?m)^{key}[ \t]*=(.*)$", head)
        try:
            return np.array([line.split() for line in said], np.float64).reshape(len(said), count)
        except ValueError:
            right = "a number" if count == 1 else f"{count} numbers"
            raise error(f"{label}: {key}={said[0].strip()[:40]}: expected {right}") from None

    factor = numbers("EXPOSURE", 1).prod(0) * numbers("COLORCORR", 3).prod(0)
    if not ((factor > 0.0) & np.isfinite(factor)).all():
        raise error(f"{label}: its EXPOSURE and COLORCORR multiply to {factor.tolist()}; expected factors above 0")
    if (numbers("GAMMA", 1) != 1.0).any():
        raise error(f"{label}: its values are of GAMMA {numbers('GAMMA', 1)[0, 0]:g}; save it as linear light")
    if (factor != 1.0).any():
        shown = ", ".join(f"{value:g}" for value in dict.fromkeys(factor.tolist()))
        say_once(f"{label}: its values were multiplied by {shown} (EXPOSURE, COLORCORR); that is divided out")
    if (numbers("PIXASPECT", 1).prod() != 1.0) or re.search("(?m)^VIEW[ \t]*=", head):
        say_once(f"{label}: VIEW and PIXASPECT of its header are not followed; it is taken as it lies")
    said = numbers("PRIMARIES", 8)
    primaries = tuple(said[-1]) if said.any() else None  # Photoshop writes zeros
    light = picture / factor.astype(np.float32) if (factor != 1.0).any() else picture
    return LinearPicture(_in_rec_709(light, primaries, error, label), {}, {})


def _in_rec_709(
    color: npt.NDArray[Any], chromaticities: Any, error: type[WarpArError], label: str
) -> npt.NDArray[np.float32]:
    """Return colours converted from a file's primaries to Rec. 709; finite colours stay finite."""
    if chromaticities is None:
        return np.ascontiguousarray(color, np.float32)
    source: Any = tuple(map(float, chromaticities))
    if len(source) != 8 or not are_primaries(source):
        shown = " ".join(f"{value:g}" for value in source)
        raise error(f"{label}: its chromaticities are {shown}; expected x and y of red, green, blue and white")
    with np.errstate(invalid="ignore", over="ignore"):
        return converted(color, source, REC_709)


def _size_of(window: Any) -> tuple[int, int]:
    """Return width and height of a window, whose first and last pixels are inclusive."""
    first, last = (np.asarray(corner, np.int64) for corner in window)
    width, height = (int(side) for side in last - first + 1)
    return width, height


def _in_window(picture: npt.NDArray[np.float32], data: Any, display: Any) -> npt.NDArray[np.float32]:
    """Return the display window's part of a picture that covers the data window; pixels without data are 0."""
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


def exr_header(**attributes: Any) -> dict[str, Any]:
    """Return a header for a losslessly compressed scanline picture with the program's signature and more attributes."""
    kind = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    return {**kind, "software": PROGRAM, **attributes}


def store_exr(path: pathlib.Path, image: OpenEXR.File) -> None:
    """Write a picture with `write_exr` under a temporary name, then rename it.

    Raises:
        SinkError: The file cannot be written.
    """
    store(path, functools.partial(write_exr, image=image))


def write_exr(path: pathlib.Path, image: OpenEXR.File) -> None:
    """Write a scanline picture of one or more parts, and read it again to check it.

    Args:
        path: The file; an existing one is replaced.
        image: The picture; its parts have the type ``OpenEXR.scanlineimage``.

    Raises:
        OSError: The file could not be written completely.
        RuntimeError: OpenEXR cannot write this picture.
    """
    image.write(str(path))
    size = path.stat().st_size
    with path.open("ab", buffering=0) as stream:
        # If the end of the file did not fit, one more byte does not either, and this write raises the system's error.
        stream.write(b"\0")
        stream.truncate(size)
    with OpenEXR.File(str(path)) as written:  # parts that lack their end are not listed
        if len(written.parts) != len(image.parts):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
