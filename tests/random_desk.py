"""A desk that is made at random, photographed: the printed card, a table of blocks, a mirror ball, a room."""

from __future__ import annotations

import functools

import cv2
import numpy as np
import pypdfium2

from tests.rendered_room import look_at
from warp_ar.light.captured import latlong_directions
from warp_ar.scene import Camera
from warp_ar.tracking import card_layout

PER_METRE = 3000.0
"""Pixels per metre of the printed sheet: a third of a millimetre, finer than any camera here sees it."""
TINT = np.array([1.0, 0.97, 0.94])
"""The camera's white balance, on codes."""
ACROSS = 2
"""Rays per pixel along each side."""
ROW = 1024
"""Points that the sheet is looked up at together."""


class RandomDesk:
    """A sheet as it was printed, on a table of blocks, a mirror ball on the cross, and a room around them."""

    def __init__(self, pdf, seed):
        rng = np.random.default_rng(seed)
        with pypdfium2.PdfDocument(pdf) as document:
            page = document[0]
            page_mm = np.array(page.get_size()) / 72 * 25.4
            fine = page.render(scale=4 * PER_METRE / 72 * 0.0254, grayscale=True).to_numpy().squeeze()
        size = np.round(page_mm * PER_METRE / 1e3).astype(int)
        paper = cv2.resize(fine.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        self.paper = 0.04 + 0.6 * paper / 255
        self.size = page_mm / 1e3
        # As `sheet` has it: from the top of the paper to the board's centre.
        self.top = 0.052 + card_layout.BALL_PLACE[1] + (self.size[1] - 0.2794) / 2
        self.radius = rng.uniform(0.027, 0.036)
        off = rng.uniform(-0.001, 0.001, 2)
        self.center = np.array([*(np.array(card_layout.BALL_PLACE) + off), self.radius])
        focal = rng.uniform(560, 760)
        lens = (rng.uniform(-0.12, 0.02), rng.uniform(-0.02, 0.04), 0.0, 0.0, 0.0)
        self.camera = Camera(640, 480, focal, focal, *(np.array([319.5, 239.5]) + rng.uniform(-6, 6, 2)), lens)
        self.blocks = rng.uniform(0.05, 0.5, (64, 64))
        self.walls = rng.uniform(0.1, 0.9, (8, 16))
        self.rng = rng

    def table(self, points):
        """What lies at points (..., 3) of the table, linear."""
        x = (points[..., 0] + self.size[0] / 2) * PER_METRE - 0.5
        y = (self.top - points[..., 1]) * PER_METRE - 0.5
        # OpenCV takes no row of more than 32767.
        rows = [np.resize(value.astype(np.float32), (-(-x.size // ROW), ROW)) for value in (x.ravel(), y.ravel())]
        paper = cv2.remap(self.paper, *rows, cv2.INTER_LINEAR, borderValue=-1.0).ravel()[: x.size].reshape(x.shape)
        cell = np.floor(points[..., :2] / 0.05).astype(int) % 64
        return np.where(paper >= 0.03, paper, self.blocks[cell[..., 1], cell[..., 0]])

    def around(self, origin, direction):
        """What rays meet but the ball, linear."""
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -origin[..., 2] / direction[..., 2]
        on = (t > 0) & np.isfinite(t)
        points = origin + np.where(on, t, 0.0)[..., None] * direction
        on &= np.abs(points[..., :2]).max(-1) < 0.7
        up = np.clip(((direction[..., 2] + 1) * 4).astype(int), 0, 7)
        around = ((np.arctan2(direction[..., 1], direction[..., 0]) / np.pi + 1) * 8).astype(int) % 16
        return np.where(on, self.table(np.where(on[..., None], points, 0.0)), self.walls[up, around])

    @functools.cached_property
    def rays(self):
        """Unit directions, in the camera's frame, of all samples of its pixels."""
        height, width = self.camera.height, self.camera.width
        sub = (np.arange(ACROSS) + 0.5) / ACROSS - 0.5
        y, x = ((np.arange(n)[:, None] + sub).reshape(-1) for n in (height, width))
        pixels = np.stack(np.meshgrid(x, y), -1).reshape(-1, 1, 2)
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-9)
        lens = np.array(self.camera.distortion)
        flat = cv2.undistortPoints(pixels, self.camera.matrix(), lens, criteria=criteria).reshape(len(y), len(x), 2)
        d = np.concatenate([flat, np.ones((*flat.shape[:2], 1))], -1)
        return d / np.linalg.norm(d, axis=-1, keepdims=True)

    def photograph(self, eye, target, roll=0.0, ball=True):
        """An RGB frame, uint8."""
        rotation, _ = look_at(np.array(eye), np.array(target), roll)
        height, width = self.camera.height, self.camera.width
        d = self.rays @ rotation
        o = np.broadcast_to(np.array(eye), d.shape)
        linear = self.around(o, d)
        if ball:
            away = np.array(eye) - self.center
            along = d @ away
            disc = along**2 - away @ away + self.radius**2
            rows, columns = np.nonzero((disc > 0) & (along < 0))
            ray = d[rows, columns]
            hit = o[rows, columns] + (-along[rows, columns] - np.sqrt(disc[rows, columns]))[:, None] * ray
            normal = (hit - self.center) / self.radius
            mirrored = ray - 2 * (ray * normal).sum(-1, keepdims=True) * normal
            linear = linear.copy()
            linear[rows, columns] = 0.85 * self.around(hit[None], mirrored[None])[0]
        linear = linear.reshape(height, ACROSS, width, ACROSS).mean((1, 3))
        codes = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        noisy = 255 * codes[..., None] * TINT + self.rng.normal(0, 1.0, (height, width, 1))
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)

    def light(self, height):
        """What the camera would see from the ball's place, linear RGB by sRGB, (height, 2 height, 3)."""
        across = 4
        directions = latlong_directions(across * height)
        linear = self.around(np.broadcast_to(self.center, directions.shape), directions)
        linear = linear.reshape(height, across, 2 * height, across).mean((1, 3))
        codes = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        codes = codes[..., None] * TINT
        return np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
