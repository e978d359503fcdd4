"""Weights of several mirror balls in the light at a point between them.

Gradient bands [Johansen09, section 6.3]. On the line from the centre c_i of ball i to that of another ball, j, the
point x has the coordinate

    t_ij = clamp((x - c_i).(c_j - c_i) / |c_j - c_i|^2, 0, 1),

0 at i and behind it, 1 at j and beyond it. With a trust T of every ball in 0..1 the weights are

    w_i ~ T_i min over j of (1 - T_j t_ij),    sum w_i = 1.

Between two balls of equal trust the light is interpolated linearly along the line from one to the other; beyond either
ball it is that ball's alone. At a ball's centre the weights of all others are zero, for any number of balls, if its
trust is 1. Weights are continuous in positions and trusts: a ball whose trust falls to zero has no influence on the
others. The sum of weights does not vanish if some T is 1: the nearest of those balls has all t <= 1/2.

Trust follows the share of a ball's directions that the frame shows, over ``ENOUGH``, smoothed by ``TRUST_TIME``. Only
ratios matter, so trusts are scaled to a maximum of 1; while no ball is seen they do not change. A ball that is no
longer seen keeps its last position and its accumulated environment.

References:
    [Johansen09] Johansen 2009, Automated Semi-Procedural Animation for Character Locomotion, master's thesis, Aarhus.
"""

from __future__ import annotations

import warp as wp

from warp_ar.kernels.environment.unwrap import RIM_START
from warp_ar.kernels.launch import launch
from warp_ar.kernels.structs import FrameParams, Probe

wp.set_module_options({"enable_backward": False})

TRUST_TIME = wp.constant(wp.float32(0.4))
"""Time constant, seconds, with which trust follows a ball's visibility."""
ENOUGH = wp.constant(wp.float32(0.5))
"""Share of measured texels in a ball's map from which the ball is trusted fully."""
SEEN_AT_ALL = wp.constant(wp.float32(0.02))
"""Least share of a ball's map that the frame must show for the ball's position to be updated."""


@wp.func
def probe_weight(places: wp.array[wp.vec4], ball: wp.int32, point: wp.vec3) -> wp.float32:
    """Return the weight of a ball at a point, not normalised.

    Args:
        places: (P,) centre of each ball, and its trust.
        ball: Index of the ball.
        point: Lit point, world.
    """
    place = places[ball]
    center = wp.vec3(place[0], place[1], place[2])
    least = float(1.0)
    for index in range(places.shape[0]):
        other = places[index]
        across = wp.vec3(other[0], other[1], other[2]) - center
        squared = wp.dot(across, across)
        if squared > 0.0:  # else it is the ball itself, or one at the same position
            t = wp.clamp(wp.dot(point - center, across) / squared, 0.0, 1.0)
            least = wp.min(least, 1.0 - other[3] * t)
    return place[3] * least


@wp.func
def probe_share(places: wp.array[wp.vec4], ball: wp.int32, point: wp.vec3) -> wp.float32:
    """Return the normalised weight of a ball at a point; if no ball was ever seen, the first has the weight 1."""
    total = float(0.0)
    for index in range(places.shape[0]):
        total += probe_weight(places, index, point)
    if total <= 0.0:
        return wp.where(ball == 0, 1.0, 0.0)
    return probe_weight(places, ball, point) / total


@wp.kernel(enable_backward=False)
def measure_seen_kernel(
    # In:
    corners: wp.array3d[wp.vec3],
    size: wp.vec2i,
    # Out:
    seen_out: wp.array2d[wp.float32],
):
    """Measure the share of the texel corners in one row of a ball's map whose light the frame shows."""
    ball, row = wp.tid()
    count = wp.float32(0.0)
    for column in range(corners.shape[1]):
        corner = corners[row, column, ball]
        inside = corner[0] >= 0.0 and corner[0] <= wp.float32(size[0] - 1)
        if inside and corner[1] >= 0.0 and corner[1] <= wp.float32(size[1] - 1) and corner[2] > RIM_START:
            count += 1.0
    seen_out[ball, row] = count / wp.float32(corners.shape[1])


@wp.kernel(enable_backward=False)
def update_places_kernel(
    # In:
    seen: wp.array2d[wp.float32],
    probes: wp.array[Probe],
    params: wp.array[FrameParams],
    # In and out:
    places_out: wp.array[wp.vec4],
):
    """Update position and trust of all balls in one thread: trusts are divided by the greatest of all."""
    blend = 1.0 - wp.exp(-wp.max(params[0].time_step, 0.0) / TRUST_TIME)
    known = float(0.0)
    for ball in range(places_out.shape[0]):
        known = wp.max(known, places_out[ball][3])
    fresh = params[0].environment_reset != 0 or known == 0.0
    most = float(0.0)
    for ball in range(places_out.shape[0]):
        share = float(0.0)
        for row in range(seen.shape[1]):
            share += seen[ball, row] / wp.float32(seen.shape[1])
        place = places_out[ball]
        center = wp.vec3(place[0], place[1], place[2])
        if fresh or share > SEEN_AT_ALL:
            center = probes[ball].center
        trust = wp.min(share / ENOUGH, 1.0)
        if not fresh:
            trust = place[3] + blend * (trust - place[3])
        most = wp.max(most, trust)
        places_out[ball] = wp.vec4(center[0], center[1], center[2], trust)
    if most > 0.0:
        for ball in range(places_out.shape[0]):
            place = places_out[ball]
            places_out[ball] = wp.vec4(place[0], place[1], place[2], place[3] / most)


def measure_seen(corners: wp.array, size: tuple[int, int], seen_out: wp.array) -> None:
    """Measure the share of every ball's map that the frame shows, row by row.

    Args:
        corners: From ``unwrap.project_corners``, (h + 1, w + 1, P).
        size: Width and height of the frame in pixels.
        seen_out: (P, h + 1) shares, 0..1.
    """
    launch(measure_seen_kernel, seen_out.shape, [corners, size], [seen_out])


def update_places(seen: wp.array, probes: wp.array, params: wp.array, places_out: wp.array) -> None:
    """Move every ball's trust toward its visible share; positions and trusts are updated in place, from zero.

    Args:
        seen: From ``measure_seen``, (P, h + 1).
        probes: ``Probe`` (P).
        params: ``FrameParams`` (1): ``time_step`` and ``environment_reset``.
        places_out: (P,) ``wp.vec4``: last known position of each ball, metres, and its trust; the greatest is 1.
    """
    launch(update_places_kernel, 1, [seen, probes, params], [places_out])
