"""Exposure and camera by a photograph's EXIF."""

from __future__ import annotations

import dataclasses
import io
import math
import re
import struct
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from PIL import ExifTags, Image

from warp_ar.errors import SceneError
from warp_ar.files import read_bytes
from warp_ar.pictures import check_picture, picture_size
from warp_ar.scene.description import Camera

FULL_FRAME_DIAGONAL: Final = math.hypot(36.0, 24.0)
"""Millimetres: a focal length "in 35 mm film" gives the same angle across this diagonal."""
SENSOR_SHAPES: Final = (1.0, 4 / 3, 3 / 2, 16 / 9, 5 / 4, 18 / 9, 19.5 / 9, 20 / 9)
"""Ratios of sides that cameras have; a picture of another one has been cut."""
SHAPE_TOLERANCE: Final = 0.012
"""Relative: cameras round sides to multiples of 16."""
AGREEING: Final = 0.15
"""Logarithm within which two focal lengths agree: the 35 mm equivalent is a whole number, and rounds by diagonals."""
LEAST_SIDE: Final = 400
"""Pixels along the shorter side below which a picture is a cut-out or a thumbnail."""
_TURNED: Final = (5, 6, 7, 8)
"""EXIF orientations that exchange width and height."""

# What Pillow has been seen to raise on damaged files; it does not document it.
_READING_ERRORS: Final = (
    *(OSError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, MemoryError, SyntaxError),
    *(struct.error, Image.DecompressionBombError),
)


@dataclasses.dataclass(frozen=True)
class PhotoInfo:
    """EXIF of one photograph; None where it does not say."""

    width: int
    """Upright width in pixels."""
    height: int
    """Upright height in pixels."""
    seconds: float | None = None
    """Exposure time."""
    iso: float | None = None
    """Sensitivity."""
    f_number: float | None = None
    """Focal length over aperture."""
    focal_35mm: float | None = None
    """Focal length in millimetres of a full-frame camera with the same view."""
    focal_pixels: float | None = None
    """Focal length, pixels, from the sensor's resolution; None without it."""
    model: str = ""
    """Name of the camera."""

    @property
    def exposure(self) -> float | None:
        """T ISO / (100 N^2), seconds at ISO 100 and f/1: what the picture's brightness is proportional to."""
        if self.seconds is None:
            return None
        return self.seconds * (self.iso or 100.0) / 100.0 / (self.f_number or 1.0) ** 2

    @property
    def is_whole(self) -> bool:
        """Return whether the picture has the shape of a sensor: a cut-out's focal length in pixels is not known."""
        if min(self.width, self.height) < LEAST_SIDE:
            return False
        shape = max(self.width, self.height) / min(self.width, self.height)
        return any(abs(shape / known - 1.0) < SHAPE_TOLERANCE for known in SENSOR_SHAPES[1:])

    @property
    def by_35mm(self) -> float | None:
        """Focal length in pixels by the equivalent for 35 mm film, across the diagonal."""
        if self.focal_35mm is None:
            return None
        return self.focal_35mm / FULL_FRAME_DIAGONAL * math.hypot(self.width, self.height)

    def focal_length(self) -> float | None:
        """Focal length in pixels, None where EXIF does not tell or the picture was cut."""
        if not self.is_whole:
            return None
        return self.by_35mm if self.focal_pixels is None or self.contradiction else self.focal_pixels

    @property
    def contradiction(self) -> str:
        """Words on two tags that give different focal lengths; empty where they agree.

        Programs that resize pictures rewrite the size that the sensor's resolution refers to; the equivalent for 35 mm
        film does not depend on it.
        """
        film, pixels = self.by_35mm, self.focal_pixels
        if film is None or pixels is None or abs(math.log(film / pixels)) < AGREEING:
            return ""
        return (
            f"EXIF contradicts itself: focal length {pixels:.0f} pixels by the sensor's resolution, {film:.0f} by the "
            "35 mm equivalent, which is taken"
        )

    def camera(self, transfer: str | Path = "srgb") -> Camera | None:
        """Pinhole camera with the axis through the picture's middle; None where the focal length is not known."""
        focal = self.focal_length()
        if focal is None:
            return None
        middle = (self.width - 1) / 2, (self.height - 1) / 2
        return Camera(self.width, self.height, focal, focal, *middle, transfer=transfer)


def read_exif(path: str | Path) -> PhotoInfo:
    """EXIF of a photograph; pictures without any give their size alone.

    Follows:
        orientation, exposure time, ISO, f-number; focal length by FocalPlaneXResolution or the 35 mm equivalent.

    Names:
        focal lengths that contradict each other (the 35 mm equivalent is taken).

    Raises:
        SceneError: Damaged.
    """
    path = Path(path)
    data = read_bytes(path, "picture_bytes", SceneError, f"{path}: the photograph")
    check_picture(data, SceneError, f"{path}: the photograph")
    try:
        with Image.open(io.BytesIO(data)) as picture:
            width, height = picture_size(data) or picture.size  # Pillow's own is that of a TIFF turned upright
            first = picture.getexif()
            tags = {**first, **first.get_ifd(ExifTags.IFD.Exif)}
    except _READING_ERRORS as error:
        raise SceneError(f"{path}: no photograph whose EXIF can be read ({' '.join(str(error).split())})") from error
    base = ExifTags.Base
    if _number(tags, base.Orientation) in _TURNED:
        width, height = height, width
    resolution, focal = _number(tags, base.FocalPlaneXResolution), _number(tags, base.FocalLength)
    unit = {2: 25.4, 3: 10.0, 4: 1.0}.get(int(_number(tags, base.FocalPlaneResolutionUnit) or 2), 25.4)
    longest = max(_number(tags, side) or 0.0 for side in (base.ExifImageWidth, base.ExifImageHeight))
    pixels = None
    if resolution and focal and longest:
        pixels = focal * resolution / unit * max(width, height) / longest
    return PhotoInfo(
        width,
        height,
        seconds=_number(tags, base.ExposureTime),
        iso=_number(tags, base.ISOSpeedRatings),
        f_number=_number(tags, base.FNumber),
        focal_35mm=_number(tags, base.FocalLengthIn35mmFilm),
        focal_pixels=pixels,
        model=" ".join(str(tags.get(base.Model, "")).replace("\0", " ").split()),
    )


def camera_by_exif(path: Path, transfer: str | Path = "srgb") -> Camera:
    """Camera of a photograph, or of the first one in a folder.

    Raises:
        SceneError: It has no focal length, or was cut.
    """
    if path.is_dir():
        endings = (".jpg", ".jpeg", ".tif", ".tiff", ".png")
        shown = (entry for entry in path.iterdir() if not entry.name.startswith("."))
        pictures = sorted(entry for entry in shown if entry.suffix.lower() in endings)
        if not pictures:
            raise SceneError(f"{path}: holds no photograph to read EXIF from")
        path = pictures[0]
    info = read_exif(path)
    if info.contradiction:
        print(f"{path}: {info.contradiction}", file=sys.stderr)
    camera = info.camera(transfer)
    if camera is None:
        why = "tells no focal length" if info.is_whole else f"is of {info.width}x{info.height}, a part of a photograph"
        raise SceneError(f"{path}: its EXIF {why}; calibrate the camera or give its numbers")
    return camera


def _number(tags: Mapping[int, Any], tag: int) -> float | None:
    """First value of a tag as a number above 0."""
    value = tags.get(tag)
    try:
        number = float(value[0] if isinstance(value, tuple) else value)  # type: ignore[arg-type]
    except (TypeError, ValueError, LookupError, ArithmeticError):
        return None
    return number if math.isfinite(number) and number > 0.0 else None


def exposure_in_name(path: str | Path) -> float | None:
    """Seconds that a file's name seems to tell: the last number n of ``d1_25.jpg`` or ``probe 1-4.png`` as 1 / n."""
    numbers = re.findall(r"\d+", Path(path).stem)
    value = int(numbers[-1]) if numbers else 0
    return 1.0 / value if 1 <= value <= 100_000 else None
