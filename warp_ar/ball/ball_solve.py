"""Centre and radius of a mirror ball from its outlines in frames with known poses.

An outline gives the direction of the ball's centre and the ball's apparent size. From one side, a small near ball and a
large distant one look the same; frames from several sides, or a ball known to stand on the table, resolve this. The
unknowns (c, r) minimise

    sum_i |(m(R_i c + t_i, r) - m_i) / sigma_i|^2 + ((c_z - r - ground) / sigma_ground)^2,
    m(q, r) = (f x/z, f y/z, f r/|q|),

by Gauss-Newton with Huber's weights. Disturbances of a rim (a band of light inside it, the background) are the same in
every frame, so their errors do not average out: the interval is that of one typical frame, not of the mean.

In about one frame of twenty, the finder takes a nearby edge for the rim, such as the table's edge mirrored along it or
an edge behind the ball. The interval of that outline is then wrong, and with two frames from different sides it is
unknown which of the contradicting outlines is wrong. Therefore each outline in turn predicts the ball in the other
frames, where outlines are searched again near the prediction. The ball with the most visible rim over all frames is
kept. With two frames of a path-traced studio, this reduces the error of the centre from 8 mm to 0.2 mm.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from warp_ar.ball.ball_finder import ROUGH_ERROR, BallOutline, find_ball, rim_strength
from warp_ar.errors import UsageError
from warp_ar.scene import Camera, Pose, Probe, Proxy

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
View = tuple[Image, Pose]
Found = tuple[BallOutline, Pose]
"""Outline with the pose of its frame."""

STANDS = 0.0005
"""Standard deviation in metres of the height of a ball that stands on a table: the card's thickness, unevenness."""
LEAST_PIXELS = 0.25
"""Smallest standard deviation in pixels of an outline's position and radius."""
HUBER = 2.0
"""Residual in standard deviations beyond which an outline has less weight."""
STEPS = 30
"""Largest number of Gauss-Newton steps."""
APART = 4.0
"""Distance in standard deviations beyond which an outline contradicts the others; right ones are within 3.2."""
AGAIN = 0.12
"""Relative search range around an outline predicted by other frames, as a share of the radius."""
SAME = 0.05
"""Relative difference, as a share of the radius, within which two balls are the same."""
MOST = 2
"""Number of balls that are tried; each takes a third of a second per frame."""


@dataclasses.dataclass(frozen=True)
class BallSolution:
    """Mirror ball determined by its outlines."""

    center: tuple[float, float, float]
    """Centre in the marker's frame, metres."""
    radius: float
    """Radius, metres."""
    center_deviation: tuple[float, float, float]
    """Standard deviations of the centre, metres."""
    radius_deviation: float
    """Standard deviation of the radius, metres; 0 if it was assumed."""
    radius_assumed: bool
    """True if the given radius was kept, because the frames are too similar to determine it."""
    outlines: tuple[BallOutline, ...]
    """Outlines that were used."""


def ground_below(probe: Probe, proxies: Sequence[Proxy]) -> float | None:
    """Return the height in metres of the horizontal plane below a ball; None if the scene has none."""
    x, y, _ = probe.center
    levels = []
    for proxy in proxies:
        if proxy.shape == "plane" and abs(proxy.rotate[0]) + abs(proxy.rotate[1]) < 1.0:
            reach = 0.5 * math.hypot(*proxy.size[:2])
            if math.hypot(x - proxy.at[0], y - proxy.at[1]) <= reach:
                levels.append(proxy.at[2])
    return max(levels) if levels else None


def rough_circle(camera: Camera, pose: Pose, probe: Probe) -> tuple[float, float, float] | None:
    """Return column, row and radius in pixels of a scene's ball; None if it is not in front of the camera."""
    c = pose.apply(np.array(probe.center))
    if c[2] <= 1.2 * probe.radius:
        return None
    return (
        float(camera.cx + camera.fx * c[0] / c[2]),
        float(camera.cy + camera.fy * c[1] / c[2]),
        float(camera.fx * probe.radius / np.linalg.norm(c)),
    )


def standing_ground(probe: Probe, proxies: Sequence[Proxy]) -> float | None:
    """Return the height in metres of the surface on which the ball stands.

    Return None if the scene's ball floats, or has no horizontal plane below it.
    """
    ground = ground_below(probe, proxies)
    return ground if ground is not None and probe.center[2] - probe.radius - ground < 0.3 * probe.radius else None


def find_outline(view: View, camera: Camera, probe: Probe, rough_error: float = ROUGH_ERROR) -> BallOutline | None:
    """Return the ball's outline in a frame, searched near the scene's position.

    Args:
        view: RGB frame with ``camera_from_world``.
        camera: Camera of the frame.
        probe: The scene's ball, metres.
        rough_error: Error of the scene's ball, as a share of its radius.

    Returns:
        The outline; None if none is found or the radius is below 4 pixels.
    """
    circle = rough_circle(camera, view[1], probe)
    if circle is not None and circle[2] >= 4.0:
        with contextlib.suppress(UsageError):
            return find_ball(view[0], camera, circle, rough_error)
    return None


def _measure(camera: Camera, sphere: Array) -> Array:
    """Return column and row from the principal point, and radius, in pixels, of centre over radius."""
    f = 0.5 * (camera.fx + camera.fy)
    return np.array([f * sphere[0] / sphere[2], f * sphere[1] / sphere[2], f / np.linalg.norm(sphere)])


def outline_misfit(found: Found, camera: Camera, solution: BallSolution) -> float:
    """Return the largest deviation of an outline's three numbers from a solution, in standard deviations."""
    outline, pose = found
    sphere = pose.apply(np.array(solution.center)) / solution.radius
    off = _measure(camera, sphere) - _measure(camera, np.array(outline.sphere))
    return float((np.abs(off) / np.maximum(outline.deviation, LEAST_PIXELS)).max())


def solve_ball(outlines: Sequence[Found], camera: Camera, probe: Probe, ground: float | None = None) -> BallSolution:
    """Solve for centre and radius from outlines.

    Args:
        outlines: Outlines with ``camera_from_world``.
        camera: The camera.
        probe: The scene's ball, as the initial value.
        ground: Height in metres of the surface below the ball; None: unknown.

    Raises:
        UsageError: There is no outline.
    """
    if not outlines:
        raise UsageError("the ball's outline is in no frame; see [probe] center and radius")
    seen = np.array([_measure(camera, np.array(outline.sphere)) for outline, _ in outlines])
    sigma = np.maximum([outline.deviation for outline, _ in outlines], LEAST_PIXELS)

    def residuals(x: Array) -> Array:
        rows = [
            (_measure(camera, pose.apply(x[:3]) / x[3]) - m) / s
            for (_, pose), m, s in zip(outlines, seen, sigma, strict=True)
        ]
        last = [] if ground is None else [(x[2] - x[3] - ground) / STANDS]
        return np.concatenate([np.ravel(rows), last])

    start = np.array([*probe.center, probe.radius])
    x, covariance = _minimise(residuals, start, np.arange(4), len(outlines))
    assumed = ground is None and math.sqrt(covariance[3, 3]) > 0.05 * probe.radius
    if assumed:
        x, covariance = _minimise(residuals, start, np.arange(3), len(outlines))
    deviations = np.sqrt(np.diag(covariance))
    cx, cy, cz, radius = (float(v) for v in x)
    dx, dy, dz = (float(v) for v in deviations[:3])
    return BallSolution(
        (cx, cy, cz),
        radius,
        (dx, dy, dz),
        0.0 if assumed else float(deviations[3]),
        assumed,
        tuple(outline for outline, _ in outlines),
    )


def _minimise(
    residuals: Callable[[Array], Array], start: Array, free: NDArray[np.int_], frames: int
) -> tuple[Array, Array]:
    """Return the least-squares solution in some of the unknowns, and the covariance of the free unknowns."""
    x = start.copy()
    normal = np.eye(len(free))
    for _ in range(STEPS):
        e = residuals(x)
        jacobian = np.empty((len(e), len(free)))
        for column, k in enumerate(free):
            step = np.zeros(4)
            step[k] = 1e-6
            jacobian[:, column] = (residuals(x + step) - residuals(x - step)) / 2e-6
        weight = np.minimum(1.0, HUBER / np.maximum(np.abs(e), 1e-9))
        normal = jacobian.T @ (weight[:, None] * jacobian)
        move = -np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(len(free)), jacobian.T @ (weight * e))
        # Far from the solution, the ball is kept in front of the camera and its radius positive.
        move *= min(1.0, 0.02 / max(float(np.abs(move).max()), 1e-12))
        x[free] += move
        x[3] = max(x[3], 1e-3)
        if np.abs(move).max() < 1e-7:
            break
    e = residuals(x)
    spread = max(1.0, float(np.median(np.abs(e))) / 0.6745) ** 2
    # A pseudo-inverse would report unobservable unknowns as certain.
    certain = normal + 1e-12 * np.trace(normal) * np.eye(len(free))
    return x, np.asarray(np.linalg.inv(certain) * spread * frames, float)


def agreeing_outlines(views: Sequence[View], camera: Camera, probe: Probe, ground: float | None = None) -> list[Found]:
    """Return the ball's outlines in frames with known poses; contradicting outlines are searched again.

    Args:
        views: RGB frames with ``camera_from_world``.
        camera: The camera.
        probe: The scene's ball, as the initial value.
        ground: Height in metres of the surface below the ball; None: unknown.

    Returns:
        Outlines with their poses, for frames that show the ball near the scene's position.
    """
    # Frames with an outline, which may not be the ball's.
    shown = [(view, outline) for view in views if (outline := find_outline(view, camera, probe)) is not None]
    first = [(outline, pose) for (_, pose), outline in shown]
    if len(first) < 2 or not _contradicted(first, camera, solve_ball(first, camera, probe, ground)):
        return first
    tried: list[BallSolution] = []
    best, most = first, -np.inf
    for pairs in (first, *([pair] for pair in first)):
        start = solve_ball(pairs, camera, probe, ground)
        if len(tried) == MOST or any(_is_same(start, other) for other in tried):
            continue
        tried.append(start)
        off, ball, found = _contradicted(first, camera, start), Probe(start.center, start.radius), []
        for number, (view, outline) in enumerate(shown):
            again = find_outline(view, camera, ball, AGAIN) if number in off else outline
            if again is not None:
                found.append((again, view))
        if len(found) < 2:
            continue
        pairs = [(outline, pose) for outline, (_, pose) in found]
        out = _contradicted(pairs, camera, solve_ball(pairs, camera, probe, ground))
        kept = [number for number in range(len(found)) if number not in out]
        rim = sum(rim_strength(found[k][1][0], camera, np.array(found[k][0].sphere)) for k in kept)
        if kept and rim > most:
            best, most = [pairs[k] for k in kept], rim
    return best


def _contradicted(outlines: Sequence[Found], camera: Camera, solution: BallSolution) -> set[int]:
    """Return the indices of outlines that contradict a solution."""
    return {k for k, pair in enumerate(outlines) if outline_misfit(pair, camera, solution) > APART}


def _is_same(one: BallSolution, other: BallSolution) -> bool:
    reach = SAME * one.radius
    return abs(one.radius - other.radius) < reach and float(np.abs(np.subtract(one.center, other.center)).max()) < reach
