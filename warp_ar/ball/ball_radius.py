"""A mirror ball's radius by what it mirrors of the receiver, where outlines are in doubt.

On the white card a ball's rim is a faint edge, for what a mirror reflects there is what lies behind it; from above, the
edge of the card's mirror image inside the rim is stronger, in every frame alike, and so are the rings printed
around the cross. Outlines then agree on a ball that is not there. The mirrored receiver knows better: of the right
radius it explains twice as much as of one a tenth smaller, wherever that ball is put.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from warp_ar.ball.ball import mirrored_error, prepare_views
from warp_ar.scene import Camera, Pose, Probe, Proxy

Image = NDArray[np.uint8]
View = tuple[Image, Pose]

SPAN: Final = 0.14
"""Share of the given radius by which it may be off."""
STEP: Final = 0.02
"""Share of it between radii that are tried."""
ASIDE: Final = 3
"""Steps from the best radius at which its cost is compared with others'."""
DISTINCT: Final = 0.9
"""The least cost over those ``ASIDE``, below which the radius is told: 0.6 to 0.87 on rendered desks."""
EXPLAINED: Final = 0.42
"""Mean cost up to which a ball explains what is mirrored: 0.2 to 0.39 on rendered desks, else 0.5 and more."""
HOPELESS: Final = 0.6
"""Mean cost of a few radii beyond which no other explains the frames: 0.25 to 0.45 on rendered desks up to six steps
beside the right one, 0.7 and more without a ball."""
VIEWS: Final = 3
"""Frames that are compared: each costs a second."""
DEVIATION: Final = 0.01
"""Share of the radius: standard deviation of what is found; on rendered desks it is off by 0.003, at most by 0.012."""
BETTER: Final = 0.9
"""What is given explains the frames at less than so much of another ball's cost, or it does not explain them better."""


def mirrored_radius(
    views: Sequence[View], camera: Camera, probe: Probe, proxies: Sequence[Proxy], others: Sequence[Probe] = ()
) -> Probe | None:
    """The ball with the radius, and the centre, that explain best what it mirrors; None where that does not tell.

    Args:
        views: RGB frames with ``camera_from_world``.
        camera: The camera.
        probe: The ball as it is given: it stands, its radius is within ``SPAN``, its centre within millimetres.
        proxies: What stands on the receiver.
        others: Other balls.
    """
    few = prepare_views(views[:: -(-len(views) // VIEWS)], camera)
    steps = round(SPAN / STEP)
    costs: dict[int, float] = {}
    balls: dict[int, Probe] = {}

    def attempt(k: int, place: tuple[float, float, float]) -> None:
        """Try a radius from a place, and still on the ground."""
        radius = probe.radius * (1.0 + STEP * k)
        start = (place[0], place[1], probe.center[2] + radius - probe.radius)
        ball = dataclasses.replace(probe, center=start, radius=radius)
        found = mirrored_error(few, ball, proxies, others)
        if found is not None and found[0] < costs.get(k, math.inf):
            x, y, z = (float(value) for value in found[1])
            costs[k], balls[k] = found[0], dataclasses.replace(ball, center=(x, y, z))

    # One of the first few is within four steps of the right radius, and explains more than nothing.
    first = [k for k in range(-steps, steps + 1) if k % 4 == 3 and abs(k) < steps]
    for k in first:
        attempt(k, probe.center)
    if not costs or min(costs.values()) > HOPELESS:
        return None
    for k in range(-steps, steps + 1, 2):
        if k not in first:
            attempt(k, probe.center)
    # From the best one outward, each from its neighbour's place.
    best = min(costs, key=lambda k: costs[k])
    for way in (1, -1):
        for k in range(best + way, best + (ASIDE + 2) * way, way):
            if k - way in balls:
                attempt(k, balls[k - way].center)
    best = min(costs, key=lambda k: costs[k])
    near = [k for k in costs if abs(k - best) <= 2]
    aside = [costs[k] for k in costs if abs(k - best) == ASIDE]
    if len(near) < 5 or len(aside) < 2 or costs[best] > EXPLAINED or costs[best] > DISTINCT * min(aside):
        return None
    bend, slope, _ = np.polyfit(near, [costs[k] for k in near], 2)
    part = float(np.clip(-0.5 * slope / bend, best - 1.0, best + 1.0)) - best if bend > 0.0 else 0.0
    radius = probe.radius * (1.0 + STEP * (best + part))
    px, py, pz = balls[best].center
    return dataclasses.replace(probe, center=(px, py, pz + radius - balls[best].radius), radius=float(radius))


def explains_better(
    views: Sequence[View],
    camera: Camera,
    probe: Probe,
    other: Probe,
    proxies: Sequence[Proxy],
    others: Sequence[Probe] = (),
) -> bool:
    """Whether a ball explains what is mirrored, and much better than another one does."""
    few = prepare_views(views[:: -(-len(views) // VIEWS)], camera)
    found = [mirrored_error(few, ball, proxies, others) for ball in (probe, other)]
    if found[0] is None or found[0][0] > EXPLAINED:
        return False
    return found[1] is None or found[0][0] < BETTER * found[1][0]
