"""Scene files, schema 1: TOML read into frozen dataclasses, with errors that say what would be right.

Metres, degrees, linear RGB. The world is the marker's frame: origin at the marker's (or board's) centre, x right, y up
the printed page, z out of the page. Paths are relative to the scene file. What a file leaves out has the default of its
field; sections other than ``[camera]`` are optional, and ``[marker]`` must be there as soon as anything has a place in
the world.

A scene built or changed in Python is checked by ``loads_scene(dumps_scene(scene))``.
"""

from __future__ import annotations

import dataclasses
import difflib
import importlib.resources
import json
import math
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal, NoReturn, TypeAlias, TypeVar, cast

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError
from warp_ar.geometry import MESH_SUFFIXES, rotation_matrix

Vec3: TypeAlias = tuple[float, float, float]
RGB: TypeAlias = tuple[float, float, float]
Color: TypeAlias = RGB | Path
"""Linear RGB, or the path of a texture (sRGB-encoded picture)."""

FloatMatrix: TypeAlias = npt.NDArray[np.float64]

SCHEMA: Final = 1
"""The version of the format that this program reads."""


# --- What a scene is made of ------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Camera:
    """OpenCV's pinhole camera; pixel centres lie at integers."""

    width: int
    """Width of the picture in pixels."""
    height: int
    """Height of the picture in pixels."""
    fx: float
    """Focal length along x in pixels."""
    fy: float
    """Focal length along y in pixels."""
    cx: float
    """Column of the principal point in pixels."""
    cy: float
    """Row of the principal point in pixels."""
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]]: 4, 5 or 8 values."""
    transfer: str | Path = "srgb"
    """How values were encoded: "srgb", "linear", "gamma:G" (linear = value ** G), or a measured response's file."""

    def matrix(self) -> FloatMatrix:
        """Camera matrix K, (3, 3), in pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def scaled_to(self, width: int, height: int) -> Camera:
        """The same camera with its picture resampled to another size.

        A pixel centre at x covers [x, x + 1) after a shift of one half, so cx' = (cx + 0.5) s - 0.5.

        Args:
            width: New width in pixels.
            height: New height in pixels.

        Raises:
            SceneError: The new size has another aspect ratio, so that part of the picture would have been cut away.
        """
        if (width, height) == (self.width, self.height):
            return self
        if width < 1 or height < 1 or width * self.height != height * self.width:
            raise SceneError(
                f"camera: calibrated for {self.width}x{self.height}, frames are {width}x{height}: another aspect "
                "ratio, so the intrinsics cannot be scaled; record at the calibrated aspect or calibrate at this size"
            )
        s = width / self.width
        return dataclasses.replace(
            self,
            width=width,
            height=height,
            fx=self.fx * s,
            fy=self.fy * s,
            cx=(self.cx + 0.5) * s - 0.5,
            cy=(self.cy + 0.5) * s - 0.5,
        )

    @classmethod
    def load_calibration(cls, path: str | Path, transfer: str | Path = "srgb") -> Camera:
        """Read a calibration file: OpenCV's YAML, JSON or XML, or ROS's camera_info YAML.

        Args:
            path: The file; keys as OpenCV's and ROS's calibration programs write them (``image_width``,
                ``image_height``, ``camera_matrix``, ``distortion_coefficients`` and their common variants).
            transfer: Encoding of the camera's values, which such files do not hold.

        Raises:
            SceneError: The file is missing, damaged, lacks a key, or holds a camera that is not a pinhole.
        """
        return _read_calibration(Path(path), transfer)


@dataclasses.dataclass(frozen=True)
class SourceSpec:
    """Where frames come from: exactly one of ``path``, ``camera`` and ``synthetic`` is given."""

    path: Path | None = None
    """A folder of frames in name order, or a video file."""
    camera: int | None = None
    """Index of a capture device."""
    synthetic: str | None = None
    """Name of a generated source."""
    fps: float | None = None
    """Frames per second; the source's own if left out."""
    exposures: tuple[float, ...] | None = None
    """Exposure times in seconds that frames have in turn: recorded so, or to be asked of the device."""


@dataclasses.dataclass(frozen=True)
class CharucoBoard:
    """Chessboard with markers in its white squares: ``"charuco 5x7 0.04 0.03"``."""

    columns: int
    """Squares along x."""
    rows: int
    """Squares along y."""
    square_length: float
    """Side of a square in metres."""
    marker_length: float
    """Side of a marker in metres."""

    @property
    def marker_count(self) -> int:
        """Number of markers, with the dictionary's ids from 0."""
        return self.columns * self.rows // 2

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the whole board in metres; the world's origin is its centre."""
        return self.columns * self.square_length, self.rows * self.square_length

    def __str__(self) -> str:
        return f"charuco {self.columns}x{self.rows} {self.square_length!r} {self.marker_length!r}"


@dataclasses.dataclass(frozen=True)
class GridBoard:
    """Grid of markers with gaps: ``"grid 4x3 0.04 0.01"``."""

    columns: int
    """Markers along x."""
    rows: int
    """Markers along y."""
    marker_length: float
    """Side of a marker in metres."""
    separation: float
    """Gap between neighbouring markers in metres."""

    @property
    def marker_count(self) -> int:
        """Number of markers, with the dictionary's ids from 0."""
        return self.columns * self.rows

    @property
    def size(self) -> tuple[float, float]:
        """Width and height from outer edge to outer edge in metres; the world's origin is the centre."""
        pitch = self.marker_length + self.separation
        return self.columns * pitch - self.separation, self.rows * pitch - self.separation

    def __str__(self) -> str:
        return f"grid {self.columns}x{self.rows} {self.marker_length!r} {self.separation!r}"


Board: TypeAlias = CharucoBoard | GridBoard


@dataclasses.dataclass(frozen=True)
class Marker:
    """The printed marker, or board of markers, that the world is fixed to."""

    dictionary: str = "DICT_4X4_50"
    """OpenCV's name of the dictionary, ArUco or AprilTag."""
    id: int = 0
    """Which marker of the dictionary; unused with a board."""
    size: float = 0.08
    """Side of the black square in metres; unused with a board."""
    white: float = 0.85
    """Diffuse reflectance of the card's white paper."""
    board: Board | None = None
    """A board instead of a single marker."""


@dataclasses.dataclass(frozen=True)
class Probe:
    """A mirror ball."""

    center: Vec3
    """Centre in metres."""
    radius: float
    """Radius in metres."""
    reflectance: RGB = (0.85, 0.85, 0.85)
    """Share of light that the ball reflects; a silvered ornament if left out. A file may give one number for grey."""


@dataclasses.dataclass(frozen=True)
class Proxy:
    """Simplified physical geometry: receives virtual light and shadow, and hides what is behind it."""

    shape: Literal["plane", "box", "mesh"]
    """A plane lies in its own x and y and faces its own +z."""
    at: Vec3 = (0.0, 0.0, 0.0)
    """Centre (mesh: origin) in metres."""
    rotate: Vec3 = (0.0, 0.0, 0.0)
    """Degrees about the fixed x, then y, then z axis."""
    size: tuple[float, ...] = ()
    """Whole lengths in metres: x and y of a plane; x, y and z of a box; empty for a mesh."""
    file: Path | None = None
    """Mesh file, in metres."""


@dataclasses.dataclass(frozen=True)
class Animation:
    """Motion of an object or a light; nothing moves by default.

    At t seconds a body stands at R(t) (at - pivot) + pivot + sway sin(2 pi t / period), turned by R(t): ``turn`` t
    degrees about the fixed x, then y, then z axis.
    """

    turn: Vec3 = (0.0, 0.0, 0.0)
    """Degrees per second about the fixed axes."""
    pivot: Vec3 | None = None
    """Point in metres that ``turn`` leaves in place; the body's own ``at`` if left out, so that it spins in place."""
    sway: Vec3 = (0.0, 0.0, 0.0)
    """Furthest excursion of a swing to and fro, in metres."""
    period: float = 4.0
    """Duration of one swing in seconds."""

    def rotation_at(self, seconds: float) -> FloatMatrix:
        """R(t), (3, 3)."""
        return rotation_matrix([rate * seconds for rate in self.turn])

    def position_at(self, seconds: float, at: Vec3) -> FloatMatrix:
        """Where a body that starts at ``at`` stands, (3,) in metres."""
        pivot = np.array(at if self.pivot is None else self.pivot)
        swing = np.array(self.sway) * math.sin(2.0 * math.pi * (seconds / self.period))
        position: FloatMatrix = self.rotation_at(seconds) @ (np.array(at) - pivot) + pivot + swing
        return position


@dataclasses.dataclass(frozen=True)
class PhongMaterial:
    """Diffuse plus a cosine lobe about the mirror direction."""

    diffuse: Color = (0.8, 0.8, 0.8)
    """Diffuse reflectance."""
    specular: Color = (0.2, 0.2, 0.2)
    """Reflectance of the lobe."""
    shininess: float = 32.0
    """Exponent of the lobe, from 0 (widest) on."""


@dataclasses.dataclass(frozen=True)
class MetallicRoughnessMaterial:
    """glTF's BRDF: GGX with alpha = roughness squared, F0 = 0.04 for what is no metal."""

    base_color: Color = (0.8, 0.8, 0.8)
    """Diffuse reflectance of a non-metal, F0 of a metal."""
    metallic: float = 0.0
    """0 (no metal) to 1 (metal)."""
    roughness: float = 0.5
    """0 (mirror) to 1 (matt)."""


@dataclasses.dataclass(frozen=True)
class LambertMaterial:
    """Perfectly diffuse."""

    base_color: Color = (0.8, 0.8, 0.8)
    """Diffuse reflectance."""


@dataclasses.dataclass(frozen=True)
class MirrorMaterial:
    """Perfect mirror."""

    base_color: Color = (1.0, 1.0, 1.0)
    """Reflectance, the same at every angle."""


Material: TypeAlias = PhongMaterial | MetallicRoughnessMaterial | LambertMaterial | MirrorMaterial


@dataclasses.dataclass(frozen=True)
class Object:
    """A virtual object; a point p of its shape stands at R (scale p) + at. Fields unused by its shape are zero."""

    shape: Literal["mesh", "sphere", "box", "torus"]
    """Spheres, boxes and tori are centred at their origin; a torus lies around its z axis."""
    file: Path | None = None
    """Mesh file; a texture that it brings is multiplied by the material's first colour."""
    radius: float = 0.0
    """Radius of a sphere in metres."""
    size: Vec3 = (0.0, 0.0, 0.0)
    """Whole lengths of a box in metres."""
    major_radius: float = 0.0
    """Distance of a torus's tube from its axis in metres."""
    minor_radius: float = 0.0
    """Radius of a torus's tube in metres, below the major radius."""
    at: Vec3 = (0.0, 0.0, 0.0)
    """Position in metres."""
    rotate: Vec3 = (0.0, 0.0, 0.0)
    """Degrees about the fixed x, then y, then z axis."""
    scale: float = 1.0
    """Factor on all lengths of the shape."""
    material: Material = LambertMaterial()
    """How it reflects light."""
    animate: Animation | None = None
    """How it moves."""

    def pose_at(self, seconds: float) -> tuple[FloatMatrix, FloatMatrix]:
        """Rotation R (3, 3) and position (3,) in metres, ``seconds`` after the first frame."""
        rotation = rotation_matrix(self.rotate)
        if self.animate is None:
            return rotation, np.array(self.at)
        return self.animate.rotation_at(seconds) @ rotation, self.animate.position_at(seconds, self.at)


@dataclasses.dataclass(frozen=True)
class Light:
    """A virtual light.

    A white Lambertian surface that faces a point light of intensity I at distance d has linear camera value
    I / (pi (a + b d + c d^2)) with attenuation (a, b, c); one that faces a directional light has I / pi.
    """

    kind: Literal["point", "spot", "directional"]
    """Where its light goes."""
    intensity: float
    """Radiant intensity (point, spot) or irradiance (directional), in camera values."""
    color: RGB = (1.0, 1.0, 1.0)
    """Factor on the intensity per channel."""
    at: Vec3 = (0.0, 0.0, 0.0)
    """Position of a point or spot light in metres."""
    target: Vec3 | None = None
    """Point in metres that a spot light shines at; it stays when the light moves."""
    direction: Vec3 | None = None
    """The way the light travels, of any length; instead of a target. It turns with the light."""
    inner_angle: float = 0.0
    """Half angle of a spot in degrees within which it is full."""
    outer_angle: float = 0.0
    """Half angle in degrees at which a spot is zero, after a linear fall from the inner angle."""
    attenuation: Vec3 = (0.0, 0.0, 1.0)
    """Constant, linear and quadratic term of the fall with distance; (0, 0, 1) is the inverse square."""
    radius: float = 0.0
    """Radius in metres of the sphere that emits (point, spot), for soft shadows; 0 is a point."""
    animate: Animation | None = None
    """How it moves."""

    def pose_at(self, seconds: float) -> tuple[FloatMatrix, FloatMatrix]:
        """Position (3,) in metres and unit direction (3,) that the light travels, ``seconds`` after the first frame.

        A point light has no direction and gets -z. So does a spot light that passes through its target.
        """
        position, direction = np.array(self.at), np.array(self.direction or (0.0, 0.0, -1.0))
        if self.animate is not None:
            position = self.animate.position_at(seconds, self.at)
            direction = self.animate.rotation_at(seconds) @ direction
        if self.target is not None:
            direction = np.array(self.target) - position
        length = np.linalg.norm(direction)
        return position, direction / length if length > 0.0 else np.array([0.0, 0.0, -1.0])


@dataclasses.dataclass(frozen=True)
class Exposure:
    """A simulated shorter exposure."""

    scale: float | Literal["auto"] = 1.0
    """Factor on the frame's light, 1 = off; "auto" keeps highlights below clipping when virtual light is added."""


@dataclasses.dataclass(frozen=True)
class Scene:
    """All that a scene file says."""

    camera: Camera
    """The camera that the frames come from."""
    schema: int = SCHEMA
    """Version of the format."""
    name: str = "scene"
    """Name to show; the file's own if left out."""
    source: SourceSpec | None = None
    """Where frames come from, if the file says."""
    marker: Marker = Marker()
    """What fixes the world."""
    probes: tuple[Probe, ...] = ()
    """Mirror balls that show the room's light."""
    proxies: tuple[Proxy, ...] = ()
    """The physical things that are modelled."""
    objects: tuple[Object, ...] = ()
    """Virtual things."""
    lights: tuple[Light, ...] = ()
    """Virtual lights."""
    exposure: Exposure = Exposure()
    """Simulated exposure."""
    path: Path | None = dataclasses.field(default=None, compare=False)
    """The file that the scene was read from."""


# --- Which keys there are ---------------------------------------------------------------------------------------------

_TOP_KEYS: Final = ("schema", "name")
_SECTIONS: Final = ("camera", "source", "marker", "probe", "proxy", "object", "light", "exposure")
_INTRINSICS: Final = ("width", "height", "fx", "fy", "cx", "cy", "distortion")
_SOURCES: Final = ("path", "camera", "synthetic")
_PROXY_KEYS: Final = {"plane": ("size",), "box": ("size",), "mesh": ("file",)}
_OBJECT_KEYS: Final = {
    "mesh": ("file",),
    "sphere": ("radius",),
    "box": ("size",),
    "torus": ("major_radius", "minor_radius"),
}
_LIGHT_KEYS: Final = {
    "point": ("at", "attenuation", "radius"),
    "spot": ("at", "target", "direction", "inner_angle", "outer_angle", "attenuation", "radius"),
    "directional": ("direction",),
}
_MATERIALS: Final[dict[str, type[Material]]] = {
    "phong": PhongMaterial,
    "metallic_roughness": MetallicRoughnessMaterial,
    "lambert": LambertMaterial,
    "mirror": MirrorMaterial,
}
_TRANSFERS: Final = '"srgb", "linear", "gamma:2.2" or the path of a measured response'
_BOARDS: Final = (
    '"charuco COLUMNSxROWS SQUARE MARKER" or "grid COLUMNSxROWS MARKER GAP" with lengths in metres, such as '
    '"charuco 5x7 0.04 0.03"'
)

# Beyond these a square leaves single precision.
_LARGEST, _SMALLEST = 1e18, 1e-18
_MOST_PIXELS: Final = 65536

_DICTIONARIES: Final = {name: int(getattr(cv2.aruco, name)) for name in dir(cv2.aruco) if name.startswith("DICT_")}

_T = TypeVar("_T")


# --- Reading ----------------------------------------------------------------------------------------------------------


def _show(value: object) -> str:
    """A value as a TOML file would have it, on one line and not too long."""
    try:
        text = json.dumps(value, ensure_ascii=False, default=str)
    except ValueError:  # an integer with more digits than Python turns into text
        return "a number of thousands of digits"
    return text if len(text) <= 80 else f"{text[:60]}... ({len(text)} characters)"


def _show_key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]{1,60}", key) else _show(key)


def _nearest(word: str, known: Iterable[str]) -> str:
    """What to say after "unknown": the nearest known word, or all of them."""
    known = list(known)
    close = difflib.get_close_matches(word.lower(), [name.lower() for name in known], n=1, cutoff=0.6)
    if close:
        return f'did you mean "{next(name for name in known if name.lower() == close[0])}"?'
    return f"known: {', '.join(known[:20])}{', ...' if len(known) > 20 else ''}"


class _Table:
    """One table of a scene file: hands out checked values and knows how to complain about them."""

    def __init__(self, label: str, folder: Path, section: str, data: object, keys: Sequence[str]) -> None:
        self.label, self.folder, self.section = label, folder, section
        if not isinstance(data, dict):
            raise SceneError(f"{label}: {section} = {_show(data)}: expected a table with {', '.join(keys)}")
        self.data: dict[str, Any] = data
        for key in data:
            if key not in keys:
                raise SceneError(f"{label}: {self.name(key)}: unknown key; {_nearest(key, keys)}")

    def __contains__(self, key: str) -> bool:
        return key in self.data

    def name(self, key: str) -> str:
        return f"{self.section}.{_show_key(key)}" if self.section else _show_key(key)

    def fail(self, key: str, right: str) -> NoReturn:
        """Say what is wrong with a key: its value if it has one, and what would be right."""
        value = f" = {_show(self.data[key])}" if key in self.data else " is missing"
        raise SceneError(f"{self.label}: {self.name(key)}{value}: {right}")

    def only(self, kind: str, allowed: Iterable[str], others: Iterable[str]) -> None:
        """Complain about keys that other kinds of this section use, but not the one that ``kind`` names."""
        unused = sorted(set(others) - set(allowed))
        for key in self.data:
            if key in unused:
                used = ", ".join(sorted(set(allowed)))
                self.fail(key, f"not used with {kind} = {_show(self.data.get(kind))}; its own keys are {used}")

    def number(
        self, key: str, default: float | None = None, *, low: float = -_LARGEST, high: float = _LARGEST, unit: str = ""
    ) -> float:
        if default is not None and key not in self.data:
            return default
        return self._number(key, self.data.get(key), low, high, _range("a number", low, high, unit))

    def _number(self, key: str, value: object, low: float, high: float, right: str) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.fail(key, f"expected {right}")
        # Compared before it is converted: an integer may be too large for a float.
        if not low <= value <= high:
            self.fail(key, f"expected {right}")
        return float(value)

    def length(self, key: str) -> float:
        return self.number(key, low=_SMALLEST, unit="metres")

    def integer(self, key: str, default: int | None = None, *, low: int, high: int) -> int:
        if default is not None and key not in self.data:
            return default
        value = self.data.get(key)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            self.fail(key, f"expected a whole number from {low} to {high}")
        return value

    def text(self, key: str, default: str | None = None, *, right: str = "some text") -> str:
        if default is not None and key not in self.data:
            return default
        value = self.data.get(key)
        if not isinstance(value, str) or not value:
            self.fail(key, f"expected {right}")
        return value

    def choice(self, key: str, options: Iterable[str], default: str | None = None) -> str:
        options = list(options)
        few = len(options) < 8
        right = "one of " + ", ".join(f'"{option}"' for option in options) if few else f'a name such as "{options[0]}"'
        value = self.text(key, default, right=right)
        if value not in options:
            self.fail(key, f"expected {right}" if few else f"unknown; {_nearest(value, options)}")
        return value

    def vector(
        self,
        key: str,
        default: tuple[float, ...] | None = None,
        *,
        sizes: Sequence[int] = (3,),
        low: float = -_LARGEST,
        high: float = _LARGEST,
        unit: str = "",
    ) -> tuple[float, ...]:
        if default is not None and key not in self.data:
            return default
        value = self.data.get(key)
        right = _range(f"a list of {' or '.join(map(str, sizes))} numbers", low, high, unit)
        if not isinstance(value, list) or len(value) not in sizes:
            self.fail(key, f"expected {right}")
        return tuple(self._number(key, element, low, high, right) for element in value)

    def vec3(self, key: str, default: Vec3 | None = None, *, low: float = -_LARGEST, unit: str = "") -> Vec3:
        return cast(Vec3, self.vector(key, default, low=low, unit=unit))

    def reflectance(self, key: str, default: Color) -> Color:
        """A colour from 0 to 1, or the path of a texture."""
        value = self.data.get(key, default)
        if isinstance(value, str):
            return self.file(key, "a picture")
        if not isinstance(value, list | tuple):
            self.fail(key, "expected a list of 3 numbers from 0 to 1, or the path of a texture")
        return cast(RGB, self.vector(key, cast(RGB, default), low=0.0, high=1.0))

    def resolve(self, key: str, right: str) -> Path:
        value = self.text(key, right=f"the path of {right}")
        try:
            path = (self.folder / value).resolve()
            path.exists()
        except (OSError, RuntimeError, ValueError):  # too long, a loop of links, a zero byte
            self.fail(key, f"expected the path of {right}; this cannot be one")
        return path

    def file(self, key: str, right: str) -> Path:
        path = self.resolve(key, right)
        if not path.is_file():
            self.fail(key, f"no such file: {path}")
        return path


def _range(what: str, low: float, high: float, unit: str) -> str:
    """Words for a range of numbers."""
    unit = f" ({unit})" if unit else ""
    if low > -_LARGEST and high < _LARGEST:
        return f"{what} from {low:g} to {high:g}{unit}"
    if low == _SMALLEST:
        return f"{what} above 0{unit}" if what.startswith("a number") else f"{what}, each above 0{unit}"
    if low > -_LARGEST:
        return f"{what}, {low:g} or more{unit}"
    return f"{what}, finite{unit}" if what == "a number" else f"{what}, each finite{unit}"


def _read_camera(table: _Table) -> Camera:
    transfer = _read_transfer(table)
    if "calibration" in table:
        for key in _INTRINSICS:
            if key in table:
                table.fail(key, "not used beside calibration; give either the file or the numbers")
        return Camera.load_calibration(table.file("calibration", "a calibration file"), transfer)
    if not any(key in table for key in _INTRINSICS):
        table.fail("width", f"give {', '.join(_INTRINSICS[:6])}, or calibration with the path of OpenCV's YAML or JSON")
    return Camera(
        width=table.integer("width", low=1, high=_MOST_PIXELS),
        height=table.integer("height", low=1, high=_MOST_PIXELS),
        fx=table.number("fx", low=_SMALLEST, unit="pixels"),
        fy=table.number("fy", low=_SMALLEST, unit="pixels"),
        cx=table.number("cx", unit="pixels"),
        cy=table.number("cy", unit="pixels"),
        distortion=table.vector("distortion", Camera.distortion, sizes=(4, 5, 8)),
        transfer=transfer,
    )


def _read_transfer(table: _Table) -> str | Path:
    value = table.text("transfer", "srgb", right=_TRANSFERS)
    if value in ("srgb", "linear"):
        return value
    if value.startswith("gamma:"):
        try:
            gamma = float(value.removeprefix("gamma:"))
        except ValueError:
            gamma = math.nan
        if not 0.1 <= gamma <= 10.0:
            table.fail("transfer", 'expected a gamma from 0.1 to 10, such as "gamma:2.2"')
        return value
    path = table.resolve("transfer", _TRANSFERS)
    if not path.is_file():
        table.fail("transfer", f"expected {_TRANSFERS}; no such file: {path}")
    return path


def _read_source(table: _Table) -> SourceSpec:
    given = [key for key in _SOURCES if key in table]
    if len(given) != 1:
        key = given[1] if given else "path"
        also = f"{given[0]} is given too; " if given else ""
        table.fail(key, f"{also}expected exactly one of path, camera and synthetic")
    path = table.resolve("path", "a folder of frames or a video") if "path" in table else None
    # Whether the path is there is asked when the source is opened: another source may stand in for it.
    return SourceSpec(
        path=path,
        camera=table.integer("camera", low=0, high=1023) if "camera" in table else None,
        synthetic=table.text("synthetic", right="the name of a generated source") if "synthetic" in table else None,
        fps=table.number("fps", low=1e-3, high=1e5, unit="frames per second") if "fps" in table else None,
        exposures=table.vector("exposures", sizes=range(2, 9), low=1e-6, high=1e3, unit="seconds")
        if "exposures" in table
        else None,
    )


def _read_marker(table: _Table) -> Marker:
    dictionary = table.choice("dictionary", _DICTIONARIES, Marker.dictionary)
    count = len(cv2.aruco.getPredefinedDictionary(_DICTIONARIES[dictionary]).bytesList)
    white = table.number("white", Marker.white, low=0.01, high=1.0)
    if "board" not in table:
        return Marker(dictionary, table.integer("id", Marker.id, low=0, high=count - 1), table.length("size"), white)
    for key in ("id", "size"):
        if key in table:
            table.fail(key, "not used beside board, which says its own sizes; remove one of the two")
    board = _read_board(table)
    if board.marker_count > count:
        table.fail("board", f"needs {board.marker_count} markers; {dictionary} has {count}")
    return Marker(dictionary, white=white, board=board)


def _read_board(table: _Table) -> Board:
    words = table.text("board", right=_BOARDS).split()
    match = re.fullmatch(r"([0-9]{1,4})x([0-9]{1,4})", words[1]) if len(words) == 4 else None
    if match is None or words[0] not in ("charuco", "grid"):
        table.fail("board", f"expected {_BOARDS}")
    columns, rows = int(match[1]), int(match[2])
    try:
        first, second = float(words[2]), float(words[3])
    except ValueError:
        first = second = math.nan
    if not (_SMALLEST <= first <= _LARGEST and _SMALLEST <= second <= _LARGEST):
        table.fail("board", f"lengths must be above 0 and finite; expected {_BOARDS}")
    if words[0] == "grid":
        if columns < 1 or rows < 1:
            table.fail("board", "a grid has at least 1x1 markers")
        return GridBoard(columns, rows, first, second)
    if columns < 2 or rows < 2:
        table.fail("board", "a ChArUco board has at least 2x2 squares")
    if second >= first:
        table.fail("board", "a marker must be smaller than its square; the square's length comes first")
    return CharucoBoard(columns, rows, first, second)


def _read_probe(table: _Table) -> Probe:
    reflectance = Probe.reflectance
    if isinstance(table.data.get("reflectance"), list):
        reflectance = cast(RGB, table.vector("reflectance", low=0.01, high=1.0))
    elif "reflectance" in table:
        reflectance = (table.number("reflectance", low=0.01, high=1.0),) * 3
    return Probe(table.vec3("center", unit="metres"), table.length("radius"), reflectance)


def _read_proxy(table: _Table) -> Proxy:
    shape = table.choice("shape", _PROXY_KEYS)
    table.only("shape", _PROXY_KEYS[shape], ("size", "file"))
    sides = {"plane": 2, "box": 3}.get(shape)
    return Proxy(
        shape=cast(Any, shape),
        at=table.vec3("at", Proxy.at, unit="metres"),
        rotate=table.vec3("rotate", Proxy.rotate, unit="degrees"),
        size=() if sides is None else table.vector("size", sizes=(sides,), low=_SMALLEST, unit="metres"),
        file=_read_mesh_path(table) if shape == "mesh" else None,
    )


def _read_mesh_path(table: _Table) -> Path:
    path = table.file("file", "a mesh")
    if path.suffix.lower() not in MESH_SUFFIXES:
        table.fail("file", f"unknown mesh format; use one of {', '.join(MESH_SUFFIXES)}")
    return path


def _read_object(table: _Table) -> Object:
    shape = table.choice("shape", _OBJECT_KEYS)
    table.only("shape", _OBJECT_KEYS[shape], (key for keys in _OBJECT_KEYS.values() for key in keys))
    major = table.length("major_radius") if shape == "torus" else Object.major_radius
    minor = table.length("minor_radius") if shape == "torus" else Object.minor_radius
    if shape == "torus" and minor >= major:
        table.fail("minor_radius", f"must be below major_radius ({major:g}), else the torus has no hole")
    return Object(
        shape=cast(Any, shape),
        file=_read_mesh_path(table) if shape == "mesh" else None,
        radius=table.length("radius") if shape == "sphere" else Object.radius,
        size=table.vec3("size", low=_SMALLEST, unit="metres") if shape == "box" else Object.size,
        major_radius=major,
        minor_radius=minor,
        at=table.vec3("at", Object.at, unit="metres"),
        rotate=table.vec3("rotate", Object.rotate, unit="degrees"),
        scale=table.number("scale", Object.scale, low=_SMALLEST),
        material=_read_material(table) if "material" in table else Object.material,
        animate=_read_animation(table),
    )


def _keys(*classes: type[Any]) -> list[str]:
    return list(dict.fromkeys(field.name for kind in classes for field in dataclasses.fields(kind)))


def _read_material(parent: _Table) -> Material:
    known = ["model", *_keys(*_MATERIALS.values())]
    table = _Table(parent.label, parent.folder, parent.name("material"), parent.data["material"], known)
    model = table.choice("model", _MATERIALS)
    kind = _MATERIALS[model]
    table.only("model", _keys(kind), known[1:])
    if kind is PhongMaterial:
        return PhongMaterial(
            diffuse=table.reflectance("diffuse", PhongMaterial.diffuse),
            specular=table.reflectance("specular", PhongMaterial.specular),
            shininess=table.number("shininess", PhongMaterial.shininess, low=0.0),
        )
    if kind is MetallicRoughnessMaterial:
        return MetallicRoughnessMaterial(
            base_color=table.reflectance("base_color", MetallicRoughnessMaterial.base_color),
            metallic=table.number("metallic", MetallicRoughnessMaterial.metallic, low=0.0, high=1.0),
            roughness=table.number("roughness", MetallicRoughnessMaterial.roughness, low=0.0, high=1.0),
        )
    if kind is LambertMaterial:
        return LambertMaterial(table.reflectance("base_color", LambertMaterial.base_color))
    return MirrorMaterial(table.reflectance("base_color", MirrorMaterial.base_color))


def _read_animation(parent: _Table) -> Animation | None:
    if "animate" not in parent:
        return None
    section = parent.name("animate")
    table = _Table(parent.label, parent.folder, section, parent.data["animate"], _keys(Animation))
    if "period" in table and "sway" not in table:
        table.fail("period", "is the duration of a swing; give sway too, its excursion in metres")
    if "pivot" in table and "turn" not in table:
        table.fail("pivot", "is the point to turn about; give turn too, in degrees per second")
    return Animation(
        turn=table.vec3("turn", Animation.turn, unit="degrees per second"),
        pivot=table.vec3("pivot", unit="metres") if "pivot" in table else None,
        sway=table.vec3("sway", Animation.sway, unit="metres"),
        period=table.number("period", Animation.period, low=1e-3, unit="seconds"),
    )


def _read_light(table: _Table) -> Light:
    kind = table.choice("kind", _LIGHT_KEYS)
    table.only("kind", _LIGHT_KEYS[kind], _LIGHT_KEYS["spot"])
    spot = kind == "spot"
    at = Light.at if kind == "directional" else table.vec3("at", unit="metres")
    target = table.vec3("target", unit="metres") if "target" in table else None
    direction = None
    if target is not None:
        if "direction" in table:
            table.fail("direction", "target is given too; expected exactly one of the two")
        if target == at:
            table.fail("target", "is where the light itself is; move one of the two")
    elif kind != "point":
        if spot and "direction" not in table:
            table.fail("target", "a spot light needs a target (a point) or a direction")
        direction = table.vec3("direction")
        if not any(abs(component) >= _SMALLEST for component in direction):
            table.fail("direction", "has no length; expected the way the light travels, such as [0, 0, -1]")
    outer = table.number("outer_angle", low=0.0, high=90.0, unit="degrees") if spot else Light.outer_angle
    inner = table.number("inner_angle", low=0.0, high=90.0, unit="degrees") if spot else Light.inner_angle
    if inner > outer:
        table.fail("inner_angle", f"must not be above outer_angle ({outer:g})")
    attenuation = table.vec3("attenuation", Light.attenuation, low=0.0)
    if not any(term >= _SMALLEST for term in attenuation):
        table.fail("attenuation", "is zero everywhere; expected constant, linear and quadratic term, such as [0, 0, 1]")
    return Light(
        kind=cast(Any, kind),
        intensity=table.number("intensity", low=0.0),
        color=table.vec3("color", Light.color, low=0.0),
        at=at,
        target=target,
        direction=direction,
        inner_angle=inner,
        outer_angle=outer,
        attenuation=attenuation,
        radius=table.number("radius", Light.radius, low=0.0, unit="metres"),
        animate=_read_animation(table),
    )


def _read_exposure(table: _Table) -> Exposure:
    if table.data.get("scale") == "auto":
        return Exposure("auto")
    if isinstance(table.data.get("scale"), str):
        table.fail("scale", 'expected a number, 0 or more, or "auto"')
    return Exposure(table.number("scale", 1.0, low=0.0))


# --- Calibration files ------------------------------------------------------------------------------------------------

# Keys as OpenCV's, ROS's, ArUco's and the usual Python scripts write them.
_WIDTH_NAMES: Final = ("image_width", "image_Width", "width", "imageWidth")
_HEIGHT_NAMES: Final = ("image_height", "image_Height", "height", "imageHeight")
_SIZE_NAMES: Final = ("image_size", "imageSize", "image_Size", "calibImageDimensions", "resolution")
_MATRIX_NAMES: Final = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "CameraMatrix", "K", "mtx", "intrinsics")
_DISTORTION_NAMES: Final = (
    *("distortion_coefficients", "Distortion_Coefficients", "distortionCoefficients", "dist_coeffs", "distCoeffs"),
    *("dist_coeff", "dist", "distortion", "D"),
)


def _read_calibration(path: Path, transfer: str | Path) -> Camera:
    if not path.is_file():
        raise SceneError(f"{path}: no such calibration file")
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        if not storage.isOpened():
            raise SceneError(f"{path}: the calibration cannot be read; expected OpenCV's YAML, JSON or XML")
        found = {
            what: _calibration_numbers(storage, names)
            for what, names in {
                "width": _WIDTH_NAMES,
                "height": _HEIGHT_NAMES,
                "size": _SIZE_NAMES,
                "matrix": _MATRIX_NAMES,
                "distortion": _DISTORTION_NAMES,
            }.items()
        }
        storage.release()
    except (
        cv2.error,
        SystemError,
    ) as error:  # SystemError: how OpenCV's constructor reports a file that does not parse
        raise SceneError(f"{path}: the calibration cannot be read; expected OpenCV's YAML, JSON or XML") from error

    def fail(names: Sequence[str], value: object, right: str) -> NoReturn:
        shown = " is missing" if value is None else f" = {_show(value)}"
        raise SceneError(f"{path}: {names[0]}{shown}: {right}")

    size = found["size"] or [*(found["width"] or []), *(found["height"] or [])]
    if len(size) != 2 or not all(1 <= side <= _MOST_PIXELS and side == int(side) for side in size):
        fail(
            _WIDTH_NAMES,
            size or None,
            f"expected image_width and image_height, whole numbers to {_MOST_PIXELS} (pixels)",
        )
    k = found["matrix"]
    if k is None or len(k) != 9 or not all(map(math.isfinite, k)):
        fail(_MATRIX_NAMES, k, "expected a 3x3 matrix of finite numbers")
    if not (_SMALLEST <= k[0] <= _LARGEST and _SMALLEST <= k[4] <= _LARGEST):
        fail(_MATRIX_NAMES, k, "focal lengths must be above 0 (pixels)")
    if any(abs(k[i]) > 1e-9 * k[0] for i in (1, 3, 6, 7)) or abs(k[8] - 1.0) > 1e-9:
        fail(_MATRIX_NAMES, k, "expected [fx, 0, cx, 0, fy, cy, 0, 0, 1]: a camera without skew")
    distortion = found["distortion"] or Camera.distortion
    if len(distortion) > 8 and not any(distortion[8:]):
        distortion = distortion[:8]
    if len(distortion) not in (4, 5, 8) or not all(map(math.isfinite, distortion)):
        fail(_DISTORTION_NAMES, distortion, "expected 4, 5 or 8 finite values (k1 k2 p1 p2 [k3 [k4 k5 k6]])")
    return Camera(int(size[0]), int(size[1]), k[0], k[4], k[2], k[5], tuple(distortion), transfer)


def _calibration_numbers(storage: Any, names: Sequence[str]) -> list[float] | None:
    """All numbers under the first of ``names`` that is there, in order; None where none is."""
    for name in names:
        node = storage.getNode(name)
        if not node.empty():
            return _flatten(node)
    return None


def _flatten(node: Any) -> list[float]:
    """Numbers of a matrix, of a map with ``data`` (ROS), of nested lists, or a single one."""
    if node.isMap():
        return _flatten(node.getNode("data"))
    if node.isSeq():
        return [number for i in range(node.size()) for number in _flatten(node.at(i))]
    return [float(node.real())] if node.isReal() or node.isInt() else []


# --- The public functions ---------------------------------------------------------------------------------------------


def bundled_scenes() -> dict[str, Path]:
    """The scenes that come with the program: name to file, in order of name."""
    folder = Path(str(importlib.resources.files("warp_ar.scenes")))
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def load_scene(path_or_name: str | Path) -> Scene:
    """Read a scene file.

    Args:
        path_or_name: A file, or the name of a bundled scene.

    Raises:
        SceneError: No such scene, or something in it is wrong; one line names file, key, value and what would be right.
    """
    path = Path(path_or_name)
    try:
        found = path.is_file()
    except (OSError, ValueError):  # too long, or a zero byte
        found = False
    if not found:
        bundled = bundled_scenes()
        if str(path_or_name) not in bundled:
            hint = f"a file, or a bundled scene ({_nearest(str(path_or_name), bundled)})" if bundled else "a scene file"
            raise SceneError(f"{path}: no such scene; expected {hint}")
        path = bundled[str(path_or_name)]
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: not a text file in UTF-8 (byte {error.start}); expected TOML") from error
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}") from error
    return loads_scene(text, path)


def loads_scene(text: str, path: str | Path | None = None) -> Scene:
    """Read a scene from text.

    Args:
        text: TOML.
        path: The file that the text stands for: named in errors, and its folder is where relative paths start. Without
            it they start at the current folder.

    Raises:
        SceneError: As :func:`load_scene`.
    """
    path = None if path is None else Path(path)
    label = "scene" if path is None else str(path)
    folder = Path.cwd() if path is None else path.parent.resolve()
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # ValueError: TOMLDecodeError, and integers of too many digits
        raise SceneError(f"{label}: not valid TOML: {' '.join(str(error).split())}") from error

    top = _Table(label, folder, "", {key: data[key] for key in data if key not in _SECTIONS}, (*_TOP_KEYS, *_SECTIONS))
    if "schema" not in top:
        top.fail("schema", f"expected schema = {SCHEMA} at the top of the file")
    if top.data["schema"] is True or top.data["schema"] != SCHEMA:
        top.fail("schema", f"this program reads schema {SCHEMA}")
    if "camera" not in data:
        raise SceneError(f"{label}: [camera] is missing: give {', '.join(_INTRINSICS[:6])}, or calibration")

    def one(section: str, keys: Sequence[str], read: Any) -> Any:
        return read(_Table(label, folder, section, data[section], keys)) if section in data else None

    def many(section: str, keys: Sequence[str], read: Any, *, single: bool = False) -> tuple[Any, ...]:
        value = data.get(section, [])
        if single and isinstance(value, dict):
            return (read(_Table(label, folder, section, value, keys)),)
        if not isinstance(value, list):
            raise SceneError(f"{label}: {section}: there may be several: write [[{section}]] instead of [{section}]")
        return tuple(read(_Table(label, folder, f"{section}[{i}]", item, keys)) for i, item in enumerate(value))

    scene = Scene(
        schema=SCHEMA,
        name=top.text("name", "scene" if path is None else path.stem),
        camera=one("camera", (*_INTRINSICS, "transfer", "calibration"), _read_camera),
        source=one("source", _keys(SourceSpec), _read_source),
        marker=one("marker", _keys(Marker), _read_marker) or Marker(),
        probes=many("probe", _keys(Probe), _read_probe, single=True),
        proxies=many("proxy", _keys(Proxy), _read_proxy),
        objects=many("object", _keys(Object), _read_object),
        lights=many("light", _keys(Light), _read_light),
        exposure=one("exposure", _keys(Exposure), _read_exposure) or Exposure(),
        path=path,
    )
    placed = [section for section in ("probe", "proxy", "object", "light") if data.get(section)]
    if placed and "marker" not in data:
        raise SceneError(
            f"{label}: [marker] is missing: [{placed[0]}] has its place in the marker's frame; give its size"
        )
    return scene


def dumps_scene(scene: Scene, folder: str | Path | None = None) -> str:
    """Write a scene as TOML that :func:`loads_scene` turns into an equal one.

    Args:
        scene: The scene.
        folder: Where the text will be saved: paths to things inside it are written relative to it, all others, and
            without it all paths, in full.

    Returns:
        The text. A camera read from a calibration file is written as its numbers.
    """
    base = None if folder is None else Path(folder).resolve()

    def value(item: Any) -> str:
        if isinstance(item, Path):
            item = (item.relative_to(base) if base and item.is_relative_to(base) else item).as_posix()
        if isinstance(item, str):
            return json.dumps(item, ensure_ascii=False).replace("\x7f", "\\u007F")  # TOML, unlike JSON, escapes DEL
        if isinstance(item, Board):
            return value(str(item))
        if isinstance(item, Mapping):
            return "{ " + ", ".join(f"{key} = {value(entry)}" for key, entry in item.items()) + " }"
        if isinstance(item, tuple):
            return "[" + ", ".join(map(value, item)) + "]"
        return repr(float(item)) if isinstance(item, float) else repr(item)  # NumPy's say their type

    def table(item: Any, keys: Iterable[str]) -> list[str]:
        """Lines of the keys that have a value."""
        entries = ((key, getattr(item, key)) for key in keys)
        return [f"{key} = {value(entry)}" for key, entry in entries if entry is not None]

    def animation(item: Object | Light) -> list[str]:
        if item.animate is None:
            return []
        fields = {key: getattr(item.animate, key) for key in _keys(Animation)}
        return [f"animate = {value({key: entry for key, entry in fields.items() if entry is not None})}"]

    lines = [f"schema = {scene.schema}", f"name = {value(scene.name)}"]
    lines += ["", "[camera]", *table(scene.camera, (*_INTRINSICS, "transfer"))]
    if scene.source is not None:
        lines += ["", "[source]", *table(scene.source, _keys(SourceSpec))]
    keys = ("dictionary", "id", "size", "white") if scene.marker.board is None else ("dictionary", "board", "white")
    lines += ["", "[marker]", *table(scene.marker, keys)]
    for probe in scene.probes:
        lines += ["", "[[probe]]", *table(probe, _keys(Probe))]
    for proxy in scene.proxies:
        lines += ["", "[[proxy]]", *table(proxy, ("shape", "at", "rotate", *_PROXY_KEYS[proxy.shape]))]
    for thing in scene.objects:
        model = next(name for name, kind in _MATERIALS.items() if isinstance(thing.material, kind))
        lines += ["", "[[object]]", *table(thing, ("shape", *_OBJECT_KEYS[thing.shape], "at", "rotate", "scale"))]
        lines += animation(thing)
        lines += [
            "",
            "[object.material]",
            f"model = {value(model)}",
            *table(thing.material, _keys(type(thing.material))),
        ]
    for light in scene.lights:
        lines += ["", "[[light]]", *table(light, ("kind", *_LIGHT_KEYS[light.kind], "color", "intensity"))]
        lines += animation(light)
    lines += ["", "[exposure]", *table(scene.exposure, ("scale",))]
    return "\n".join(lines) + "\n"
