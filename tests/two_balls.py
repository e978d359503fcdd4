"""Spheres between two mirror balls on a desk that is rendered in float64, and what is true of them."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.reference import latlong
from tests.reference.probe_weights import weights
from tests.reference.unwrap import normal_angle
from tests.rendered_lamp import Array, Desk, irradiance, picture, radiance
from tests.rendered_room import look_at
from warp_ar.engine.pipeline import Pipeline
from warp_ar.kernels.environment.unwrap import RIM_START, RIM_WIDTH
from warp_ar.scene import Camera, LambertMaterial, Marker, MirrorMaterial, Object, Pose, Probe, Proxy, Scene
from warp_ar.stages.quality import Quality

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


def make_scene(probes: tuple[Probe, ...], surface: Any, detail: int = 1) -> Scene:
    """Spheres of one material between the balls."""
    width, height = (detail * side for side in SIZE)
    camera = Camera(width, height, detail * FOCAL, detail * FOCAL, (width - 1) / 2, (height - 1) / 2)
    objects = tuple(Object("sphere", at=(x, ASIDE, HEIGHT), radius=RADIUS, material=surface) for x in PLACES)
    desk = Proxy("plane", size=(2.0, 2.0))
    return Scene(camera, marker=Marker(size=0.08), probes=probes, proxies=(desk,), objects=objects)


def rays(right: float = 0.0, detail: int = 1) -> Array:
    """World directions of pixels, ``detail`` times as many along each side."""
    (width, height), focal = (detail * side for side in SIZE), detail * FOCAL
    x, y = np.meshgrid((np.arange(width) - (width - 1) / 2) / focal, (np.arange(height) - (height - 1) / 2) / focal)
    return np.asarray(np.stack([x, y, np.ones_like(x)], -1) @ pose(right).rotation)


def hits(index: int, right: float = 0.0, detail: int = 1) -> tuple[NDArray[np.bool_], Array, Array, Array]:
    """Pixels (H, W) that show an object; there its points, its normals and what they mirror, (n, 3) each."""
    d = rays(right, detail)
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


def shown_of(pipeline: Pipeline, index: int, right: float = 0.0, detail: int = 1) -> tuple[Array, NDArray[np.bool_]]:
    """Radiance of an object's pixels (n, 3), and which of them are one sample: it covers them and all beside them."""
    virtual = pipeline.arrays["virtual"].numpy().astype(np.float64)
    inside = cv2.erode((virtual[..., 3] == 1.0).astype(np.uint8), np.ones((3, 3), np.uint8))
    shown = hits(index, right, detail)[0]
    whole = inside[shown] == 1
    assert whole.sum() > 50
    return virtual[shown][:, :3], whole


def rms(values: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt((values**2).mean()))


class TwoBalls:
    """A desk, and what its balls can tell."""

    def __init__(self, desk: Desk, detail: int = 1) -> None:
        """Pictures have ``detail`` times ``SIZE`` pixels along each side."""
        self.desk, self.detail = desk, detail
        self._truth: dict[tuple[int, bool], Array] = {}

    def photograph(self, right: float = 0.0) -> NDArray[np.uint8]:
        """The desk and its balls."""
        balls = [(ball.center, ball.radius, ball.reflectance[0]) for ball in BALLS]
        linear = np.clip(picture(self.desk, EYE, rays(right, self.detail), balls), 0.0, 1.0)
        encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        return np.round(255.0 * encoded).astype(np.uint8)

    def mirrored(self, ball: Probe, directions: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Radiance (n, 3) that a ball shows the camera from directions (n, 3), and whether it tells it at all (n,).

        A lamp is nearer to the ball's surface than to its centre, and so is larger there. Where the ball tells
        nothing, the radiance is that at its centre: what fills it is taken to lie between none and twice that.
        """
        axis = EYE - np.array(ball.center)
        away = float(np.linalg.norm(axis))
        axis /= away
        cosine = directions @ axis
        side = directions - cosine[:, None] * axis
        sine = np.linalg.norm(side, axis=-1)
        theta = normal_angle(np.arctan2(sine, cosine), away / ball.radius)
        told = np.isfinite(theta)
        theta = np.where(told, theta, 0.0)
        # A rim whose width the kernels have is not trusted, or in part.
        rim = np.sin(np.arccos(ball.radius / away))
        pixels = self.detail * FOCAL * ball.radius / away * (1.0 - np.sin(theta) / rim)
        told &= pixels > RIM_START + RIM_WIDTH
        normal = np.cos(theta)[:, None] * axis + (np.sin(theta) / np.maximum(sine, 1e-12))[:, None] * side
        origin = np.array(ball.center) + ball.radius * np.where(told[:, None], normal, 0.0)
        return radiance(self.desk, origin, directions), told

    @functools.cached_property
    def _maps(self) -> dict[Probe, tuple[Array, Array, Array]]:
        """Of all directions (n, 3), by ball: them, flux that it shows (n, 3), and the part that it does not tell."""
        directions, found = latlong.directions(96, 192).reshape(-1, 3), {}
        for ball in BALLS:
            light, told = self.mirrored(ball, directions)
            flux = light * latlong.solid_angles(96, 192).reshape(-1, 1)
            found[ball] = directions, flux, flux * ~told[:, None]
        return found

    def foreseen(self, probes: tuple[Probe, ...], index: int, mirror: bool = False) -> tuple[Array, Array]:
        """Radiance of an object's pixels (n, 3) by all that balls show, interpolated; and the part that none tells."""
        _, points, normals, toward = hits(index, 0.0, self.detail)
        share = shares(probes, points)
        out, untold = np.zeros_like(points), np.zeros_like(points)
        for column, ball in enumerate(probes):
            if mirror:
                light, told = self.mirrored(ball, toward)
                lost = light * ~told[:, None]
            else:
                directions, flux, unseen = self._maps[ball]
                cosine = np.maximum(normals @ directions.T, 0.0)
                light, lost = (ALBEDO / np.pi * cosine @ one for one in (flux, unseen))
            out += share[:, column, None] * light
            untold += share[:, column, None] * lost
        return out, untold

    def truth(self, index: int, mirror: bool = False) -> Array:
        """Radiance of an object's pixels, (n, 3)."""
        if (index, mirror) not in self._truth:
            _, points, normals, toward = hits(index, 0.0, self.detail)
            if mirror:
                true = radiance(self.desk, points, toward)
            else:
                true = ALBEDO / np.pi * irradiance(self.desk, points, normals, 512)
            self._truth[index, mirror] = true
        return self._truth[index, mirror]

    def lit(self, probes: tuple[Probe, ...], quality: Quality, device: str, frames: int = 3) -> list[Array]:
        """Radiance of matt objects' pixels after some frames; NaN in those that an object does not cover whole."""
        scene = make_scene(probes, material(False), self.detail)
        frame = self.photograph()
        with Pipeline(scene, device=device, quality=quality) as pipeline:
            for number in range(frames):
                pipeline(frame, pose=pose(), time_seconds=0.1 * number)
            found = [shown_of(pipeline, index, 0.0, self.detail) for index in range(len(PLACES))]
        return [np.where(whole[:, None], light, np.nan) for light, whole in found]

    def errors(self, found: Sequence[Array]) -> Array:
        """Root mean square error of each matt object over that of its radiance."""
        out = []
        for index, light in enumerate(found):
            known, true = np.isfinite(light[:, 0]), self.truth(index)
            out.append(rms(light[known] - true[known]) / rms(true[known]))
        return np.array(out)
