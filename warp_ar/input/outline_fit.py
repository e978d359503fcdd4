"""Walls, boxes and planes of a desk from four points of one picture, fitted to the edges that the picture shows.

A shape has five or six numbers: where it stands, how it is turned about the vertical, and its sizes. The points give
their start. Then, as in model-based tracking [DC02], every visible edge of the shape is sampled; from each sample the
picture is searched along the edge's normal for the strongest step in brightness, and Gauss-Newton moves the shape so
that its edges meet the steps. The points themselves hold it weakly, so that a shape without edges stays where it was
pointed out.

References:
    [DC02] T. Drummond and R. Cipolla. Real-time visual tracking of complex structures. PAMI 2002.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Final, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.errors import UsageError
from warp_ar.scene import Camera, Pose, Proxy

Array = NDArray[np.float64]
_Places: TypeAlias = list[tuple[int, int, float]]
"""Two corners of an edge, and how far along it a sample lies, 0 to 1."""

REACHES: Final = (16.0, 9.0, 5.0)
"""Pixels to either side of an edge in which its step is looked for, round after round: a hand points as well."""
MODELLED: Final = 30.0
"""The same at first for shapes that are modelled already: a ruler and a guess are worse than a hand."""
ROUNDS: Final = 6
"""Steps of Gauss-Newton with each reach."""
SPACING: Final = 4.0
"""Pixels between samples of an edge."""
STEP: Final = 6.0
"""Codes per pixel that a step must have: more than noise and wood have."""
DEPTHS: Final = (1.0, 0.9, 0.8, 1.12, 1.25)
"""Factors of the side that is pointed out worst, from which the edges are tried."""
FARTHEST: Final = 12.0
"""Pixels that a corner may lie from where it was pointed out."""
POINTED: Final = 8.0
"""Pixels: standard deviation of a pointed corner, over that of an edge's step of one pixel."""
MET: Final = 1.5
"""Pixels within which an edge has met its step."""
ENOUGH: Final = 0.35
"""Share of an outline's samples that must have met a step: else the shape stays as pointed out."""
SMALLEST: Final = 0.004
"""Metres: no side of a shape is shorter."""
LARGEST: Final = 3.0
"""Metres: no side is longer, and no shape stands farther off."""
_SQUARE: Final = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
_RING: Final = ((0, 1), (1, 2), (2, 3), (3, 0))
_FACES: Final = ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))


@dataclasses.dataclass(frozen=True)
class OutlineFit:
    """A shape of the desk that was pointed out."""

    proxy: Proxy
    met: float
    """Share of its visible outline that lies on edges of the picture."""
    fitted: bool
    """Whether the edges moved it; else it is as it was pointed out."""


def fit_outline(
    image: NDArray[np.uint8], camera: Camera, pose: Pose, kind: str, points: Sequence[tuple[float, float]]
) -> OutlineFit:
    """The plane, wall or box that four points outline.

    Args:
        image: RGB, of the camera's size.
        camera: The camera.
        pose: ``camera_from_world``.
        kind: ``plane``: corners of a rectangle that lies on the desk, around it; ``wall``: the left and right end of
            its foot, then its top right and top left corner; ``box``: the ends of an edge of its base, then the corner
            of its top above the second, then the next corner of its top, behind: all four are seen.
        points: Pixels.

    Raises:
        UsageError: The points outline no such shape.
    """
    view = _View(camera, pose)
    start = {"plane": _start_plane, "wall": _start_wall, "box": _start_box}[kind](view, np.asarray(points, float))
    _check(kind, start)
    gray = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (0, 0), 0.8).astype(np.float32)
    anchors = _anchors(kind, start, view, np.asarray(points, float))
    start = _settled(kind, start, view, anchors)
    best, met = start, 0.0
    # A pixel is millimetres along the line of sight: the last side is tried at several lengths.
    for factor, first in itertools.product(DEPTHS, (0, 1)):
        shape = start.copy()
        shape[4] *= factor
        for reach in REACHES[first:]:
            shape = _rounds(kind, shape, view, gray, reach, anchors)
        # Edges that lie far from where somebody pointed are others.
        off = np.linalg.norm(view.pixels(_corners(kind, shape))[anchors[0]] - anchors[1], axis=1).max()
        share = _met(kind, shape, view, gray) if off <= FARTHEST else 0.0
        if share > met:
            best, met = shape, share
    fitted = met >= ENOUGH
    if not fitted:
        best, met = start, _met(kind, start, view, gray)
    return OutlineFit(_proxy(kind, best), met, fitted)


def _rounds(
    kind: str, shape: Array, view: _View, gray: NDArray[np.float32], reach: float, anchors: tuple[list[int], Array]
) -> Array:
    """A shape after some steps with one reach."""
    for _ in range(ROUNDS):
        moved = _improve(kind, shape, view, gray, reach, anchors)
        if moved is None:
            break
        shape = moved
    return shape


@dataclasses.dataclass(frozen=True)
class OutlineRefit:
    """A modelled shape against the picture's edges."""

    proxy: Proxy
    """Where the edges have it."""
    met: float
    """Share of its visible outline that lies on edges there."""
    met_before: float
    """The same where it is modelled."""
    moved: float
    """Pixels by which its corners are off at most."""


def refit_outline(image: NDArray[np.uint8], camera: Camera, pose: Pose, proxy: Proxy) -> OutlineRefit | None:
    """A modelled box on the desk or wall, moved and turned to fit the picture's edges; its sizes stay.

    None where it is neither, or not whole in the picture.

    Args:
        image: RGB, of the camera's size.
        camera: The camera.
        pose: ``camera_from_world``.
        proxy: The shape.
    """
    kind, shape = _shape_of(proxy)
    view = _View(camera, pose)
    if kind is None or view.eye[2] <= 0:
        return None
    gray = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (0, 0), 0.8).astype(np.float32)
    seen = view.pixels(_corners(kind, shape))
    size = (gray.shape[1], gray.shape[0])
    if not np.isfinite(seen).all() or not ((seen > 2) & (seen < (size[0] - 3, size[1] - 3))).all():
        return None  # of an outline that is cut off, what is left fits anywhere
    start, before = shape, _met(kind, shape, view, gray)
    anchors = (list(range(len(seen))), seen)
    for reach in (MODELLED, *REACHES):
        for _ in range(ROUNDS):
            moved = _improve(kind, shape, view, gray, reach, anchors, free=3)
            if moved is None:
                break
            shape = moved
    if not _is_sound(kind, shape):
        shape = start
    off = float(np.linalg.norm(view.pixels(_corners(kind, shape)) - seen, axis=1).max())
    return OutlineRefit(_proxy(kind, shape), _met(kind, shape, view, gray), before, off)


def _shape_of(proxy: Proxy) -> tuple[str | None, Array]:
    """Kind and numbers of a proxy that could have been pointed out, but for planes: they need no edges."""
    turn = math.radians(proxy.rotate[2])
    x, y, z = proxy.at
    if proxy.shape == "box" and proxy.rotate[:2] == (0.0, 0.0) and abs(z - proxy.size[2] / 2) < 0.1 * proxy.size[2]:
        return "box", np.array([x, y, turn, *proxy.size])
    if proxy.shape == "plane" and proxy.rotate[:2] == (90.0, 0.0) and abs(z - proxy.size[1] / 2) < 0.1 * proxy.size[1]:
        return "wall", np.array([x, y, turn, *proxy.size])
    return None, np.zeros(0)


class _View:
    """Points of the world to pixels, and back."""

    def __init__(self, camera: Camera, pose: Pose) -> None:
        self.camera, self.pose = camera, pose
        self.eye = -pose.rotation.T @ pose.translation
        self._matrix, self._lens = camera.matrix(), np.array(camera.distortion)

    def pixels(self, points: Array) -> Array:
        """Pixels (n, 2) of points (n, 3); NaN behind the camera."""
        seen = self.pose.apply(points)
        out, _ = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), self._matrix, self._lens)
        flat = np.asarray(out.reshape(-1, 2), float)
        flat[seen[:, 2] < 1e-3] = np.nan
        return flat

    def rays(self, pixels: Array) -> Array:
        """Directions (n, 3) in the world through pixels (n, 2)."""
        flat = cv2.undistortPoints(pixels.reshape(-1, 1, 2), self._matrix, self._lens).reshape(-1, 2)
        return np.asarray(np.column_stack([flat, np.ones(len(flat))]) @ self.pose.rotation, float)

    def on_desk(self, pixels: Array) -> Array:
        """Where rays through pixels meet the desk, (n, 2)."""
        ways = self.rays(pixels)
        with np.errstate(divide="ignore", invalid="ignore"):
            far = -self.eye[2] / ways[:, 2]
        if not (np.isfinite(far) & (far > 0)).all():
            raise UsageError("a point lies above the desk's horizon; point out corners that stand on the desk")
        return np.asarray((self.eye + far[:, None] * ways)[:, :2], float)


def _turned(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def _start_plane(view: _View, points: Array) -> Array:
    """Middle, angle and sides of the rectangle nearest to four corners: x, y, angle, width, depth."""
    corners = view.on_desk(points)
    sides = np.roll(corners, -1, 0) - corners
    width, depth = (float(np.linalg.norm(sides[[k, k + 2]], axis=1).mean()) for k in (0, 1))
    # All four sides say how it is turned, each up to a quarter turn: the mean of four times their angles.
    angles = np.arctan2(sides[:, 1], sides[:, 0])
    lengths = np.linalg.norm(sides, axis=1)
    turn = float(np.angle((lengths * np.exp(4j * angles)).sum())) / 4
    turn += round((angles[0] - turn) / (math.pi / 2)) * (math.pi / 2)
    return np.array([*corners.mean(0), turn, width, depth])


def _start_wall(view: _View, points: Array) -> Array:
    """Middle of its foot (x, y), angle, width, height."""
    left, right = view.on_desk(points[:2])
    along = right - left
    width = float(np.linalg.norm(along))
    if width < SMALLEST:
        raise UsageError("the wall's ends are at one place; point out its left and its right end")
    normal = np.array([along[1], -along[0], 0.0]) / width
    ways = view.rays(points[2:])
    foot = np.array([*(left + right) / 2, 0.0])
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (foot - view.eye) @ normal / (ways @ normal)
    heights = view.eye[2] + far * ways[:, 2]
    return np.array([foot[0], foot[1], math.atan2(along[1], along[0]), width, float(np.mean(heights))])


def _start_box(view: _View, points: Array) -> Array:
    """x, y, angle, width, depth, height."""
    a, b = view.on_desk(points[:2])
    along = b - a
    width = float(np.linalg.norm(along))
    if width < SMALLEST:
        raise UsageError("two corners of the box are at one place; point out both ends of an edge of its base")
    sideways = np.array([-along[1], along[0]]) / width
    above, behind = view.rays(points[2:])
    # The height at which the ray of the third point passes the second's upright.
    flat = above[:2]
    far = float(flat @ (b - view.eye[:2])) / max(float(flat @ flat), 1e-12)
    height = float(view.eye[2] + far * above[2])
    with np.errstate(divide="ignore", invalid="ignore"):
        last = view.eye + np.float64(height - view.eye[2]) / behind[2] * behind
    depth = float((last[:2] - b) @ sideways)
    middle = a + along / 2 + sideways * depth / 2
    # Corners run around the base from the end that was pointed out first, or, behind it, from the other side.
    return np.array([*middle, math.atan2(along[1], along[0]), width, abs(depth), height])


def _is_sound(kind: str, shape: Array) -> bool:
    return bool(
        np.isfinite(shape).all()
        and (shape[3:] >= SMALLEST).all()
        and (shape[3:] <= LARGEST).all()
        and np.abs(shape[:2]).max() <= LARGEST
    )


def _check(kind: str, shape: Array) -> None:
    if _is_sound(kind, shape):
        return
    order = {
        "plane": "its four corners, around it",
        "wall": "the left and right end of its foot, then its top right and top left corner",
        "box": "both ends of an edge of its base, the corner of its top above the second, and the next one behind it",
    }[kind]
    sizes = " x ".join(f"{1e3 * side:.0f}" for side in shape[3:])
    raise UsageError(f"the points make a {kind} of {sizes} mm; expected {order}")


def _corners(kind: str, shape: Array) -> Array:
    """Corners in the world: four, or a box's base and then its top."""
    x, y, angle, width, second = shape[:5]
    turn = _turned(angle)
    if kind == "wall":
        foot = np.array([[-width / 2, 0.0], [width / 2, 0.0]]) @ turn.T + (x, y)
        return np.array([[*foot[0], 0.0], [*foot[1], 0.0], [*foot[1], second], [*foot[0], second]])
    flat = (_SQUARE * (width, second)) @ turn.T + (x, y)
    base = np.column_stack([flat, np.zeros(4)])
    return base if kind == "plane" else np.concatenate([base, base + np.array([0.0, 0.0, shape[5]])])


def _edges(kind: str, corners: Array, eye: Array) -> list[tuple[int, int]]:
    """Edges that the camera sees: of a box those of the faces that are turned toward it."""
    if kind != "box":
        return list(_RING)
    middle = corners.mean(0)
    seen: set[tuple[int, int]] = set()
    for face in _FACES:
        center = corners[list(face)].mean(0)
        if (center - middle) @ (eye - center) > 0:
            seen |= {(min(i, j), max(i, j)) for i, j in zip(face, (*face[1:], face[0]), strict=True)}
    return sorted(seen)


def _samples(kind: str, shape: Array, view: _View, size: tuple[int, int]) -> tuple[_Places, Array, Array]:
    """Where along which edge samples lie, their pixels (n, 2) and normals (n, 2)."""
    corners = _corners(kind, shape)
    pixels = view.pixels(corners)
    places, normals = [], []
    for i, j in _edges(kind, corners, view.eye):
        length = float(np.linalg.norm(pixels[j] - pixels[i]))
        if not math.isfinite(length) or length < 3 * SPACING:
            continue
        count = min(int(length / SPACING), 200)
        # Corners see two edges at once.
        share = np.linspace(0.0, 1.0, count + 2)[1:-1]
        places += [(i, j, t) for t in share]
        along = (pixels[j] - pixels[i]) / length
        normals += [(-along[1], along[0])] * count
    if not places:
        return [], np.zeros((0, 2)), np.zeros((0, 2))
    at = _points_of(corners, places, view)
    width, height = size
    inside = np.asarray(((at > 2) & (at < (width - 3, height - 3))).all(axis=1), bool)
    kept = [place for place, good in zip(places, inside.tolist(), strict=True) if good]
    return kept, at[inside], np.array(normals)[inside]


def _points_of(corners: Array, places: Sequence[tuple[int, int, float]], view: _View) -> Array:
    first, second, share = (np.array(column) for column in zip(*places, strict=True))
    points = corners[first] * (1 - share[:, None]) + corners[second] * share[:, None]
    return view.pixels(points)


def _steps(gray: NDArray[np.float32], at: Array, normals: Array, reach: float) -> tuple[Array, Array]:
    """How far along its normal the strongest step of each sample lies, pixels, and its strength, codes per pixel."""
    offsets = np.arange(-reach, reach + 0.25, 0.5)
    places = (at[:, None] + (offsets[:, None] * normals[:, None])).astype(np.float32)
    values = cv2.remap(gray, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    slope = np.abs(values[:, 4:] - values[:, :-4]) / 2.0
    middle = offsets[2:-2]
    # Of two steps the nearer one, unless the other is much stronger.
    weighed = slope * np.exp(-0.5 * (middle / (0.6 * reach)) ** 2)
    best = weighed.argmax(1)
    rows = np.arange(len(best))
    low, high = np.clip(best - 1, 0, None), np.clip(best + 1, None, len(middle) - 1)
    a, b, c = slope[rows, low], slope[rows, best], slope[rows, high]
    bend = a - 2 * b + c
    with np.errstate(divide="ignore", invalid="ignore"):
        fine = np.where((bend < 0) & (low < best) & (high > best), 0.5 * (a - c) / bend, 0.0)
    return middle[best] + 0.5 * np.clip(fine, -1, 1), b


def _anchors(kind: str, shape: Array, view: _View, points: Array) -> tuple[list[int], Array]:
    """Numbers of the shape's corners that were pointed out, and where they were."""
    seen = view.pixels(_corners(kind, shape))
    chosen = [int(np.linalg.norm(seen - point, axis=1).argmin()) for point in points]
    return chosen, points


def _settled(kind: str, shape: Array, view: _View, anchors: tuple[list[int], Array]) -> Array:
    """The shape whose corners lie nearest to where they were pointed out: all points count alike."""
    chosen, pointed = anchors
    for _ in range(ROUNDS):
        now = view.pixels(_corners(kind, shape))[chosen].ravel()
        steps = 1e-4 * np.eye(len(shape))
        jacobian = np.column_stack([view.pixels(_corners(kind, shape + s))[chosen].ravel() - now for s in steps]) / 1e-4
        if not np.isfinite(jacobian).all():
            return shape
        moved = shape + np.linalg.lstsq(jacobian, pointed.ravel() - now, rcond=None)[0]
        if not _is_sound(kind, moved):
            return shape
        shape = moved
    return shape


def _improve(
    kind: str,
    shape: Array,
    view: _View,
    gray: NDArray[np.float32],
    reach: float,
    anchors: tuple[list[int], Array],
    free: int | None = None,
) -> Array | None:
    """One step of Gauss-Newton for the first ``free`` numbers; None where there is nothing to go by."""
    size = (gray.shape[1], gray.shape[0])
    places, at, normals = _samples(kind, shape, view, size)
    if len(places) < 8:
        return None
    offsets, strength = _steps(gray, at, normals, reach)
    # Tukey: a step of something else pulls no more.
    weight = np.where(strength > STEP, np.clip(1 - (offsets / reach) ** 2, 0, None) ** 2, 0.0)
    chosen, pointed = anchors

    def seen(numbers: Array) -> Array:
        corners = _corners(kind, numbers)
        along = ((_points_of(corners, places, view) - at) * normals).sum(1)
        return np.concatenate([along, (view.pixels(corners)[chosen] - pointed).ravel() / POINTED])

    now = seen(shape)
    delta = np.array([1e-4, 1e-4, 1e-3, 1e-4, 1e-4, 1e-4])[: len(shape)]
    steps = np.diag(delta)[:free]
    jacobian = np.column_stack([(seen(shape + one) - now) / one.max() for one in steps])
    target = np.concatenate([offsets, np.zeros(2 * len(chosen))]) - now
    root = np.sqrt(np.concatenate([weight, np.ones(2 * len(chosen))]))
    good = np.isfinite(jacobian).all(1) & np.isfinite(target)
    step, *_ = np.linalg.lstsq(jacobian[good] * root[good, None], target[good] * root[good], rcond=None)
    moved = shape.copy()
    moved[:free] += step
    return moved if _is_sound(kind, moved) else None


def _met(kind: str, shape: Array, view: _View, gray: NDArray[np.float32]) -> float:
    places, at, normals = _samples(kind, shape, view, (gray.shape[1], gray.shape[0]))
    if not places:
        return 0.0
    offsets, strength = _steps(gray, at, normals, REACHES[-1])
    return float(((strength > STEP) & (np.abs(offsets) < MET)).mean())


def _proxy(kind: str, shape: Array) -> Proxy:
    x, y = (round(float(value), 5) for value in shape[:2])
    turn = round((math.degrees(float(shape[2])) + 180) % 360 - 180, 3)
    sides = tuple(round(float(value), 5) for value in shape[3:])
    if kind == "plane":
        return Proxy("plane", at=(x, y, 0.0), rotate=(0.0, 0.0, turn), size=sides)
    if kind == "wall":
        # A plane faces its own +z; turned up about x it faces -y.
        return Proxy("plane", at=(x, y, round(sides[1] / 2, 5)), rotate=(90.0, 0.0, turn), size=sides)
    return Proxy("box", at=(x, y, round(sides[2] / 2, 5)), rotate=(0.0, 0.0, turn), size=sides)
