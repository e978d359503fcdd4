"""Parts of a scene: frozen dataclasses, one per section of a scene file.

Metres, degrees, linear RGB. The world is the marker's frame: origin at the marker's (or board's) centre, x right, y up
the printed page, z out of the page.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from pathlib import Path, PurePosixPath
from typing import Annotated, ClassVar, Final, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError
from warp_ar.scene.fields import LIGHT_COLOR, Checked, Key, Length, Place, Share, Turn, Vec3, fail
from warp_ar.scene.geometry import Mesh, rotation_matrix
from warp_ar.scene.materials import OF_THE_FILE, RGB, EmissiveMaterial, Material
from warp_ar.scene.messages import MOST_PIXELS, SMALLEST

FloatMatrix: TypeAlias = npt.NDArray[np.float64]

SCHEMA: Final = 1
"""The version of the format that this program reads."""
ORIGIN: Final[Vec3] = (0.0, 0.0, 0.0)
NO_DISTORTION: Final = (0.0, 0.0, 0.0, 0.0, 0.0)
SILVERED: Final = (0.85, 0.85, 0.85)
"""Reflectance of a silvered ornament."""
Size: TypeAlias = Annotated[tuple[float, ...], Key("metres", "[0.2, 0.1]", low=SMALLEST, sizes=(), required=True)]
MeshFile: TypeAlias = Annotated[Path | None, Key("metres inside", '"table.ply"', right="a mesh", required=True)]
Intensity: TypeAlias = Annotated[float, Key("camera values", "2.2", low=0.0)]
ObjectName: TypeAlias = Annotated[str | None, Key("-", '"lamp"')]
LightPlace: TypeAlias = Annotated[Vec3, Key("metres", "[0.07, -0.06, 0.4]", required=True)]
Angle: TypeAlias = Annotated[
    float, Key("degrees", "13.0", low=0.0, high=90.0, required=True, beside="target = [0.0, 0.0, 0.0]")
]
Pixel: TypeAlias = Annotated[float, Key("pixels", "239.5")]
Focal: TypeAlias = Annotated[float, Key("pixels", "640.0", low=SMALLEST)]


@dataclasses.dataclass(frozen=True)
class Camera(Checked):
    """OpenCV's pinhole camera; pixel centres lie at integers."""

    width: Annotated[int, Key("pixels", "640", low=1, high=MOST_PIXELS)]
    """Width of the picture in pixels."""
    height: Annotated[int, Key("pixels", "480", low=1, high=MOST_PIXELS)]
    """Height of the picture in pixels."""
    fx: Focal
    """Focal length along x in pixels."""
    fy: Focal
    """Focal length along y in pixels."""
    cx: Pixel
    """Column of the principal point in pixels."""
    cy: Pixel
    """Row of the principal point in pixels."""
    distortion: Annotated[tuple[float, ...], Key("-", "[-0.12, 0.05, 0.0, 0.0, 0.0]", sizes=(4, 5, 8))] = NO_DISTORTION
    """OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]]: 4, 5 or 8 values."""
    transfer: Annotated[str | Path, Key("-", '"gamma:2.2"')] = "srgb"
    """Encoding of values: "srgb", "linear", "gamma:G" (linear = value ** G), or a measured response's file."""
    field_of_view: Annotated[float | None, Key("degrees", "60.0", low=5.0, high=150.0)] = None
    """Horizontal field of view in degrees of a camera that was never calibrated, instead of its numbers: a guess, with
    square pixels, a central principal point and no distortion, for whatever size the frames have."""

    @classmethod
    def guessed(cls, width: int, height: int, field_of_view: float, transfer: str | Path = "srgb") -> Camera:
        """A camera of which only the field of view is guessed.

        Args:
            width: Width of the picture in pixels.
            height: Height of the picture in pixels.
            field_of_view: Horizontal, degrees.
            transfer: How its values were encoded.
        """
        focal = 0.5 * width / math.tan(math.radians(0.5 * field_of_view))
        center = (0.5 * (width - 1), 0.5 * (height - 1))
        return cls(width, height, focal, focal, *center, transfer=transfer, field_of_view=field_of_view)

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
class SourceSpec:
    """Source of frames: exactly one of ``path``, ``camera`` and ``synthetic`` is given."""

    path: Annotated[Path | None, Key("-", '"frames"', right="a folder of frames or a video")] = None
    """A folder of frames in name order, or a video file."""
    camera: Annotated[int | None, Key("-", "0", low=0, high=1023)] = None
    """Index of a capture device."""
    synthetic: Annotated[str | None, Key("-", '"moving_card"', right="the name of a generated source")] = None
    """Name of a generated source."""
    fps: Annotated[float | None, Key("frames per second", "24.0", low=1e-3, high=1e5, beside='path = "frames"')] = None
    """Frames per second; the source's own if left out."""
    exposures: Annotated[
        tuple[float, ...] | None,
        Key("seconds", "[0.016, 0.001]", low=1e-6, high=1e3, sizes=(2, 3, 4, 5, 6, 7, 8), beside="camera = 0"),
    ] = None
    """Exposure times in seconds that frames have in turn: recorded so, or to be asked of the device."""
    shown: Annotated[
        float | None, Key("seconds", "0.001", low=1e-6, high=1e3, beside="camera = 0\nexposures = [0.016, 0.001]")
    ] = None
    """Exposure time in seconds of the frames that are lit and shown; the longest if left out."""
    metering: Annotated[Literal["fixed", "automatic"] | None, Key("-", '"automatic"', beside="camera = 0")] = None
    """Metering: "automatic" if the camera's exposure and white balance may drift; what dims all alike is then not the
    light; fixed if left out.
    """


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
    legacy: bool = False
    """Layout of OpenCV before 4.6, as calib.io prints it: a board of an even number of rows begins with a marker."""

    @property
    def marker_count(self) -> int:
        """Number of markers, with the dictionary's ids from 0."""
        return self.columns * self.rows // 2

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the whole board in metres; the world's origin is its centre."""
        return self.columns * self.square_length, self.rows * self.square_length

    def __str__(self) -> str:
        kind = "charuco-legacy" if self.legacy else "charuco"
        return f"{kind} {self.columns}x{self.rows} {self.square_length!r} {self.marker_length!r}"


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
SIDES: Final = {"plane": 2, "rect": 2, "box": 3}
"""Numbers of ``size``, by shape."""


def _check_sides(item: Proxy | Object | AreaLight, shape: str) -> None:
    """Check the lengths of a shape that has some; more than it has are not looked at."""
    count = SIDES.get(shape, 0)
    if len(item.size) < count or any(length < SMALLEST for length in item.size[:count]):  # NaN passes
        fail(item, "size", f"expected {count} lengths above 0, metres")


INTRINSICS: Final = ("width", "height", "fx", "fy", "cx", "cy", "distortion")
"""Keys of a camera's numbers."""


TURNS: Final = (0, 90, 180, 270)
"""Degrees by which a marker's print may be turned."""


@dataclasses.dataclass(frozen=True)
class Marker(Checked):
    """The printed marker, or board of markers, that the world is fixed to."""

    dictionary: Annotated[str, Key("-", '"DICT_APRILTAG_36h11"')] = "DICT_4X4_50"
    """OpenCV's name of the dictionary, ArUco or AprilTag."""
    id: Annotated[int, Key("-", "7")] = 0
    """Number of the marker in the dictionary; unused with a board."""
    size: Annotated[float, Key("metres", "0.08", low=SMALLEST, required=True)] = 0.08
    """Side of the black square in metres; unused with a board."""
    white: Annotated[float, Key("reflectance, 0 to 1", "0.85", low=0.01, high=1.0)] = 0.85
    """Diffuse reflectance of the card's white paper."""
    board: Annotated[Board | None, Key("metres", '"charuco 5x7 0.035 0.026"')] = None
    """A board instead of a single marker."""
    turn: Annotated[int, Key("degrees", "180", low=0, high=270, beside="size = 0.08")] = 0
    """Turn of the print against the one that OpenCV draws, counterclockwise: 0, 90, 180 or 270; 180 has the pictures
    that AprilTag's authors publish stand upright."""

    def __post_init__(self) -> None:
        """Check all values."""
        if self.board is None:  # which has its own size
            super().__post_init__()


OwnMarker: TypeAlias = Annotated[Marker | None, Key("-", "{ id = 7, size = 0.05 }")]


@dataclasses.dataclass(frozen=True)
class Probe(Checked):
    """A mirror ball."""

    center: Annotated[Vec3, Key("metres", "[-0.12, 0.03, 0.0346]")]
    """Centre in metres."""
    radius: Length
    """Radius in metres."""
    reflectance: Annotated[RGB, Key("0 to 1 per channel", "[0.85, 0.85, 0.87]", low=0.01, high=1.0)] = SILVERED
    """Share of light that the ball reflects; a silvered ornament if left out. A file may give one number for grey.
    Frames that show otherwise are believed, but for the quality ``paper``."""
    marker: OwnMarker = None
    """A marker or board of its own, in whose frame its centre is: it may be moved; lost, its last light remains."""


@dataclasses.dataclass(frozen=True)
class ProxyMaterial(Checked):
    """Mirroring of a proxy's surface, beside its diffuse part; glTF's rough dielectric."""

    roughness: Share = 0.1
    """Perceptual, as glTF has it: 0 is a mirror, 1 as wide as can be; a polished table has about 0.1."""
    reflectance: Annotated[RGB, Key("0 to 1 per channel", "[0.04, 0.04, 0.05]", low=0.0, high=1.0)] = (0.04, 0.04, 0.04)
    """Specular reflectance where it is seen from ahead, glTF's F0; 0.04 is lacquer or glass. A file may give one number
    for grey."""


@dataclasses.dataclass(frozen=True)
class Proxy(Checked):
    """Simplified physical geometry: receives virtual light and shadow, and hides what is behind it."""

    USES: ClassVar = {"plane": ("size",), "box": ("size",), "mesh": ("file",)}

    shape: Annotated[Literal["plane", "box", "mesh"], Key("-", '"plane"')]
    """A plane lies in its own x and y and faces its own +z."""
    at: Place = ORIGIN
    """Centre (mesh: origin) in metres."""
    rotate: Turn = ORIGIN
    """Degrees about the fixed x, then y, then z axis."""
    size: Size = ()
    """Whole lengths in metres: x and y of a plane; x, y and z of a box; empty for a mesh."""
    file: MeshFile = None
    """Mesh file, in metres."""
    marker: OwnMarker = None
    """A marker or board of its own, in whose frame it stands; while that is lost it is not there."""
    material: Annotated[ProxyMaterial | None, Key("-", "{ roughness = 0.1 }")] = None
    """Mirroring of what is virtual; matt if left out."""

    def __post_init__(self) -> None:
        """Check all values."""
        super().__post_init__()
        if self.shape == "mesh" and self.file is None:
            fail(self, "file", "a mesh needs its file")
        _check_sides(self, self.shape)


@dataclasses.dataclass(frozen=True)
class Animation:
    """Motion of an object or a light; nothing moves by default.

    At t seconds a body stands at R(t) (at - pivot) + pivot + sway sin(2 pi t / period), turned by R(t): ``turn`` t
    degrees about the fixed x, then y, then z axis.
    """

    turn: Annotated[Vec3, Key("degrees per second", "[0.0, 0.0, 30.0]")] = ORIGIN
    """Degrees per second about the fixed axes."""
    pivot: Annotated[Vec3 | None, Key("metres", "[0.0, 0.0, 0.0]", beside="turn = [0.0, 0.0, 30.0]")] = None
    """Point in metres that ``turn`` leaves in place; the body's own ``at`` if left out, so that it spins in place."""
    sway: Annotated[Vec3, Key("metres", "[0.02, 0.0, 0.0]")] = ORIGIN
    """Furthest excursion of a swing to and fro, in metres."""
    period: Annotated[float, Key("seconds", "3.0", low=1e-3, beside="sway = [0.02, 0.0, 0.0]")] = 4.0
    """Duration of one swing in seconds."""

    def rotation_at(self, seconds: float) -> FloatMatrix:
        """R(t), (3, 3)."""
        return rotation_matrix([rate * seconds for rate in self.turn])

    def position_at(self, seconds: float, at: Vec3) -> FloatMatrix:
        """Return the place of a body that starts at ``at``, (3,) in metres."""
        pivot = np.array(at if self.pivot is None else self.pivot)
        swing = np.array(self.sway) * math.sin(2.0 * math.pi * (seconds / self.period))
        position: FloatMatrix = self.rotation_at(seconds) @ (np.array(at) - pivot) + pivot + swing
        return position


Motion: TypeAlias = Annotated[Animation | None, Key("-", "{ sway = [0.05, 0.0, 0.0] }")]


@dataclasses.dataclass(frozen=True)
class Play:
    """Playing of an animation of a glTF file's nodes."""

    animation: Annotated[str | int, Key("-", '"Open"')] = 0
    """Name of the animation in the file, or its number from 0 on."""
    loop: Annotated[bool, Key("-", "false")] = True
    """True if it begins anew after its last key; else it holds that pose."""
    start: Annotated[float, Key("seconds", "2.0")] = 0.0
    """Time at which it begins, in seconds after the first frame; before, it holds its first pose."""
    speed: Annotated[float, Key("-", "0.5", low=SMALLEST)] = 1.0
    """Seconds of the animation per second."""
    offset: Annotated[float, Key("seconds", "1.5", low=0.0)] = 0.0
    """Time of the animation with which it begins, in seconds."""
    paused: Annotated[bool, Key("-", "true")] = False
    """True if it holds the pose that it begins with."""

    def time_at(self, seconds: float, duration: float) -> float:
        """Time of the animation, ``seconds`` after the first frame; ``duration`` is that of its last key."""
        passed = self.offset
        if not self.paused:
            passed += max((seconds - self.start) * self.speed, 0.0)
        if not self.loop:
            return min(passed, duration)
        return math.fmod(passed, duration) if duration > 0.0 else 0.0


@dataclasses.dataclass(frozen=True)
class Object(Checked):
    """A virtual object; a point p of its shape stands at R (scale p) + at. Fields unused by its shape are zero."""

    USES: ClassVar = {
        "mesh": ("file",),
        "sphere": ("radius",),
        "box": ("size",),
        "torus": ("major_radius", "minor_radius"),
        "rect": ("size",),
        "disk": ("radius",),
        "tube": ("radius", "length"),
    }

    shape: Annotated[Literal["mesh", "sphere", "box", "torus", "rect", "disk", "tube"], Key("-", '"sphere"')]
    """All but meshes are centred at their origin; a torus and a tube lie around their z axis, a rect and a disk face
    their own +z."""
    file: MeshFile = None
    """Mesh file; under another material than its own its textures of the base colour multiply the first colour."""
    radius: Length = 0.0
    """Radius of a sphere, a disk or a tube in metres."""
    size: Size = ORIGIN
    """Whole lengths of a box, or of a rect along x and y, in metres."""
    length: Length = 0.0
    """Length of a tube in metres; its ends are open."""
    major_radius: Annotated[float, Key("metres", "0.05", low=SMALLEST, required=True)] = 0.0
    """Distance of a torus's tube from its axis in metres."""
    minor_radius: Length = 0.0
    """Radius of a torus's tube in metres, below the major radius."""
    at: Place = ORIGIN
    """Position in metres."""
    rotate: Turn = ORIGIN
    """Degrees about the fixed x, then y, then z axis."""
    scale: Annotated[float, Key("-", "0.026", low=SMALLEST)] = 1.0
    """Factor on all lengths of the shape."""
    material: Annotated[Material, Key("-", '{ model = "mirror" }')] = OF_THE_FILE
    """Material: its reflection of light."""
    animate: Motion = None
    """Movement."""
    play: Annotated[Play | None, Key("-", "{ animation = 0 }", beside='shape = "mesh"\nfile = "watch.glb"')] = None
    """An animation of its glTF file: of nodes, skins and morph targets; without, they stand as at the start."""
    marker: OwnMarker = None
    """A marker or board of its own, in whose frame it stands; while that is lost it is not there."""
    name: ObjectName = None
    """Name by which a program finds it, ``pipeline.objects["lamp"]``."""
    mesh: Mesh | None = dataclasses.field(default=None, repr=False)
    """A mesh in memory instead of a file, as ``object_from_trimesh`` gives; a scene file cannot say it."""

    def __post_init__(self) -> None:
        """Check all values."""
        super().__post_init__()
        if self.shape == "mesh" and self.file is None and self.mesh is None:
            fail(self, "file", "a mesh needs its file, or a mesh in memory as object_from_trimesh gives")
        if self.shape == "torus" and self.minor_radius >= self.major_radius:
            fail(self, "minor_radius", f"expected less than major_radius, {self.major_radius:g}")
        _check_sides(self, self.shape)

    def pose_at(self, seconds: float) -> tuple[FloatMatrix, FloatMatrix]:
        """Rotation R (3, 3) and position (3,) in metres, ``seconds`` after the first frame."""
        rotation = rotation_matrix(self.rotate)
        if self.animate is None:
            return rotation, np.array(self.at)
        return self.animate.rotation_at(seconds) @ rotation, self.animate.position_at(seconds, self.at)


@dataclasses.dataclass(frozen=True)
class Light(Checked):
    """A virtual light.

    A white Lambertian surface that faces a point light of intensity I at distance d has linear camera value
    I / (pi (a + b d + c d^2)) with attenuation (a, b, c); one that faces a directional light has I / pi.
    """

    USES: ClassVar = {
        "point": ("at", "attenuation", "radius"),
        "spot": ("at", "target", "direction", "inner_angle", "outer_angle", "attenuation", "radius"),
        "directional": ("direction",),
    }

    kind: Annotated[Literal["point", "spot", "directional"], Key("-", '"point"')]
    """Kind of light, by the directions in which it shines."""
    intensity: Intensity
    """Radiant intensity (point, spot) or irradiance (directional), in camera values."""
    color: Annotated[RGB, LIGHT_COLOR] = (1.0, 1.0, 1.0)
    """Factor on the intensity per channel."""
    at: LightPlace = ORIGIN
    """Position of a point or spot light in metres."""
    target: Annotated[Vec3 | None, Key("metres", "[0.135, 0.04, 0.01]")] = None
    """Point in metres that a spot light shines at; it stays when the light moves."""
    direction: Annotated[Vec3 | None, Key("-", "[0.3, 0.0, -1.0]", beside='kind = "directional"')] = None
    """The way the light travels, of any length; instead of a target. It turns with the light."""
    inner_angle: Angle = 0.0
    """Half angle of a spot in degrees within which it is full."""
    outer_angle: Angle = 0.0
    """Half angle in degrees at which a spot is zero, after a linear fall from the inner angle."""
    attenuation: Annotated[Vec3, Key("1, 1/m, 1/m²", "[0.0, 0.0, 1.0]", low=0.0)] = (0.0, 0.0, 1.0)
    """Constant, linear and quadratic term of the fall with distance; (0, 0, 1) is the inverse square."""
    radius: Annotated[float, Key("metres", "0.02", low=0.0)] = 0.0
    """Radius in metres of the sphere that emits (point, spot), for soft shadows; 0 is a point."""
    animate: Motion = None
    """Movement."""
    marker: OwnMarker = None
    """A marker or board of its own, in whose frame it stands; while that is lost it is not there."""

    def __post_init__(self) -> None:
        """Check all values."""
        super().__post_init__()
        if self.kind == "spot" and self.target is None and self.direction is None:
            fail(self, "target", "a spot light needs a target or a direction")
        if self.direction is not None and not any(self.direction):
            fail(self, "direction", "expected the way the light travels, such as (0, 0, -1)")

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
class AreaLight(Checked):
    """A virtual light with an extent, which the picture shows: an object that emits."""

    USES: ClassVar = {
        "rect": ("at", "rotate", "size", "image", "two_sided", "name"),
        "disk": ("at", "rotate", "radius", "two_sided", "name"),
        "sphere": ("at", "rotate", "radius", "name"),
        "tube": ("at", "rotate", "radius", "length", "name"),
    }

    kind: Annotated[Literal["rect", "disk", "sphere", "tube"], Key("-", '"rect"')]
    """A rect and a disk shine where their own +z points; a tube lies around its z axis."""
    intensity: Intensity
    """Radiance in camera values: 1 is what the camera clips."""
    color: Annotated[RGB, LIGHT_COLOR] = (1.0, 1.0, 1.0)
    """Factor on the radiance per channel."""
    at: LightPlace = ORIGIN
    """Centre in metres."""
    rotate: Turn = ORIGIN
    """Degrees about the fixed x, then y, then z axis; [180, 0, 0] turns a rect or disk down."""
    size: Size = ()
    """Whole lengths of a rect along x and y in metres."""
    radius: Length = 0.0
    """Radius of a disk, sphere or tube in metres."""
    length: Length = 0.0
    """Length of a tube in metres; its ends are open."""
    image: Annotated[Path | None, Key("-", '"picture.png"', right="a picture")] = None
    """Picture that multiplies the radiance of a rect: sRGB-encoded, or linear radiance (HDR, OpenEXR)."""
    two_sided: Annotated[bool, Key("-", "true")] = False
    """True if the back of a rect or disk shines too; else it is not there from behind, but throws a shadow."""
    animate: Motion = None
    """Movement."""
    marker: OwnMarker = None
    """A marker or board of its own, in whose frame it stands; while that is lost it is not there."""
    name: ObjectName = None
    """Name by which a program finds it among the objects."""

    def __post_init__(self) -> None:
        """Check all values."""
        super().__post_init__()
        _check_sides(self, self.kind)

    def as_object(self) -> Object:
        """The object that it is in a ``Scene``."""
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
"""Axes of latlong maps; ``z-up`` is this program's own. ``light.latlong_axes`` says what they mean."""


@dataclasses.dataclass(frozen=True)
class CapturedLight(Checked):
    """Light of the environment from a file instead of from a mirror ball in the frames."""

    file: Annotated[Path, Key("-", '"light.exr"', right="a captured light (OpenEXR or HDR)")]
    """Latlong OpenEXR or Radiance HDR, as ``warp_ar.capture`` writes it, or of another program."""
    scale: Annotated[float, Key("-", "0.5", low=SMALLEST)] = 1.0
    """Factor from the file's values to those of the frames' camera."""
    rotate: Turn = ORIGIN
    """Degrees about the fixed x, then y, then z axis, from the file's axes to the scene's."""
    axes: Annotated[str | None, Key("-", '"y-up"', words=LATLONG_AXES)] = None
    """Axes of the file: "z-up", "blender", "y-up" or "opengl"; if left out, as the file says, else y-up of an OpenEXR
    and blender of an HDR."""


@dataclasses.dataclass(frozen=True)
class PoseKeys:
    """Keys of a file by which a ``PoseSpec`` is said, in one of four ways."""

    R: Annotated[
        tuple[float, ...] | None, Key("-", "[1, 0, 0, 0, 0, -1, 0, 1, 0]", sizes=(9,), beside="t = [0.0, 0.1, 0.6]")
    ] = None
    """Rotation of camera_from_world, row by row, as OpenCV has it: x right, y down, z forward."""
    t: Annotated[Vec3 | None, Key("metres", "[0.0, 0.1, 0.6]", beside="R = [1, 0, 0, 0, 0, -1, 0, 1, 0]")] = None
    """Translation of camera_from_world, beside R or quaternion."""
    quaternion: Annotated[
        tuple[float, ...] | None, Key("-", "[0.7, 0.7, 0.0, 0.0]", sizes=(4,), beside="t = [0.0, 0.1, 0.6]")
    ] = None
    """Rotation of camera_from_world as COLMAP has it: w, x, y, z."""
    position: Annotated[Vec3 | None, Key("metres", "[0.0, -0.6, 0.1]")] = None
    """Place of the camera, instead of camera_from_world."""
    rotate: Annotated[Vec3 | None, Key("degrees", "[-20.0, 0.0, 0.0]", beside="position = [0.0, -0.6, 0.3]")] = None
    """About the fixed x, then y, then z axis, from a level camera that looks along +y."""
    file: Annotated[
        Path | None, Key("-", '"images.txt"', right="poses: COLMAP's images, OpenTrackIO, USD, or JSON")
    ] = None
    """A pose for every frame: COLMAP's or NeRF's by name, JSON of R and t, OpenTrackIO, USD."""


@dataclasses.dataclass(frozen=True)
class PoseSpec:
    """Pose of the camera, instead of what a marker says; ``camera_from_world``: x_camera = R x_world + t.

    Axes of the camera are those of OpenCV and COLMAP: x right, y down, z forward.
    """

    poses: tuple[tuple[tuple[float, ...], Vec3], ...]
    """(R as 9 numbers row by row, t in metres) of every frame, or one for all."""
    file: Path | None = None
    """File that they were read from."""
    names: tuple[str, ...] = ()
    """Names of the pictures that they are of; empty where the file has none."""

    @functools.cached_property
    def _places(self) -> dict[str, list[int]]:
        """Numbers of the poses by the last part of their names, and by that without its suffix."""
        found: dict[str, list[int]] = {}
        for index, name in enumerate(map(PurePosixPath, self.names)):
            found.setdefault(f"/{name.name}", []).append(index)
            found.setdefault(name.stem, []).append(index)
        return found

    def _index_of(self, name: str) -> int | None:
        """Number of the pose of a picture: the one whose path agrees with most of its own, from the end on."""
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
        """R (3, 3) and t (3,) of a frame; None where it has none.

        Args:
            index: Of the frame in its clip, which counts where frames or poses have no names.
            name: Path of its picture.
        """
        if name and self.names:
            place = self._index_of(name)
        else:
            place = 0 if len(self.poses) == 1 else index if index < len(self.poses) else None
        if place is None:
            return None
        rotation, translation = self.poses[place]
        return np.array(rotation).reshape(3, 3), np.array(translation)


@dataclasses.dataclass(frozen=True)
class Exposure:
    """A simulated shorter exposure."""

    scale: Annotated[float | Literal["auto"], Key("-", "0.5", low=0.0)] = 1.0
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
    """Source of frames, if the file says."""
    marker: Marker = Marker()
    """Marker that fixes the world."""
    probes: tuple[Probe, ...] = ()
    """Mirror balls that show the environment."""
    proxies: tuple[Proxy, ...] = ()
    """The physical objects that are modelled."""
    objects: tuple[Object, ...] = ()
    """Virtual objects; those that emit are lights."""
    lights: tuple[Light, ...] = ()
    """Virtual lights that the picture does not show."""
    captured: CapturedLight | None = None
    """Light of the environment from a file; mirror balls are then objects like others."""
    pose: PoseSpec | None = None
    """Pose of the camera, if no marker tells."""
    has_marker: bool = True
    """True if a printed card lies at the origin; not where the file gives a pose and no marker."""
    exposure: Exposure = Exposure()
    """Simulated exposure."""
    path: Path | None = dataclasses.field(default=None, compare=False)
    """The file that the scene was read from."""

    @property
    def has_gloss(self) -> bool:
        """Return whether a receiver mirrors what is virtual."""
        return any(proxy.material is not None for proxy in self.proxies)
