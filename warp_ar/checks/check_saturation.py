"""What a scene's frames say of the code at which the camera saturates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from warp_ar.calibration.saturation import NEAR_FULL, SaturationLevels, ball_discs
from warp_ar.checks.check_pictures import Look
from warp_ar.checks.finding import Finding
from warp_ar.scene import Scene

LEAST: Final = 220
"""Code below which nothing is said: no camera's range ends there (limited range ends at 235, shoulders above), but
pictures that somebody darkened afterwards do."""
ALIKE: Final = 2.0
"""Codes between the channels' ends: a range or a shoulder is that of all three, a tint that was laid over pictures
afterwards is not. Two must tell; nothing clips in the third, as in blue under warm lamps, or it ends there too."""
LIMITED: Final = (14, 236)
"""Lowest code that is seen at least, and code at which channels end at most, where limited range (16 to 235) may be
taken for the full one: within what a codec does to them."""
FEW: Final = 1e-3
"""Share of a picture's pixels that may lie beyond its lowest code and its highest: noise, a codec's ringing."""


def check_saturation(scene: Scene, look: Look) -> list[Finding]:
    """The finding that the lamps in a mirror ball, or what else clips there, end below the highest code.

    Nothing is found where no ball shows anything that clips.

    Args:
        scene: With its balls where the scene has them.
        look: What its frames show.
    """
    seen = SaturationLevels()
    for image, pose in look.views:
        seen.observe(image, ball_discs(scene.probes, look.camera, pose))
    told = seen.levels[seen.levels < NEAR_FULL]
    if len(told) < 2 or told.min() < LEAST or np.ptp(told) > ALIKE:
        return []
    level = round(float(np.median(told)))
    if max(float((image[::2, ::2] > level + ALIKE).mean()) for image, _ in look.views) > FEW:
        return []
    text = f"what clips in the ball ends at code {level} of 255"
    remedy = "turn the camera's HDR and tone mapping modes off, so that what clips has code 255"
    if _lowest_code(look.images) >= LIMITED[0] and level <= LIMITED[1]:
        text += " and nothing is black: limited range (16 to 235) shown as if it were full"
        remedy = "set the camera, the capture card or the recording to full range (0 to 255)"
    else:
        text += ": a shoulder, tone mapping, or another range than 0 to 255"
    return [Finding("camera.saturation", text, remedy)]


def _lowest_code(images: Sequence[NDArray[np.uint8]]) -> float:
    """The lowest code of all but ``FEW`` of the pixels, by the darkest channel of some pictures."""
    few = images[:: -(-len(images) // 4)]
    return min(float(np.quantile(image[::2, ::2].min(axis=2), FEW)) for image in few)
