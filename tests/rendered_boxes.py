"""Boxes on a wooden desk under a lamp, rendered: each with a print on its faces, and the shadow that it throws."""

from __future__ import annotations

import cv2
import numpy as np

from tests.rendered_room import look_at
from warp_ar.scene import Camera, Pose, Proxy
from warp_ar.scene.geometry import rotation_matrix

ACROSS = 2
"""Rays per pixel along each side."""


def _grain(rng, points):
    """Wood along x: linear RGB at points (..., 2) of the desk, metres."""
    rough = cv2.GaussianBlur(rng.normal(0, 1, (1024, 256)).astype(np.float32), (0, 0), sigmaX=20, sigmaY=1.2)
    rough /= rough.std()
    at = ((points + 1.0) * (120.0, 500.0) % (255, 1023)).astype(np.float32)
    value = cv2.remap(rough, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    base, dark = rng.uniform(0.12, 0.5), rng.uniform(0.1, 0.25)
    wood = base * np.array([1.0, rng.uniform(0.6, 0.9), rng.uniform(0.35, 0.8)])
    return wood * np.exp(dark * value)[..., None]


def _enter(box, origin, direction):
    """Where rays (..., 3) enter a box: distance (infinite where they miss), axis, and the point in its own frame."""
    turn = rotation_matrix(box.rotate)
    o, d = (origin - np.array(box.at)) @ turn, direction @ turn
    half = np.array(box.size) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        near = (-np.sign(d) * half - o) / d
        far = (np.sign(d) * half - o) / d
    near = np.where(np.isfinite(near), near, -np.inf)
    axis = near.argmax(-1)
    enters = near.max(-1)
    hit = (enters < np.nanmin(far, -1)) & (enters > 1e-6)
    return np.where(hit, enters, np.inf), axis, o + np.where(hit, enters, 0.0)[..., None] * d


def _distance(box, origin, direction):
    """As ``_enter``, the distance alone: most rays miss the sphere around the box, and need not be asked further."""
    to = np.array(box.at) - origin
    along = np.einsum("...k,...k", to, direction)
    aside = np.einsum("...k,...k", to, to) - along**2
    radius = 1.01 * np.linalg.norm(box.size) / 2
    near = (aside < radius**2) & (along > -radius)
    found = np.full(near.shape, np.inf)
    found[near] = _enter(box, origin[near], direction[near])[0]
    return found


def _print(rng, box, axis, local):
    """Linear RGB of a box's faces: a colour, with a band and some lines of another on each."""
    color = rng.uniform(0.04, 0.6, 3)
    other = np.clip(color * rng.uniform(0.3, 2.5, 3), 0.02, 0.8)
    share = local / np.array(box.size) + 0.5
    up = np.where(axis == 2, share[..., 1], share[..., 2])
    low, high = rng.uniform(0.1, 0.4), rng.uniform(0.6, 0.9)
    band = (up > low) & (up < high) & (axis != 2)
    lines = (np.abs(up - rng.uniform(0.92, 0.97)) < 0.015) & (axis != 2)
    return np.where((band | lines)[..., None], other, color)


def photograph_boxes(boxes: list[Proxy], camera: Camera, pose: Pose, seed: int, exposure: float = 1.0):
    """An RGB frame, uint8, of boxes that stand on z = 0."""
    rng = np.random.default_rng(seed)
    height, width = camera.height, camera.width
    sub = (np.arange(ACROSS) + 0.5) / ACROSS - 0.5
    y, x = ((np.arange(n)[:, None] + sub).reshape(-1) for n in (height, width))
    pixels = np.stack(np.meshgrid(x, y), -1)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-9)
    flat = cv2.undistortPoints(
        pixels.reshape(-1, 1, 2), camera.matrix(), np.array(camera.distortion), criteria=criteria
    )
    flat = flat.reshape(*pixels.shape)
    d = np.concatenate([flat, np.ones((*flat.shape[:2], 1))], -1) @ pose.rotation
    eye = -pose.rotation.T @ pose.translation
    with np.errstate(divide="ignore"):
        desk = np.where(d[..., 2] < 0, -eye[2] / d[..., 2], 30.0)
    desk = np.minimum(desk, 30.0)
    nearest, points = desk, eye + desk[..., None] * d
    color = _grain(rng, points[..., :2])
    normal = np.broadcast_to(np.array([0.0, 0.0, 1.0]), d.shape)
    on = np.full(nearest.shape, -1)
    for number, box in enumerate(boxes):
        t, axis, local = _enter(box, eye, d)
        painted = _print(rng, box, axis, local)
        first = t < nearest
        nearest = np.where(first, t, nearest)
        points = np.where(first[..., None], eye + np.where(first, t, 0.0)[..., None] * d, points)
        own = np.eye(3)[axis] * np.sign(np.take_along_axis(local, axis[..., None], -1))
        normal = np.where(first[..., None], own @ rotation_matrix(box.rotate).T, normal)
        color, on = np.where(first[..., None], painted, color), np.where(first, number, on)
    turn, tilt = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 1.2)
    lamp = 1.2 * np.array([np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), np.sin(tilt)])
    lit, outside = np.zeros(nearest.shape), points + 1e-5 * normal
    # Some points of a lamp as large as a hand: its shadows are soft.
    for spot in lamp + rng.normal(0, 0.04, (6, 3)):
        way = spot - points
        far = np.linalg.norm(way, axis=-1)
        way = way / far[..., None]
        seen = np.ones(nearest.shape, bool)
        for number, box in enumerate(boxes):
            seen &= (on == number) | (_distance(box, outside, way) > far)
        lit += seen * np.clip((way * normal).sum(-1), 0, None) / 6
    light = rng.uniform(0.25, 0.5) * (0.75 + 0.25 * normal[..., 2]) + lit
    linear = (color * light[..., None]).reshape(height, ACROSS, width, ACROSS, 3).mean((1, 3)) * exposure
    codes = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.clip(linear, 0, 1) ** (1 / 2.4) - 0.055)
    image = cv2.GaussianBlur(255 * codes, (0, 0), 0.6) + rng.normal(0, 2, linear.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def random_boxes(rng, count: int) -> list[Proxy]:
    """Boxes that stand apart on the desk."""
    found: list[Proxy] = []
    while len(found) < count:
        size = tuple(rng.uniform(low, high) for low, high in ((0.06, 0.2), (0.04, 0.12), (0.03, 0.14)))
        x, y = rng.uniform(-0.2, 0.2), rng.uniform(-0.08, 0.22)
        reach = np.hypot(*size[:2]) / 2
        if all(np.hypot(x - b.at[0], y - b.at[1]) > reach + np.hypot(*b.size[:2]) / 2 + 0.03 for b in found):
            found.append(Proxy("box", at=(x, y, size[2] / 2), rotate=(0.0, 0.0, rng.uniform(-180, 180)), size=size))
    return found


def random_boxes_seen(seed: int):
    """A picture of two boxes, the boxes, the camera and its pose."""
    rng = np.random.default_rng(seed)
    boxes, focal = random_boxes(rng, 2), rng.uniform(500, 760)
    camera = Camera(640, 480, focal, focal, 319.5, 239.5, (rng.uniform(-0.12, 0.02), 0.0, 0.0, 0.0, 0.0))
    turn = np.radians(rng.uniform(-130, -50))
    far, high = rng.uniform(0.55, 0.85) * focal / 620, rng.uniform(0.2, 0.6)
    eye = np.array([far * np.cos(turn), 0.05 + far * np.sin(turn), high])
    pose = Pose(*look_at(eye, np.array([0.0, 0.06, 0.02])))
    return photograph_boxes(boxes, camera, pose, seed, rng.uniform(0.35, 1.3)), boxes, camera, pose
