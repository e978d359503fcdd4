"""Centre and radius of a mirror ball with reliable error intervals: first by outlines, then by the mirror image.

The mirror image of the receiver gives the centre to a fraction of a millimetre, but only for the assumed radius. A
radius error of 1 mm moves that centre by ``SLOPE`` millimetres, mostly along the line of sight, and its own interval
does not include this. Therefore the radius comes from the outlines, and its uncertainty is added to the centre's
interval.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from warp_ar.ball.ball import DEVIATION, fit_ball, mirrored_radius
from warp_ar.ball.ball_solve import BallSolution, agreeing_outlines, solve_ball, standing_ground
from warp_ar.ball.ground_seen import ground_is_seen
from warp_ar.errors import UsageError
from warp_ar.scene import Camera, Pose, Probe, Proxy

Image = NDArray[np.uint8]

SLOPE = 1.8
"""Displacement of the centre, in metres, per metre of radius error."""
OUTLINES = 6
"""Number of frames in which outlines are searched; each takes half a second."""
SEARCH = 5e-3
"""Radius in metres around the outlines' centre in which the mirror image is compared."""
ASSUMED = 0.01
"""Relative error of an assumed radius: that of a ruler."""
MOST = 0.1
"""Largest interval of the radius, relative to it, for a usable ball; the centre's may be twice as large."""
DOUBT = 0.025
"""Relative difference of radii from the given one above which the mirror image is examined as well."""
STRAY = 1.0 / 3.0
"""Relative difference from the given radius above which an outline is another circle, such as a ring on the card."""


@dataclasses.dataclass(frozen=True)
class BallMeasurement:
    """Measured mirror ball; metres, in the marker's frame."""

    center: tuple[float, float, float]
    """Centre, (x, y, z)."""
    deviation: float
    """Standard deviation of the centre along its least certain axis."""
    radius: float
    """Radius."""
    radius_deviation: float | None
    """Standard deviation of the radius; None if the radius was assumed."""
    how: str
    """Source of the numbers, as a description."""

    @property
    def is_usable(self) -> bool:
        """Return True if radius and centre are certain enough to be written into a scene."""
        return max(2 * (self.radius_deviation or 0.0), self.deviation) <= MOST * self.radius


def measure_ball(
    views: Sequence[tuple[Image, Pose]],
    camera: Camera,
    probe: Probe,
    proxies: Sequence[Proxy] = (),
    others: Sequence[Probe] = (),
    *,
    keep_radius: bool = False,
    tell: Callable[[str], None] = lambda words: None,
) -> BallMeasurement:
    """Measure centre and radius of a mirror ball.

    Args:
        views: RGB frames with ``camera_from_world``.
        camera: The camera.
        probe: The ball; its centre is accurate to its radius, its radius to a fifth.
        proxies: Proxies of the scene.
        others: Other balls.
        keep_radius: True to keep the probe's radius.
        tell: Function that receives a description of each step; all steps take some seconds.

    Raises:
        UsageError: Too few frames show the ball, or they show the surface below it instead.
    """
    few = views[:: -(-len(views) // OUTLINES)]
    ground = standing_ground(probe, proxies)
    is_bare = ground is not None and ground_is_seen(few, camera, probe, ground)
    tell("the ball's outlines")
    outlines = [] if is_bare else agreeing_outlines(few, camera, probe, ground)
    if not outlines:
        raise UsageError(
            f"no mirror ball is seen where [probe] center = {[round(x, 4) for x in probe.center]} has it; stand it on "
            "the card's cross, have all of it in the picture, and check [probe]"
        )
    solution = solve_ball(outlines, camera, probe, ground)
    if abs(solution.radius - probe.radius) > STRAY * probe.radius:
        raise UsageError(
            f"the round outline at the ball's place has a radius of {solution.radius:.3f} m, but [probe] radius = "
            f"{probe.radius:g}: it is a ring on the card, or the radius is wrong; stand the ball on the cross, and "
            "measure it"
        )
    assumed = keep_radius or solution.radius_assumed
    radius = probe.radius if assumed else solution.radius
    deviation = ASSUMED * radius if assumed else solution.radius_deviation
    own, how = max(solution.center_deviation), f"by {len(outlines)} outlines"
    if not assumed and ground is not None and _is_doubtful(solution, probe, len(few)):
        tell("the ball's radius, from its reflections")
        mirrored = mirrored_radius(few, camera, probe, proxies, others)
        if mirrored is not None and _contradicts(solution, mirrored):
            radius, deviation = mirrored.radius, DEVIATION * mirrored.radius
            own = SLOPE * deviation
            solution = dataclasses.replace(solution, center=mirrored.center)
            how = "by the desk in it"
    tell("the ball's place, from its reflections")
    told = None if assumed else deviation
    by_outlines = BallMeasurement(solution.center, own, radius, told, how)
    found = dataclasses.replace(probe, center=solution.center, radius=radius)
    better = fit_ball(few, camera, found, proxies, others, search=SEARCH)
    if better is None or not better.is_good:
        return by_outlines
    spread = math.hypot(better.deviation, SLOPE * deviation)
    x, y, z = (float(value) for value in better.center)
    # Both agree within their intervals, or the mirror image was matched to another part of the receiver.
    apart = math.dist((x, y, z), by_outlines.center)
    if apart < 3 * math.hypot(spread, own) and spread < own:
        return dataclasses.replace(by_outlines, center=(x, y, z), deviation=spread, how="by the desk in it")
    return by_outlines


def _is_doubtful(solution: BallSolution, probe: Probe, frames: int) -> bool:
    """Return True if outlines need a second opinion: some are missing, or the ball differs from the given one."""
    allowed = DOUBT * probe.radius
    moved = max(abs(a - b) for a, b in zip(solution.center[:2], probe.center[:2], strict=True))
    return len(solution.outlines) < frames or abs(solution.radius - probe.radius) > allowed or moved > 2 * allowed


def _contradicts(solution: BallSolution, mirrored: Probe) -> bool:
    """Return True if the ball by the mirror image contradicts the outlines' ball, or is more certain."""
    off = DEVIATION * mirrored.radius
    if solution.radius_deviation > 1.5 * off:
        return True
    if abs(solution.radius - mirrored.radius) > 2 * math.hypot(solution.radius_deviation, off):
        return True
    reach = 3 * math.hypot(max(solution.center_deviation), SLOPE * off)
    return math.dist(solution.center, mirrored.center) > reach
