"""A mirror ball's centre and radius together, from its outlines in frames with known poses.

An outline tells three things: where the ball's centre is seen, and how large the ball looks. Frames from one side leave
a small near ball and a large far one alike; frames from several sides, or a ball known to stand on the table, do not.
The unknowns (c, r) minimise

    sum_i |(m(R_i c + t_i, r) - m_i) / sigma_i|^2 + ((c_z - r - ground) / sigma_ground)^2,
    m(q, r) = (f x/z, f y/z, f r/|q|),

by Gauss-Newton with Huber's weights. What spoils a rim (a band of light inside it, what is behind it) spoils it in
every frame alike, so that frames do not average out: the interval is that of one typical frame, not of their mean.

In about one frame of twenty the finder takes an edge beside the rim for the rim: the table's edge that is mirrored
along it, the edge of something behind the ball. Its interval tells of the edge that was taken, not that it is another
one's, so that with two frames from different sides neither's interval holds. Frames that contradict each other tell
that one is wrong, but not which one. So each outline in turn says where the ball is in the other frames, the outlines
there are looked for again near those places, and the ball stays that shows the most rim over all frames. By two
frames of a path-traced studio the centre is then off by 0.2 mm instead of 8.
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
"""An outline with the pose of its frame."""

STANDS = 0.0005
"""Metres: standard deviation of the height of a ball that stands on a table: the card's thickness, its unevenness."""
LEAST_PIXELS = 0.25
"""Pixels: no outline is better than this in any of its three numbers."""
HUBER = 2.0
"""Standard deviations beyond which an outline has less say."""
STEPS = 30
"""Most Gauss-Newton steps."""
APART = 4.0
"""Standard deviations of an outline beyond which the others contradict it: right ones are off by 3.2 at most."""
AGAIN = 0.12
"""Share of the radius around an outline that others tell in which it is looked for again."""
SAME = 0.05
"""Share of the radius within which two balls are one."""
MOST = 2
"""Balls that are tried: each costs a third of a second and frame."""


@dataclasses.dataclass(frozen=True)
class BallSolution:
    """A mirror ball as its outlines show it."""

    center: tuple[float, float, float]
    """Centre in the marker's frame, metres."""
    radius: float
    """Radius, metres."""
    center_deviation: tuple[float, float, float]
    """Standard deviations of the centre, metres."""
    radius_deviation: float
    """Standard deviation of the radius, metres; 0 where it was assumed."""
    radius_assumed: bool
    """True if the radius is the one that was given: the frames are too alike to tell it."""
    outlines: tuple[BallOutline, ...]
    """The outlines that it rests on."""


def ground_below(probe: Probe, proxies: Sequence[Proxy]) -> float | None:
    """Height in metres of the level plane that a ball is over; None where the scene has none."""
    x, y, _ = probe.center
    levels = []
    for proxy in proxies:
        if proxy.shape == "plane" and abs(proxy.rotate[0]) + abs(proxy.rotate[1]) < 1.0:
            reach = 0.5 * math.hypot(*proxy.size[:2])
            if math.hypot(x - proxy.at[0], y - proxy.at[1]) <= reach:
                levels.append(proxy.at[2])
    return max(levels) if levels else None


def rough_circle(camera: Camera, pose: Pose, probe: Probe) -> tuple[float, float, float] | None:
    """Column, row and radius in pixels of where a scene has its ball; None where that is not before the camera."""
    c = pose.apply(np.array(probe.center))
    if c[2] <= 1.2 * probe.radius:
        return None
    return (
        float(camera.cx + camera.fx * c[0] / c[2]),
        float(camera.cy + camera.fy * c[1] / c[2]),
        float(camera.fx * probe.radius / np.linalg.norm(c)),
    )


def standing_ground(probe: Probe, proxies: Sequence[Proxy]) -> float | None:
    """Return the height in metres of what the ball stands on; None where the scene has it above nothing or afloat."""
    ground = ground_below(probe, proxies)
    return ground if ground is not None and probe.center[2] - probe.radius - ground < 0.3 * probe.radius else None


def find_outline(view: View, camera: Camera, probe: Probe, rough_error: float = ROUGH_ERROR) -> BallOutline | None:
    """The ball's outline in a frame that shows it near where the scene has it.

    Args:
        view: RGB frame with ``camera_from_world``.
        camera: It took the frame.
        probe: The ball as the scene has it, metres.
        rough_error: Share of the radius by which that may be off.

    Returns:
        None where none is found, or it is below 4 pixels.
    """
    circle = rough_circle(camera, view[1], probe)
    if circle is not None and circle[2] >= 4.0:
        with contextlib.suppress(UsageError):
            return find_ball(view[0], camera, circle, rough_error)
    return None


def _measure(camera: Camera, sphere: Array) -> Array:
    """Column and row of the centre from the principal point, and the radius, in pixels, of centre over radius."""
    f = 0.5 * (camera.fx + camera.fy)
    return np.array([f * sphere[0] / sphere[2], f * sphere[1] / sphere[2], f / np.linalg.norm(sphere)])


def outline_misfit(found: Found, camera: Camera, solution: BallSolution) -> float:
    """Standard deviations of an outline, of its worst number, by which it is not where a solution has it."""
    outline, pose = found
    sphere = pose.apply(np.array(solution.center)) / solution.radius
    off = _measure(camera, sphere) - _measure(camera, np.array(outline.sphere))
    return float((np.abs(off) / np.maximum(outline.deviation, LEAST_PIXELS)).max())


def solve_ball(outlines: Sequence[Found], camera: Camera, probe: Probe, ground: float | None = None) -> BallSolution:
    """Centre and radius from outlines.

    Args:
        outlines: Outlines with ``camera_from_world``.
        camera: The camera.
        probe: What the scene says, to start from.
        ground: Height in metres of what the ball stands on; None: it may stand anywhere.

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
    """Least squares in some of the unknowns; returns all of them, and the covariance of the free ones."""
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
        # The ball stays before the camera and keeps a size while far from the solution.
        move *= min(1.0, 0.02 / max(float(np.abs(move).max()), 1e-12))
        x[free] += move
        x[3] = max(x[3], 1e-3)
        if np.abs(move).max() < 1e-7:
            break
    e = residuals(x)
    spread = max(1.0, float(np.median(np.abs(e))) / 0.6745) ** 2
    # Not a pseudo-inverse, which would call certain what the frames do not tell at all.
    certain = normal + 1e-12 * np.trace(normal) * np.eye(len(free))
    return x, np.asarray(np.linalg.inv(certain) * spread * frames, float)


def agreeing_outlines(views: Sequence[View], camera: Camera, probe: Probe, ground: float | None = None) -> list[Found]:
    """The ball's outlines in frames with known poses; those that contradict each other are looked for again.

    Args:
        views: RGB frames with ``camera_from_world``.
        camera: The camera.
        probe: What the scene says, to start from.
        ground: Height in metres of what the ball stands on; None: it may stand anywhere.

    Returns:
        Outlines with their poses, of the frames that show the ball near where the scene has it.
    """
    # Frames in which something is found; whether it is the ball is what is asked.
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
    """Return which of several outlines a solution contradicts."""
    return {k for k, pair in enumerate(outlines) if outline_misfit(pair, camera, solution) > APART}


def _is_same(one: BallSolution, other: BallSolution) -> bool:
    reach = SAME * one.radius
    return abs(one.radius - other.radius) < reach and float(np.abs(np.subtract(one.center, other.center)).max()) < reach
