"""Colour spaces of exported light: this program's own, Rec. 709's primaries, and ACEScg."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from warp_ar.errors import UsageError
from warp_ar.light.captured import latlong_directions, texel_solid_angles
from warp_ar.signals import REC_709, Chromaticities, converted

Radiance = npt.NDArray[np.float32]

COLOR_SPACES: Final[dict[str, Chromaticities]] = {
    "rec709": REC_709,
    "acescg": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767),
}
"""Chromaticities of red, green, blue and white, x and y each; ACEScg's are AP1 (ACES S-2014-004)."""


def convert_light(radiance: Radiance, source: str, target: str) -> Radiance:
    """Return linear light, (height, width, 3), in another colour space of ``COLOR_SPACES``, its white adapted.

    Raises:
        UsageError: There is no such space.
    """
    for name in (source, target):
        if name not in COLOR_SPACES:
            raise UsageError(f"color space {name!r}: expected {', '.join(COLOR_SPACES)}")
    return radiance if source == target else converted(radiance, COLOR_SPACES[source], COLOR_SPACES[target])


def grey_card_scale(radiance: Radiance) -> float:
    """Factor on an environment under which a grey card that lies on the marker has a luminance of 0.18.

    The card is Lambertian: its radiance is 0.18 E / pi, with the irradiance E of a surface that faces up.

    Args:
        radiance: Latlong (height, 2 height, 3), z-up.

    Raises:
        UsageError: Nothing comes from above.
    """
    height = len(radiance)
    cos_theta = np.clip(latlong_directions(height)[..., 2], 0.0, None) * texel_solid_angles(height)
    luminance = radiance.astype(np.float64) @ np.array([0.2126, 0.7152, 0.0722])
    irradiance = float((luminance * cos_theta).sum())
    if not irradiance > 0.0 or not math.isfinite(irradiance):
        raise UsageError(f"--grey-card: the light from above is {irradiance:g}; there is nothing to scale by")
    return math.pi / irradiance
