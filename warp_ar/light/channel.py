"""Which channel of a picture tells what light is missing.

Emitters are looked for in all channels. Where the card clips, surfaces' reflectances are taken from one, and how far an
estimate can be relied on is asked of one. It is that in which most points show what they receive. A point that clips
says that from one side only, and where many do the card does not tell either, so they count against their channel.
"""

from __future__ import annotations

import numpy as np

from warp_ar.light.problem import Problem


def choose_channel(problem: Problem) -> int:
    """The channel that surfaces show best; green of equals.

    Args:
        problem: The equations.
    """
    points = problem.exact.sum(axis=0) - problem.bound.sum(axis=0)
    return int(np.argmax(points + np.array([0.0, 0.5, 0.0])))


def told_channel(problem: Problem, best: int) -> int:
    """The same among channels in which something is missing.

    Args:
        problem: The equations.
        best: From ``choose_channel``.
    """
    missing = problem.solid_angle @ problem.missing
    lacks = missing > 0.3 * missing.max()
    points = problem.exact.sum(axis=0) - problem.bound.sum(axis=0)
    return max(range(3), key=lambda c: (lacks[c], c == best, points[c], c == 1))
