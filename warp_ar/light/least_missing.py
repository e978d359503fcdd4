"""What clips is brighter than clipping by at least so much in nearly every place: light where nothing else tells.

Let X be the irradiance that an estimate adds and D that which is missing. It is no worse than nothing as long as X is
at most 2 D (``light/evidence.py``). So twice a radiance that is missing nearly everywhere may be added without knowing
more about the place. What nearly always is missing depends on what the map shows:

- **How much clips.** The more of all directions clips, W steradians, the longer the exposure and the further what clips
  lies above clipping: as W^(1/4), up to a steradian. A sky that clips in whole may be hardly above it.
- **Whether channels clip alike** (``excess.alike``). What clips in one channel alone is hardly brighter than clipping.
- **Whether it fades.** Beside a lamp or a window it is far darker. Where cells beside what clips are nearly at it,
  so may be what clips (``PriorConfig.fades``).

A component of what clips is raised, in units of the level of clipping, by

    x = least * alike * sharp * W^(1/4).

``bench clipping_prior`` has in how many exposures of a folder of environments that became worse.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from warp_ar.kernels.recovery.recover_cells import LOST
from warp_ar.light.clipping_prior import alike, grown
from warp_ar.light.config import CONFIG
from warp_ar.light.regions import connected_regions

Array = NDArray[np.float64]


def least_missing(
    radiance: NDArray[Any], clipped: NDArray[Any], solid_angle: NDArray[Any], is_light: NDArray[np.bool_]
) -> Array:
    """Radiance by which what clips is raised where nothing else tells, (rows, columns, 3): of a wholly clipped texel.

    Args:
        radiance: Mean of cells of a latlong map, as captured, (rows, columns, 3).
        clipped: Share of them at clipping, per channel, (rows, columns, 3).
        solid_angle: Steradians, (rows, columns).
        is_light: Cells that were seen and show no modelled surface, (rows, columns): what clips elsewhere is lit or
            unknown.
    """
    own = np.where(is_light[..., None], clipped, 0.0)
    some = own.max(axis=-1)
    component = connected_regions(some > LOST)
    count = int(component.max(initial=-1)) + 1
    inside = component >= 0
    found = np.zeros(np.shape(radiance), np.float64)
    if count == 0:
        return found
    # No cell is brighter than clipping, and the brightest ones clip throughout where something wide enough does.
    level = np.asarray(radiance, np.float64)[inside].max(axis=0)
    area = np.asarray(solid_angle, np.float64)
    wide = min(float((area * some)[inside].sum()), CONFIG.least.most)
    shares = alike(own.reshape(-1, 3).astype(np.float64), area.ravel(), component.ravel(), count)
    shares *= _sharp(np.asarray(radiance, np.float64) / max(float(level.max()), 1e-9), area, component, is_light)
    found[inside] = CONFIG.least.least * wide**CONFIG.least.exponent * shares[component[inside], None] * level
    return found


def _sharp(radiance: Array, area: Array, component: NDArray[np.int64], is_light: NDArray[np.bool_]) -> Array:
    """How far components end at something darker, 0 to 1, (components,); half where nothing beside one was seen.

    Args:
        radiance: Of cells over the level of clipping, (rows, columns, 3).
        area: Steradians, (rows, columns).
        component: Of each cell, -1 for none, (rows, columns).
        is_light: Cells that tell, (rows, columns).
    """
    below, nearly = CONFIG.priors.fades
    brightness = np.clip(radiance, 0.0, 1.0).mean(axis=-1)
    beside = (component < 0) & is_light
    sharp = np.full(int(component.max()) + 1, 0.5)
    for one in range(len(sharp)):
        around = grown(component == one) & beside
        if around.any():
            rim = float((area * brightness)[around].sum() / area[around].sum())
            sharp[one] = np.clip((nearly - rim) / (nearly - below), 0.0, 1.0)
    return sharp
