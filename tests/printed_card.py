"""The card as it comes out of a printer, photographed by cameras of any response: quick, for it is flat."""

from __future__ import annotations

import cv2
import numpy as np

from tests.rendered_room import look_at
from warp_ar.calibration.card import PAPERS, draw_card
from warp_ar.scene import Camera, Pose
from warp_ar.tracking import card_layout

PER_METRE = 4000
"""Pixels per metre of the print: four dots of a grey are four pixels."""
WHITE = 0.8
"""Reflectance of the paper."""


def smooth_curve(rng):
    """What some camera does: a gamma near sRGB's, bent into an S; from linear light 0 to 1 to 0 to 1."""
    gamma, strength, middle = rng.uniform(1.8, 2.6), rng.uniform(0.0, 0.35), rng.uniform(0.35, 0.6)

    def encode(linear):
        x = np.clip(linear, 0.0, 1.0) ** (1.0 / gamma)
        # An S through (0, 0), (middle, middle) and (1, 1).
        return x + strength * x * (1 - x) * (x - middle) * 2.0

    return encode


class PrintedCard:
    """A sheet of paper on a dark table, under light that falls off across it."""

    def __init__(self, rng, black=None, spread=None, paper="a4", scale=1.0):
        self.rng = rng
        self.black = rng.uniform(0.03, 0.1) if black is None else black
        self.spread = rng.normal(0.0, 0.015) if spread is None else spread
        width, height = (length / 1e3 for length in PAPERS[paper])
        board = draw_card(card_layout.CARD_MARKER, PER_METRE)
        ink = 1.0 - card_layout.draw_page((width, height), PER_METRE, board) / 255.0
        # Ink spreads in the greys' dots alone: each patch gets what its share becomes.
        self.origin = np.array([width / 2, 0.052 + card_layout.BALL_PLACE[1] + (height - 0.2794) / 2]) * PER_METRE
        for share, center in zip(card_layout.GREYS, card_layout.grey_centers(), strict=True):
            x, y = self.origin + np.array([center[0], -center[1]]) * PER_METRE
            w, h = (round(side * PER_METRE / 2) for side in card_layout.GREY_SIZE)
            inked = share + 4 * self.spread * share * (1 - share)
            patch = ink[round(y) - h : round(y) + h, round(x) - w : round(x) + w]
            patch += inked - share
        if scale != 1.0:
            # Printers scale about the page's middle; what was cut off is white.
            middle = np.array(ink.shape[::-1]) / 2
            turn = np.column_stack([np.eye(2) * scale, middle * (1 - scale)])
            ink = np.clip(cv2.warpAffine(ink, turn, ink.shape[::-1], flags=cv2.INTER_AREA), 0.0, 1.0)
            self.origin = middle + (self.origin - middle) * scale
        self.paper = (WHITE * (1.0 - ink * (1.0 - self.black))).astype(np.float32)
        self.slope = rng.uniform(-1.5, 1.5, 2)

    def photograph(self, camera: Camera, pose: Pose, light: float, encode, noise=1.2):
        """An RGB frame, uint8; white paper in the card's middle has linear value ``light``."""
        across = 2
        # Where each ray meets the paper, in its own pixels.
        sub = (np.arange(across) + 0.5) / across - 0.5
        rows, columns = ((np.arange(side)[:, None] + sub).ravel() for side in (camera.height, camera.width))
        flat = np.stack(np.meshgrid(columns, rows), -1)
        if any(camera.distortion):
            criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-8)
            matrix, lens = camera.matrix(), np.array(camera.distortion)
            flat = cv2.undistortPoints(flat.reshape(-1, 1, 2), matrix, lens, criteria=criteria).reshape(flat.shape)
        else:
            flat = (flat - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        plane = np.column_stack([pose.rotation[:, 0], pose.rotation[:, 1], pose.translation])
        met = np.concatenate([flat, np.ones((*flat.shape[:2], 1))], -1) @ np.linalg.inv(plane).T
        places = met[..., :2] / met[..., 2:] * (PER_METRE, -PER_METRE) + self.origin
        y, x = np.mgrid[: self.paper.shape[0], : self.paper.shape[1]].astype(np.float32)
        fall = np.exp(((x - self.origin[0]) * self.slope[0] - (y - self.origin[1]) * self.slope[1]) / PER_METRE)
        # Blurred to the picture's grain first: dots that a camera does not resolve.
        grain = PER_METRE * pose.translation[2] / camera.fx / across
        fine = cv2.GaussianBlur(self.paper * fall, (0, 0), max(0.45 * grain, 0.3))
        places = places.astype(np.float32)
        linear = cv2.remap(fine, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderValue=0.05)
        linear = cv2.resize(linear, (camera.width, camera.height), interpolation=cv2.INTER_AREA) * light / WHITE
        codes = 255 * encode(linear)[..., None] + self.rng.normal(0, noise, (camera.height, camera.width, 3))
        return np.clip(np.rint(codes), 0, 255).astype(np.uint8)


def poses(rng, count, far=(0.38, 0.55)):
    """Cameras around the card's board that see it and its greys."""
    found = []
    for _ in range(count):
        tilt, turn, distance = rng.uniform(0.15, 0.7), rng.uniform(-2.6, -0.5), rng.uniform(*far)
        target = np.array([rng.uniform(-0.02, 0.02), rng.uniform(-0.04, 0.0), 0.0])
        eye = target + distance * np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
        found.append(Pose(*look_at(eye, target)))
    return found


def linear_of(encode):
    """Linear value of each code under an encoding, (256,)."""
    linear = np.linspace(0.0, 1.0, 8001)
    return np.interp(np.arange(256) / 255.0, encode(linear), linear)
