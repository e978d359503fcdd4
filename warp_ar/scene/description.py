"""What a scene is made of: frozen dataclasses, one per section of a scene file.

Metres, degrees, linear RGB. The world is the marker's frame: origin at the marker's (or board's) centre, x right, y up
the printed page, z out of the page.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Final, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from warp_ar.errors import SceneError
from warp_ar.scene.checks import check_choice, check_number, check_vector, fail
from warp_ar.scene.geometry import Mesh, rotation_matrix
from warp_ar.scene.keys import AREA_LIGHT_KEYS, LIGHT_KEYS, OBJECT_KEYS, PROXY_KEYS
from warp_ar.scene.materials import OF_THE_FILE, RGB, EmissiveMaterial, Material

Vec3: TypeAlias = tuple[float, float, float]

FloatMatrix: TypeAlias = npt.NDArray[np.float64]

SCHEMA: Final = 1
"""The version of the format that this program reads."""


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
    field_of_view: float | None = None
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
    shown: float | None = None
    """Exposure time in seconds of the frames that are lit and shown; the longest if left out."""
    metering: Literal["fixed", "automatic"] | None = None
    """Whether the camera's exposure and white balance may drift; what dims all alike is then not the light; fixed if
    left out."""


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
    """Share of light that the ball reflects; a silvered ornament if left out. A file may give one number for grey.
    Frames that show otherwise are believed, but for the quality ``paper``."""
    marker: Marker | None = None
    """A marker or board of its own, in whose frame its centre is: it may be moved; lost, its last light remains."""

    def __post_init__(self) -> None:
        """Raise a SceneError that names the first value that cannot be."""
        check_vector(self, "center")
        check_number(self, "radius", above=0.0)
        check_vector(self, "reflectance", low=0.0, high=1.0)


@dataclasses.dataclass(frozen=True)
class ProxyMaterial:
    """How a proxy's surface mirrors, beside what it scatters; glTF's rough dielectric."""

    roughness: float = 0.1
    """Perceptual, as glTF has it: 0 is a mirror, 1 as wide as can be; a polished table has about 0.1."""
    reflectance: RGB = (0.04, 0.04, 0.04)
    """Specular reflectance where it is seen from ahead, glTF's F0; 0.04 is lacquer or glass. A file may give one number
    for grey."""

    def __post_init__(self) -> None:
        """Raise a SceneError that names the first value that cannot be."""
        check_number(self, "roughness", low=0.0, high=1.0)
        check_vector(self, "reflectance", low=0.0, high=1.0)


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
    marker: Marker | None = None
    """A marker or board of its own, in whose frame it stands; while that is lost it is not there."""
    material: ProxyMaterial | None = None
    """How it mirrors what is virtual; matt if left out."""

    def __post_init__(self) -> None:
        """Raise a SceneError that names the first value that cannot be."""
        check_choice(self, "shape", PROXY_KEYS)
        check_vector(self, "at")
        check_vector(self, "rotate")
        if self.shape == "mesh" and self.file is None:
            fail(self, "file", "a mesh needs its file")


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
class Play:
    """How an animation of a glTF file's nodes is played."""

    animation: str | int = 0
    """Name of the animation in the file, or its number from 0 on."""
    loop: bool = True
    """Whether it begins anew after its last key; else it holds that pose."""
    start: float = 0.0
    """Time at which it begins, in seconds after the first frame; before, it holds its first pose."""
    speed: float = 1.0
    """Seconds of the animation per second."""
    offset: float = 0.0
    """Time of the animation with which it begins, in seconds."""
    paused: bool = False
    """Whether it holds the pose that it begins with."""

    def time_at(self, seconds: float, duration: float) -> float:
        """Time of the animation, ``seconds`` after the first frame; ``duration`` is that of its last key."""
        passed = self.offset
        if not self.paused:
            passed += max((seconds - self.start) * self.speed, 0.0)
        if not self.loop:
            return min(passed, duration)
        return math.fmod(passed, duration) if duration > 0.0 else 0.0


@dataclasses.dataclass(frozen=True)
class Object:
    """A virtual object; a point p of its shape stands at R (scale p) + at. Fields unused by its shape are zero."""

    shape: Literal["mesh", "sphere", "box", "torus", "rect", "disk", "tube"]
    """All but meshes are centred at their origin; a torus and a tube lie around their z axis, a rect and a disk face
    their own +z."""
    file: Path | None = None
    """Mesh file; under another material than its own its textures of the base colour multiply the first colour."""
    radius: float = 0.0
    """Radius of a sphere, a disk or a tube in metres."""
    size: tuple[float, ...] = (0.0, 0.0, 0.0)
    """Whole lengths of a box, or of a rect along x and y, in metres."""
    length: float = 0.0
    """Length of a tube in metres; its ends are open."""
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
    material: Material = OF_THE_FILE
    """How it reflects light."""
    animate: Animation | None = None
    """How it moves."""
    play: Play | None = None
    """An animation of its glTF file that moves the file's nodes; without, they stand as at the start."""
    marker: Marker | None = None
    """A marker or board of its own, in whose frame it stands; while that is lost it is not there."""
    mesh: Mesh | None = dataclasses.field(default=None, repr=False)
    """A mesh in memory instead of a file, as ``object_from_trimesh`` gives; a scene file cannot say it."""

    def __post_init__(self) -> None:
        """Raise a SceneError that names the first value that cannot be."""
        check_choice(self, "shape", OBJECT_KEYS)
        check_vector(self, "at")
        check_vector(self, "rotate")
        check_number(self, "scale", above=0.0)
        if self.shape == "mesh" and self.file is None and self.mesh is None:
            fail(self, "file", "a mesh needs its file, or a mesh in memory as object_from_trimesh gives")
        for key in OBJECT_KEYS[self.shape]:
            if key not in ("file", "size"):
                check_number(self, key, above=0.0)
        if self.shape == "torus" and self.minor_radius >= self.major_radius:
            fail(self, "minor_radius", f"expected less than major_radius, {self.major_radius:g}")

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
    marker: Marker | None = None
    """A marker or board of its own, in whose frame it stands; while that is lost it is not there."""

    def __post_init__(self) -> None:
        """Raise a SceneError that names the first value that cannot be."""
        check_choice(self, "kind", LIGHT_KEYS)
        check_number(self, "intensity", low=0.0)
        check_vector(self, "color", low=0.0)
        check_vector(self, "at")
        check_vector(self, "attenuation", low=0.0)
        check_number(self, "radius", low=0.0)
        if self.kind == "spot" and self.target is None and self.direction is None:
            fail(self, "target", "a spot light needs a target or a direction")
        if self.direction is not None:
            check_vector(self, "direction")
            if not any(self.direction):
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
class AreaLight:
    """A virtual light with an extent, which the picture shows: an object that emits."""

    kind: Literal["rect", "disk", "sphere", "tube"]
    """A rect and a disk shine where their own +z points; a tube lies around its z axis."""
    intensity: float
    """Radiance in camera values: 1 is what the camera clips."""
    color: RGB = (1.0, 1.0, 1.0)
    """Factor on the radiance per channel."""
    at: Vec3 = (0.0, 0.0, 0.0)
    """Centre in metres."""
    rotate: Vec3 = (0.0, 0.0, 0.0)
    """Degrees about the fixed x, then y, then z axis; [180, 0, 0] turns a rect or disk down."""
    size: tuple[float, ...] = ()
    """Whole lengths of a rect along x and y in metres."""
    radius: float = 0.0
    """Radius of a disk, sphere or tube in metres."""
    length: float = 0.0
    """Length of a tube in metres; its ends are open."""
    image: Path | None = None
    """Picture that multiplies the radiance of a rect: sRGB-encoded, or linear radiance (HDR, OpenEXR)."""
    two_sided: bool = False
    """Whether the back of a rect or disk shines too; else it is not there from behind, but throws a shadow."""
    animate: Animation | None = None
    """How it moves."""
    marker: Marker | None = None
    """A marker or board of its own, in whose frame it stands; while that is lost it is not there."""

    def __post_init__(self) -> None:
        """Raise a SceneError that names the first value that cannot be."""
        check_choice(self, "kind", AREA_LIGHT_KEYS)
        check_number(self, "intensity", low=0.0)
        check_vector(self, "color", low=0.0)

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
        )


LATLONG_AXES: Final = ("z-up", "blender", "y-up", "opengl")
"""Axes of latlong maps; ``z-up`` is this program's own. ``light.latlong_axes`` says what they mean."""


@dataclasses.dataclass(frozen=True)
class CapturedLight:
    """Light of the environment from a file instead of from a mirror ball in the frames."""

    file: Path
    """Latlong OpenEXR or Radiance HDR, as ``warp_ar.capture`` writes it, or of another program."""
    scale: float = 1.0
    """Factor from the file's values to those of the frames' camera."""
    rotate: Vec3 = (0.0, 0.0, 0.0)
    """Degrees about the fixed x, then y, then z axis, from the file's axes to the scene's."""
    axes: str | None = None
    """Axes of the file: "z-up", "blender", "y-up" or "opengl"; if left out, as the file says, else y-up of an OpenEXR
    and blender of an HDR."""

    def __post_init__(self) -> None:
        """Raise a SceneError that names the first value that cannot be."""
        check_number(self, "scale", above=0.0)
        check_vector(self, "rotate")
        if self.axes is not None:
            check_choice(self, "axes", LATLONG_AXES)


@dataclasses.dataclass(frozen=True)
class PoseSpec:
    """Where the camera stands, instead of what a marker says; ``camera_from_world``: x_camera = R x_world + t.

    Axes of the camera are those of OpenCV and COLMAP: x right, y down, z forward.
    """

    poses: tuple[tuple[tuple[float, ...], Vec3], ...]
    """(R as 9 numbers row by row, t in metres) of every frame, or one for all."""
    file: Path | None = None
    """Where they were read from."""

    def at(self, index: int) -> tuple[FloatMatrix, FloatMatrix]:
        """R (3, 3) and t (3,) of a frame; after the last, poses start again, as a looped clip does."""
        rotation, translation = self.poses[index % len(self.poses)]
        return np.array(rotation).reshape(3, 3), np.array(translation)


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
    """Where the camera stands, where no marker tells."""
    has_marker: bool = True
    """Whether a printed card lies at the origin; not where the file gives a pose and no marker."""
    exposure: Exposure = Exposure()
    """Simulated exposure."""
    path: Path | None = dataclasses.field(default=None, compare=False)
    """The file that the scene was read from."""

    @property
    def has_gloss(self) -> bool:
        """Whether a receiver mirrors what is virtual."""
        return any(proxy.material is not None for proxy in self.proxies)
