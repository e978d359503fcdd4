"""A mirror ball's outlines in several frames that agree with each other.

In about one frame of twenty the finder takes an edge beside the rim for the rim: the table's edge that is mirrored
along it, the edge of something behind the ball. Its interval tells of the edge that was taken, not that it is another
one's, so that with two frames from different sides neither's interval holds. Frames that contradict each other tell
that one is wrong, but not which one. So each outline in turn says where the ball is in the other frames, the outlines
there are looked for again near those places, and the ball stays that shows the most rim over all frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from warp_ar.ball.ball_finder import BallOutline, find_ball, outline_strength
from warp_ar.ball.ball_solve import BallSolution, find_outlines, outline_misfit, rough_circle, solve_ball
from warp_ar.errors import UsageError
from warp_ar.scene import Camera, Pose, Probe

Image = NDArray[np.uint8]
View = tuple[Image, Pose]
Found = list[tuple[BallOutline, Pose]]

APART: Final = 4.0
"""Standard deviations of an outline beyond which the others contradict it: right ones are off by 3.2 at most."""
AGAIN: Final = 0.12
"""Share of the radius around an outline that others tell in which it is looked for again."""
SAME: Final = 0.05
"""Share of the radius within which two balls are one."""
MOST: Final = 2
"""Balls that are tried: each costs a third of a second and frame."""


def agreeing_outlines(views: Sequence[View], camera: Camera, probe: Probe, ground: float | None = None) -> Found:
    """The ball's outlines in frames with known poses; those that contradict each other are looked for again.

    Args:
        views: RGB frames with ``camera_from_world``.
        camera: The camera.
        probe: What the scene says, to start from.
        ground: Height in metres of what the ball stands on; None: it may stand anywhere.

    Returns:
        Outlines with their poses, of the frames that show the ball near where the scene has it.
    """
    seen = [(view, pair[0]) for view in views if (pair := find_outlines([view], camera, probe))]
    first = [pair for _, pair in seen]
    if len(first) < 2 or not _apart(first, camera, solve_ball(first, camera, probe, ground)):
        return first
    # Views in which something was found; whether it was the ball is what is asked.
    shown = [view for view, _ in seen]
    tried: list[BallSolution] = []
    best, most = first, -np.inf
    for pairs in (first, *([pair] for pair in first)):
        start = solve_ball(pairs, camera, probe, ground)
        if len(tried) == MOST or any(_same(start, other) for other in tried):
            continue
        tried.append(start)
        found = _look_again(shown, first, camera, start)
        if len(found) < 2:
            continue
        together = solve_ball(found, camera, probe, ground)
        out = _apart(found, camera, together)
        kept = [pair for k, pair in enumerate(found) if k not in out]
        images = {id(pose): image for image, pose in shown}
        rim = sum(outline_strength(images[id(pose)], camera, outline) for outline, pose in kept)
        if kept and rim > most:
            best, most = kept, rim
    return best


def _apart(outlines: Found, camera: Camera, solution: BallSolution) -> set[int]:
    """Which outlines a solution contradicts."""
    return {k for k, pair in enumerate(outlines) if outline_misfit(pair, camera, solution) > APART}


def _same(one: BallSolution, other: BallSolution) -> bool:
    reach = SAME * one.radius
    return abs(one.radius - other.radius) < reach and float(np.abs(np.subtract(one.center, other.center)).max()) < reach


def _look_again(views: Sequence[View], first: Found, camera: Camera, solution: BallSolution) -> Found:
    """Outlines near where a solution has them: those that were found there, else what a second look finds."""
    ball = Probe(solution.center, solution.radius)
    again = []
    for (image, pose), pair in zip(views, first, strict=True):
        if outline_misfit(pair, camera, solution) <= APART:
            again.append(pair)
            continue
        circle = rough_circle(camera, pose, ball)
        try:
            if circle is not None and circle[2] >= 4.0:
                again.append((find_ball(image, camera, circle, AGAIN), pose))
        except UsageError:
            continue
    return again
