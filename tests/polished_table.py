"""Films around tables that may be polished, rendered by NumPy alone, and the light that the program captures there."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import cv2
import numpy as np

from bench.random_tables import MARKER
from bench.table_world import FINE, Block, Card, World, latlong_directions
from warp_ar import PRESETS, Pipeline, Pose
from warp_ar.scene import loads_scene

WIDTH, HEIGHT, FOCAL = 320, 240, 330.0
VIEWS = 7
RAYS = 8
"""Per pixel of the table, for what it mirrors."""
HALF = np.array([0.8, 0.7])
BALL_REFLECTS = 0.85

Spoil = Callable[[np.ndarray, int], np.ndarray]
"""What a camera does to a linear picture (h, w, 3) of a number."""


def _masking(cosine, alpha):
    return 0.5 * (np.sqrt(1.0 + alpha**2 * (1.0 / np.maximum(cosine, 1e-4) ** 2 - 1.0)) - 1.0)


class PolishedWorld(World):
    """Its table has a coat of GGX with Smith's masking and Schlick's Fresnel, lit by all that stands around it."""

    def polish(self, roughness, reflectance, rng):
        """Give it a coat; a reflectance of 0 is none."""
        self.alpha, self.f0, self.rng, self.follows = roughness**2, reflectance, rng, reflectance > 0.0

    def _trace_table(self, origin, d, radiance, nearest):
        before = nearest.copy()
        super()._trace_table(origin, d, radiance, nearest)
        met = np.flatnonzero(nearest < before)
        if not self.follows or not len(met):
            return
        at = origin[met] + nearest[met][:, None] * d[met]
        met = met[np.abs(at[:, :2]).max(-1) > self.card.half]
        at = origin[met] + nearest[met][:, None] * d[met] + [0.0, 0.0, 1e-5]
        wo = -d[met][:, None]
        # Half vectors by GGX's own density: f cos_i / density = F G (wo . h) / (n . wo) / (n . h).
        steps = np.stack([np.arange(RAYS) / RAYS, np.arange(RAYS) * 0.618])[:, None]
        u, around = (self.rng.random((2, len(met), 1)) + steps) % 1.0
        tangent, around = self.alpha * np.sqrt(u / (1.0 - u)), 2.0 * np.pi * around
        h = np.stack([tangent * np.cos(around), tangent * np.sin(around), np.ones_like(tangent)], -1)
        h /= np.linalg.norm(h, axis=-1, keepdims=True)
        cosine = (h * wo).sum(-1)
        wi = 2.0 * cosine[..., None] * h - wo
        shadowing = 1.0 / (1.0 + _masking(wo[..., 2], self.alpha) + _masking(wi[..., 2], self.alpha))
        lost = (wi[..., 2] <= 0.0) | (cosine <= 0.0)
        weight = np.where(lost, 0.0, shadowing * cosine / np.maximum(wo[..., 2] * h[..., 2], 1e-6))
        fresnel = self.f0 + (1.0 - self.f0) * np.clip(1.0 - cosine, 0.0, 1.0) ** 5
        self.follows = False
        mirrored = self.trace(np.repeat(at, RAYS, 0), wi.reshape(-1, 3)).reshape(*weight.shape, 3)
        self.follows = True
        radiance[met] *= 1.0 - (weight * fresnel).mean(1)[:, None]
        radiance[met] += ((weight * fresnel)[..., None] * mirrored).mean(1)


def _texture(rng, amplitude, size=512):
    noise = np.zeros((size, size), np.float32)
    for scale in (4, 16, 64):
        coarse = rng.standard_normal((size // scale, size // scale)).astype(np.float32)
        noise += cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC) / 1.7
    color = rng.uniform(0.08, 0.7) * (1.0 + 0.25 * rng.uniform(-1.0, 1.0, 3))
    return np.clip(color * np.exp(amplitude * noise)[..., None], 0.02, 0.9).astype(np.float32)


def _clutter(rng, ball):
    """Boxes of which the program is not told."""
    blocks = []
    for _ in range(4):
        turn, away = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.22, 0.45)
        at, size = away * np.array([np.cos(turn), np.sin(turn)]), rng.uniform([0.03] * 3, [0.1, 0.1, 0.12])
        if np.linalg.norm(at - ball[:2]) > 0.15 and at[1] > -0.1:
            turn, color = rng.uniform(0.0, 90.0), rng.uniform(0.05, 0.8, 3)
            blocks.append(Block(np.array([*at, size[2] / 2]), size, turn, color, False))
    return blocks


@dataclasses.dataclass
class Film:
    """Views around a table, and what the program is told and sees."""

    scene: object
    views: list
    """RGB and ``camera_from_world``."""
    about: str

    @functools.cached_property
    def captured(self):
        """The environment as the ball shows it, nothing recovered."""
        quality = PRESETS["medium"].with_methods(recover="clipped")
        with Pipeline(self.scene, device="cpu", quality=quality, outputs=("environment",)) as pipeline:
            for number, (image, pose) in enumerate(self.views):
                result = pipeline(image, time_seconds=0.5 * number, pose=pose)
            return np.array(result.environment, np.float32)


def room(rng):
    """Radiance of dim walls with windows, pictures and panels, ``FINE`` latlong."""
    d, _ = latlong_directions(*FINE)
    height, turn = np.degrees(np.arcsin(d[..., 2])), np.degrees(np.arctan2(d[..., 1], d[..., 0]))
    radiance = 0.15 + 0.05 * d @ rng.uniform(0.0, 1.0, (3, 3))
    for _ in range(14):
        up, around = rng.uniform(0.0, 70.0), rng.uniform(-180.0, 180.0)
        tall, wide = rng.uniform(4.0, 15.0, 2)
        across = np.abs((turn - around + 180.0) % 360.0 - 180.0) * np.cos(np.radians(up))
        radiance[(np.abs(height - up) < tall) & (across < wide)] = rng.uniform(0.02, 1.5) * rng.uniform(0.7, 1.3, 3)
    return cv2.GaussianBlur(radiance.astype(np.float32), (0, 0), 1.0)


def _photograph(exposed, rng):
    """sRGB codes of linear values, with a sensor's noise."""
    exposed = exposed + 0.003 * np.sqrt(np.maximum(exposed, 0.0) + 0.02) * rng.standard_normal(exposed.shape)
    exposed = np.clip(exposed, 0.0, 1.0)
    codes = np.where(exposed <= 0.0031308, 12.92 * exposed, 1.055 * np.maximum(exposed, 1e-9) ** (1 / 2.4) - 0.055)
    return np.round(255.0 * codes).astype(np.uint8)


@functools.cache
def film(
    seed,
    roughness,
    reflectance,
    *,
    clutter=False,
    spoil: Spoil | None = None,
) -> Film:
    """Seven views, 44 degrees around a table with a card and a ball, by sRGB codes with a sensor's noise."""
    rng = np.random.default_rng(seed)
    environment = room(rng)
    radius, turn = float(rng.choice([0.03, 0.04, 0.05])), rng.uniform(0.0, 2.0 * np.pi)
    off = radius + 0.06 + rng.uniform(0.01, 0.06)
    ball = np.array([off * np.cos(turn), 0.6 * off * np.sin(turn), radius])
    amplitude = float(rng.choice([0.0, 0.05, 0.15, 0.35]))
    marker = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 0, 120)
    card = Card(np.pad(np.asarray(marker, np.uint8), 30, constant_values=255), 0.75 * MARKER, np.full(3, 0.85), 0.04)
    blocks = _clutter(rng, ball) if clutter else []
    table = _texture(rng, amplitude), HALF
    world = PolishedWorld(environment, (ball, radius, BALL_REFLECTS), blocks, [], table, card)
    world.polish(roughness, reflectance, rng)
    elevation, azimuth, distance = rng.uniform(20.0, 50.0), rng.uniform(-0.7, 0.7) - np.pi / 2, rng.uniform(0.4, 0.7)
    target = np.array([*(0.5 * ball[:2]), 0.02])
    pixels = np.stack([*np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))], -1).reshape(-1, 2)
    local = np.column_stack([(pixels - [(WIDTH - 1) / 2, (HEIGHT - 1) / 2]) / FOCAL, np.ones(len(pixels))])
    views, exposure = [], 0.0
    for number, step in enumerate(np.linspace(-1.0, 1.0, VIEWS)):
        up, around = np.radians(elevation + 7.0 * np.sin(3.0 * step)), azimuth + np.radians(22.0) * step
        away = np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
        eye = target + distance * away
        x = np.cross(-away, [0.0, 0.0, 1.0]) / np.cos(up)
        rotation = np.stack([x, np.cross(-away, x), -away])
        rays = local @ rotation
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        linear = world.trace(eye, rays).reshape(HEIGHT, WIDTH, 3)
        exposure = exposure or float(rng.uniform(0.25, 0.7) / np.percentile(linear.mean(-1), 75))
        exposed = exposure * linear if spoil is None else spoil(exposure * linear, number)
        views.append((_photograph(exposed, rng), Pose(rotation, -rotation @ eye)))
    scene = loads_scene(
        f"schema = 1\n[camera]\nwidth = {WIDTH}\nheight = {HEIGHT}\nfx = {FOCAL}\nfy = {FOCAL}\n"
        f'cx = {(WIDTH - 1) / 2}\ncy = {(HEIGHT - 1) / 2}\ntransfer = "srgb"\n'
        f'[marker]\ndictionary = "DICT_4X4_50"\nid = 0\nsize = {MARKER}\n'
        f"[probe]\ncenter = {ball.tolist()}\nradius = {radius}\nreflectance = {[BALL_REFLECTS] * 3}\n"
        f'[[proxy]]\nshape = "plane"\nsize = {(2.0 * HALF).tolist()}\n'
    )
    return Film(scene, views, f"{seed}: texture {amplitude}, from {elevation:.0f} degrees")
