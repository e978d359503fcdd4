"""Random tables with known light, each with a scene file that describes them more or less correctly."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.environments import made_up_environment
from bench.table_world import FINE, Block, Bulb, Card, World, latlong_directions

Array = NDArray[np.float64]
SIZE = (480, 360)
"""Width and height of pictures."""
SUPERSAMPLING = 2
"""Number of rays along each side of a pixel."""
MARKER = 0.08
"""Side of the marker's black square, metres."""
NAMES = ("city", "courtyard", "forest", "interior", "night", "studio", "sunrise", "sunset")
"""Names of environments in WARP_AR_SHARED/hdri; a generated one replaces those that are missing."""


@dataclasses.dataclass
class Setup:
    """Picture of a table, its true light, and the scene file for the program."""

    image: NDArray[np.uint8]
    """Picture, RGB (height, width, 3)."""
    truth: Array
    """True radiance that arrives at the ball's centre, in units of the camera's clipping, (64, 128, 3)."""
    scene: str
    """Text of the scene file."""
    rotation: Array
    """Rotation of ``camera_from_world``, (3, 3)."""
    translation: Array
    """Translation of ``camera_from_world``, metres, (3,)."""
    about: dict[str, Any]
    """Properties of the table and errors of the scene file."""


def load_environment(rng: np.random.Generator) -> tuple[str, NDArray[np.float32]]:
    """Return the name and the radiance of a random environment, rotated about the vertical by a random angle."""
    name, folder = str(rng.choice(NAMES)), Path(os.environ.get("WARP_AR_SHARED", ""), "hdri")
    image = made_up_environment(FINE[0])
    if (folder / f"{name}.exr").is_file():
        import OpenEXR

        image = np.array(OpenEXR.File(str(folder / f"{name}.exr")).channels()["RGB"].pixels, np.float32)
    else:
        name = "made up"
    image = np.maximum(cv2.resize(image, FINE[::-1], interpolation=cv2.INTER_AREA), 0.0)
    return name, np.roll(image, int(rng.integers(FINE[1])), axis=1).copy()


def make_setup(seed: int) -> Setup:
    """Return the set-up for a seed."""
    rng = np.random.default_rng(seed)
    name, environment = load_environment(rng)
    radius = float(rng.choice([0.03, 0.04, 0.05, 0.075]))
    turn, off = rng.uniform(0.0, 2.0 * np.pi), radius + 0.06 + rng.uniform(0.01, 0.1)
    ball = np.array([off * np.cos(turn), 0.6 * off * np.sin(turn), radius])
    eye, rotation, focal = _choose_camera(rng, ball, radius)
    half = rng.uniform([0.4, 0.35], [1.2, 1.0])
    kind = str(rng.choice(["true", "none", "grey", "tinted"], p=[0.4, 0.35, 0.17, 0.08]))
    texture, amplitude = _choose_texture(rng)
    blocks, wall = _choose_blocks(rng, ball, radius, eye, half)
    bulbs = _choose_bulbs(rng, environment, ball, eye, wall)
    reflectance = float(rng.uniform(0.5, 0.95))
    world = World(environment, (ball, radius, reflectance), blocks, bulbs, (texture, half), _choose_card(rng, kind))
    image, exposure, camera = _photograph(rng, world, eye, rotation, focal)
    told_radius = radius * (1.0 if rng.random() < 0.7 else rng.uniform(0.93, 1.07))
    told_reflectance = min(reflectance * (1.0 if rng.random() < 0.7 else rng.uniform(0.85, 1.15)), 1.0)
    d, _ = latlong_directions(*FINE)
    seen = world.trace(ball, d.reshape(-1, 3), ball=False).reshape(64, 4, 128, 4, 3)
    about = {
        "seed": seed,
        "environment": name,
        "card": kind,
        **camera,
        "texture": amplitude,
        "blocks": len(blocks),
        "wall": wall,
        "lamps": len(bulbs),
        "pixels": 2.0 * radius * focal / float(np.linalg.norm(eye - ball)),
        "told": (told_radius / radius, told_reflectance / reflectance),
    }
    scene = _describe(focal, ball, told_radius, told_reflectance, half, blocks)
    return Setup(image, exposure * seen.mean((1, 3)), scene, rotation, -rotation @ eye, about)


def _choose_camera(rng: np.random.Generator, ball: Array, radius: float) -> tuple[Array, Array, float]:
    """Return the camera's position, its rotation ``camera_from_world``, and its focal length in pixels.

    The ball is 30 to 300 pixels wide in a picture of 640.
    """
    elevation, azimuth = np.radians(rng.uniform(12.0, 60.0)), rng.uniform(-0.7, 0.7) - np.pi / 2
    target = ball * rng.uniform(0.3, 0.9)
    target[2] = 0.02
    away = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    eye = target + rng.uniform(0.35, 0.9) * away
    across = np.exp(rng.uniform(np.log(30.0), np.log(300.0)))
    focal = float(np.clip(0.5 * across / radius * np.linalg.norm(eye - ball), 450.0, 3840.0)) * SIZE[0] / 640
    x = np.cross(-away, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return eye, np.stack([x, np.cross(-away, x), -away]), focal


def _choose_texture(rng: np.random.Generator, size: int = 512) -> tuple[NDArray[np.float32], float]:
    """Return a random texture of a table, (size, size, 3), and the strength of its pattern.

    The texture holds reflectances. The strength is about the standard deviation of their logarithm; 0 means one colour.
    """
    amplitude = float(rng.choice([0.0, 0.05, 0.15, 0.35]))
    noise = np.zeros((size, size), np.float32)
    for scale in (4, 16, 64):
        coarse = rng.standard_normal((size // scale, size // scale)).astype(np.float32)
        noise += cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC) / 1.7
    color = rng.uniform(0.08, 0.7) * (1.0 + 0.25 * rng.uniform(-1.0, 1.0, 3))
    return np.clip(color * np.exp(amplitude * noise)[..., None], 0.02, 0.9).astype(np.float32), amplitude


def _choose_card(rng: np.random.Generator, kind: str) -> Card | None:
    """Return a card of a kind: ``true`` (as white as the scene states), ``grey``, ``tinted``, or ``none``."""
    if kind == "none":
        return None
    pattern = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 0, 120)
    white = {
        "true": np.full(3, 0.85),
        "grey": np.full(3, rng.uniform(0.3, 0.65)),
        "tinted": np.array([0.85, 0.8, 0.65]),
    }
    printed = np.pad(np.asarray(pattern, np.uint8), 30, constant_values=255)
    return Card(printed, 0.75 * MARKER, white[kind], float(rng.uniform(0.03, 0.06)))


def _choose_blocks(
    rng: np.random.Generator, ball: Array, radius: float, eye: Array, half: Array
) -> tuple[list[Block], bool]:
    """Return boxes, some of which are not modelled, and True if there is a wall behind the ball.

    No box is in front of the ball or the card.
    """
    blocks: list[Block] = []
    toward = (eye - ball)[:2] / np.linalg.norm((eye - ball)[:2])
    side = np.array([-toward[1], toward[0]])

    def place(modelled: bool) -> None:
        for _ in range(30):
            size = rng.uniform([0.03, 0.03, 0.03], [0.2, 0.2, 0.22])
            at, reach = rng.uniform(-0.8 * half, 0.8 * half), float(np.hypot(size[0], size[1])) / 2
            free = np.linalg.norm(at - ball[:2]) > reach + radius + 0.02 and np.abs(at).max() > 0.07 + 0.8 * reach
            free &= np.linalg.norm(at - eye[:2]) > reach + 0.1
            for middle, wide in ((ball[:2], radius), (np.zeros(2), 0.06)):
                free &= not ((at - middle) @ toward > 0.0 and abs((at - middle) @ side) < reach + wide)
            if free:
                color = rng.uniform(0.03, 0.8) * (1.0 + 0.3 * rng.uniform(-1.0, 1.0, 3))
                turn = float(rng.uniform(0.0, 90.0))
                blocks.append(Block(np.array([*at, size[2] / 2]), size, turn, np.minimum(color, 0.95), modelled))
                return

    if rng.random() < 0.45:
        place(True)
    for _ in range(int(rng.choice([0, 0, 1, 2, 4]))):
        place(False)
    wall = bool(rng.random() < 0.3)
    if wall:
        middle = np.array([*(ball[:2] - (rng.uniform(0.3, 0.8) + 0.05) * toward), 0.7])
        turn = float(np.degrees(np.arctan2(-toward[1], -toward[0])))
        blocks.append(Block(middle, np.array([0.1, 4.0, 3.0]), turn, np.full(3, rng.uniform(0.2, 0.8)), False))
    return blocks, wall


def _choose_bulbs(
    rng: np.random.Generator, environment: NDArray[np.float32], ball: Array, eye: Array, wall: bool
) -> list[Bulb]:
    """Return lamps, of which about a third are in directions that the ball does not show; none is behind a wall."""
    area = latlong_directions(*FINE)[1]
    mean = float((environment * area[..., None]).sum((0, 1)).mean() / (4.0 * np.pi))
    bulbs = []
    for _ in range(int(rng.choice([0, 0, 0, 1, 1, 2]))):
        unseen = rng.random() < 0.3
        d = rng.standard_normal(3)
        if unseen:
            d = (ball - eye) / np.linalg.norm(ball - eye) + 0.15 * d
        d[2] = 0.3 * abs(d[2]) + 0.1 if unseen else abs(d[2]) + 0.3
        d /= np.linalg.norm(d)
        distance, radius = rng.uniform(0.4, 2.0), float(rng.uniform(0.01, 0.05))
        irradiance = rng.uniform(0.1, 1.2) * np.pi * mean * (1.0 + 0.3 * rng.uniform(-1.0, 1.0, 3))
        if not (wall and unseen):
            bulbs.append(Bulb(ball + distance * d, radius, irradiance * distance**2 / (np.pi * radius**2)))
    return bulbs


def _photograph(
    rng: np.random.Generator, world: World, eye: Array, rotation: Array, focal: float
) -> tuple[NDArray[np.uint8], float, dict[str, Any]]:
    """Return a picture of the table, its exposure, and the properties of the camera."""
    (width, height), many = SIZE, SUPERSAMPLING
    u, v = np.meshgrid((np.arange(width * many) + 0.5) / many - 0.5, (np.arange(height * many) + 0.5) / many - 0.5)
    d = np.stack([(u - (width - 1) / 2) / focal, (v - (height - 1) / 2) / focal, np.ones_like(u)], -1).reshape(-1, 3)
    d = d @ rotation
    linear = world.trace(eye, d / np.linalg.norm(d, axis=1, keepdims=True))
    linear = linear.reshape(height, many, width, many, 3).mean((1, 3))
    exposure = float(rng.uniform(0.15, 0.8) / np.percentile(linear.mean(-1), rng.uniform(60.0, 90.0)))
    response = ("srgb", "gamma", "curve")[int(rng.choice(3, p=[0.6, 0.3, 0.1]))]
    value = float(rng.uniform(1.8, 2.6) if response == "gamma" else rng.uniform(2.0, 4.0))
    exposed = exposure * linear
    exposed += 0.003 * np.sqrt(np.maximum(exposed, 0.0) + 0.02) * rng.standard_normal(exposed.shape)
    codes = 255.0 * _encode(np.clip(exposed, 0.0, 1.0), response, value)
    top = int(rng.choice([255, 238], p=[0.8, 0.2]))
    codes = np.minimum(codes, top) if rng.random() < 0.5 else codes * top / 255.0
    image = np.round(codes).astype(np.uint8)
    quality = int(rng.choice([0, 92], p=[0.7, 0.3]))
    if quality:
        packed = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        image = np.ascontiguousarray(cv2.imdecode(packed, cv2.IMREAD_COLOR)[..., ::-1])
    about = {"response": response, "value": value, "top": top, "jpeg": quality}
    return image, exposure, about


def _encode(x: Array, response: str, value: float) -> Array:
    """Return the encoded values of linear ones, both 0 to 1.

    Args:
        x: Linear values.
        response: ``srgb``, ``gamma`` or ``curve`` (an S-shaped curve after sRGB).
        value: Exponent of ``gamma``, or steepness of ``curve``.
    """
    if response == "gamma":
        return np.asarray(x ** (1.0 / value))
    y = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1.0 / 2.4) - 0.055)
    if response == "curve":
        ends = 1.0 / (1.0 + np.exp(value * 0.5)), 1.0 / (1.0 + np.exp(-value * 0.5))
        y = (1.0 / (1.0 + np.exp(-value * (y - 0.5))) - ends[0]) / (ends[1] - ends[0])
    return np.asarray(y)


def _describe(focal: float, ball: Array, radius: float, reflectance: float, half: Array, blocks: list[Block]) -> str:
    """Return the text of the scene file, with the numbers that it states."""
    width, height = SIZE
    parts = [
        f"schema = 1\n[camera]\nwidth = {width}\nheight = {height}\nfx = {focal}\nfy = {focal}\n"
        f'cx = {(width - 1) / 2}\ncy = {(height - 1) / 2}\ntransfer = "srgb"\n'
        f'[marker]\ndictionary = "DICT_4X4_50"\nid = 0\nsize = {MARKER}\n'
        f"[probe]\ncenter = {ball.tolist()}\nradius = {radius}\nreflectance = {[reflectance] * 3}\n"
        f'[[proxy]]\nshape = "plane"\nsize = {(2.0 * half).tolist()}\n'
    ]
    parts += [
        f'[[proxy]]\nshape = "box"\nat = {block.at.tolist()}\nsize = {block.size.tolist()}\n'
        f"rotate = [0.0, 0.0, {block.turn}]\n"
        for block in blocks
        if block.modelled
    ]
    return "".join(parts)
