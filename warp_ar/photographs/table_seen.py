"""Measurements by the table around a photographed mirror ball: the ball's reflectance, and the light's level.

The ball mirrors the table, which the photograph also shows directly: the ratio of both is the ball's reflectance
(``ball/ball_reflectance.py``). No table reflects more light than it receives. With radiance L of the table in the
photograph and irradiance E on it by the captured light, its reflectance is

    rho = pi L / E,

Light for which rho is above ``WHITEST`` is too dark: the ball's reflectance is lower than assumed, or lamps clip.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from warp_ar.ball.ball_finder import BallOutline
from warp_ar.ball.ball_reflectance import Reflected, are_seen, measure_reflectance
from warp_ar.photographs.support import Support
from warp_ar.scene import Camera, Probe, Proxy, Scene
from warp_ar.scene.pixel_rays import project
from warp_ar.tracking.card_layout import CARD_MARKER
from warp_ar.tracking.markers import pattern_of

Array = NDArray[np.float64]

WHITEST: Final = 0.9
"""Largest reflectance of a table; white paper has 0.85."""
REACH: Final = (2.0, 6.0)
"""Range of distances from the ball's foot, in radii, at which the table is measured; closer, the ball shades it."""
SHARE: Final = 90.0
"""Percentile of the table's radiance that counts as its brightest part without shadows; above it are specular
reflections."""
CLIPPED: Final = 250
"""Code from which paper counts as clipped."""
FEWEST: Final = 40
"""Smallest number of visible points of the table."""


@dataclasses.dataclass(frozen=True)
class Table:
    """Ball on a table in a photograph, with the table's plane."""

    image: NDArray[np.uint8]
    """uint8 RGB, upright."""
    camera: Camera
    """Camera of the photograph."""
    support: Support
    """The table's plane."""
    probe: Probe
    """The ball, with the radius of a ball that stands on the plane."""
    table: NDArray[np.float32]
    """Linear value of each code, (256, 3)."""

    @classmethod
    def under(
        cls,
        outline: BallOutline,
        image: NDArray[np.uint8],
        camera: Camera,
        support: Support,
        table: NDArray[np.float32],
    ) -> Table:
        """Return the table below a ball with a given outline."""
        radius = support.radius_of(outline.sphere)
        x, y, z = map(float, support.pose.inverse().apply(radius * np.array(outline.sphere)))
        return cls(image, camera, support, Probe((x, y, z), radius), table)

    def _scene(self) -> Scene:
        (x, y, _), side = self.probe.center, 80.0 * self.probe.radius
        proxies = (Proxy("plane", at=(x, y, 0.0), size=(side, side)),)
        return Scene(camera=self.camera, probes=(self.probe,), proxies=proxies, has_marker=False, name="table")

    def reflectance_of_ball(self) -> Reflected | None:
        """Return the ball's reflectance; None if it mirrors too little of the photograph's visible table."""
        view = self.image, self.support.pose
        return measure_reflectance(self._scene(), self.camera, self.probe, view, self.table)

    def reflectance_under(self, irradiance: Array) -> float:
        """Return the reflectance that the table's brightest part must have if it receives ``irradiance``, (3,).

        It is the mean of the channels, or 0 if fewer than ``FEWEST`` points of the table around the ball are visible.
        """
        angle, away = np.meshgrid(np.arange(48) * np.pi / 24, np.linspace(*REACH, 16))
        x, y, _ = self.probe.center
        away = self.probe.radius * away.ravel()
        points = np.column_stack([x + away * np.cos(angle.ravel()), y + away * np.sin(angle.ravel()), 0.0 * away])
        points = points[are_seen(self._scene(), self.camera, self.probe, self.support.pose, points)]
        if len(points) < FEWEST:
            return 0.0
        at = project(self.camera, self.support.pose.apply(points)).astype(np.float32)
        linear = cv2.GaussianBlur(cv2.LUT(self.image, self.table[None]), (0, 0), 1.5)
        seen = cv2.remap(linear, at[:, None, 0], at[:, None, 1], cv2.INTER_LINEAR).mean((1, 2))
        return float(np.pi * np.percentile(seen, SHARE) / irradiance.mean())


def exposure_by_paper(
    image: NDArray[np.uint8], camera: Camera, support: Support, table: NDArray[np.float32], irradiance: Array
) -> float | None:
    """Return a photograph's exposure over that of a light, by the printed card's white paper under that light.

    Args:
        image: uint8 RGB, upright.
        camera: Camera of the photograph.
        support: The card's plane.
        table: Linear value of each code, (256, 3).
        irradiance: Irradiance of the card by the light, (3,).

    Returns:
        Ratio of the exposures; None if the paper clips or is not visible.
    """
    cells, white = pattern_of(CARD_MARKER).cells, pattern_of(CARD_MARKER).white
    at = project(camera, support.pose.apply(cells[white])).astype(np.float32)
    codes = np.median(cv2.remap(image, at[:, None, 0], at[:, None, 1], cv2.INTER_LINEAR)[:, 0], 0)
    if codes.max() >= CLIPPED or codes.min() < 1.0:
        return None
    seen = np.mean([np.interp(code, np.arange(256), table[:, channel]) for channel, code in enumerate(codes)])
    return float(np.pi * seen / (CARD_MARKER.white * irradiance.mean()))
