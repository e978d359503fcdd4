"""Frozen dataclasses of a scene, one per section of a scene file.

Units are metres and degrees; colours are linear RGB. The world frame is the marker's frame: origin at the centre of the
marker or board, x to the right and y up on the printed page, z out of the page.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from pathlib import Path, PurePosixPath
from typing import Annotated, ClassVar, Final, Literal, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from warp_ar.declared import check_fields
from warp_ar.errors import SceneError
from warp_ar.files import is_file
from warp_ar.scene.fields import LIGHT_COLOR, Checked, Key, Length, Place, Share, Turn, Vec3, fail
from warp_ar.scene.geometry import Mesh, rotation_matrix
from warp_ar.scene.materials import OF_THE_FILE, RGB, EmissiveMaterial, Material
from warp_ar.scene.messages import MOST_PIXELS, SMALLEST
from warp_ar.srgb import TRANSFERS, is_formula

FloatMatrix: TypeAlias = npt.NDArray[np.float64]

SCHEMA: Final = 1
"""Version of the scene file format that this program reads."""
ORIGIN: Final[Vec3] = (0.0, 0.0, 0.0)
NO_DISTORTION: Final = (0.0, 0.0, 0.0, 0.0, 0.0)
SILVERED: Final = (0.85, 0.85, 0.85)
"""Reflectance of a silvered Christmas ball, linear RGB."""
Size: TypeAlias = Annotated[tuple[float, ...], Key("metres", "[0.2, 0.1]", sizes=(), required=True)]
MeshFile: TypeAlias = Annotated[Path | None, Key("metres inside", '"table.ply"', right="a mesh", required=True)]
Intensity: TypeAlias = Annotated[float, Key("camera values", "2.2", low=0.0)]
ObjectName: TypeAlias = Annotated[str | None, Key("-", '"lamp"')]
LightPlace: TypeAlias = Annotated[Vec3, Key("metres", "[0.07, -0.06, 0.4]", required=True)]
Angle: TypeAlias = Annotated[float, Key("degrees", "13.0", low=0.0, high=90.0, required=True)]
Pixel: TypeAlias = Annotated[float, Key("pixels", "239.5")]
Focal: TypeAlias = Annotated[float, Key("pixels", "640.0", low=SMALLEST)]


@dataclasses.dataclass(frozen=True)
class Camera(Checked):
    """Pinhole camera with OpenCV's lens distortion; pixel centres have integer coordinates."""

    width: Annotated[int, Key("pixels", "640", low=1, high=MOST_PIXELS)]
    """Width of the picture, pixels."""
    height: Annotated[int, Key("pixels", "480", low=1, high=MOST_PIXELS)]
    """Height of the picture, pixels."""
    fx: Focal
    """Focal length along x, pixels."""
    fy: Focal
    """Focal length along y, pixels."""
    cx: Pixel
    """Column of the principal point, pixels."""
    cy: Pixel
    """Row of the principal point, pixels."""
    distortion: Annotated[tuple[float, ...], Key("-", "[-0.12, 0.05, 0.0, 0.0, 0.0]", sizes=(4, 5, 8))] = NO_DISTORTION
    """OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]]: 4, 5 or 8 values."""
    transfer: Annotated[str | Path, Key("-", '"gamma:2.2"')] = "srgb"
    """Encoding: "srgb", "linear", "gamma:G" (linear = value ** G), or a measured response's file."""
    field_of_view: Annotated[float | None, Key("degrees", "60.0", low=5.0, high=150.0)] = None
    """Horizontal field of view, degrees, of an uncalibrated camera instead of its numbers. Assumes square pixels, a
    central principal point and no distortion; fits any frame size."""

    def __post_init__(self) -> None:
        """Check all values."""
        super().__post_init__()
        if not is_formula(str(self.transfer)) and not is_file(self.transfer):
            fail(self, "transfer", f"expected {TRANSFERS}")

    @classmethod
    def guessed(cls, width: int, height: int, field_of_view: float, transfer: str | Path = "srgb") -> Camera:
        """Return a camera of which only the field of view is given, with square pixels and a central principal point.

        Args:
            width: Width of the picture in pixels.
            height: Height of the picture in pixels.
            field_of_view: Horizontal field of view in degrees.
            transfer: Encoding of its values.
        """
        focal = 0.5 * width / math.tan(math.radians(0.5 * field_of_view))
        center = (0.5 * (width - 1), 0.5 * (height - 1))
        return cls(width, height, focal, focal, *center, transfer=transfer, field_of_view=field_of_view)

    def matrix(self) -> FloatMatrix:
        """Return the camera matrix K, (3, 3), in pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def scaled_to(self, width: int, height: int) -> Camera:
        """Return the camera for the same picture resampled to another size.

        A pixel centre has integer coordinates, so the pixel's area begins at x - 1/2. Scaling by s therefore gives cx'
        = (cx + 0.5) s - 0.5.

        Args:
            width: New width in pixels.
            height: New height in pixels.

        Raises:
            SceneError: The new size has another aspect ratio: it is a crop, not a resampling.
        """
        if (width, height) == (self.width, self.height):
            return self
        if self.field_of_view is not None and min(width, height) >= 1:
            return Camera.guessed(width, height, self.field_of_view, self.transfer)
        if width < 1 or height < 1 or width * self.height != height * self.width:
            sideways = width * self.width == height * self.height
            turned = "turn the frames by 90 degrees, " if sideways else ""
            raise SceneError(
                f"camera: calibrated for {self.width}x{self.height}, frames are {width}x{height}: another aspect "
                f"ratio, so the intrinsics cannot be scaled; {turned}record at the calibrated aspect or calibrate at "
                "this size"
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


@dataclasses.dataclass(frozen=True)
class SourceSpec(Checked):
    """Source of frames: exactly one of ``path``, ``camera`` and ``synthetic`` is given."""

    path: Annotated[Path | None, Key("-", '"frames"', right="a folder of frames or a video")] = None
    """Folder of frames in name order, or a video."""
    camera: Annotated[int | None, Key("-", "0", low=0, high=1023)] = None
    """Index of a capture device."""
    synthetic: Annotated[str | None, Key("-", '"card"', right="the name of a generated source")] = None
    """Name of a generated source."""
    fps: Annotated[float | None, Key("frames per second", "24.0", low=1e-3, high=1e5)] = None
    """Frames per second; default: the source's own."""
    exposures: Annotated[
        tuple[float, ...] | None,
        Key("seconds", "[0.016, 0.001]", low=1e-6, high=1e3, sizes=(2, 3, 4, 5, 6, 7, 8)),
    ] = None
    """Exposure times, seconds, that the frames have in turn; a camera is set to them."""
    shown: Annotated[float | None, Key("seconds", "0.001", low=1e-6, high=1e3)] = None
    """Exposure time, seconds, of the frames that are shown; default: the longest."""
    metering: Annotated[Literal["fixed", "automatic"] | None, Key("-", '"automatic"')] = None
    """Metering: "fixed" (default), or "automatic" if exposure and white balance may drift: a change of all surfaces
    alike is then the camera's."""

    def __post_init__(self) -> None:
        """Check all values."""
        super().__post_init__()
        given = [key for key in ("path", "camera", "synthetic") if getattr(self, key) is not None]
        if len(given) != 1:
            also = f"{given[0]} is given too; " if given else ""
            fail(self, given[1] if given else "path", f"{also}expected exactly one of path, camera and synthetic")


@dataclasses.dataclass(frozen=True)
class CharucoBoard(Checked):
    """Chessboard with a marker in each white square, written ``"charuco 5x7 0.04 0.03"`` in a scene file."""

    columns: Annotated[int, Key(low=2)]
    """Squares along x."""
    rows: Annotated[int, Key(low=2)]
    """Squares along y."""
    square_length: Length
    """Side of a square in metres."""
    marker_length: Length
    """Side of a marker in metres."""
    legacy: bool = False
    """True for the layout of OpenCV before 4.6, which calib.io prints: a board with an even number of rows begins with
    a marker."""

    def __post_init__(self) -> None:
        """Check all values."""
        super().__post_init__()
        if self.marker_length >= self.square_length:
            fail(self, "marker_length", "a marker must be smaller than its square")

    @property
    def marker_count(self) -> int:
        """Return the number of markers; their ids are 0, 1, 2, ..."""
        return self.columns * self.rows // 2

    @property
    def size(self) -> tuple[float, float]:
        """Return width and height of the whole board in metres; the world's origin is its centre."""
        return self.columns * self.square_length, self.rows * self.square_length

    def __str__(self) -> str:
        kind = "charuco-legacy" if self.legacy else "charuco"
        return f"{kind} {self.columns}x{self.rows} {self.square_length!r} {self.marker_length!r}"


@dataclasses.dataclass(frozen=True)
class GridBoard(Checked):
    """Grid of markers with gaps between them, written ``"grid 4x3 0.04 0.01"`` in a scene file."""

    columns: Annotated[int, Key(low=1)]
    """Markers along x."""
    rows: Annotated[int, Key(low=1)]
    """Markers along y."""
    marker_length: Length
    """Side of a marker in metres."""
    separation: Length
    """Gap between neighbouring markers in metres."""

    @property
    def marker_count(self) -> int:
        """Return the number of markers; their ids are 0, 1, 2, ..."""
        return self.columns * self.rows

    @property
    def size(self) -> tuple[float, float]:
        """Return width and height between outer marker edges in metres; the world's origin is the centre."""
        pitch = self.marker_length + self.separation
        return self.columns * pitch - self.separation, self.rows * pitch - self.separation

    def __str__(self) -> str:
        return f"grid {self.columns}x{self.rows} {self.marker_length!r} {self.separation!r}"


Board: TypeAlias = CharucoBoard | GridBoard
FLATTEST: Final = 1e5
"""Ratio of the longest to the shortest image of a unit vector above which a stretched mesh is too flat for rays."""
SIDES: Final = {"plane": 2, "rect": 2, "box": 3}
"""Number of values that ``size`` needs, by shape."""


def _check_sides(item: Proxy | Object | AreaLight, shape: str) -> None:
    """Check that ``size`` has as many positive lengths as a shape needs; further values are ignored."""
    count = SIDES.get(shape, 0)
    if len(item.size) < count or any(length < SMALLEST for length in item.size[:count]):  # NaN passes
        fail(item, "size", f"expected {count} lengths above 0, metres")


INTRINSICS: Final = ("width", "height", "fx", "fy", "cx", "cy", "distortion")
"""Keys of ``[camera]`` that give the calibration as numbers."""


DICTIONARIES: Final = {name: int(getattr(cv2.aruco, name)) for name in dir(cv2.aruco) if name.startswith("DICT_")}
"""OpenCV's dictionaries of markers by name."""
TURNS: Final = (0, 90, 180, 270)
"""Allowed values of ``Marker.turn``, degrees."""


@dataclasses.dataclass(frozen=True)
class Marker(Checked):
    """Printed marker or board of markers whose frame is the world frame."""

    dictionary: Annotated[str, Key("-", '"DICT_APRILTAG_36h11"', words=tuple(DICTIONARIES))] = "DICT_4X4_50"
    """OpenCV's name of the ArUco or AprilTag dictionary."""
    id: Annotated[int, Key("-", "7")] = 0
    """Number of the marker; unused with a board."""
    size: Annotated[float, Key("metres", "0.08", low=SMALLEST, required=True)] = 0.08
    """Side of the black square, metres; unused with a board."""
    white: Annotated[float, Key("reflectance, 0 to 1", "0.85", low=0.01, high=1.0)] = 0.85
    """Diffuse reflectance of the white paper, 0 to 1."""
    board: Annotated[Board | None, Key("metres", '"charuco 5x7 0.035 0.026"')] = None
    """Board instead of a single marker, lengths in metres."""
    turn: Annotated[int, Key("degrees", "180", low=0, high=270)] = 0
    """Counterclockwise turn of the print from OpenCV's drawing, degrees: 0, 90, 180 or 270; 180 for the pictures that
    AprilTag's authors publish."""

    def __post_init__(self) -> None:
        """Check all values."""
        if self.turn not in TURNS:
            fail(self, "turn", "expected 0, 90, 180 or 270 degrees")
        super().__post_init__()
        count = len(cv2.aruco.getPredefinedDictionary(DICTIONARIES[self.dictionary]).bytesList)
        if self.board is None and self.id >= count:
            fail(self, "id", f"expected a whole number from 0 to {count - 1}")
        if self.board is not None and self.board.marker_count > count:
            fail(self, "board", f"needs {self.board.marker_count} markers; {self.dictionary} has {count}")


OwnMarker: TypeAlias = Annotated[Marker | None, Key("-", "{ id = 7, size = 0.05 }")]


@dataclasses.dataclass(frozen=True)
class Probe(Checked):
    """A mirror ball."""

    center: Annotated[Vec3, Key("metres", "[-0.12, 0.03, 0.0346]")]
    """Centre, metres."""
    radius: Length
    """Radius, metres."""
    reflectance: Annotated[RGB, Key("0 to 1 per channel", "[0.85, 0.85, 0.87]", low=0.01, high=1.0, grey=True)] = (
        SILVERED
    )
    """Share of light that the ball reflects, 0 to 1, RGB or one number; default: a silvered ornament. Corrected where
    frames show another, except in the preset ``paper``."""
    marker: OwnMarker = None
    """Own marker or board, in whose frame the centre is. While it is lost, the ball's last light remains."""


@dataclasses.dataclass(frozen=True)
class ProxyMaterial(Checked):
    """Specular reflection of a proxy, in addition to its diffuse reflection: glTF's rough dielectric."""

    roughness: Share = 0.1
    """glTF's roughness: 0 (mirror) to 1 (matt); a polished table has about 0.1."""
    reflectance: Annotated[RGB, Key("0 to 1 per channel", "[0.04, 0.04, 0.05]", low=0.0, high=1.0, grey=True)] = (
        0.04,
        0.04,
        0.04,
    )
    """Specular reflectance seen from ahead, glTF's F0, RGB or one number; 0.04 is lacquer or glass."""


@dataclasses.dataclass(frozen=True)
class Proxy(Checked):
    """Simplified physical geometry: it receives virtual light and shadow, and hides virtual objects behind it."""

    USES: ClassVar = {"plane": ("size",), "box": ("size",), "mesh": ("file",)}

    shape: Annotated[Literal["plane", "box", "mesh"], Key("-", '"plane"')]
    """Shape: "plane" in its own x and y, facing +z; "box"; or "mesh"."""
    at: Place = ORIGIN
    """Centre (mesh: origin), metres."""
    rotate: Turn = ORIGIN
    """Degrees about the fixed x, then y, then z axis."""
    size: Size = ()
    """Whole lengths, metres: x and y of a plane; x, y and z of a box."""
    file: MeshFile = None
    """Mesh file, in metres."""
    marker: OwnMarker = None
    """Own marker or board, in whose frame it stands; absent while that is lost."""
    material: Annotated[ProxyMaterial | None, Key("-", "{ roughness = 0.1 }")] = None
    """Reflection of virtual things; default: none."""

    def __post_init__(self) -> None:
        """Check all values."""
        super().__post_init__()
        if self.shape == "mesh" and self.file is None:
            fail(self, "file", "a mesh needs its file")
        _check_sides(self, self.shape)


@dataclasses.dataclass(frozen=True)
class Animation(Checked):
    """Motion of an object or light; the default is no motion.

    At t seconds the body's origin is at R(t) (at - pivot) + pivot + sway sin(2 pi t / period), and the body is rotated
    by R(t). R(t) rotates by the angles ``turn`` t degrees about the fixed x, then y, then z axis.
    """

    turn: Annotated[Vec3, Key("degrees per second", "[0.0, 0.0, 30.0]")] = ORIGIN
    """Degrees per second about the fixed x, y and z axis."""
    pivot: Annotated[Vec3 | None, Key("metres", "[0.0, 0.0, 0.0]")] = None
    """Centre of ``turn``, metres; default: the body's own ``at``."""
    sway: Annotated[Vec3, Key("metres", "[0.02, 0.0, 0.0]")] = ORIGIN
    """Amplitude of a swing to and fro, metres."""
    period: Annotated[float, Key("seconds", "3.0", low=1e-3)] = 4.0
    """Duration of one swing, seconds."""

    def rotation_at(self, seconds: float) -> FloatMatrix:
        """Return the rotation R(t), (3, 3)."""
        return rotation_matrix([rate * seconds for rate in self.turn])

    def position_at(self, seconds: float, at: Vec3) -> FloatMatrix:
        """Return the position of a body at a time, (3,) in metres; ``at`` is its position without motion."""
        pivot = np.array(at if self.pivot is None else self.pivot)
        swing = np.array(self.sway) * math.sin(2.0 * math.pi * (seconds / self.period))
        position: FloatMatrix = self.rotation_at(seconds) @ (np.array(at) - pivot) + pivot + swing
        return position


Motion: TypeAlias = Annotated[Animation | None, Key("-", "{ sway = [0.05, 0.0, 0.0] }")]


@dataclasses.dataclass(frozen=True)
class Play(Checked):
    """Playback of a node animation of a glTF file."""

    animation: Annotated[str | int, Key("-", '"Open"')] = 0
    """Name of the animation, or its number from 0."""
    loop: Annotated[bool, Key("-", "false")] = True
    """True to repeat it; else it holds the last pose."""
    start: Annotated[float, Key("seconds", "2.0")] = 0.0
    """Start, seconds after the first frame; before, it holds its first pose."""
    speed: Annotated[float, Key("-", "0.5", low=SMALLEST)] = 1.0
    """Seconds of the animation per second."""
    offset: Annotated[float, Key("seconds", "1.5", low=0.0)] = 0.0
    """Time of the animation at the start, seconds."""
    paused: Annotated[bool, Key("-", "true")] = False
    """True to hold the pose of the start."""

    def time_at(self, seconds: float, duration: float) -> float:
        """Return the animation's time ``seconds`` after the first frame; ``duration`` is the time of its last key."""
        passed = self.offset
        if not self.paused:
            passed += max((seconds - self.start) * self.speed, 0.0)
        if not self.loop:
            return min(passed, duration)
        return math.fmod(passed, duration) if duration > 0.0 else 0.0


@dataclasses.dataclass(frozen=True)
class Object(Checked):
    """Virtual object.

    A point p of its shape is at R (scale stretch p) + at in the world. Fields that its shape does not use are zero.
    """

    USES: ClassVar = {
        "mesh": ("file", "stretch"),
        "sphere": ("radius",),
        "box": ("size",),
        "torus": ("major_radius", "minor_radius"),
        "rect": ("size",),
        "disk": ("radius",),
        "tube": ("radius", "length"),
    }

    shape: Annotated[Literal["mesh", "sphere", "box", "torus", "rect", "disk", "tube"], Key("-", '"sphere"')]
    """Shape: "mesh", "sphere", "box", "torus" or "tube" around its z axis, "rect" or "disk" facing its +z. All but
    meshes are centred at their origin."""
    file: MeshFile = None
    """Mesh file, metres. Its base-colour textures multiply the first colour of a material given here."""
    radius: Length = 0.0
    """Radius of a sphere, disk or tube, metres."""
    size: Size = ORIGIN
    """Whole lengths of a box, or x and y of a rect, metres."""
    length: Length = 0.0
    """Length of a tube, metres; its ends are open."""
    major_radius: Annotated[float, Key("metres", "0.05", low=SMALLEST, required=True)] = 0.0
    """Distance of a torus's tube from its axis, metres."""
    minor_radius: Length = 0.0
    """Radius of a torus's tube, metres."""
    at: Place = ORIGIN
    """Position, metres."""
    rotate: Turn = ORIGIN
    """Degrees about the fixed x, then y, then z axis."""
    scale: Annotated[float, Key("-", "0.026", low=SMALLEST)] = 1.0
    """Factor on all lengths."""
    stretch: Annotated[tuple[float, ...] | None, Key("-", "[1, 0.2, 0, 0, 1, 0, 0, 0, -1]", sizes=(9,))] = None
    """Invertible 3x3 matrix, by rows, that maps a mesh before ``scale``."""
    material: Annotated[Material, Key("-", '{ model = "mirror" }')] = OF_THE_FILE
    """Material."""
    animate: Motion = None
    """Movement."""
    play: Annotated[Play | None, Key("-", "{ animation = 0 }")] = None
    """Animation of its glTF file to play; default: its nodes stand still."""
    marker: OwnMarker = None
    """Own marker or board, in whose frame it stands; absent while that is lost."""
    name: ObjectName = None
    """Name in Python: ``pipeline.objects["lamp"]``."""
    mesh: Mesh | None = dataclasses.field(default=None, repr=False)
    """Mesh in memory instead of a file, as ``object_from_trimesh`` sets it; a scene file has no key for it."""

    def __post_init__(self) -> None:
        """Check all values."""
        super().__post_init__()
        if self.shape == "mesh" and self.file is None and self.mesh is None:
            fail(self, "file", "a mesh needs its file, or a mesh in memory as object_from_trimesh gives")
        if self.stretch is not None and self.shape != "mesh":
            fail(
                self,
                "stretch",
                f"expected a mesh, as by object_from_trimesh; a {self.shape} has one scale for all",
            )
        if not np.linalg.cond(self.stretch_matrix()) < FLATTEST:
            fail(self, "stretch", "flattens; expected an invertible matrix")
        if self.shape == "torus" and self.minor_radius >= self.major_radius:
            fail(self, "minor_radius", f"expected less than major_radius, {self.major_radius:g}")
        _check_sides(self, self.shape)

    def stretch_matrix(self) -> FloatMatrix:
        """Return ``stretch``, (3, 3)."""
        return np.eye(3) if self.stretch is None else np.reshape(self.stretch, (3, 3))

    def pose_at(self, seconds: float) -> tuple[FloatMatrix, FloatMatrix]:
        """Return the rotation R, (3, 3), and the position, (3,) in metres, ``seconds`` after the first frame."""
        rotation = rotation_matrix(self.rotate)
        if self.animate is None:
            return rotation, np.array(self.at)
        return self.animate.rotation_at(seconds) @ rotation, self.animate.position_at(seconds, self.at)


@dataclasses.dataclass(frozen=True)
class Light(Checked):
    """Virtual light without visible surface.

    A white Lambertian surface that faces a point light of intensity I at distance d has linear camera value I / (pi (a
    + b d + c d^2)) with attenuation (a, b, c); a surface that faces a directional light has I / pi.
    """

    USES: ClassVar = {
        "point": ("at", "attenuation", "radius"),
        "spot": ("at", "target", "direction", "inner_angle", "outer_angle", "attenuation", "radius"),
        "directional": ("direction",),
    }

    kind: Annotated[Literal["point", "spot", "directional"], Key("-", '"point"')]
    """Kind: "point", "spot" or "directional"."""
    intensity: Intensity
    """Radiant intensity (point, spot) or irradiance (directional), camera values."""
    color: Annotated[RGB, LIGHT_COLOR] = (1.0, 1.0, 1.0)
    """Factor per channel, linear RGB."""
    at: LightPlace = ORIGIN
    """Position, metres."""
    target: Annotated[Vec3 | None, Key("metres", "[0.135, 0.04, 0.01]")] = None
    """Point, metres, that a spot aims at, also when it moves."""
    direction: Annotated[Vec3 | None, Key("-", "[0.3, 0.0, -1.0]")] = None
    """Direction in which the light travels, instead of a target; turns with the light."""
    inner_angle: Angle = 0.0
    """Half angle, degrees, of a spot's full intensity."""
    outer_angle: Angle = 0.0
    """Half angle, degrees, at which a spot ends, after a linear fall."""
    attenuation: Annotated[Vec3, Key("1, 1/m, 1/m²", "[0.0, 0.0, 1.0]", low=0.0)] = (0.0, 0.0, 1.0)
    """Constant, linear and quadratic term of the fall with distance: 1, 1/m, 1/m²."""
    radius: Annotated[float, Key("metres", "0.02", low=0.0)] = 0.0
    """Radius, metres, of a point or spot, for soft shadows."""
    animate: Motion = None
    """Movement."""
    marker: OwnMarker = None
    """Own marker or board, in whose frame it stands; absent while that is lost."""

    def __post_init__(self) -> None:
        """Check all values."""
        super().__post_init__()
        if self.kind == "spot" and self.target is None and self.direction is None:
            fail(self, "target", "a spot light needs a target or a direction")
        if self.direction is not None and max(map(abs, self.direction)) < SMALLEST:
            fail(self, "direction", "has no length; expected the way the light travels, such as (0, 0, -1)")
        if self.inner_angle > self.outer_angle:
            fail(self, "inner_angle", f"expected no more than outer_angle, {self.outer_angle:g}")
        if max(self.attenuation) < SMALLEST:
            right = "expected constant, linear and quadratic term, such as (0, 0, 1)"
            fail(self, "attenuation", f"is zero everywhere; {right}")

    def pose_at(self, seconds: float) -> tuple[FloatMatrix, FloatMatrix]:
        """Return position and unit direction of the light's rays, (3,) each, ``seconds`` after the first frame.

        The direction is -z for a point light, and for a spot light whose position coincides with its target.
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
class AreaLight(Checked):
    """Virtual light with a visible emitting surface."""

    USES: ClassVar = {
        "rect": ("at", "rotate", "size", "image", "two_sided", "name"),
        "disk": ("at", "rotate", "radius", "two_sided", "name"),
        "sphere": ("at", "rotate", "radius", "name"),
        "tube": ("at", "rotate", "radius", "length", "name"),
    }

    kind: Annotated[Literal["rect", "disk", "sphere", "tube"], Key("-", '"rect"')]
    """Kind: "rect" or "disk" shining along its +z, "sphere", or "tube" around its z axis."""
    intensity: Intensity
    """Radiance, camera values: 1 clips."""
    color: Annotated[RGB, LIGHT_COLOR] = (1.0, 1.0, 1.0)
    """Factor per channel, linear RGB."""
    at: LightPlace = ORIGIN
    """Position, metres."""
    rotate: Turn = ORIGIN
    """Degrees about the fixed x, then y, then z axis."""
    size: Size = ()
    """Whole lengths of a rect along x and y, metres."""
    radius: Length = 0.0
    """Radius of a disk, sphere or tube, metres."""
    length: Length = 0.0
    """Length of a tube, metres; its ends are open."""
    image: Annotated[Path | None, Key("-", '"picture.png"', right="a picture")] = None
    """Picture that multiplies the radiance of a rect: sRGB-encoded, or linear (HDR, OpenEXR)."""
    two_sided: Annotated[bool, Key("-", "true")] = False
    """True if the back shines too; else it is invisible from behind, but throws a shadow."""
    animate: Motion = None
    """Movement."""
    marker: OwnMarker = None
    """Own marker or board, in whose frame it stands; absent while that is lost."""
    name: ObjectName = None
    """Name in Python, among ``pipeline.objects``."""

    def __post_init__(self) -> None:
        """Check all values."""
        super().__post_init__()
        _check_sides(self, self.kind)

    def as_object(self) -> Object:
        """Return the emissive object that represents this light in a ``Scene``."""
        return Object(
            self.kind,
            radius=self.radius,
            size=self.size or Object.size,
            length=self.length,
            at=self.at,
            rotate=self.rotate,
            material=EmissiveMaterial(self.color, self.intensity, self.image, self.two_sided),
            animate=self.animate,
            marker=self.marker,
            name=self.name,
        )


LATLONG_AXES: Final = ("z-up", "blender", "y-up", "opengl")
"""Names of axis conventions of latlong maps; ``z-up`` is the one used internally. ``light.latlong_axes`` defines
them."""


@dataclasses.dataclass(frozen=True)
class CapturedLight(Checked):
    """Light of the environment, read from a file instead of from a mirror ball in the frames."""

    file: Annotated[Path, Key("-", '"light.exr"', right="a captured light (OpenEXR or HDR)")]
    """Latlong OpenEXR or Radiance HDR, by ``warp_ar.capture`` or another program."""
    scale: Annotated[float, Key("-", "0.5", low=SMALLEST)] = 1.0
    """Factor on the file's values, to match the camera's."""
    colors: Annotated[tuple[float, ...] | None, Key("-", "[0.8, 0.2, 0, 0.1, 0.9, 0, 0, 0.2, 0.7]", sizes=(9,))] = None
    """Matrix from the file's RGB to the camera's, row by row."""
    rotate: Turn = ORIGIN
    """Degrees about the fixed x, then y, then z axis."""
    axes: Annotated[str | None, Key("-", '"y-up"', words=LATLONG_AXES)] = None
    """Axes of the file: "z-up", "blender", "y-up" or "opengl"; default: the file's, else y-up of an OpenEXR and blender
    of an HDR."""


@dataclasses.dataclass(frozen=True)
class PoseKeys:
    """Keys of ``[pose]``, which give a ``PoseSpec`` in one of four ways."""

    R: Annotated[tuple[float, ...] | None, Key("-", "[1, 0, 0, 0, 0, -1, 0, 1, 0]", sizes=(9,))] = None
    """Rotation of camera_from_world, row by row; camera axes x right, y down, z forward."""
    t: Annotated[Vec3 | None, Key("metres", "[0.0, 0.1, 0.6]")] = None
    """Translation of camera_from_world, metres, with R or quaternion."""
    quaternion: Annotated[tuple[float, ...] | None, Key("-", "[0.7, 0.7, 0.0, 0.0]", sizes=(4,))] = None
    """Rotation of camera_from_world: w, x, y, z."""
    position: Annotated[Vec3 | None, Key("metres", "[0.0, -0.6, 0.1]")] = None
    """Position of the camera, metres, instead of camera_from_world."""
    rotate: Annotated[Vec3 | None, Key("degrees", "[-20.0, 0.0, 0.0]")] = None
    """Degrees about the fixed x, then y, then z axis, from a level camera that looks along +y."""
    file: Annotated[
        Path | None, Key("-", '"images.txt"', right="poses: COLMAP's images, OpenTrackIO, USD, or JSON")
    ] = None
    """A pose for every frame: COLMAP's or NeRF's by name, JSON, OpenTrackIO, USD."""


@dataclasses.dataclass(frozen=True)
class PoseSpec:
    """Given poses of the camera, used instead of tracking a marker.

    ``camera_from_world`` maps x_world to R x_world + t.

    The camera's axes are those of OpenCV and COLMAP: x right, y down, z forward.
    """

    poses: tuple[tuple[tuple[float, ...], Vec3], ...]
    """Pose of every frame, or a single pose for all frames: (R as 9 numbers row by row, t in metres)."""
    file: Path | None = None
    """File that the poses were read from."""
    names: tuple[str, ...] = ()
    """File names of the pictures that the poses belong to; empty if the file has no names."""
    cameras: tuple[str, ...] = ()
    """Number of each pose's camera in a COLMAP model; empty in other files."""

    def __post_init__(self) -> None:
        """Check the types, and that all numbers are finite."""
        check_fields(self)

    @functools.cached_property
    def _places(self) -> dict[str, list[int]]:
        """Indices of the poses by the file name of their picture, with and without suffix."""
        found: dict[str, list[int]] = {}
        for index, name in enumerate(map(PurePosixPath, self.names)):
            found.setdefault(f"/{name.name}", []).append(index)
            found.setdefault(name.stem, []).append(index)
        return found

    def index_of(self, name: str) -> int | None:
        """Return the index of the pose whose name shares the most trailing path components with a picture's path.

        Return None if no pose, or more than one, fits best.
        """
        path = PurePosixPath(name)
        indices = self._places.get(f"/{path.name}") or self._places.get(path.stem, [])
        folders = path.parts[-2::-1]

        def common(index: int) -> int:
            pairs = zip(folders, PurePosixPath(self.names[index]).parts[-2::-1], strict=False)
            return sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], pairs))

        best = sorted(indices, key=common)
        if not best or (len(best) > 1 and common(best[-1]) == common(best[-2])):
            return None
        return best[-1]

    def at(self, index: int, name: str = "") -> tuple[FloatMatrix, FloatMatrix] | None:
        """Return R, (3, 3), and t, (3,) in metres, of a frame; None if there is no pose for it.

        Args:
            index: Index of the frame in its clip; used where frames or poses have no names.
            name: Path of the frame's picture.
        """
        if name and self.names:
            place = self.index_of(name)
        else:
            place = 0 if len(self.poses) == 1 else index if index < len(self.poses) else None
        if place is None:
            return None
        rotation, translation = self.poses[place]
        return np.array(rotation).reshape(3, 3), np.array(translation)


@dataclasses.dataclass(frozen=True)
class Exposure(Checked):
    """A simulated shorter exposure."""

    scale: Annotated[float | Literal["auto"], Key("-", "0.5", low=0.0)] = 1.0
    """Factor on the frame's light; "auto" keeps highlights below clipping when virtual light is added."""


@dataclasses.dataclass(frozen=True)
class Scene:
    """Complete contents of a scene file: camera, world marker, mirror balls, proxies, virtual objects and lights."""

    camera: Camera
    """Camera that took the frames."""
    schema: int = SCHEMA
    """Version of the format."""
    name: str = "scene"
    """Display name; if omitted, the name of the scene file."""
    source: SourceSpec | None = None
    """Source of frames, or None."""
    marker: Marker = Marker()
    """Printed marker or board whose frame is the world frame."""
    probes: tuple[Probe, ...] = ()
    """Mirror balls that reflect the environment."""
    proxies: tuple[Proxy, ...] = ()
    """Modelled physical geometry."""
    objects: tuple[Object, ...] = ()
    """Virtual objects; emissive ones act as lights."""
    lights: tuple[Light, ...] = ()
    """Virtual lights without visible surface."""
    captured: CapturedLight | None = None
    """Environment light from a file, or None. With a file, mirror balls are ordinary physical objects."""
    pose: PoseSpec | None = None
    """Given poses of the camera, or None if the marker is tracked."""
    has_marker: bool = True
    """True if a printed marker lies at the origin; False if the file gives poses and no marker."""
    exposure: Exposure = Exposure()
    """Simulated exposure."""
    path: Path | None = dataclasses.field(default=None, compare=False)
    """File that the scene was read from, or None."""

    def __post_init__(self) -> None:
        """Check the type of every part.

        Raises:
            UsageError: A part has another type.
            SceneError: The name is empty.
        """
        check_fields(self)
        if not self.name:
            fail(self, "name", "expected some text")

    @property
    def has_gloss(self) -> bool:
        """Return True if any proxy reflects virtual objects specularly."""
        return any(proxy.material is not None for proxy in self.proxies)
