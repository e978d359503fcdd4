"""A mirror ball's centre and radius with intervals that hold: its outlines first, then the receiver that it mirrors.

The mirrored receiver gives the centre within a fraction of a millimetre, but only for the radius that is assumed: a
radius 1 mm wrong moves that centre by ``SLOPE`` millimetres, mostly along the line of sight, and its own interval does
not tell. So the radius comes from the outlines, and what is uncertain of it is added to the centre's interval.
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
"""Metres that the centre moves for each metre that the radius is wrong."""
OUTLINES = 6
"""Frames whose outlines are looked for: each takes half a second."""
SEARCH = 5e-3
"""Metres around the outlines' centre in which the mirrored receiver is compared."""
ASSUMED = 0.01
"""Share of a radius that is only assumed by which it may be off: a ruler's error."""
MOST = 0.1
"""Share of the radius that its interval may have, and half of what the centre's may, for a ball to be used."""
DOUBT = 0.025
"""Share of the radius by which outlines may differ from what was typed before the mirrored receiver is asked."""
STRAY = 1.0 / 3.0
"""Share of the given radius beyond which outlines are not those that were looked for, but of rings on the card."""


@dataclasses.dataclass(frozen=True)
class BallMeasurement:
    """A measured mirror ball; metres, in the marker's frame."""

    center: tuple[float, float, float]
    """Centre."""
    deviation: float
    """Standard deviation of the centre along its worst axis."""
    radius: float
    """Radius."""
    radius_deviation: float | None
    """Its standard deviation; None: it was assumed."""
    how: str
    """Source of the numbers, in words."""

    @property
    def is_usable(self) -> bool:
        """Return whether radius and centre are known well enough to be put into a scene."""
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
    """Centre and radius of a mirror ball.

    Args:
        views: RGB frames with ``camera_from_world``.
        camera: The camera.
        probe: The ball; its centre within its radius, its radius within a fifth.
        proxies: What stands on the receiver.
        others: Other balls.
        keep_radius: Believe the probe's radius.
        tell: Takes what is being looked at, in words, whenever that changes: all of it takes some seconds.

    Raises:
        UsageError: The ball is in too few frames, or they show what it should stand on instead.
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
            f"what is round where the ball should be has a radius of {solution.radius:.3f} m, but [probe] radius = "
            f"{probe.radius:g}: a ring on the card, or a wrong radius; stand the ball on the cross, and measure it"
        )
    assumed = keep_radius or solution.radius_assumed
    radius = probe.radius if assumed else solution.radius
    deviation = ASSUMED * radius if assumed else solution.radius_deviation
    own, how = max(solution.center_deviation), f"by {len(outlines)} outlines"
    if not assumed and ground is not None and _is_doubtful(solution, probe, len(few)):
        tell("its radius, by what it mirrors")
        mirrored = mirrored_radius(few, camera, probe, proxies, others)
        if mirrored is not None and _contradicts(solution, mirrored):
            radius, deviation = mirrored.radius, DEVIATION * mirrored.radius
            own = SLOPE * deviation
            solution = dataclasses.replace(solution, center=mirrored.center)
            how = "by the desk in it"
    tell("its place, by what it mirrors")
    told = None if assumed else deviation
    by_outlines = BallMeasurement(solution.center, own, radius, told, how)
    found = dataclasses.replace(probe, center=solution.center, radius=radius)
    better = fit_ball(few, camera, found, proxies, others, search=SEARCH)
    if better is None or not better.is_good:
        return by_outlines
    spread = math.hypot(better.deviation, SLOPE * deviation)
    x, y, z = (float(value) for value in better.center)
    # Both are right within their intervals, or the mirrored receiver has been confused with another part of it.
    apart = math.dist((x, y, z), by_outlines.center)
    if apart < 3 * math.hypot(spread, own) and spread < own:
        return dataclasses.replace(by_outlines, center=(x, y, z), deviation=spread, how="by the desk in it")
    return by_outlines


def _is_doubtful(solution: BallSolution, probe: Probe, frames: int) -> bool:
    """Return whether outlines need a second opinion: some are missing, or the ball is not what was given."""
    allowed = DOUBT * probe.radius
    moved = max(abs(a - b) for a, b in zip(solution.center[:2], probe.center[:2], strict=True))
    return len(solution.outlines) < frames or abs(solution.radius - probe.radius) > allowed or moved > 2 * allowed


def _contradicts(solution: BallSolution, mirrored: Probe) -> bool:
    """Return whether a ball that explains what is mirrored cannot be the one of the outlines, or is better known."""
    off = DEVIATION * mirrored.radius
    if solution.radius_deviation > 1.5 * off:
        return True
    if abs(solution.radius - mirrored.radius) > 2 * math.hypot(solution.radius_deviation, off):
        return True
    reach = 3 * math.hypot(max(solution.center_deviation), SLOPE * off)
    return math.dist(solution.center, mirrored.center) > reach
