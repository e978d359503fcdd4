"""Outline of a mirror ball in a photograph, with sub-pixel accuracy and its uncertainty.

The search goes from coarse to fine. An approximate circle, given or found, is refined in a reduced picture where the
ball's radius is ``COARSE_RADIUS`` pixels, then in increasingly larger pictures, each time by the evidence of
``ball_rim``. The three unknowns are those of a sphere in front of the camera, so the elliptic outline under a wide lens
needs no further unknowns.

The uncertainty is estimated by leaving out one sector of the rim after the other (delete-a-group jackknife).
Disturbances of a rim (a stand, a band of light, a shadow) affect neighbouring pieces equally, so single pieces are not
independent. The difference between the two-sided model of the rim and plain step detection is added to the uncertainty.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.ball.ball_proposals import propose_circles
from warp_ar.ball.ball_rim import (
    MOST_COST,
    RimEvidence,
    descend,
    gather_evidence,
    gather_steps,
    gradients,
    mirror_misfit,
    radial_compression,
)
from warp_ar.errors import UsageError
from warp_ar.scene import Camera
from warp_ar.scene.pixel_rays import project, undistorted

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

SMALLEST_PICTURE = 24
"""Shorter side of a picture in pixels below which no ball is searched, because noise then fits any circle."""
COARSE_RADIUS = 48.0
"""Radius in pixels of the ball in the smallest reduced picture."""
ROUGH_ERROR = 0.22
"""Relative error of an approximate circle, as a share of its radius."""
BLURS = (0.45, 0.6, 0.75, 0.95, 1.3, 1.8)
"""Standard deviations in pixels of the picture's blur that are tried at full size."""
STARTS = 4
"""Number of candidates from which a search descends, because a mirrored edge often gives a stronger circle than the
rim."""
SEARCHED = 1600.0
"""Longer side in pixels to which a picture is reduced before a ball is searched in all of it."""
DIM_SUPPORT = 0.4
"""Visible share of the rim below which a person should check the result."""
TINY = 24.0
"""Radius in pixels below which many objects resemble a ball."""
SEARCHES = 16
"""Number of proposed circles from which a ball is searched in a whole picture."""
CERTAIN = 9.8
"""Evidence above which no further circle is examined; most pictures of a ball reach it, few others do."""
LEAST_EVIDENCE = 6.0
"""Smallest evidence for a ball. Between it and ``CERTAIN``, a person should check the result, which is mostly right."""
UNSURE = 0.02
"""Largest standard deviation of position and radius, relative to the radius, of an outline without doubt."""
STRAY = 0.026
"""Largest ``BallOutline.stray`` of an outline without doubt, relative to the radius."""
STRAY_PIXELS = 2.0
"""``BallOutline.stray`` in pixels below which it is noise."""
STRAY_REACH = 0.08
"""Distance from an outline, relative to the radius, in which other edges are searched."""
STRAY_RADIUS = 160.0
"""Radius in pixels of the ball in the reduced picture in which these other edges are searched."""
MISFIT = 0.6
"""Largest ``BallOutline.misfit`` of a mirror ball."""
DARK = 6.0
"""Code below which a lifted picture is not logarithmic, because of noise."""
LARGEST_RADIUS = 700.0
"""Radius in pixels above which a ball is measured in a reduced picture; lens errors then exceed a fifth of a pixel."""
ALIKE = 0.06
"""Difference of mean log likelihoods per piece within which two blurs are equally likely."""
LEAST_DEVIATION = 0.08
"""Smallest standard deviation in pixels: model errors at the rim that the jackknife does not show."""
PIECES = 240
"""Number of pieces of a rim."""
COMPRESSION = 1.0
"""Weight of the radial compression inside a rim relative to the steps across it."""
BEHIND = -4.0
"""Compression assigned to a ball partly behind the camera; lower than any real one."""
TOGETHER = 64
"""Number of outlines whose compression is computed together; more would not fit the core's cache."""
SECTORS = 12
"""Number of sectors of the rim that are left out in turn."""
LEAST_SUPPORT = 0.2
"""Smallest visible share of a rim."""


@dataclasses.dataclass(frozen=True)
class BallOutline:
    """Silhouette of a ball in a picture."""

    center: tuple[float, float]
    """Centre of the ellipse, pixels (column, row)."""
    axes: tuple[float, float]
    """Half axes of the ellipse in pixels, longer axis first."""
    angle: float
    """Direction of the longer axis in degrees, from the picture's x axis toward its y axis."""
    deviation: tuple[float, float, float]
    """Standard deviations of column, row and radius in pixels."""
    support: float
    """Share of the rim in view that supports the outline."""
    sphere: tuple[float, float, float]
    """Centre of the ball in the camera's frame, divided by its radius."""
    evidence: float = math.inf
    """Similarity to a mirror ball if the whole picture was searched; else infinite."""
    stray: float = 0.0
    """Largest distance in pixels to ellipses that have as many steps across them."""
    misfit: float = 0.0
    """Difference of the compression inside from a mirror ball's (``mirror_misfit``)."""

    @property
    def doubts(self) -> tuple[str, ...]:
        """Return reasons for which the outline may be wrong, or another object's; most such outlines are right."""
        dim = self.support < DIM_SUPPORT or self.radius < TINY
        reasons = {
            "little of it is seen": math.isfinite(self.evidence) and (self.evidence < CERTAIN or dim),
            "it is uncertain": max(self.deviation) > UNSURE * self.radius,
            f"edges lie up to {self.stray:.0f} pixels from it": self.stray > max(STRAY * self.radius, STRAY_PIXELS),
            "its inside is unlike a mirror ball's": self.misfit > MISFIT,
        }
        return tuple(reason for reason, holds in reasons.items() if holds)

    @property
    def radius(self) -> float:
        """Return the mean radius in pixels."""
        return math.sqrt(self.axes[0] * self.axes[1])

    def points(self, count: int = PIECES) -> Array:
        """Return the outline, (count, 2) pixels."""
        angle = 2 * np.pi * np.arange(count) / count
        c, s = math.cos(math.radians(self.angle)), math.sin(math.radians(self.angle))
        local = np.column_stack([self.axes[0] * np.cos(angle), self.axes[1] * np.sin(angle)])
        return np.asarray(local @ np.array([[c, s], [-s, c]]) + self.center, float)


def far_camera(width: int, height: int) -> Camera:
    """Return a camera for pictures without known perspective, so distant that a ball's outline is a circle."""
    focal = 30.0 * max(width, height)
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def silhouette(camera: Camera, sphere: Array, count: int = PIECES) -> tuple[Array, Array]:
    """Return the outline (count, 2) in pixels and outward unit normals of a ball at ``sphere`` (centre over radius)."""
    if not _is_before(sphere[None])[0]:
        return np.zeros((0, 2)), np.zeros((0, 2))
    pixels, normals = silhouettes(camera, sphere[None], count)
    return pixels[0], normals[0]


def _is_before(spheres: Array) -> NDArray[np.bool_]:
    """Return a mask of spheres (m, 3) that are entirely in front of the camera."""
    return np.asarray((np.linalg.norm(spheres, axis=1) > 1.0) & (spheres[:, 2] > 1.0))


def silhouettes(camera: Camera, spheres: Array, count: int = PIECES) -> tuple[Array, Array]:
    """Return outlines (m, count, 2) in pixels and outward unit normals of balls (m, 3) in front of the camera.

    All are computed together: a search needs thousands, and NumPy takes as long for a few numbers as for hundreds.
    """
    d = np.linalg.norm(spheres, axis=1, keepdims=True)
    n = spheres / d
    u = np.cross(n, np.where(np.abs(n[:, 1:2]) < 0.9, (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    angle = 2 * np.pi * np.arange(count)[:, None] / count
    spokes = np.cos(angle) * u[:, None] + np.sin(angle) * np.cross(n, u)[:, None]
    # Rays tangent to the ball touch it on a circle with centre c - n / d and radius sqrt(1 - 1 / d^2).
    rim = (spheres - n / d)[:, None] + np.sqrt(1.0 - 1.0 / (d * d))[:, None] * spokes
    pixels = project(camera, rim.reshape(-1, 3)).reshape(len(spheres), count, 2)
    # The rim runs from x to y about the axis away from the camera: outward is to the right of its direction.
    tangent = np.roll(pixels, -1, 1) - np.roll(pixels, 1, 1)
    normal = np.stack([tangent[..., 1], -tangent[..., 0]], -1)
    return pixels, normal / np.maximum(np.hypot(normal[..., 0], normal[..., 1]), 1e-9)[..., None]


def sphere_of_circle(camera: Camera, x: float, y: float, radius: float) -> Array:
    """Return centre over radius, (3,), of the ball whose silhouette is approximately a circle in the picture."""
    around = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))
    circle = np.array([[x + dx * radius, y + dy * radius] for dx, dy in around], float)
    flat = undistorted(camera, circle)
    rays = np.column_stack([flat, np.ones(4)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    # The cone's axis bisects the angle between opposite rays.
    axis = rays[:2].sum(0) / np.linalg.norm(rays[:2].sum(0)) + rays[2:].sum(0) / np.linalg.norm(rays[2:].sum(0))
    axis /= np.linalg.norm(axis)
    half = float(np.arccos(np.clip(rays @ axis, -1.0, 1.0)).mean())
    return np.asarray(axis / math.sin(max(half, 1e-6)), float)


def _steps(camera: Camera, sphere: Array) -> Array:
    """Return columns (3, 3): changes of a sphere that move its outline by a pixel right, down and outward."""
    scale = 1.0 / math.hypot(*sphere)
    pixels, _ = silhouette(camera, sphere, 16)
    columns = []
    for axis in np.eye(3):
        ahead, _ = silhouette(camera, sphere + 1e-3 / scale * axis, 16)
        shift = (ahead - pixels) / (1e-3 / scale)
        out = pixels - pixels.mean(0)
        columns.append([*shift.mean(0), float((shift * out).sum() / np.linalg.norm(out, axis=1).sum())])
    return np.linalg.inv(np.array(columns).T)


class _Fit:
    """Cost of a ball's sphere by one picture's evidence around a base outline."""

    def __init__(self, image: Image, camera: Camera, base: Array, shift: float, blur: float | None = None) -> None:
        """Gather the evidence; without ``blur`` only steps, to choose among several candidates."""
        self.base = base
        self.steps = _steps(camera, base)
        self.points, self.normals = silhouette(camera, base)
        nx, ny = self.normals.T
        self.basis = np.stack([nx, ny, np.ones_like(nx), nx * nx - ny * ny, 2.0 * nx * ny])
        self.radius = float(np.linalg.norm(self.points - self.points.mean(0), axis=1).mean())
        if blur is None:
            self.evidence = gather_steps(image, self.points, self.normals, self.radius, shift=shift)
        else:
            self.evidence = gather_evidence(image, self.points, self.normals, self.radius, shift=shift, blur=blur)

    def shifts(self, moves: Array) -> Array:
        """Return shifts along the normals, pixels (m, n), of an outline after moves (m, 3 or 5).

        A move is right, down and outward, and the two components of an ellipse.
        """
        return np.asarray(moves @ self.basis[: moves.shape[1]])

    def costs(self, moves: Array, evidence: RimEvidence | None = None) -> Array:
        """Return the costs (m,) of moves (m, 3)."""
        return (evidence or self.evidence).totals(self.shifts(moves))

    def spheres(self, moves: Array) -> Array:
        """Return the spheres (m, 3) after moves (m, 3), or the sphere (3,) after one."""
        return np.asarray(self.base + moves @ self.steps.T)


def _reduced(image: Image, camera: Camera, share: float) -> tuple[Image, Camera]:
    """Return picture and camera scaled by ``share``, with whole pixels."""
    if share >= 1.0:
        return image, camera
    height, width = image.shape[:2]
    w, h = max(round(width * share), 8), max(round(height * share), 8)
    sx, sy = w / width, h / height
    small = dataclasses.replace(
        camera, width=w, height=h, fx=camera.fx * sx, fy=camera.fy * sy,
        cx=(camera.cx + 0.5) * sx - 0.5, cy=(camera.cy + 0.5) * sy - 0.5,
    )  # fmt: skip
    return np.asarray(cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA)), small


def _search(image: Image, camera: Camera, sphere: Array, shift: float, step: float) -> Array:
    """Return the sphere with the strongest rim, whose outline is moved by up to ``shift`` pixels in every unknown."""
    slopes, fit = gradients(image), _Fit(image, camera, sphere, math.ceil(2.0 * shift))

    def compressions(moves: Array) -> Array:
        spheres = fit.spheres(moves)
        found, before = np.full(len(moves), BEHIND), _is_before(spheres)
        if before.any():
            points, normals = silhouettes(camera, spheres[before], PIECES // 3)
            found[before] = radial_compression(slopes, points, normals, fit.radius + moves[before, 2])
        return found

    def costs(moves: Array) -> Array:
        parts = (moves[k : k + TOGETHER] for k in range(0, len(moves), TOGETHER))
        return np.concatenate([fit.costs(part) - COMPRESSION * compressions(part) for part in parts])

    moves = _grid(shift, step)
    chosen = _apart(moves, costs(moves), 2.5 * step)
    found = [descend(costs, moves[k], 0.5 * step, 0.2) for k in chosen]
    return fit.spheres(min(found, key=lambda item: item[1])[0])


def _grid(reach: float, step: float) -> Array:
    """Return moves (m, 3) of up to ``reach`` pixels in each unknown."""
    grid = np.arange(-math.ceil(reach / step), math.ceil(reach / step) + 1.0) * step
    return np.stack(np.meshgrid(grid, grid, grid), -1).reshape(-1, 3)


def _apart(places: Array, costs: Array, distance: float) -> list[int]:
    """Return the indices of the cheapest ``STARTS`` places farther than ``distance`` from each other."""
    chosen: list[int] = []
    for k in np.argsort(costs):
        if all(np.abs(places[k] - places[other]).max() > distance for other in chosen):
            chosen.append(int(k))
            if len(chosen) == STARTS:
                break
    return chosen


def _radius(camera: Camera, sphere: Array) -> float:
    points, _ = silhouette(camera, sphere, 16)
    return float(np.linalg.norm(points - points.mean(0), axis=1).mean()) if len(points) else math.inf


def _coarse(image: Image, camera: Camera, sphere: Array, rough_error: float) -> Array:
    """Return the best sphere within ``rough_error`` of an approximate one, searched exhaustively in a small picture."""
    radius = _radius(camera, sphere)
    small, view = _reduced(image, camera, COARSE_RADIUS / radius)
    return _search(small, view, sphere, rough_error * min(radius, COARSE_RADIUS), 2.0)


def refine_outline(image: Image, camera: Camera, sphere: Array, largest: float = LARGEST_RADIUS) -> BallOutline:
    """Refine the outline near a sphere that is accurate to a few percent, and estimate its uncertainty.

    Args:
        image: 8-bit RGB.
        camera: Camera of the picture.
        sphere: Centre over radius, (3,), in the camera's frame.
        largest: Radius in pixels above which the ball is measured in a reduced picture.

    Raises:
        UsageError: The result is not a ball in front of the camera.
    """
    image, camera, corner = _window(image, camera, sphere)
    radius = _radius(camera, sphere)
    share, finest = min(1.0, COARSE_RADIUS / radius), min(1.0, largest / radius)
    for octave in range(max(math.ceil(math.log2(finest / share)), 1)):
        picture, view = _reduced(image, camera, min(2.0 ** (octave + 1) * share, finest))
        sphere = _search(picture, view, sphere, 2.0, 1.0)
    # A wider blur moves the rim inward by the same amount; blurs that are equally likely add to the uncertainty.
    tried = []
    for blur in BLURS:
        fit = _Fit(picture, view, sphere, 1.5, blur)
        move, value = descend(fit.costs, np.zeros(3), 0.4, 0.02)
        tried.append((value + fit.evidence.least, move, blur))
    least = min(cost for cost, _, _ in tried)
    likely = [(move, blur) for cost, move, blur in tried if cost < least + ALIKE]
    unsure = np.std([move[2] for move, _ in likely])
    # Repeated around the result, so that normals and window are those of the outline itself.
    move, blur = likely[(len(likely) - 1) // 2]
    fit = _Fit(picture, view, fit.spheres(move), 1.5, blur)
    move, _ = descend(fit.costs, np.zeros(3), 0.2, 0.01)
    sector = np.arange(PIECES) * SECTORS // PIECES
    rest = [functools.partial(fit.costs, evidence=fit.evidence.without(sector == k)) for k in range(SECTORS)]
    left = np.stack([descend(costs, move, 0.1, 0.01)[0] for costs in rest])
    spread = np.sqrt((SECTORS - 1) / SECTORS * ((left - left.mean(0)) ** 2).sum(0)) + LEAST_DEVIATION
    # Plain step detection is a second opinion; its difference from the model adds to the uncertainty.
    steps = _Fit(picture, view, fit.spheres(move), 1.0)
    other, _ = descend(steps.costs, np.zeros(3), 0.4, 0.02)
    spread = np.sqrt(spread**2 + np.array([0.0, 0.0, unsure]) ** 2 + other**2) / finest
    found = _describe(camera, fit.spheres(move), spread, steps.evidence.support(np.zeros(PIECES)))
    return dataclasses.replace(found, center=(found.center[0] + corner[0], found.center[1] + corner[1]))


def _window(image: Image, camera: Camera, sphere: Array) -> tuple[Image, Camera, tuple[int, int]]:
    """Return the part of a picture that may contain a ball's outline, its camera, and its corner's column and row."""
    points, _ = silhouette(camera, sphere, 32)
    low, high = points.min(0), points.max(0)
    margin = 0.35 * (high - low).max() + 24.0
    x0, y0 = (int(v) for v in np.maximum(np.floor(low - margin), 0))
    x1, y1 = (int(v) for v in np.minimum(np.ceil(high + margin) + 1, image.shape[1::-1]))
    part = np.ascontiguousarray(image[y0:y1, x0:x1])
    inside = dataclasses.replace(camera, width=x1 - x0, height=y1 - y0, cx=camera.cx - x0, cy=camera.cy - y0)
    return part, inside, (x0, y0)


def _describe(camera: Camera, sphere: Array, spread: Array, support: float) -> BallOutline:
    points, _ = silhouette(camera, sphere)
    if len(points) == 0:
        raise UsageError("the outline fits no ball in front of the camera; give a rough circle")
    (x, y), (a, b), angle = cv2.fitEllipseDirect(points.astype(np.float32)[:, None])
    if a < b:
        a, b, angle = b, a, angle + 90.0
    # OpenCV's ellipse fit is in single precision; its centre is as exact as the mean of points at equal angles.
    dx, dy, dr = map(float, spread)
    cx, cy, cz = map(float, sphere)
    return BallOutline((float(x), float(y)), (a / 2, b / 2), angle % 180.0, (dx, dy, dr), support, (cx, cy, cz))


def lifted(image: Image) -> Image:
    """Return the picture with logarithmic codes, so that dark and bright edges have equal contrast.

    In a bracket's short exposures, a rim has a contrast of a few codes, next to lamps of two hundred.
    """
    return np.asarray(_LIFT[image])


def find_ball(
    image: Image, camera: Camera | None = None, rough: Sequence[float] | None = None, rough_error: float = ROUGH_ERROR
) -> BallOutline:
    """Find the outline of a mirror ball in a photograph.

    Args:
        image: uint8 RGB (height, width, 3).
        camera: The camera, if known; else the outline is assumed to be a circle.
        rough: Column, row and radius in pixels of an approximate circle; None: search the picture.
        rough_error: Error of ``rough``, as a share of its radius.

    Raises:
        UsageError: No ball is found, the picture is too small, or the circle lies outside of it.
    """
    height, width = image.shape[:2]
    if min(width, height) < SMALLEST_PICTURE:
        raise UsageError(
            f"the picture is {width}x{height} pixels; expected {SMALLEST_PICTURE} or more on each side to find a ball"
        )
    camera = camera or far_camera(width, height)
    if rough is None:
        return _find_anywhere(image, camera)
    start = _sphere_of_given(image, camera, rough)
    outlines = []
    for view in (image, lifted(image)):
        outlines.append(refine_outline(view, camera, _coarse(view, camera, start, rough_error)))
        if outlines[-1].support >= LEAST_SUPPORT:
            return _examined(image, camera, outlines[-1])
    raise _unseen(max(outlines, key=lambda outline: outline.support), "give a circle that is nearer to the rim")


def exact_outline(image: Image, camera: Camera, circle: Sequence[float]) -> BallOutline:
    """Return the outline of exactly the given circle (column, row, radius in pixels).

    Raises:
        UsageError: No ball in front of the camera has this outline.
    """
    sphere = _sphere_of_given(image, camera, circle)
    steps = _Fit(image, camera, sphere, 1.0).evidence
    return _describe(camera, sphere, np.zeros(3), steps.support(np.zeros(PIECES)))


def _sphere_of_given(image: Image, camera: Camera, rough: Sequence[float]) -> Array:
    """Return the sphere of a given circle.

    Raises:
        UsageError: The circle is invalid, or outside the picture.
    """
    height, width = image.shape[:2]
    if len(rough) != 3 or not all(map(math.isfinite, rough)) or rough[2] < 4.0:
        raise UsageError(
            f"ball {', '.join(f'{v:g}' for v in rough)}: expected column, row and radius (4 or more) in pixels"
        )
    x, y, reach = rough
    if not (-reach < x < width + reach and -reach < y < height + reach):
        raise UsageError(f"ball {x:g}, {y:g}, {reach:g}: the circle lies outside the picture, {width}x{height} pixels")
    start = sphere_of_circle(camera, *rough)
    if start[2] <= 1.0:
        raise UsageError("no ball in front of the camera has this circle; expected one nearer to the picture's centre")
    return start


def _find_anywhere(image: Image, camera: Camera) -> BallOutline:
    """Return the likeliest ball in the whole picture."""
    small, view = _reduced(image, camera, SEARCHED / max(image.shape))
    height, width = small.shape[:2]
    # Also a circle as wide as the picture, for a crop of the ball alone.
    circles = [*propose_circles(small), ((width - 1) / 2, (height - 1) / 2, 0.48 * min(width, height))]
    starts = [sphere_of_circle(view, *circle) for circle in circles]
    tries = [(lift, start) for lift in (False, True) for start in starts if start[2] > 1.0]
    pictures = small, lifted(small)
    # Candidates are ranked by the evidence of the proposed circle itself; the ball's rim may be outside a mirrored
    # edge.
    tries = sorted(tries, key=lambda item: -rim_strength(pictures[item[0]], view, item[1]))[:SEARCHES]
    best, told = None, -math.inf
    for lift, start in tries:
        sphere = _coarse(pictures[lift], view, start, ROUGH_ERROR)
        strength = rim_strength(pictures[lift], view, sphere)
        if strength > told:
            best, told = (lift, sphere), strength
        if told > CERTAIN:
            break
    ask = "give a rough circle (--ball): column, row, radius in pixels"
    if best is None:
        raise UsageError(f"no ball was found in the picture; {ask}")
    lift, sphere = best
    picture = lifted(image) if lift else image
    outline = refine_outline(picture, camera, sphere)
    if outline.support < LEAST_SUPPORT and (reduced := _refine_reduced(picture, camera, outline)) is not None:
        outline, told = reduced, min(told, LEAST_EVIDENCE)  # mostly right for soft photographs, but doubtful
    outline = dataclasses.replace(outline, evidence=told)
    if told < LEAST_EVIDENCE or outline.support < LEAST_SUPPORT:
        raise _unseen(outline, ask)
    return _examined(image, camera, outline)


def _examined(image: Image, camera: Camera, outline: BallOutline) -> BallOutline:
    """Return an outline with its stray and its misfit.

    Circles are tried all around. From the best of them and from the outline itself, ellipses are fitted to the steps in
    the picture. A ball's outline is such an ellipse if the true perspective is not the assumed one. Outlines of many
    other objects are ellipses too.
    """
    size = STRAY_RADIUS / max(outline.radius, STRAY_RADIUS)
    small, view = _reduced(image, camera, size)
    fit = _Fit(small, view, np.array(outline.sphere), math.ceil(STRAY_REACH * size * outline.radius))
    moves = _grid(STRAY_REACH * fit.radius, 0.25 * STRAY_REACH * fit.radius)
    circles = moves[_apart(moves, fit.costs(moves), 0.6 * STRAY_REACH * fit.radius)]
    starts = np.column_stack([np.concatenate([np.zeros((1, 3)), circles]), np.zeros((1 + len(circles), 2))])
    ellipses = [descend(fit.costs, start, 0.4 * STRAY_REACH * fit.radius, 0.1) for start in starts]
    rivals = np.array([move for move, cost in ellipses if cost <= ellipses[0][1]])
    misfit = mirror_misfit(gradients(small), fit.points, fit.normals, fit.radius)
    return dataclasses.replace(outline, stray=float(np.abs(fit.shifts(rivals)).max()) / size, misfit=misfit)


def _refine_reduced(image: Image, camera: Camera, outline: BallOutline) -> BallOutline | None:
    """Return the outline in the largest reduced picture that shows the rim.

    Noise or a soft lens hides it in larger ones.
    """
    largest = 0.5 * min(outline.radius, LARGEST_RADIUS)
    while largest >= COARSE_RADIUS:
        reduced = refine_outline(image, camera, np.array(outline.sphere), largest)
        if reduced.support >= DIM_SUPPORT:
            return reduced  # the rim must be clearly visible: every scene has faint circles
        largest *= 0.5
    return None


def _unseen(outline: BallOutline, ask: str) -> UsageError:
    (x, y), radius = outline.center, outline.radius
    return UsageError(
        f"no ball was found in the picture: the best outline, about ({x:.0f}, {y:.0f}) with a radius of {radius:.0f} "
        f"pixels, is hardly a mirror ball's ({outline.support:.0%} of its rim is seen); {ask}"
    )


def rim_strength(image: Image, camera: Camera, sphere: Array) -> float:
    """Return the evidence for a ball at a sphere: steps at the rim and compression inside, more for larger balls.

    A plate, a lid or a mirrored horizon has as sharp a rim as a ball. Only a ball compresses its reflections toward the
    rim, so the compression has twice the weight.

    Args:
        image: 8-bit RGB; it is reduced so that the ball's radius is ``COARSE_RADIUS`` pixels.
        camera: Camera of the picture.
        sphere: Centre over radius, (3,), in the camera's frame.
    """
    radius = _radius(camera, sphere)
    if not math.isfinite(radius):
        return -math.inf
    small, view = _reduced(image, camera, COARSE_RADIUS / radius)
    fit = _Fit(small, view, sphere, 1.0)
    if not fit.evidence.known.any():
        return -math.inf
    compression = radial_compression(gradients(small), fit.points[None], fit.normals[None], np.array([fit.radius]))
    # Improvement of a step over a smooth curve, as a model of the rim's pieces.
    steps = MOST_COST - float(fit.costs(np.zeros((1, 3)))[0])
    size = 1.0 + 0.1 * math.log(max(radius, 4.0))
    return (steps + 2.0 * float(compression[0])) * float(fit.evidence.known.mean()) * size


_LIFT = np.round(255 * np.log1p(np.arange(256) / DARK) / np.log1p(255 / DARK)).astype(np.uint8)
