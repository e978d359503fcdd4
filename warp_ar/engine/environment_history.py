"""Light of the environment that is kept from frame to frame, and from one pipeline to the next."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import warp as wp

from warp_ar.kernels.environment.accumulate import scale_radiance
from warp_ar.kernels.structs import struct_values
from warp_ar.stages.base import Arrays

KEPT_ARRAYS = ("others_kept_radiance", "others_filled")
"""Arrays with the kept radiance of the second and further mirror balls, before and after holes are filled."""
LIGHT_ARRAYS = ("environment_radiance", "environment_confidence", "environment_clipped")
"""Arrays of the environment that ``CarriedLight.take_over`` resamples into a new pipeline."""
SCALED_ARRAYS = ("environment_radiance", "filled_radiance", "recover_recovered", *KEPT_ARRAYS)
"""Arrays of radiance that are kept between frames; ``filled_radiance`` is kept only while something covers a ball."""


class CarriedLight:
    """Environment that a pipeline has captured so far; ``known`` is False before the first."""

    def __init__(self, arrays: Arrays, *, wanted: bool) -> None:
        """Store the pipeline's arrays; ``wanted`` is True if the environment is one of the outputs."""
        self._arrays, self._wanted = arrays, wanted
        self.known = False
        """True if the arrays hold light; if not, the next frame discards their content."""

    @property
    def environment(self) -> Any:
        """Return the environment for the results; None if it is not an output or has not been captured yet."""
        return self._arrays["environment"] if self.known and self._wanted else None

    @property
    def others(self) -> Any:
        """Return the environments of balls 2 to P, (P - 1, rows, columns); None if there is only one environment."""
        return self._arrays.get("others_environment") if self.environment is not None else None

    def scale(self, ratio: npt.NDArray[np.float64]) -> None:
        """Scale the kept radiance after a change of the camera's gain, so that it fits the values of the next frame.

        Args:
            ratio: New gain over old gain, RGB.
        """
        arrays = self._arrays
        captured = ("environment",) if "environment" in arrays and SCALED_ARRAYS[0] not in arrays else ()
        for name in (*SCALED_ARRAYS, *captured):
            if name in arrays:
                scale_radiance(arrays[name].reshape((-1, arrays[name].shape[-1])), ratio)
        for name in (*captured, "others_filled"):
            if name in arrays:
                arrays.touch(name)
        name = "recover_found" if "recover_found" in arrays else "emitters"
        if name in arrays and isinstance(arrays[name], wp.array):
            emitters = arrays[name]
            records = struct_values(emitters)
            records["power"] *= ratio
            emitters.assign(records)

    def take_over(self, other: CarriedLight) -> None:
        """Continue with another pipeline's light, resampled to the size of this pipeline's arrays."""
        mine, theirs = self._arrays, other._arrays
        kept = [name for name in LIGHT_ARRAYS if name in mine and name in theirs]
        if not other.known or not kept:
            return
        if mine[kept[0]].shape == theirs[kept[0]].shape:
            for name in kept:
                wp.copy(mine[name], theirs[name])
        else:
            radiance, confidence, clipped = (theirs[name].numpy() for name in LIGHT_ARRAYS)
            light = resample_light(radiance, confidence, clipped, mine[kept[0]].shape)
            for name, values in zip(LIGHT_ARRAYS, light, strict=True):
                mine[name].assign(values)
        self.known = True


def resample_light(
    radiance: npt.NDArray[np.float32],
    confidence: npt.NDArray[np.float32],
    clipped: npt.NDArray[np.float32],
    shape: tuple[int, int],
) -> tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]]:
    """Return captured light resampled to another size, as means weighted with confidence.

    Args:
        radiance: Latlong (h, w, 3), camera values.
        confidence: 0 to 1, (h, w).
        clipped: Share of each texel that clips, by channel, (h, w, 3).
        shape: Rows and columns of the new maps.

    Returns:
        Radiance, confidence and clipped shares at the new size.
    """

    def resize(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        way = cv2.INTER_AREA if shape[0] < values.shape[0] else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(values, (shape[1], shape[0]), interpolation=way), np.float32)

    known = resize(confidence)
    weight = np.where(known > 0.0, known, 1.0)[..., None]
    return resize(radiance * confidence[..., None]) / weight, known, resize(clipped * confidence[..., None]) / weight
