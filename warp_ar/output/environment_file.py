"""Environments as files: OpenEXR, Radiance HDR, or spherical harmonics in JSON; one file, or one per frame.

An OpenEXR contains metadata. Always present are ``axes`` (a sentence of `environment_axes`), ``chromaticities`` (of
sRGB's primaries) and ``whiteLevel`` (the value at which the camera clips). ``envmap`` is present for pictures as seen
from inside, which are all axes except ``z-up``. If known, there are ``whiteLuminance`` (luminance in cd/m^2 of the
value 1), ``exposure`` (t ISO / (100 N^2)), ``capDate`` with ``utcOffset``, and ``longitude``, ``latitude``,
``altitude``.

Texel centres are at half-integers, as in renderers. OpenEXR's own functions place the outermost centres at the poles
and edges, which differs by at most half a texel.
"""

from __future__ import annotations

import dataclasses
import datetime
import functools
import math
import pathlib
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import OpenEXR

from warp_ar.declared import checked
from warp_ar.errors import SinkError, UsageError, counted, reason
from warp_ar.exr_file import exr_header, read_exr_header, read_linear_picture, write_exr
from warp_ar.files import store
from warp_ar.light.captured import latlong_directions, texel_solid_angles
from warp_ar.light.latlong_axes import DESCRIPTIONS, axes_of, from_axes, to_axes
from warp_ar.output.environment_axes import CUBES, check_axes, encode_harmonics, to_cube
from warp_ar.output.places import check_replaceable
from warp_ar.output.sink import make_folder
from warp_ar.signals import AP1, REC_709, Chromaticities, converted
from warp_ar.signature import PROGRAM

Radiance = npt.NDArray[np.float32]

COLOR_SPACES: Final[dict[str, Chromaticities]] = {
    "rec709": REC_709,
    "acescg": AP1,
}
"""Chromaticities of red, green, blue and white, x and y each."""
_REC_709_WORDS = " ".join(f"{value:.4f}" for value in REC_709)
ENVIRONMENT_SUFFIXES = (".exr", ".hdr", ".json")

_SATURATION = 1.2
"""Luminance in cd/m^2 at which a camera clips, times t ISO / (100 N^2): by the saturation-based speed of ISO 12232, 78
/ (100 q) with the usual factor q = 0.65 for lens and angle."""


@dataclasses.dataclass(frozen=True)
class EnvironmentInfo:
    """Metadata of an environment."""

    white_level: float = 1.0
    """Value at which the camera clips."""
    white_luminance: float | None = None
    """Luminance in cd/m^2 of the value 1; None if unknown."""
    exposure: float | None = None
    """Exposure t ISO / (100 N^2), with t in seconds; None if unknown."""
    taken: datetime.datetime | None = None
    """Time of capture, with time zone."""
    place: tuple[float, float, float] | None = None
    """Longitude and latitude in degrees, east and north positive, and altitude in metres."""

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
        """Return the luminance in cd/m^2 of the value 1: as given, or by the exposure; None if both are unknown."""
        if self.white_luminance is not None or self.exposure is None:
            return self.white_luminance
        return _SATURATION / self.exposure / self.white_level

    def attributes(self) -> dict[str, Any]:
        """Return the known metadata as attributes of an OpenEXR."""
        known: dict[str, Any] = {
            "whiteLevel": self.white_level,
            "whiteLuminance": self.luminance_of_one(),
            "exposure": self.exposure,
            **dict(zip(("longitude", "latitude", "altitude"), self.place or (), strict=False)),
        }
        known = {name: float(value) for name, value in known.items() if value is not None}
        if self.taken is not None:
            known["capDate"] = self.taken.astimezone(datetime.UTC).strftime("%Y:%m:%d %H:%M:%S")
            known["utcOffset"] = 0.0
        return known


@checked
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
    """Write an environment in the format of the suffix of ``path``.

    ``.hdr`` is Radiance HDR, whose values are exact to 1/256 of a texel's brightest channel and never negative.
    ``.json`` holds spherical harmonics, see `environment_harmonics`. Any other ending is OpenEXR, 32-bit float,
    ZIP-compressed, channels R, G, B.

    Args:
        path: The file; missing parent folders are made.
        radiance: Linear RGB in camera values, float32, (height, width, 3); row 0 is toward +z, the centre column toward
            +x, and columns advance toward +y.
        overwrite: True to replace a file that this program did not write.
        axes: Axes of the file's directions: one of ``AXES`` of `environment_axes`.
        layout: ``latlong``, or ``cube``: six faces, one below the other.
        size: Texels along an edge of a cube; None means half the map's rows.
        info: Metadata; HDR stores none, JSON only the white level.
        color_space: One of ``COLOR_SPACES``; spaces other than ``rec709`` are for OpenEXR only.

    Raises:
        SinkError: The array is invalid, or the file cannot be written or must not be replaced.
        UsageError: The axes, the layout, the size or the colour space is invalid.
    """
    path = pathlib.Path(path)
    info = EnvironmentInfo() if info is None else info
    check_environment(radiance)
    check_axes(axes, layout)
    check_replaceable(path, overwrite=overwrite)
    suffix = path.suffix.lower()
    if color_space != "rec709" and suffix in (".hdr", ".json"):
        raise UsageError(f"{path}: color space {color_space!r} can be stored in OpenEXR only; name an .exr")
    radiance = convert_light(radiance, "rec709", color_space)
    described = (DESCRIPTIONS if layout == "latlong" else CUBES)[axes]
    data: Any
    if suffix == ".json":
        if layout != "latlong":
            raise UsageError(f"{path}: spherical harmonics have no layout {layout}")
        data = encode_harmonics(radiance, axes, info.white_level)
    else:
        picture = to_axes(radiance, axes) if layout == "latlong" else to_cube(radiance, axes, size)
        if suffix == ".hdr":
            data = encode_hdr(picture, described)
        else:
            header = exr_header(axes=described, chromaticities=COLOR_SPACES[color_space], **info.attributes())
            if layout == "cube":
                header["envmap"] = OpenEXR.ENVMAP_CUBE
            elif axes != "z-up":
                # OpenEXR defines the picture as seen from inside; readers that rely on it would flip a mirror image.
                header["envmap"] = OpenEXR.ENVMAP_LATLONG
            image = OpenEXR.File(header, {"RGB": np.ascontiguousarray(picture)})
            data = functools.partial(write_exr, image=image)
    make_folder(path.parent)
    store(path, data)


@checked
def read_environment(path: str | pathlib.Path, *, axes: str | None = None) -> npt.NDArray[np.float32]:
    """Read a latlong OpenEXR or Radiance HDR as float32 (height, width, 3), in this program's axes and primaries.

    Args:
        path: The file.
        axes: One of ``AXES`` of `environment_axes`; None: as stated in the file, else the convention of its format.

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
    """Read an environment's metadata from the header of an OpenEXR.

    Raises:
        SinkError: The file cannot be read, or its header has an invalid date or place.
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


def check_environment(radiance: npt.NDArray[Any]) -> None:
    """Check that an array is an environment.

    Raises:
        SinkError: The array is no environment.
    """
    if radiance.dtype != np.float32 or radiance.ndim != 3 or radiance.shape[2] != 3 or not radiance.size:
        raise SinkError(f"an environment is float32 (height, width, 3), not {radiance.dtype} {radiance.shape}")
    if not np.isfinite(radiance).all():
        wrong = int(np.count_nonzero(~np.isfinite(radiance)))
        raise SinkError(f"an environment has {counted(wrong, 'value')} that are NaN or infinite; expected finite light")


def encode_hdr(radiance: npt.NDArray[np.float32], axes: str) -> bytes:
    """Return the bytes of a Radiance HDR without run-length encoding, because camera pictures hardly repeat.

    Channels are exact to half a step, at most 1/256 of a texel's brightest channel. Negative values and NaN become 0,
    infinity becomes the largest value.

    Args:
        radiance: Linear RGB, (height, width, 3), row 0 at the top.
        axes: Description of the directions for the header.
    """
    height, width = radiance.shape[:2]
    values = np.clip(np.nan_to_num(radiance.astype(np.float64), nan=0.0, posinf=1e38), 0.0, 1e38)
    brightest = values.max(2)
    exponent = np.frexp(brightest)[1]
    # A mantissa that rounds to 256 needs the next exponent.
    exponent += np.rint(np.ldexp(brightest, 8 - exponent)) > 255
    mantissas = np.rint(np.ldexp(values, (8 - exponent)[..., None]))
    seen = (brightest > 0.0) & (exponent > -128)
    pixels = np.concatenate([mantissas, (exponent + 128)[..., None]], 2) * seen[..., None]
    # Some readers expect FORMAT on the header's last line.
    header = [
        *("#?RADIANCE", f"SOFTWARE={PROGRAM}", f"VIEW_AXES={axes}", f"PRIMARIES={_REC_709_WORDS}"),
        *("FORMAT=32-bit_rle_rgbe", "", f"-Y {height} +X {width}", ""),
    ]
    return b"".join(["\n".join(header).encode(), pixels.astype(np.uint8).tobytes()])


def convert_light(radiance: Radiance, source: str, target: str) -> Radiance:
    """Convert linear light, (height, width, 3), between colour spaces of ``COLOR_SPACES``, with white adaptation.

    Raises:
        UsageError: There is no such space.
    """
    for name in (source, target):
        if name not in COLOR_SPACES:
            raise UsageError(f"color space {name!r}: expected {', '.join(COLOR_SPACES)}")
    return radiance if source == target else converted(radiance, COLOR_SPACES[source], COLOR_SPACES[target])


def grey_card_scale(radiance: Radiance) -> float:
    """Return the factor on an environment under which a grey card lying on the marker has a luminance of 0.18.

    The card is Lambertian: its radiance is 0.18 E / pi, with the irradiance E of a surface facing up.

    Args:
        radiance: Latlong (height, 2 height, 3), z-up.

    Raises:
        UsageError: There is no light from above.
    """
    height = len(radiance)
    cos_theta = np.clip(latlong_directions(height)[..., 2], 0.0, None) * texel_solid_angles(height)
    luminance = radiance.astype(np.float64) @ np.array([0.2126, 0.7152, 0.0722])
    irradiance = float((luminance * cos_theta).sum())
    if not irradiance > 0.0 or not math.isfinite(irradiance):
        raise UsageError(f"--grey-card: the light from above is {irradiance:g}, so it cannot be scaled")
    return math.pi / irradiance
