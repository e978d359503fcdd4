"""Environments as files: OpenEXR, Radiance's HDR, or spherical harmonics in JSON; one, or one per frame.

An OpenEXR says how it is to be read. ``axes`` (a sentence of `environment_axes`), ``chromaticities`` (of sRGB's
primaries) and ``whiteLevel`` (the value at which the camera clips) are always there; ``envmap`` wherever the picture is
one that is seen from inside, so in all axes but ``z-up``. Where it is known: ``whiteLuminance`` (cd/m^2 of the value
1), ``exposure`` (t ISO / (100 N^2)), ``capDate`` with ``utcOffset``, and ``longitude``, ``latitude``, ``altitude``.

Texel centres are at half-integers, as renderers sample them. OpenEXR's own functions have the outermost centres lie at
the poles and edges: half a texel at most.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import functools
import math
import pathlib
from typing import Any

import numpy as np
import numpy.typing as npt
import OpenEXR

from warp_ar.errors import SinkError, UsageError, reason
from warp_ar.exr_file import read_exr_header, read_linear_picture, write_exr
from warp_ar.files import write_whole
from warp_ar.light.latlong_axes import axes_of
from warp_ar.output.color_spaces import COLOR_SPACES, convert_light
from warp_ar.output.environment_axes import CUBES, DESCRIPTIONS, check_axes, from_axes, to_axes, to_cube
from warp_ar.output.folder_sink import FolderSink
from warp_ar.output.places import check_replaceable, earlier_frames
from warp_ar.output.radiance_hdr import encode_hdr
from warp_ar.signature import PROGRAM, is_signed

ENVIRONMENT_SUFFIXES = (".exr", ".hdr", ".json")

_SATURATION = 1.2
"""Luminance at which a camera clips, cd/m^2, times t ISO / (100 N^2): by the saturation-based speed of ISO 12232,
78 / (100 q) with the usual q = 0.65 of lens and angle."""


@dataclasses.dataclass(frozen=True)
class EnvironmentInfo:
    """What is known of an environment beside its radiance."""

    white_level: float = 1.0
    """Value at which the camera clips."""
    white_luminance: float | None = None
    """cd/m^2 of the value 1; None where it is not known."""
    exposure: float | None = None
    """t ISO / (100 N^2), with t in seconds; None where it is not known."""
    taken: datetime.datetime | None = None
    """When it was captured, with its time zone."""
    place: tuple[float, float, float] | None = None
    """Where: longitude and latitude in degrees, east and north positive, and altitude in metres."""

    def __post_init__(self) -> None:
        for name in ("white_level", "white_luminance", "exposure"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise UsageError(f"{name} = {value!r}: expected a finite number above 0")
        if self.taken is not None and self.taken.utcoffset() is None:
            raise UsageError(f"taken = {self.taken.isoformat()}: expected a time with its zone, such as ...+01:00")
        if self.place is not None:
            longitude, latitude, altitude = self.place
            if not (abs(longitude) <= 180.0 and abs(latitude) <= 90.0 and math.isfinite(altitude)):
                raise UsageError(
                    f"place = {self.place}: expected a longitude of -180 to 180 and a latitude of -90 to 90 degrees, "
                    "and an altitude in metres"
                )

    def luminance_of_one(self) -> float | None:
        """cd/m^2 of the value 1: as given, or by the exposure; None if neither is known."""
        if self.white_luminance is not None or self.exposure is None:
            return self.white_luminance
        return _SATURATION / self.exposure / self.white_level


class EnvironmentSink(FolderSink):
    """A folder of ``NNNN.exr``, numbered from 0, each as `write_environment` writes it.

    The first one also clears away what this program left in folders ``ball_1``, ``ball_2``, ... below: light of an
    earlier run, of mirror balls that this one may not have.
    """

    _suffix = ".exr"

    def __init__(self, path: str | pathlib.Path, *, overwrite: bool = False) -> None:
        super().__init__(path, overwrite=overwrite)
        stale: list[pathlib.Path] = []
        for folder in self._path.glob("ball_[1-9]*"):
            if folder.name.removeprefix("ball_").isdecimal() and folder.is_dir():
                stale += [one for one in earlier_frames(folder, self._suffix, overwrite=True) if is_signed(one)]
        if stale:
            self._earlier += stale
            say = f"{self.replaced}; " if self.replaced else ""
            self.replaced = f"{say}{self._path}/ball_*: {len(stale)} environments of an earlier run are removed"

    def _check(self, image: npt.NDArray[Any]) -> None:
        _check_environment(image)

    def write(self, image: npt.NDArray[Any]) -> None:
        """Take the next map; the first one clears away those of an earlier run, and folders that are empty then."""
        emptied = {path.parent for path in self._earlier} - {self._path}
        super().write(image)
        for folder in emptied:
            with contextlib.suppress(OSError):  # it holds something else: that stays, and so does the folder
                folder.rmdir()

    def _store(self, index: int, image: npt.NDArray[Any]) -> None:
        write_environment(self._path / f"{index:04d}.exr", image, overwrite=True)


def write_environment(
    path: str | pathlib.Path,
    radiance: npt.NDArray[np.float32],
    *,
    overwrite: bool = False,
    axes: str = "z-up",
    layout: str = "latlong",
    size: int | None = None,
    info: EnvironmentInfo | None = None,
    color_space: str = "rec709",
) -> None:
    """Write an environment as the ending of ``path`` says.

    ``.hdr`` is Radiance's, whose values are right to 1 part in 256 of a texel's brightest channel and never negative.
    ``.json`` holds spherical harmonics, see `environment_harmonics`. Any other ending is OpenEXR, 32-bit float,
    ZIP-compressed, channels R, G, B.

    Args:
        path: The file; folders that are missing on the way are made.
        radiance: Linear RGB in camera values, float32, (height, width, 3); row 0 looks toward +z, the centre column
            toward +x, columns grow toward +y.
        overwrite: Whether a file that this program did not write may be replaced.
        axes: What the file's directions are told in: one of ``AXES`` of `environment_axes`.
        layout: ``latlong``, or ``cube``: six faces, one below the other.
        size: Texels along an edge of a cube; None means half the map's rows.
        info: What else is known; HDR holds nothing of it, JSON the white level.
        color_space: One of ``COLOR_SPACES``; another than ``rec709`` only in OpenEXR.

    Raises:
        SinkError: The array is of another kind, or the file cannot be written or may not be replaced.
        UsageError: The axes, the layout, the size or the colour space cannot be used.
    """
    path = pathlib.Path(path)
    info = EnvironmentInfo() if info is None else info
    _check_environment(radiance)
    check_axes(axes, layout)
    check_replaceable(path, overwrite=overwrite)
    suffix = path.suffix.lower()
    if color_space != "rec709" and suffix in (".hdr", ".json"):
        raise UsageError(f"{path}: color space {color_space!r} is told in OpenEXR alone; name an .exr")
    radiance = convert_light(radiance, "rec709", color_space)
    if suffix == ".json":
        from warp_ar.output.environment_harmonics import encode_harmonics  # loads Warp

        if layout != "latlong":
            raise UsageError(f"{path}: spherical harmonics have no layout {layout}")
        data: Any = encode_harmonics(radiance, axes, info.white_level)
    else:
        picture = to_axes(radiance, axes) if layout == "latlong" else to_cube(radiance, axes, size)
        described = (DESCRIPTIONS if layout == "latlong" else CUBES)[axes]
        if suffix == ".hdr":
            data = encode_hdr(picture, described)
        else:
            image = OpenEXR.File(_header(axes, layout, info, color_space), {"RGB": np.ascontiguousarray(picture)})
            data = functools.partial(write_exr, image=image)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, data)
    except (RuntimeError, OSError) as error:
        raise SinkError(f"{path} cannot be written: {reason(error)}") from error


def _header(axes: str, layout: str, info: EnvironmentInfo, color_space: str) -> dict[str, Any]:
    """Attributes of an OpenEXR."""
    header: dict[str, Any] = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "software": PROGRAM,
        "axes": (DESCRIPTIONS if layout == "latlong" else CUBES)[axes],
        "chromaticities": COLOR_SPACES[color_space],
        "whiteLevel": float(info.white_level),
    }
    if layout == "cube":
        header["envmap"] = OpenEXR.ENVMAP_CUBE
    elif axes != "z-up":
        # By OpenEXR's word the picture is seen from inside; who believed it of a mirror image would mirror the world.
        header["envmap"] = OpenEXR.ENVMAP_LATLONG
    luminance = info.luminance_of_one()
    if luminance is not None:
        header["whiteLuminance"] = float(luminance)
    if info.exposure is not None:
        header["exposure"] = float(info.exposure)
    if info.taken is not None:
        header["capDate"] = info.taken.astimezone(datetime.UTC).strftime("%Y:%m:%d %H:%M:%S")
        header["utcOffset"] = 0.0
    if info.place is not None:
        header |= dict(zip(("longitude", "latitude", "altitude"), map(float, info.place), strict=True))
    return header


def read_environment(path: str | pathlib.Path, *, axes: str | None = None) -> npt.NDArray[np.float32]:
    """Read a latlong OpenEXR or Radiance HDR as float32 (height, width, 3), in this program's axes and primaries.

    Args:
        path: The file.
        axes: One of ``AXES`` of `environment_axes`; None: as the file says, else by the convention of its format.

    Raises:
        SinkError: The file is missing, another kind of file, a cube, or has no R, G and B.
        UsageError: There are no such axes.
    """
    path = pathlib.Path(path)
    picture = read_linear_picture(path, SinkError, str(path))
    axes = axes_of(picture, path, axes, SinkError, str(path))
    try:
        return from_axes(picture.color, axes)
    except UsageError as error:
        raise SinkError(f"{path} cannot be read: {error}") from error


def read_environment_info(path: str | pathlib.Path) -> EnvironmentInfo:
    """What the header of an OpenEXR says of an environment.

    Raises:
        SinkError: The file cannot be read, or its header holds a date or place that is none.
    """
    path = pathlib.Path(path)
    header = {} if path.suffix.lower() == ".hdr" else read_exr_header(path, SinkError, str(path))

    def positive(name: str) -> float | None:
        value = header.get(name)
        return float(value) if isinstance(value, int | float) and 0.0 < value < math.inf else None

    taken = None
    if "capDate" in header:
        try:
            local = datetime.datetime.strptime(str(header["capDate"]), "%Y:%m:%d %H:%M:%S")
            offset = datetime.timedelta(seconds=float(header.get("utcOffset", 0.0)))
            taken = (local + offset).replace(tzinfo=datetime.UTC)
        except (ValueError, OverflowError) as error:
            raise SinkError(f"{path}: capDate {header['capDate']!r} is no date: {reason(error)}") from error
    names = ("longitude", "latitude", "altitude")
    place = None
    if {"longitude", "latitude"} <= header.keys():
        longitude, latitude, altitude = (float(header.get(name, 0.0)) for name in names)
        place = (longitude, latitude, altitude)
    try:
        return EnvironmentInfo(
            positive("whiteLevel") or 1.0, positive("whiteLuminance"), positive("exposure"), taken, place
        )
    except UsageError as error:
        raise SinkError(f"{path}: {error}") from error


def _check_environment(radiance: npt.NDArray[Any]) -> None:
    if radiance.dtype != np.float32 or radiance.ndim != 3 or radiance.shape[2] != 3 or not radiance.size:
        raise SinkError(f"an environment is float32 (height, width, 3), not {radiance.dtype} {radiance.shape}")
