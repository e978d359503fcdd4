"""Transfer functions of HDR video signals, and colour primaries.

All functions are closed forms in float64. Light is relative to reference white, which is 1: the signal level of diffuse
white in graded HDR programmes. For HLG, reference white is 75 % of the signal, converted to scene light by the inverse
OETF. PQ states the light of a display; its reference white is 203 cd/m².

References:
    ITU-R BT.2100-2, tables 4 (PQ) and 5 (HLG). ITU-R BT.2408-7, table 1 (reference white). ITU-R BT.709-6, BT.2020-2,
    SMPTE EG 432-1, ST 2065-1, ACES S-2014-004 (primaries); SMPTE RP 177 (matrices of primaries).
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Chromaticities = tuple[float, float, float, float, float, float, float, float]

REC_709: Final[Chromaticities] = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""Chromaticities x and y of red, green, blue and white."""
REC_2020: Final[Chromaticities] = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
ADOBE_RGB: Final[Chromaticities] = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290)
AP0: Final[Chromaticities] = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770, 0.32168, 0.33767)
AP1: Final[Chromaticities] = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
P3_D65: Final[Chromaticities] = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)

PQ_PEAK: Final = 10000.0
"""Luminance of the largest PQ signal, cd/m²."""
PQ_WHITE: Final = 203.0
"""Luminance of reference white, cd/m²."""
HLG_WHITE_SIGNAL: Final = 0.75
"""Signal of reference white in HLG."""

_M1, _M2 = 2610.0 / 16384.0, 2523.0 / 4096.0 * 128.0
_C1, _C2, _C3 = 3424.0 / 4096.0, 2413.0 / 4096.0 * 32.0, 2392.0 / 4096.0 * 32.0
_A, _B, _C = 0.17883277, 0.28466892, 0.55991073


def light_of_pq(signal: npt.ArrayLike) -> Array:
    """Return the light of a PQ signal from 0 to 1, relative to reference white (BT.2100's EOTF over 203 cd/m²)."""
    root = np.clip(np.asarray(signal, np.float64), 0.0, 1.0) ** (1.0 / _M2)
    share = np.maximum(root - _C1, 0.0) / (_C2 - _C3 * root)
    return np.asarray(PQ_PEAK / PQ_WHITE * share ** (1.0 / _M1))


def pq_of_light(light: npt.ArrayLike) -> Array:
    """Return the PQ signal of light relative to reference white; the inverse of `light_of_pq`."""
    power = np.clip(np.asarray(light, np.float64) * (PQ_WHITE / PQ_PEAK), 0.0, 1.0) ** _M1
    return np.asarray(((_C1 + _C2 * power) / (1.0 + _C3 * power)) ** _M2)


def _scene_of_hlg(signal: npt.ArrayLike) -> Array:
    """Return the scene light, 0 to 1, of an HLG signal from 0 to 1: the inverse of BT.2100's OETF."""
    s = np.clip(np.asarray(signal, np.float64), 0.0, 1.0)
    return np.where(s <= 0.5, s * s / 3.0, (np.exp((np.maximum(s, 0.5) - _C) / _A) + _B) / 12.0)


HLG_WHITE: Final = float(_scene_of_hlg(HLG_WHITE_SIGNAL))
"""Scene light of HLG's reference white, relative to that of the largest signal: 0.265."""


def light_of_hlg(signal: npt.ArrayLike) -> Array:
    """Return the scene light of an HLG signal from 0 to 1, relative to reference white."""
    return _scene_of_hlg(signal) / HLG_WHITE


def hlg_of_light(light: npt.ArrayLike) -> Array:
    """Return the HLG signal of scene light relative to reference white; the inverse of `light_of_hlg`."""
    e = np.clip(np.asarray(light, np.float64) * HLG_WHITE, 0.0, 1.0)
    above = _A * np.log(np.maximum(12.0 * e - _B, 1e-12)) + _C
    return np.where(e <= 1.0 / 12.0, np.sqrt(3.0 * e), above)


def xyz_from_rgb(chromaticities: Chromaticities) -> Array:
    """Return the matrix from linear RGB to CIE XYZ in which white has Y = 1 (RP 177)."""
    x, y = np.asarray(chromaticities, np.float64).reshape(4, 2).T
    xyz = np.stack([x / y, np.ones(4), (1.0 - x - y) / y])
    return np.asarray(xyz[:, :3] * np.linalg.solve(xyz[:, :3], xyz[:, 3]))


def are_primaries(chromaticities: Chromaticities) -> bool:
    """Return True if the chromaticities of red, green, blue and white span a colour space."""
    xy = np.asarray(chromaticities, np.float64).reshape(4, 2)
    if not np.isfinite(xy).all() or (np.abs(xy) > 10.0).any() or (np.abs(xy[:, 1]) < 1e-6).any():
        return False
    columns = np.stack([xy[:3, 0], xy[:3, 1], 1.0 - xy[:3].sum(1)])
    return bool(abs(np.linalg.det(columns)) > 1e-6 and xy[3, 1] > 0.0)


_BRADFORD: Final = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
"""Bradford matrix from CIE XYZ to cone responses, for adapting white (ICC.1:2022, annex E)."""


def rgb_from_rgb(source: Chromaticities, target: Chromaticities) -> Array:
    """Return the matrix from linear RGB of one set of primaries to another; white maps to white.

    If the whites differ, the source's white is adapted to the target's by Bradford's cone responses.

    Args:
        source: Chromaticities of the input.
        target: Chromaticities of the result.

    Returns:
        (3, 3), to be multiplied with column vectors.
    """
    from_source, from_target = xyz_from_rgb(source), xyz_from_rgb(target)
    cones = _BRADFORD @ np.stack([from_target.sum(1), from_source.sum(1)], 1)
    adapted = np.linalg.solve(_BRADFORD, (cones[:, :1] / cones[:, 1:]) * (_BRADFORD @ from_source))
    return np.asarray(np.linalg.solve(from_target, adapted))


def converted(picture: npt.NDArray[Any], source: Chromaticities, target: Chromaticities) -> npt.NDArray[np.float32]:
    """Return a linear picture, (..., 3) float32, in other primaries; colours outside the gamut are negative."""
    if np.allclose(source, target, atol=5e-4):
        return np.ascontiguousarray(picture, np.float32)
    matrix = rgb_from_rgb(source, target).astype(np.float32)
    return np.ascontiguousarray(picture @ matrix.T, np.float32)
