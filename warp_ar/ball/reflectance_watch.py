"""Reflectances of mirror balls measured in the frames, used where the scene's values are wrong.

An unmeasured reflectance is a guess: chrome has 0.55 to 0.65, a silvered ornament 0.85. An error scales all captured
light. The measurement by surfaces seen directly and in the ball (``ball_reflectance``) is within 5 % on 9 of 10 tables.
It is made in the first usable frames. If their median agrees with the scene within ``REFLECTANCE``, the scene's value
is kept, because a measured ball is more exact; otherwise the median is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from warp_ar.ball.ball_reflectance import REFLECTANCE, measure_reflectance
from warp_ar.scene import Camera, Pose, Probe, Scene

ENOUGH: Final = 8
"""Number of successful measurements after which no more are made."""
MOST: Final = 24
"""Largest number of frames in which a measurement is tried."""
EVERY: Final = 5
"""Interval, in frames, between measurements after the first three."""
FIRST: Final = 3
"""Number of first frames that are all measured, for photographs and short clips."""
STEADY: Final = 0.03
"""Smallest change of the median's logarithm that replaces the value in use, because each change affects all light."""


class ReflectanceWatch:
    """Estimator of each ball's reflectance over the frames."""

    def __init__(self, scene: Scene, camera: Camera, table: NDArray[np.float32]) -> None:
        """Start with the scene's reflectances.

        Args:
            scene: Scene with a marker and a ball.
            camera: Camera of the frames.
            table: Linear value of each code, (256, 3).
        """
        self.watches = (camera, scene.marker, scene.proxies, scene.probes)
        """Inputs that determine the result for given frames; equal values allow one instance to be shared."""
        self.values = tuple(probe.reflectance for probe in scene.probes)
        """Reflectance of each ball, RGB."""
        self._scene, self._camera, self._table = scene, camera, table
        self._told: list[list[tuple[float, float, float]]] = [[] for _ in scene.probes]
        self._seen = self._asked = 0

    @property
    def is_told(self) -> bool:
        """Return True if a measured reflectance replaces one of the scene."""
        return self.values != tuple(probe.reflectance for probe in self._scene.probes)

    def observe(self, image: NDArray[np.uint8], pose: Pose, probes: Sequence[Probe]) -> bool:
        """Measure the balls' reflectances in a frame, and update ``values``.

        Args:
            image: uint8 RGB (height, width, 3).
            pose: ``camera_from_world``.
            probes: The scene's balls at their present positions.

        Returns:
            True if ``values`` changed.
        """
        self._seen += 1
        rests = self._seen > FIRST and self._seen % EVERY
        if rests or self._asked >= MOST or min(map(len, self._told), default=ENOUGH) >= ENOUGH:
            return False
        self._asked += 1
        before, values = self.values, list(self.values)
        for number, (probe, told) in enumerate(zip(probes, self._told, strict=True)):
            found = measure_reflectance(self._scene, self._camera, probe, (image, pose), self._table)
            if found is None:
                continue
            told.append(found.reflectance)
            values[number] = self._chosen(self._scene.probes[number].reflectance, values[number], told)
        self.values = tuple(values)
        return self.values != before

    def _chosen(
        self,
        said: tuple[float, float, float],
        used: tuple[float, float, float],
        told: Sequence[tuple[float, float, float]],
    ) -> tuple[float, float, float]:
        """Return the reflectance to use for one ball, from the scene's, the one in use and the frames' estimates."""
        median = np.minimum(np.median(told, axis=0), 1.0)
        logarithms = np.log(median)
        if abs(float((logarithms - np.log(said)).mean())) < REFLECTANCE:
            return said
        if used != said and np.abs(logarithms - np.log(used)).max() < STEADY:
            return used
        red, green, blue = (float(value) for value in median)
        return red, green, blue
