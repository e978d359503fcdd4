"""Reflectances of mirror balls as frames tell them, in the place of what the scene says where that is wrong.

A scene's reflectance is a guess where nobody has measured it: chrome has 0.55 to 0.65, a silvered ornament 0.85. All
captured light is off by as much. What is seen twice tells (``ball_reflectance``), on 9 of 10 tables within 5 %. So the
first frames that tell are asked. Where their median agrees with the scene within ``REFLECTANCE``, the scene's number is
kept: a ball that somebody has measured is known better. Beyond, the frames' is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from warp_ar.ball.ball_reflectance import REFLECTANCE, measure_reflectance
from warp_ar.scene import Camera, Pose, Probe, Scene

ENOUGH: Final = 8
"""Frames that tell, after which no more are asked."""
MOST: Final = 24
"""Frames that are asked where few tell."""
EVERY: Final = 5
"""Interval, in frames, between measurements after the first three."""
FIRST: Final = 3
"""Number of first frames that are all measured, for photographs and short clips."""
STEADY: Final = 0.03
"""Change of the median's logarithm that replaces the value in use; each replacement changes all light."""


class ReflectanceWatch:
    """Tells, frame after frame, what to take for the reflectance of each ball."""

    def __init__(self, scene: Scene, camera: Camera, table: NDArray[np.float32]) -> None:
        """Begin with what the scene says.

        Args:
            scene: With a marker and a ball.
            camera: Of the frames.
            table: Linear value of each code, (256, 3).
        """
        self.watches = (camera, scene.marker, scene.proxies, scene.probes)
        """Things that frames are of: the same frames tell those that watch the same, the same."""
        self.values = tuple(probe.reflectance for probe in scene.probes)
        """RGB of each ball."""
        self._scene, self._camera, self._table = scene, camera, table
        self._told: list[list[tuple[float, float, float]]] = [[] for _ in scene.probes]
        self._seen = self._asked = 0

    @property
    def is_told(self) -> bool:
        """Return whether frames have taken the place of what the scene says."""
        return self.values != tuple(probe.reflectance for probe in self._scene.probes)

    def observe(self, image: NDArray[np.uint8], pose: Pose, probes: Sequence[Probe]) -> bool:
        """Look at a frame.

        Args:
            image: uint8 RGB (height, width, 3).
            pose: ``camera_from_world``.
            probes: The scene's, where they are now.

        Returns:
            Whether ``values`` changed.
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
