"""Walls, boxes and planes of a desk from four points of one picture, fitted to the edges that the picture shows.

A shape has five or six numbers: where it stands, how it is turned about the vertical, and its sizes. The points give
their start. Then, as in model-based tracking [DC02], every visible edge of the shape is sampled; from each sample the
picture is searched along the edge's normal for the strongest step in colour, and Gauss-Newton moves the shape so that
its edges meet the steps. The points themselves hold it weakly, so that a shape without edges stays where it was pointed
out. A box may be as bright as the wood behind it, so that steps are told in RGB.

Other steps (a print on the box, its shadow, the desk's grain) make wrong shapes that fit as well. So the fit
starts from several sizes, and a shape counts as fitted only if no other one, more than ``TRUSTED`` away, fits nearly as
well, and if the edges that were met tell its corners within ``TRUSTED``. For that each edge has an offset of its own of
``EDGE`` pixels (its bevel, the card's pose, the lens) beside the scatter s of its n samples, so that it tells no more
than n / (s^2 + n EDGE^2), and with J the derivatives of all samples the corners' covariance follows from (J^T W J)^-1.

References:
    [DC02] T. Drummond and R. Cipolla. Real-time visual tracking of complex structures. PAMI 2002.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
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
STILL: Final = 5e-5
"""Metres and radians below which a step is none."""
SPACING: Final = 4.0
"""Pixels between samples of an edge."""
STEP: Final = 6.0
"""Codes per pixel that a step must have: more than noise and wood have; less in dark pictures, as theirs are."""
BRIGHT: Final = 110.0
"""Mean code of a picture from which on ``STEP`` holds."""
FAINTEST: Final = 2.0
"""Codes per pixel that a step has in the darkest picture: four standard deviations of a camera's noise."""
HAND: Final = 5.0
"""Pixels: standard deviation of a hand that points."""
HANDS: Final = 12
"""Further hands from whose points the edges are tried."""
STRONG: Final = 2.5
"""Times the least step from which on a step is strong enough: a print's edge is no better than a shadowed one."""
TRUSTED: Final = 0.005
"""Metres: two standard deviations of the worst corner of a shape that counts as fitted."""
OUTLINE: Final = 30.0
"""Logarithm of how much likelier an outline is that is wholly met than one that is not at all: half an edge, e^2."""
RIVAL: Final = 3.0
"""Logarithm of how much likelier the best shape must be than any other."""
EDGE: Final = 0.3
"""Pixels: standard deviation of what a whole edge is off by."""
SCATTER: Final = 0.4
"""Pixels: least standard deviation of one sample of an edge."""
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
    """Share of its visible outline that lies on edges of the picture: the mean over its edges."""
    fitted: bool
    """Whether edges of the picture tell its corners within ``TRUSTED``; where there are none it is as pointed out."""
    deviation: float
    """Standard deviation of its worst corner in metres, as far as edges and points tell; the camera's is not in it."""
    doubt: str
    """Why it is not fitted, in words; empty where it is."""


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
    picture = _Picture(image)
    anchors = _anchors(kind, start, view, np.asarray(points, float))
    start = _settled(kind, start, view, anchors)
    tried = _tried(kind, start, view, picture, anchors)
    if not tried:
        deviation = _deviation(kind, start, view, None, anchors)
        share, _ = _met(kind, start, view, picture)
        return OutlineFit(_proxy(kind, start), share, False, deviation, "the picture shows too few of its edges")
    best = max(tried, key=lambda one: one.score)
    corners = _corners(kind, best.shape)
    apart = [_apart(corners, _corners(kind, one.shape)) for one in tried if one.score > best.score - RIVAL]
    if max(apart) > TRUSTED:
        doubt = f"edges that are {1e3 * max(apart):.0f} mm apart fit it alike"
        return OutlineFit(_proxy(kind, best.shape), best.met, False, max(apart) / 2, doubt)
    deviation = _deviation(kind, best.shape, view, picture, anchors)
    fitted = 2 * deviation < TRUSTED
    doubt = "" if fitted else f"its edges tell it only within {2e3 * deviation:.0f} mm"
    return OutlineFit(_proxy(kind, best.shape), best.met, fitted, deviation, doubt)


def _apart(corners: Array, others: Array) -> float:
    """How far corners (n, 3) are from the nearest of others at most, metres: a box may be named from another corner."""
    return float(np.linalg.norm(corners[:, None] - others, axis=2).min(1).max())


@dataclasses.dataclass(frozen=True)
class _Tried:
    """A shape that edges meet."""

    shape: Array
    met: float
    score: float
    """Logarithm of its likelihood but for a constant: edges met, and how far a hand was off."""


def _tried(kind: str, start: Array, view: _View, picture: _Picture, anchors: tuple[list[int], Array]) -> list[_Tried]:
    """Shapes that enough edges meet."""
    # Where a pixel is millimetres, a hand makes a shape of quite other sizes: what other hands would point out.
    rng = np.random.default_rng(0)
    chosen, pointed = anchors
    hands = pointed + rng.normal(0.0, HAND, (HANDS, *pointed.shape))
    starts = [start, *(_settled(kind, start, view, (chosen, hand)) for hand in hands)]
    found = []
    for first, reaches in itertools.product(starts, (REACHES, REACHES[1:], REACHES[2:])):
        shape = first
        for reach in reaches:
            shape = _rounds(kind, shape, view, picture, reach, anchors)
        off = view.pixels(_corners(kind, shape))[chosen] - pointed
        # Edges that lie far from where somebody pointed are others.
        if not np.linalg.norm(off, axis=1).max() <= FARTHEST:
            continue
        met, closely = _met(kind, shape, view, picture)
        if met >= ENOUGH:
            found.append(_Tried(shape, met, OUTLINE * closely - float((off**2).sum()) / (2 * HAND**2)))
    return found


def _deviation(
    kind: str, shape: Array, view: _View, picture: _Picture | None, anchors: tuple[list[int], Array]
) -> float:
    """Standard deviation of the worst corner, metres, by the edges that are met and the points."""
    chosen, _ = anchors
    steps = 1e-4 * np.eye(len(shape))

    def slopes(of: Callable[[Array], Array]) -> Array:
        now = of(shape)
        return np.stack([(of(shape + one) - now).ravel() / 1e-4 for one in steps], 1)

    points = slopes(lambda numbers: view.pixels(_corners(kind, numbers))[chosen])
    told = points.T @ points / POINTED**2
    if picture is not None:
        places, at, normals = _samples(kind, shape, view, picture.size)
        offsets, strength = picture.steps(at, normals, REACHES[-1])
        good = (strength > picture.step) & (np.abs(offsets) < MET)
        along = slopes(lambda numbers: ((_points_of(_corners(kind, numbers), places, view) - at) * normals).sum(1))
        names = np.array([8 * i + j for i, j, _ in places])
        for name in np.unique(names[good]):
            one = good & (names == name)
            scatter = max(float(np.std(offsets[one])), SCATTER)
            told += along[one].T @ along[one] / (scatter**2 + one.sum() * EDGE**2)
    covariance = np.linalg.inv(told + 1e-9 * np.trace(told) * np.eye(len(shape)))
    corners = slopes(lambda numbers: _corners(kind, numbers))
    variances = np.einsum("ij,jk,ik->i", corners, covariance, corners).reshape(-1, 3).sum(1)
    return math.sqrt(float(variances.max()))


def _rounds(
    kind: str, shape: Array, view: _View, picture: _Picture, reach: float, anchors: tuple[list[int], Array]
) -> Array:
    """A shape after some steps with one reach."""
    for _ in range(ROUNDS):
        moved = _improve(kind, shape, view, picture, reach, anchors)
        if moved is None:
            break
        still = np.abs(moved - shape).max() < STILL
        shape = moved
        if still:
            break
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
    picture = _Picture(image)
    seen = view.pixels(_corners(kind, shape))
    size = picture.size
    if not np.isfinite(seen).all() or not ((seen > 2) & (seen < (size[0] - 3, size[1] - 3))).all():
        return None  # of an outline that is cut off, what is left fits anywhere
    start, before = shape, _met(kind, shape, view, picture)[0]
    anchors = (list(range(len(seen))), seen)
    for reach in (MODELLED, *REACHES):
        for _ in range(ROUNDS):
            moved = _improve(kind, shape, view, picture, reach, anchors, free=3)
            if moved is None:
                break
            shape = moved
    if not _is_sound(shape):
        shape = start
    off = float(np.linalg.norm(view.pixels(_corners(kind, shape)) - seen, axis=1).max())
    return OutlineRefit(_proxy(kind, shape), _met(kind, shape, view, picture)[0], before, off)


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


class _Picture:
    """A picture whose steps are looked for."""

    def __init__(self, image: NDArray[np.uint8]) -> None:
        self._colors = cv2.GaussianBlur(image, (0, 0), 0.8).astype(np.float32)
        self.size = (image.shape[1], image.shape[0])
        self.step = max(STEP * min(float(image.mean()) / BRIGHT, 1.0), FAINTEST)
        """Codes per pixel that a step must have."""

    def steps(self, at: Array, normals: Array, reach: float) -> tuple[Array, Array]:
        """How far along its normal each sample's strongest step lies, pixels, and its strength, codes per pixel."""
        offsets = np.arange(-reach, reach + 0.25, 0.5)
        places = (at[:, None] + (offsets[:, None] * normals[:, None])).astype(np.float32)
        values = cv2.remap(
            self._colors, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        slope = np.sqrt(((values[:, 4:] - values[:, :-4]) ** 2).mean(-1)) / 2.0
        middle = offsets[2:-2]
        # Of two steps the nearer one, unless the other is much stronger.
        weighed = np.minimum(slope, STRONG * self.step) * np.exp(-0.5 * (middle / (0.6 * reach)) ** 2)
        best = weighed.argmax(1)
        rows = np.arange(len(best))
        low, high = np.clip(best - 1, 0, None), np.clip(best + 1, None, len(middle) - 1)
        a, b, c = slope[rows, low], slope[rows, best], slope[rows, high]
        bend = a - 2 * b + c
        with np.errstate(divide="ignore", invalid="ignore"):
            fine = np.where((bend < 0) & (low < best) & (high > best), 0.5 * (a - c) / bend, 0.0)
        return middle[best] + 0.5 * np.clip(fine, -1, 1), b


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


def _is_sound(shape: Array) -> bool:
    return bool(
        np.isfinite(shape).all()
        and (shape[3:] >= SMALLEST).all()
        and (shape[3:] <= LARGEST).all()
        and np.abs(shape[:2]).max() <= LARGEST
    )


def _check(kind: str, shape: Array) -> None:
    if _is_sound(shape):
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
        if not _is_sound(moved):
            return shape
        shape = moved
    return shape


def _improve(
    kind: str,
    shape: Array,
    view: _View,
    picture: _Picture,
    reach: float,
    anchors: tuple[list[int], Array],
    free: int | None = None,
) -> Array | None:
    """One step of Gauss-Newton for the first ``free`` numbers; None where there is nothing to go by."""
    places, at, normals = _samples(kind, shape, view, picture.size)
    if len(places) < 8:
        return None
    offsets, strength = picture.steps(at, normals, reach)
    # Tukey: a step of something else pulls no more.
    weight = np.where(strength > picture.step, np.clip(1 - (offsets / reach) ** 2, 0, None) ** 2, 0.0)
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
    return moved if _is_sound(moved) else None


def _met(kind: str, shape: Array, view: _View, picture: _Picture) -> tuple[float, float]:
    """Share of a shape's outline that lies on edges of the picture, and the same with those farther off counting less.

    Each edge counts alike: a short one tells a side as well as a long one.
    """
    places, at, normals = _samples(kind, shape, view, picture.size)
    if not places:
        return 0.0, 0.0
    offsets, strength = picture.steps(at, normals, REACHES[-1])
    seen = strength > picture.step
    names = np.array([8 * i + j for i, j, _ in places])
    edges = [names == name for name in np.unique(names)]
    met, closely = seen & (np.abs(offsets) < MET), seen * np.exp(-0.5 * (offsets / (0.5 * MET)) ** 2)
    return float(np.mean([met[edge].mean() for edge in edges])), float(
        np.mean([closely[edge].mean() for edge in edges])
    )


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
