"""Spheres between two mirror balls on a desk that is rendered in float64, and what is true of them."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.rendered_lamp import Array, Desk, irradiance, picture, radiance
from tests.rendered_room import look_at
from tests.twins.probe_weights import weights
from warp_ar.engine.pipeline import Pipeline
from warp_ar.scene import Camera, LambertMaterial, Marker, MirrorMaterial, Object, Pose, Probe, Proxy, Scene

SIZE = (320, 240)
FOCAL = 320.0
EYE = np.array([0.0, -0.8, 0.35])
BALLS = tuple(Probe((x, 0.0, 0.04), 0.04, (0.85,) * 3) for x in (-0.2, 0.2))
PLACES = (-0.2, -0.1, 0.0, 0.1, 0.2)
"""Of the objects, along the line from ball to ball."""
ASIDE, HEIGHT = -0.05, 0.05
"""Metres from that line to the objects, which may not be where the balls are, and above the desk."""
RADIUS = 0.015
ALBEDO = 0.8


def pose(right: float = 0.0) -> Pose:
    """``camera_from_world`` of a camera that looks between the balls, or to the right of there."""
    return Pose(*look_at(EYE, np.array([right, 0.0, 0.04])))


def material(mirror: bool) -> Any:
    """Of the objects."""
    return MirrorMaterial() if mirror else LambertMaterial((ALBEDO,) * 3)


def make_scene(probes: tuple[Probe, ...], surface: Any) -> Scene:
    """Spheres of one material between the balls."""
    width, height = SIZE
    camera = Camera(width, height, FOCAL, FOCAL, (width - 1) / 2, (height - 1) / 2)
    objects = tuple(Object("sphere", at=(x, ASIDE, HEIGHT), radius=RADIUS, material=surface) for x in PLACES)
    desk = Proxy("plane", size=(2.0, 2.0))
    return Scene(camera, marker=Marker(size=0.08), probes=probes, proxies=(desk,), objects=objects)


def rays(right: float = 0.0) -> Array:
    """World directions of pixels."""
    width, height = SIZE
    x, y = np.meshgrid((np.arange(width) - (width - 1) / 2) / FOCAL, (np.arange(height) - (height - 1) / 2) / FOCAL)
    return np.asarray(np.stack([x, y, np.ones_like(x)], -1) @ pose(right).rotation)


def hits(index: int, right: float = 0.0) -> tuple[NDArray[np.bool_], Array, Array, Array]:
    """Pixels (H, W) that show an object; there its points, its normals and what they mirror, (n, 3) each."""
    d = rays(right)
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    middle = np.array([PLACES[index], ASIDE, HEIGHT])
    o = EYE - middle
    along = d @ o
    under = along**2 - o @ o + RADIUS**2
    shown = under > 0.0
    points = EYE + (-along - np.sqrt(np.maximum(under, 0.0)))[shown, None] * d[shown]
    normals = (points - middle) / RADIUS
    return shown, points, normals, d[shown] - 2.0 * (d[shown] * normals).sum(-1, keepdims=True) * normals


def shares(probes: tuple[Probe, ...], points: Array, trusts: tuple[float, ...] = (1.0, 1.0)) -> Array:
    """What balls count at points, (n, P)."""
    places = [(*ball.center, trust) for ball, trust in zip(probes, trusts, strict=False)]
    return np.array([weights(places, point) for point in points])


def shown_of(pipeline: Pipeline, index: int, right: float = 0.0) -> tuple[Array, NDArray[np.bool_]]:
    """Radiance of an object's pixels (n, 3), and which of them are one sample: it covers them and all beside them."""
    virtual = pipeline.arrays["virtual"].numpy().astype(np.float64)
    inside = cv2.erode((virtual[..., 3] == 1.0).astype(np.uint8), np.ones((3, 3), np.uint8))
    shown = hits(index, right)[0]
    whole = inside[shown] == 1
    assert whole.sum() > 50
    return virtual[shown][:, :3], whole


def rms(values: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt((values**2).mean()))


class TwoBalls:
    """A desk with its balls: what a camera sees of it, and what is true."""

    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        self._truth: dict[tuple[int, bool], Array] = {}

    def photograph(self, right: float = 0.0) -> NDArray[np.uint8]:
        """The desk and its balls."""
        balls = [(ball.center, ball.radius, ball.reflectance[0]) for ball in BALLS]
        linear = np.clip(picture(self.desk, EYE, rays(right), balls), 0.0, 1.0)
        encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        return np.round(255.0 * encoded).astype(np.uint8)

    def truth(self, index: int, mirror: bool = False) -> Array:
        """Radiance of an object's pixels, (n, 3)."""
        if (index, mirror) not in self._truth:
            _, points, normals, toward = hits(index)
            if mirror:
                true = radiance(self.desk, points, toward)
            else:
                true = ALBEDO / np.pi * irradiance(self.desk, points, normals, 512)
            self._truth[index, mirror] = true
        return self._truth[index, mirror]
