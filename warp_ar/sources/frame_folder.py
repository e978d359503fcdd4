"""Folder of images as a source of frames.

Every picture is converted to 8-bit RGB. Grey is repeated in three channels. Alpha is dropped without blending, because
a camera's colour does not depend on it. 16-bit values v become round(v / 257), so that 65535 becomes 255. Linear
radiance (OpenEXR, TIFF of floats) is encoded as sRGB with values above 1 clipped; primaries that an OpenEXR states are
converted to Rec. 709. The deep frame keeps the original bit depth. The image's orientation tag is applied. A folder
with alternating exposures lists them in a file beside the images, ``exposures.json``.
"""

from __future__ import annotations

import math
import os
import pathlib
from collections.abc import Generator, Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.errors import SourceError
from warp_ar.exr_file import read_linear_picture
from warp_ar.files import parse_json, read_text
from warp_ar.pictures import RAW, foreign_words, read_picture, read_raw
from warp_ar.scene.pose_file import natural_key
from warp_ar.sources.deep_frame import DeepFrame, finite_light, srgb8
from warp_ar.sources.source import (
    DEFAULT_FPS,
    Frame,
    RecordedSource,
    check_size,
    distinct,
    existing_path,
    names_in,
    nearest_name,
)

Image = npt.NDArray[np.uint8]

LINEAR_SUFFIX = ".exr"
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", LINEAR_SUFFIX})
"""Suffixes of frames for `FrameFolder`; other files in a folder are ignored."""

SIDECAR = "exposures.json"
"""Name of an optional file in a frame folder with exposure times in seconds: by file name, ``{"0000.png": 0.008,
...}``, or as a list that repeats over the frames, ``[0.016, 0.001]``."""


class FrameFolder(RecordedSource):
    """The images of a folder in natural name order (``f2.png`` before ``f10.png``), or one image.

    Args:
        path: The folder or image.
        fps: Frames per second; frame n is shown at n / fps.
        loop: Start again at the end.
        exposures: Exposure times in seconds that repeat over the images, instead of those in ``exposures.json``.

    Raises:
        SourceError: The path does not exist or holds no image, or its first image or its ``exposures.json`` is invalid.
        UsageError: One of ``exposures`` is not a positive number.
    """

    def __init__(
        self,
        path: str | pathlib.Path,
        *,
        fps: float = DEFAULT_FPS,
        loop: bool = False,
        exposures: Sequence[float] = (),
    ) -> None:
        super().__init__(loop=loop, exposures=exposures)
        path = existing_path(pathlib.Path(path))
        folder = path if path.is_dir() else path.parent
        self._paths = [path]
        if path.is_dir():
            images = (name for name in names_in(path) if pathlib.Path(name).suffix.lower() in IMAGE_SUFFIXES)
            self._paths = [path / name for name in sorted(images, key=natural_key)]
        if not self._paths:
            for name in sorted(names_in(path)):
                if words := foreign_words(pathlib.Path(name).suffix.lower()):
                    raise SourceError(f"{path} holds no images that are read; {name} is {words}")
            raise SourceError(f"{path} holds no images; put frames there as {', '.join(sorted(IMAGE_SUFFIXES))}")
        told = _read_exposures(folder)
        self._exposures = told if isinstance(told, dict) else {}
        if isinstance(told, tuple):
            self._cycle = self._cycle or told
        shown = [self._exposures[path.name] for path in self._paths if path.name in self._exposures]
        self.exposures = distinct(self._cycle or shown)
        first, deep = read_frame(self._paths[0])
        height, width, _ = first.shape
        self.deep = "" if deep is None else "codes" if deep.picture.dtype == np.uint16 else "light"
        self.size, self.fps, self.length = (width, height), fps, len(self._paths)
        self.description = f"{path} ({self.length} images, {width}x{height})"

    @property
    def names(self) -> tuple[str, ...]:  # type: ignore[override]
        """Return the paths of the pictures in order."""
        return tuple(path.as_posix() for path in self._paths)

    def _decode(self) -> Generator[Frame, None, None]:
        for index, path in enumerate(self._paths):
            image, deep = read_frame(path)
            check_size(image, self.size, str(path), index)
            kept = deep if self.keeps_depth else None
            yield Frame(index, index / self.fps, image, self._exposures.get(path.name), kept, path.as_posix())


def read_frame(path: pathlib.Path) -> tuple[Image, DeepFrame | None]:
    """Return an image file as 8-bit RGB and, if it has more than 8 bits, as a deep frame.

    Returns:
        8-bit RGB, (height, width, 3), and the deep frame if the file has more than 8 bits, else None.

    Raises:
        SourceError: The file cannot be read, is no picture, is too large, or holds values of an unsupported type.
    """
    label = f"frame {path}"
    if path.suffix.lower() == LINEAR_SUFFIX:
        light = read_linear_picture(path, SourceError, label).color
    else:
        if path.suffix.lower() in RAW:
            picture = read_raw(path, SourceError)
        else:
            picture = read_picture(path, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH, SourceError, label)
        if picture.dtype in (np.uint8, np.uint16):
            image = rgb8(picture, label)
            return image, None if picture.dtype == np.uint8 else DeepFrame(_three_channels(picture), codes=image)
        if picture.dtype not in (np.float32, np.float64):
            raise SourceError(f"{label} holds {picture.dtype} values; 8 or 16 bits, or floats, are needed")
        light = finite_light(_three_channels(picture))
    image = srgb8(light)
    return image, DeepFrame(light, codes=image)


def _three_channels(picture: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a grey, RGB or RGBA picture with three channels, (H, W, 3)."""
    if picture.ndim == 2:
        picture = picture[..., None]
    if picture.shape[2] == 1:
        picture = np.repeat(picture, 3, axis=2)
    return np.ascontiguousarray(picture[..., :3])


def rgb8(picture: npt.NDArray[Any], name: str) -> Image:
    """Return a grey, RGB or RGBA picture of 8 or 16 bits as 8-bit RGB, (H, W, 3).

    Raises:
        SourceError: The picture has another type; the message contains ``name``.
    """
    if picture.dtype == np.uint16:
        # Equals round(v / 257) exactly: 257 is odd, so there are no ties.
        picture = ((picture.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if picture.dtype != np.uint8:
        raise SourceError(f"{name} holds {picture.dtype} values; 8- or 16-bit whole numbers are needed")
    return _three_channels(picture)


def _read_exposures(folder: pathlib.Path) -> dict[str, float] | tuple[float, ...]:
    """Return the exposure times in seconds from a folder's ``exposures.json``.

    Returns:
        Exposure times by file name, or as a list that repeats over the frames; an empty dictionary without the file.
    """
    path = folder / SIDECAR
    if not os.path.lexists(path):
        return {}
    table = parse_json(read_text(path, SourceError, expected="JSON"), str(path), SourceError)
    if not isinstance(table, dict | list) or not table:
        raise SourceError(
            f'{path} must hold an object such as {{"0000.png": 0.008}}, seconds by file name, or a list such as '
            "[0.016, 0.001], seconds that frames have in turn"
        )
    names = names_in(folder)
    for name, seconds in table.items() if isinstance(table, dict) else enumerate(table):
        if isinstance(name, str) and name not in names:
            hint = nearest_name(name, names)
            advice = f"did you mean {hint!r}?" if hint else "it must name files beside it"
            raise SourceError(f"{path} names {name!r}, which is not there; {advice}")
        if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not 0 < seconds < math.inf:
            raise SourceError(f"{path}: {name!r} is {seconds!r}; it must be a positive number of seconds")
    if isinstance(table, list):
        return tuple(map(float, table))
    return {name: float(seconds) for name, seconds in table.items()}
