"""Light that a desk receives over what a given light brings there, by the card: its paper reflects what is known.

Light that a file gives is light as one point sees it, and nobody says how bright a frame is that was taken in it. By
such light the paper of the card (``[marker] white``) reflects too much where the desk has more light than that, and so
does all else that the frame shows: virtual light on it is then too bright, and shadows are too dark. Recovery holds its
own light to the paper; for light that is given, this level does it for the surfaces, whose reflectance is then

    radiance / (level  irradiance),    level = what the paper seems to reflect / what it does,

and leaves the light itself, by which virtual objects are lit, as it was given.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from warp_ar.accuracy.path_tracer import PathTracer
from warp_ar.input.marker_pattern import printed_cells

SHOWN = (0.01, 0.95)
"""Radiance between which a pixel tells reflectance, in camera values."""
WITHIN = 0.5
"""Width of the part of a white cell that is looked at, over the cell's: its rim is blurred with what is beside it."""
SIDE = 5
"""Points along it."""
LEAST_POINTS = 12
"""Pixels that must show paper."""
MOST = 1.5
"""Level, and its inverse, beyond which it is rather a light, or a card, of another scene."""


def card_level(tracer: PathTracer) -> tuple[float, float, float] | None:
    """What the card's paper seems to reflect, per channel, over what the scene says that it does.

    Args:
        tracer: Of the frame, in the light that is given, with a level of 1.

    Returns:
        None where the card is not seen well enough, or the paper would be another by more than half.

    Raises:
        UsageError: The path tracer has no frame.
    """
    pixels = _paper(tracer)
    frame, reflectance, shown = tracer.frame(), tracer.reflectance(), tracer.shown()
    rows, columns = pixels.T
    values, radiance = reflectance[rows, columns], frame[rows, columns]
    told = (shown[rows, columns] >= 0) & (radiance.min(axis=1) > SHOWN[0]) & (radiance.max(axis=1) < SHOWN[1])
    if np.count_nonzero(told) < LEAST_POINTS:
        return None
    level = np.median(values[told], axis=0) / tracer.scene.marker.white
    if not (level.max() <= MOST and level.min() >= 1.0 / MOST):
        return None
    red, green, blue = map(float, level)
    return red, green, blue


def _paper(tracer: PathTracer) -> npt.NDArray[np.intp]:
    """Pixels that lie well within white cells of the card, (n, 2) row and column."""
    cells, white, side, _ = printed_cells(tracer.scene.marker)
    step = np.linspace(-0.5, 0.5, SIDE) * WITHIN * side
    x, y = np.meshgrid(step, step)
    offsets = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], -1)
    points = (cells[white][:, None] + offsets).reshape(-1, 3)
    at = tracer.pixels_of(points)
    height, width = tracer.camera.height, tracer.camera.width
    inside = (at >= 0).all(axis=1) & (at[:, 0] < height) & (at[:, 1] < width)
    return np.unique(at[inside], axis=0)
