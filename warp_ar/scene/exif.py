"""Exposure and focal length from a photograph's EXIF."""

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
from warp_ar.pictures import RAW, check_picture, open_raw, picture_size
from warp_ar.scene.description import Camera

FULL_FRAME_DIAGONAL: Final = math.hypot(36.0, 24.0)
"""Diagonal of 35 mm film in millimetres; a focal length "in 35 mm film" refers to the angle across this diagonal."""
SENSOR_SHAPES: Final = (1.0, 4 / 3, 3 / 2, 16 / 9, 5 / 4, 18 / 9, 19.5 / 9, 20 / 9)
"""Aspect ratios of camera sensors; a picture with another ratio has been cropped."""
SHAPE_TOLERANCE: Final = 0.012
"""Relative tolerance of aspect ratios, because cameras round sides to multiples of 16."""
AGREEING: Final = 0.15
"""Largest difference of the logarithms of two focal lengths that agree. The 35 mm equivalent is rounded to a whole
number, and cameras differ in which diagonal they use."""
LEAST_SIDE: Final = 400
"""Shorter side in pixels below which a picture is taken for a crop or a thumbnail."""
_TURNED: Final = (5, 6, 7, 8)
"""EXIF orientations that exchange width and height; LibRaw's are the first two of them."""

# Exceptions that Pillow was observed to raise on damaged files; it documents none.
_READING_ERRORS: Final = (
    *(OSError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, MemoryError, SyntaxError),
    *(struct.error, Image.DecompressionBombError),
)


@dataclasses.dataclass(frozen=True)
class PhotoInfo:
    """EXIF data of one photograph; a field is None if its tag is missing."""

    width: int
    """Upright width in pixels."""
    height: int
    """Upright height in pixels."""
    seconds: float | None = None
    """Exposure time, seconds."""
    iso: float | None = None
    """ISO sensitivity."""
    f_number: float | None = None
    """f-number: focal length divided by aperture diameter."""
    focal_35mm: float | None = None
    """35 mm equivalent of the focal length, millimetres."""
    focal_pixels: float | None = None
    """Focal length in pixels by the sensor's resolution; None if EXIF does not state the resolution."""
    model: str = ""
    """Name of the camera."""

    @property
    def exposure(self) -> float | None:
        """Return T ISO / (100 N^2), the exposure in seconds at ISO 100 and f/1.

        The picture's brightness is proportional to it.
        """
        if self.seconds is None:
            return None
        return self.seconds * (self.iso or 100.0) / 100.0 / (self.f_number or 1.0) ** 2

    @property
    def is_whole(self) -> bool:
        """Return True if the picture has a sensor's aspect ratio.

        A cropped picture's focal length in pixels is unknown.
        """
        if min(self.width, self.height) < LEAST_SIDE:
            return False
        shape = max(self.width, self.height) / min(self.width, self.height)
        return any(abs(shape / known - 1.0) < SHAPE_TOLERANCE for known in SENSOR_SHAPES[1:])

    @property
    def by_35mm(self) -> float | None:
        """Return the focal length in pixels by the 35 mm equivalent, which refers to the picture's diagonal."""
        if self.focal_35mm is None:
            return None
        return self.focal_35mm / FULL_FRAME_DIAGONAL * math.hypot(self.width, self.height)

    def focal_length(self) -> float | None:
        """Return the focal length in pixels; None if EXIF does not give it or the picture was cropped."""
        if not self.is_whole:
            return None
        return self.by_35mm if self.focal_pixels is None or self.contradiction else self.focal_pixels

    @property
    def contradiction(self) -> str:
        """Return a description of two tags that give different focal lengths; empty if they agree.

        Programs that resize pictures rewrite the size to which the sensor's resolution refers. The 35 mm equivalent
        does not depend on that size.
        """
        film, pixels = self.by_35mm, self.focal_pixels
        if film is None or pixels is None or abs(math.log(film / pixels)) < AGREEING:
            return ""
        return (
            f"EXIF contradicts itself: focal length {pixels:.0f} pixels by the sensor's resolution, {film:.0f} by the "
            "35 mm equivalent, which is used"
        )

    def camera(self, transfer: str | Path = "srgb") -> Camera | None:
        """Return a pinhole camera with a central principal point; None if the focal length is unknown."""
        focal = self.focal_length()
        if focal is None:
            return None
        middle = (self.width - 1) / 2, (self.height - 1) / 2
        return Camera(self.width, self.height, focal, focal, *middle, transfer=transfer)


def read_exif(path: str | Path) -> PhotoInfo:
    """Read the EXIF data of a photograph; without EXIF only its size is set.

    Follows:
        orientation, exposure time, ISO, f-number; focal length by FocalPlaneXResolution or the 35 mm equivalent.

    Names:
        focal lengths that contradict each other (the 35 mm equivalent is taken).

    Raises:
        SceneError: Damaged.
    """
    path = Path(path)
    if path.suffix.lower() in RAW:
        with open_raw(path, SceneError) as raw:
            shot, sides = raw.other, (raw.sizes.iwidth, raw.sizes.iheight)
            width, height = reversed(sides) if raw.sizes.flip in _TURNED else sides
        return PhotoInfo(width, height, shot.shutter_speed or None, shot.iso_speed or None, shot.aperture or None)
    data = read_bytes(path, "picture_bytes", SceneError, f"{path}: the photograph")
    check_picture(data, SceneError, f"{path}: the photograph")
    try:
        with Image.open(io.BytesIO(data)) as picture:
            width, height = picture_size(data) or picture.size  # Pillow turns TIFFs upright by itself
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
    """Return the camera of a photograph, or of the first photograph in a folder.

    Raises:
        SceneError: EXIF gives no focal length, or the picture was cropped.
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
        why = "has no focal length" if info.is_whole else f"is of {info.width}x{info.height}, a part of a photograph"
        raise SceneError(f"{path}: its EXIF {why}; calibrate the camera or give its numbers")
    return camera


def _number(tags: Mapping[int, Any], tag: int) -> float | None:
    """Return the first value of a tag if it is a positive number, else None."""
    value = tags.get(tag)
    try:
        number = float(value[0] if isinstance(value, tuple) else value)  # type: ignore[arg-type]
    except (TypeError, ValueError, LookupError, ArithmeticError):
        return None
    return number if math.isfinite(number) and number > 0.0 else None


def exposure_in_name(path: str | Path) -> float | None:
    """Return the exposure time in seconds that a file's name suggests.

    It is 1 / n for the last number n of ``d1_25.jpg`` or ``probe 1-4.png``.
    """
    numbers = re.findall(r"\d+", Path(path).stem)
    value = int(numbers[-1]) if numbers else 0
    return 1.0 / value if 1 <= value <= 100_000 else None
