"""Reading of photographs as upright 8-bit RGB, with their EXIF."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from warp_ar.errors import SceneError, SourceError
from warp_ar.pictures import RAW, foreign_words
from warp_ar.scene.exif import PhotoInfo, exposure_in_name, read_exif
from warp_ar.sources.frame_folder import read_frame

Image = NDArray[np.uint8]

ARITHMETIC = 0.02
"""Largest relative deviation from equal differences at which numbers in names count pictures instead of exposures."""


@dataclasses.dataclass(frozen=True)
class Photograph:
    """One photograph."""

    path: Path
    """Path of the file."""
    image: Image
    """uint8 RGB (height, width, 3), upright."""
    info: PhotoInfo
    """EXIF data."""
    deep: NDArray[np.uint16] | None = None
    """The picture in 16-bit codes; None if the file has 8 bits, or floats."""

    @property
    def name(self) -> str:
        """Return the file's name."""
        return self.path.name

    @property
    def is_raw(self) -> bool:
        """Return True if the file is a raw photograph, whose response is known."""
        return self.path.suffix.lower() in RAW


def read_photograph(path: str | Path) -> Photograph:
    """Read a photograph and its EXIF.

    Raises:
        SourceError: The file is missing, damaged or no picture.
    """
    path = Path(path)
    if path.is_dir():
        raise SourceError(f"{path} is a folder; name the photographs in it, such as {path / '*.jpg'}")
    if not path.is_file():
        raise SourceError(f"there is no photograph {path}")
    if words := foreign_words(path.suffix.lower()):
        raise SourceError(f"{path} is {words}")
    image, frame = read_frame(path)
    try:
        info = read_exif(path)
    except SceneError:
        info = PhotoInfo(image.shape[1], image.shape[0])
    if (info.width, info.height) != (image.shape[1], image.shape[0]):
        info = dataclasses.replace(info, width=image.shape[1], height=image.shape[0])
    deep = frame.picture if frame is not None and frame.picture.dtype == np.uint16 else None
    return Photograph(path, image, info, deep)


def exposures_by_exif(photographs: Sequence[Photograph]) -> tuple[float, ...] | None:
    """Return the exposure T ISO / (100 N^2) of every photograph; None if one of them has no exposure time.

    Raises:
        SourceError: Only some photographs state sensitivity or aperture.
    """
    exposures = [photo.info.exposure for photo in photographs]
    if any(exposure is None for exposure in exposures):
        return None
    for what in ("iso", "f_number"):
        told = [getattr(photo.info, what) is not None for photo in photographs]
        if any(told) and not all(told):
            name = photographs[told.index(False)].path
            raise SourceError(f"{name}: its EXIF lacks {what}, which others of the bracket have; give --exposures")
    return tuple(exposure for exposure in exposures if exposure is not None)


def exposures_by_name(photographs: Sequence[Photograph]) -> tuple[float, ...] | None:
    """Return the exposure times in seconds that file names state; None if they state none or number the pictures."""
    told = [exposure_in_name(photo.path) for photo in photographs]
    times = [time for time in told if time is not None]
    if len(times) != len(photographs) or len(set(times)) < len(times) or len(times) < 2:
        return None
    numbers = np.sort(1.0 / np.array(times))
    steps = np.diff(numbers)
    counted = steps.max() - steps.min() <= ARITHMETIC * steps.max()
    if numbers[-1] < 1.5 * numbers[0] or (counted and (len(numbers) > 2 or steps[0] < 3)):
        return None
    return tuple(times)
