"""Colour spaces of exported light: this program's own, Rec. 709's primaries, and ACEScg by OpenColorIO.

OpenColorIO's built-in configuration of the ACES project for computer graphics has both, and adapts the white of one to
that of the other. It comes with the extra ``color``.
"""

from __future__ import annotations

import functools
import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from warp_ar.errors import UsageError
from warp_ar.light.captured import latlong_directions, texel_solid_angles
from warp_ar.signals import REC_709, Chromaticities

Radiance = npt.NDArray[np.float32]

COLOR_SPACES: Final[dict[str, Chromaticities]] = {
    "rec709": REC_709,
    "acescg": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767),
}
"""Chromaticities of red, green, blue and white, x and y each; ACEScg's are AP1 (ACES S-2014-004)."""

_CONFIG = "ocio://cg-config-latest"
_NAMES = {"rec709": "Linear Rec.709 (sRGB)", "acescg": "ACEScg"}


def convert_light(radiance: Radiance, source: str, target: str) -> Radiance:
    """Linear light, (height, width, 3), in another colour space of ``COLOR_SPACES``.

    Raises:
        UsageError: There is no such space, or OpenColorIO is not installed.
    """
    for name in (source, target):
        if name not in COLOR_SPACES:
            raise UsageError(f"color space {name!r}: expected {', '.join(COLOR_SPACES)}")
    if source == target:
        return radiance
    picture = np.array(radiance, np.float32, order="C")
    height, width = picture.shape[:2]
    ocio = _load()
    _processor(source, target).apply(ocio.PackedImageDesc(picture, width, height, 3))
    return picture


@functools.cache
def _processor(source: str, target: str) -> Any:
    config = _load().Config.CreateFromFile(_CONFIG)
    return config.getProcessor(_NAMES[source], _NAMES[target]).getDefaultCPUProcessor()


def _load() -> Any:
    try:
        import PyOpenColorIO
    except ImportError as error:
        raise UsageError('ACEScg needs OpenColorIO; install it with pip install "warp-ar[color]"') from error
    return PyOpenColorIO


def find_color_space(chromaticities: Any) -> str:
    """Name of the space that a file's chromaticities are of; ``rec709`` where they are of none here, or not told."""
    if chromaticities is not None:
        for name, known in COLOR_SPACES.items():
            if np.allclose(np.asarray(chromaticities, float), known, atol=1e-3):
                return name
    return "rec709"


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
