"""Render the clips of the bundled scenes with Mitsuba 3, and path-traced truth for them.

    python scenes/make_clips.py [--clip desk] [--variant cuda_ad_rgb] [--frames N] [--spp 512] [--out scenes/clips]
    python scenes/make_clips.py --truth FOLDER [--scene torus] [--frames N]
    python scenes/make_clips.py --bundle [--scene torus] [--spp 512]

A clip is what a camera would have seen: one environment, one desk, a printed marker, a mirror ball, and clutter that no
scene file mentions. Everything is made here, in code: geometry, textures, light. Radiance is in camera values
throughout (1 clips), so no exposure is applied: a frame is clipped at 1, sRGB-encoded and rounded to 8 bit.

The virtual objects are never in a clip. ``--truth`` reads them from the scene file and renders the same frames with the
objects, the lights, or both, really there; also the frames at half the exposure and the light arriving at the ball's
centre. ``--bundle`` writes one frame of each scene as ``truth/SCENE_NNNN.png``, transparent wherever the virtual
objects (or the clipping that a shorter exposure undoes) change nothing: what ``warp_ar.tradeoff`` compares pictures
with.

Needs the extra ``assets``. ``cuda_ad_rgb`` takes about a second per frame; ``llvm_ad_rgb`` works on any CPU, slowly,
and wants LLVM 19 (DRJIT_LIBLLVM_PATH names the library; 16 and 22 do not compile the scene ``torus``). Open Image
Denoise takes off the last noise.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import pathlib
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import av
import cv2
import mitsuba as mi
import numpy as np
import pyoidn
from make_teapot import write_ply

HERE = pathlib.Path(__file__).resolve().parent
WIDTH, HEIGHT, FOCAL, FPS = 640, 480, 640.0, 24
TABLE = -0.0004
"""Height of the table's top: the marker is printed on a card 0.4 mm thick, and its face is z = 0."""
MARKER, CARD, PAPER, INK = 0.08, 0.12, 0.85, 0.04
"""Side of the marker and of its card in metres; reflectance of paper and ink."""
BALL, BALL_RADIUS, BALL_REFLECTANCE = (-0.12, 0.03, 0.0346), 0.035, (0.85, 0.85, 0.87)
PROXY = {"at": (0.0, 0.21, 0.0446), "size": (0.2, 0.075, 0.09), "turn": 9.0}
"""The tea tin behind the marker, which the scene files model as a box."""
ENVIRONMENT = {"x": (-1.7, 2.3), "y": (-2.6, 0.85), "z": (-0.74, 1.75)}

PATH = {"type": "path", "max_depth": 8, "rr_depth": 4}
"""Path tracing up to seven bounces: what more would add is below a grey level in an environment this bright."""
GUIDE_SPP = 32
"""Samples per pixel of the albedo and the normals that guide the denoiser: they need to resolve edges, not light."""

Dict = dict[str, Any]


# ---- small geometry ------------------------------------------------------------------------------


def turned(at: tuple[float, ...] = (0, 0, 0), turn: float = 0.0, size: Any = 1.0) -> mi.ScalarTransform4f:
    """Scale, turn about z by degrees, move."""
    t = mi.ScalarTransform4f()
    return t.translate(list(at)) @ t.rotate([0, 0, 1], turn) @ t.scale(size)


def box(at: tuple[float, ...], size: tuple[float, ...], bsdf: Dict, turn: float = 0.0) -> Dict:
    return {"type": "cube", "to_world": turned(at, turn, [s / 2 for s in size]), "bsdf": bsdf}


def ball(at: tuple[float, ...], radius: float, bsdf: Dict) -> Dict:
    return {"type": "sphere", "center": list(at), "radius": radius, "bsdf": bsdf}


def quad(center: Any, right: Any, up: Any, **rest: Any) -> Dict:
    """Rectangle spanned by the half sides ``right`` and ``up``; it faces along their cross product."""
    right, up = np.array(right, float), np.array(up, float)
    normal = np.cross(right, up)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, up, normal / np.linalg.norm(normal), np.array(center, float)], -1)
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f(matrix), **rest}


def grid_mesh(folder: pathlib.Path, name: str, point: np.ndarray, bsdf: Dict, to_world: Any = None) -> Dict:
    """A mesh over a grid of points ``(rows, columns, 3)`` whose columns close on themselves, smooth-shaded."""
    rows, columns = point.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    nxt = np.roll(index, -1, 1)
    a, b, c, d = index[:-1].ravel(), index[1:].ravel(), nxt[1:].ravel(), nxt[:-1].ravel()
    triangles = np.concatenate([np.stack([a, d, c], -1), np.stack([a, c, b], -1)])
    flat = point.reshape(-1, 3)
    corner = np.cross(flat[triangles[:, 1]] - flat[triangles[:, 0]], flat[triangles[:, 2]] - flat[triangles[:, 0]])
    normal = np.zeros_like(flat)
    for k in range(3):
        np.add.at(normal, triangles[:, k], corner)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    path = folder / f"{name}.ply"
    write_ply(path, flat, normal, triangles)
    shape = {"type": "ply", "filename": str(path), "bsdf": {"type": "twosided", "bsdf": bsdf}}
    return shape | ({"to_world": to_world} if to_world is not None else {})


def lathe(profile: list[tuple[float, float]], sides: int = 48, repeat: int = 4) -> np.ndarray:
    """Turn a profile of (radius, height) about z; each point is repeated nearby so that corners stay crisp."""
    points = np.array(profile, float)
    steps = [points[0]]
    for a, b in itertools.pairwise(points):
        edge = min(0.1, 0.0006 / max(float(np.linalg.norm(b - a)), 1e-9))
        steps += [a + (b - a) * t for t in (edge, *np.linspace(0, 1, repeat)[1:-1], 1 - edge)]
    radius, height = np.array([*steps, points[-1]]).T
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.concatenate(
        [radius[:, None, None] * ring, np.broadcast_to(height[:, None, None], (len(radius), sides, 1))], -1
    )


def spline(points: list[tuple[float, ...]], steps: int = 24) -> np.ndarray:
    """Catmull-Rom curve through ``points``, ``(n, 3)``."""
    p = np.array(points, float)
    p = np.concatenate([2 * p[:1] - p[1:2], p, 2 * p[-1:] - p[-2:-1]])
    t = np.linspace(0, 1, steps, endpoint=False)[:, None]
    spans = [
        0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        for a, b, c, d in zip(p[:-3], p[1:-2], p[2:-1], p[3:], strict=True)
    ]
    return np.concatenate([*spans, p[-2:-1]])


def tube(path: np.ndarray, radius: float, sides: int = 16) -> np.ndarray:
    """Rings of a tube along ``path`` ``(n, 3)``, its ends closed by a point."""
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    side = np.cross(along, np.where(np.abs(along[:, 2:3]) > 0.9, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]]))
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    up = np.cross(side, along)
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * up[:, None]
    rings = path[:, None] - radius * ring
    cap = lambda k: np.broadcast_to(path[k], (1, sides, 3))  # noqa: E731
    return np.concatenate([cap(0), rings, cap(-1)])


# ---- materials and textures ----------------------------------------------------------------------


def rgb(value: Any) -> Dict:
    return {"type": "rgb", "value": [float(v) for v in np.broadcast_to(value, 3)]}


def matte(color: Any) -> Dict:
    return {"type": "diffuse", "reflectance": color if isinstance(color, dict) else rgb(color)}


def glossy(color: Any, roughness: float, metallic: float = 0.0, specular: float = 0.5) -> Dict:
    color = color if isinstance(color, dict) else rgb(color)
    return {
        "type": "principled",
        "base_color": color,
        "roughness": roughness,
        "metallic": metallic,
        "specular": specular,
    }


def mirror(color: Any) -> Dict:
    return {"type": "conductor", "material": "none", "specular_reflectance": rgb(color)}


def texture(image: np.ndarray, filtering: str = "bilinear") -> Dict:
    """Linear RGB image; row 0 is the top of the quad that it is put on."""
    data = mi.Bitmap(np.ascontiguousarray(image[::-1], np.float32))
    return {"type": "bitmap", "bitmap": data, "raw": True, "filter_type": filtering, "wrap_mode": "clamp"}


def noise(rng: np.random.Generator, height: int, width: int, cells: tuple[int, int], octaves: int = 4) -> np.ndarray:
    """Sum of ever finer smooth noise, about -1 to 1; ``cells`` is the coarsest grid (rows, columns)."""
    total = np.zeros((height, width), np.float32)
    for k in range(octaves):
        shape = (min(cells[0] << k, height) + 1, min(cells[1] << k, width) + 1)
        coarse = rng.uniform(-1, 1, shape).astype(np.float32)
        total += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC) / 2**k
    return total


def wood(light: Any, dark: Any, seed: int, boards: int = 9, shape: tuple[int, int] = (1536, 2048)) -> np.ndarray:
    """Boards along x: growth rings stretched by the cut, fibres, pores, and a thin dark joint between boards."""
    rng = np.random.default_rng(seed)
    rows, width = shape
    height = rows // boards
    found = []
    for _ in range(boards):
        across = np.linspace(-1, 1, height, dtype=np.float32)[:, None]
        bend = noise(rng, height, width, (1, 3), 3)
        rings = 0.5 + 0.5 * np.sin(
            2 * np.pi * (rng.uniform(1.2, 2.6) * (across + rng.uniform(-1, 1)) ** 2 * 3 + 1.1 * bend)
        )
        fibre = noise(rng, height, width, (height // 6, 8), 2)
        pores = np.clip(noise(rng, height, width, (height // 3, 30), 1) - 0.6, 0, 1)
        mix = 0.42 + 0.34 * rings**1.5 + 0.10 * fibre - 0.6 * pores + rng.uniform(-0.16, 0.16)
        board = np.clip(mix, 0, 1.15)
        board[:2] *= 0.45
        found.append(board)
    mix = np.concatenate(found)
    mix = cv2.resize(mix, (width, rows))[..., None]
    return np.array(dark, np.float32) + mix * (np.array(light, np.float32) - np.array(dark, np.float32))


def card() -> np.ndarray:
    """The printed card: marker 0 of DICT_4X4_50, sharp to the pixel, ink on paper."""
    pixels = 48 * 6
    marker = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 0, pixels)
    edge = round(pixels * (CARD / MARKER - 1) / 2)
    gray = np.pad(np.where(marker > 127, PAPER, INK), edge, constant_values=PAPER)
    return np.repeat(gray[..., None], 3, -1)


def tin() -> np.ndarray:
    """Face of the tea tin: a cream band with a ring between two thin lines on sage green."""
    image = np.tile(np.array([0.16, 0.27, 0.22], np.float32), (360, 800, 1))
    cream, ink = (0.72, 0.66, 0.52), (0.12, 0.2, 0.17)
    cv2.rectangle(image, (0, 95), (800, 265), cream, -1)
    for y in (106, 254):
        cv2.line(image, (0, y), (800, y), ink, 3, cv2.LINE_AA)
    cv2.circle(image, (400, 180), 52, ink, 4, cv2.LINE_AA)
    for k in range(5):  # a leaf
        cv2.ellipse(
            image,
            (400, 190 - 4 * k),
            (30 - 4 * k, 12 + 2 * k),
            -90 + 36 * (k - 2),
            0,
            360,
            (0.22, 0.38, 0.25),
            -1,
            cv2.LINE_AA,
        )
    for x in (150, 650):
        for k in range(3):
            cv2.line(image, (x - 80, 160 + 20 * k), (x + 80, 160 + 20 * k), ink, 4 if k == 1 else 2, cv2.LINE_AA)
    cv2.line(image, (0, 38), (800, 38), (0.09, 0.16, 0.13), 3, cv2.LINE_AA)
    return image


def page() -> np.ndarray:
    """A ruled page with a few written lines."""
    rng = np.random.default_rng(5)
    image = np.full((640, 448, 3), 0.74, np.float32) * np.array([1.0, 0.98, 0.92], np.float32)
    for y in range(60, 630, 28):
        cv2.line(image, (0, y), (448, y), (0.5, 0.58, 0.68), 1, cv2.LINE_AA)
    for row in range(6):
        x, y = 46.0, 60 + 28 * row
        points = []
        while x < rng.uniform(280, 410):
            x += rng.uniform(3, 6)
            points.append((x, y - 6 + rng.uniform(-9, 5)))
            if rng.uniform() < 0.13 and len(points) > 2:
                cv2.polylines(image, [np.array(points, np.int32)], False, (0.12, 0.14, 0.24), 1, cv2.LINE_AA)
                points, x = [], x + 9
    return image


def view(seed: int) -> np.ndarray:
    """What lies behind the window: sky that brightens toward the horizon, far trees, a lawn. Mean about 1."""
    rng = np.random.default_rng(seed)
    rows, columns = 192, 192
    v = np.linspace(1, 0, rows, dtype=np.float32)[:, None, None]
    sky = np.array([0.75, 0.95, 1.25], np.float32) * v + np.array([1.35, 1.3, 1.2], np.float32) * (1 - v)
    sky = sky * (1 + 0.18 * noise(rng, rows, columns, (4, 2), 4)[..., None])
    crown = 0.3 + 0.09 * noise(rng, 1, columns, (1, 6), 4)[0]
    trees = np.array([0.22, 0.3, 0.13], np.float32) * (1 + 0.5 * noise(rng, rows, columns, (16, 16), 3)[..., None])
    image = np.where(v < crown[None, :, None], trees, sky)
    image = np.where(v < 0.14, np.array([0.45, 0.55, 0.22], np.float32), image)
    return np.clip(image, 0.02, None)


# ---- the environment and the desk -----------------------------------------------------------------------


def window(name: str, center: Any, right: Any, up: Any, radiance: np.ndarray) -> Dict:
    """A glowing view with a white frame and a cross of bars, standing a little inside the wall."""
    right, up = np.array(right, float), np.array(up, float)
    inward = np.cross(right, up) / np.linalg.norm(np.cross(right, up))
    center = np.array(center, float)
    shapes = {name: quad(center, right, up, bsdf=matte(0.0), emitter={"type": "area", "radiance": texture(radiance)})}
    white = glossy((0.75, 0.74, 0.7), 0.4)
    for k, (at, half_right, half_up) in enumerate(
        [
            (center, 0.03 * right / np.linalg.norm(right), up),
            (center + 0.2 * up, right, 0.02 * up / np.linalg.norm(up)),
            (center + right, 0.04 * right / np.linalg.norm(right), 1.06 * up),
            (center - right, 0.04 * right / np.linalg.norm(right), 1.06 * up),
            (center + up, 1.06 * right, 0.04 * up / np.linalg.norm(up)),
            (center - up, 1.06 * right, 0.05 * up / np.linalg.norm(up)),
        ]
    ):
        matrix = np.eye(4)
        matrix[:3] = np.stack([half_right, half_up, 0.03 * inward, at + 0.03 * inward], -1)
        shapes[f"{name}_bar{k}"] = {"type": "cube", "to_world": mi.ScalarTransform4f(matrix), "bsdf": white}
    return shapes


def environment(clip: str) -> Dict:
    """Walls, floor, furniture and every lamp, each at level 1; the lamps' names are keys of a clip's levels."""
    (x0, x1), (y0, y1), (z0, z1) = ENVIRONMENT["x"], ENVIRONMENT["y"], ENVIRONMENT["z"]
    cx, cy, cz, hx, hy, hz = (x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2, (x1 - x0) / 2, (y1 - y0) / 2, (z1 - z0) / 2
    plaster = matte((0.72, 0.68, 0.6))
    floor = glossy(texture(wood((0.34, 0.22, 0.13), (0.16, 0.09, 0.05), 11, 12, (1024, 1024))), 0.4)
    shapes: Dict = {
        "floor": quad((cx, cy, z0), (hx, 0, 0), (0, hy, 0), bsdf=floor),
        "ceiling": quad((cx, cy, z1), (hx, 0, 0), (0, -hy, 0), bsdf=matte((0.78, 0.77, 0.74))),
        "wall_left": quad((x0, cy, cz), (0, hy, 0), (0, 0, hz), bsdf=plaster),
        "wall_right": quad((x1, cy, cz), (0, -hy, 0), (0, 0, hz), bsdf=matte((0.5, 0.24, 0.15))),
        "wall_far": quad((cx, y1, cz), (hx, 0, 0), (0, 0, hz), bsdf=matte((0.36, 0.43, 0.42))),
        "wall_near": quad((cx, y0, cz), (-hx, 0, 0), (0, 0, hz), bsdf=plaster),
        "rug": box((0.3, -1.3, z0 + 0.006), (1.8, 1.3, 0.012), matte((0.42, 0.2, 0.16))),
        "picture_frame": box((x1 - 0.02, -0.3, 0.75), (0.03, 0.75, 0.55), matte((0.05, 0.05, 0.05))),
        "picture": quad((x1 - 0.037, -0.3, 0.75), (0, -0.33, 0), (0, 0, 0.23), bsdf=matte((0.75, 0.55, 0.22))),
        "door": box((1.55, y0 + 0.02, z0 + 1.0), (0.85, 0.05, 2.0), glossy((0.55, 0.52, 0.46), 0.4)),
        "chair_seat": box((-0.25, -1.05, -0.3), (0.46, 0.44, 0.06), matte((0.12, 0.17, 0.24)), 12),
        "chair_back": box((-0.22, -1.26, 0.05), (0.44, 0.05, 0.5), matte((0.12, 0.17, 0.24)), 12),
    }
    rng = np.random.default_rng(8)
    spines = [
        (0.45, 0.12, 0.08),
        (0.1, 0.2, 0.3),
        (0.6, 0.5, 0.3),
        (0.12, 0.24, 0.14),
        (0.68, 0.65, 0.58),
        (0.5, 0.3, 0.08),
    ]
    for shelf in range(4):  # a bookcase on the near wall
        z = -0.5 + 0.42 * shelf
        shapes[f"shelf{shelf}"] = box((-0.35, y0 + 0.14, z), (1.7, 0.28, 0.03), matte((0.3, 0.19, 0.11)))
        x = -1.17
        while x < 0.4:
            w, h = rng.uniform(0.05, 0.12), rng.uniform(0.24, 0.35)
            if rng.uniform() < 0.85:
                color = spines[rng.integers(len(spines))]
                shapes[f"spine{shelf}_{int(1000 * (x + 2))}"] = box(
                    (x + w / 2, y0 + 0.12, z + 0.015 + h / 2), (w, 0.2, h), matte(color)
                )
            x += w + 0.005

    def lamp(radiance: Any) -> Dict:
        return {"bsdf": matte(0.7), "emitter": {"type": "area", "radiance": rgb(radiance)}}

    if clip == "desk":
        shapes |= window("window", (x0 + 0.01, 0.0, 0.8), (0, 0.75, 0), (0, 0, 0.68), 10.5 * view(3))
        shapes["ceiling_lamp"] = {
            "type": "disk",
            "to_world": turned((0.75, -0.65, z1 - 0.06), 0, 0.2) @ mi.ScalarTransform4f().rotate([1, 0, 0], 180),
            **lamp(30.0 * np.array([1.0, 0.72, 0.42])),
        }
    elif clip == "wire":
        shapes |= window("window", (x0 + 0.01, 0.0, 0.8), (0, 0.75, 0), (0, 0, 0.68), 0.3 * view(3) * (0.55, 0.75, 1.2))
        shapes["table_lamp"] = ball(LAMP, 0.045, {}) | lamp(780.0 * np.array([1.0, 0.86, 0.66]))
    else:
        shapes |= window("window", (-0.55, y1 - 0.01, 0.72), (0.45, 0, 0), (0, 0, 0.66), 9.0 * view(3))
        shapes["globe"] = ball((0.2, 0.24, 0.135), 0.055, {}) | lamp(14.0 * np.array([1.0, 0.8, 0.52]))
        brass = glossy((0.75, 0.55, 0.25), 0.3, 1.0)
        shapes["globe_foot"] = {
            "type": "cylinder",
            "p0": [0.2, 0.24, TABLE],
            "p1": [0.2, 0.24, 0.014],
            "radius": 0.04,
            "bsdf": {"type": "twosided", "bsdf": brass},
        }
        shapes["globe_top"] = {"type": "disk", "to_world": turned((0.2, 0.24, 0.014), 0, 0.04), "bsdf": brass}
        shapes["globe_stem"] = {
            "type": "cylinder",
            "p0": [0.2, 0.24, 0.014],
            "p1": [0.2, 0.24, 0.09],
            "radius": 0.007,
            "bsdf": brass,
        }
    return shapes


LAMP_DIRECTION = np.array(
    [
        np.cos(np.radians(24)) * np.cos(np.radians(28)),
        np.cos(np.radians(24)) * np.sin(np.radians(28)),
        np.sin(np.radians(24)),
    ]
)
LAMP = tuple(1.5 * LAMP_DIRECTION)
"""The one lamp of the clip ``wire``, low over the table: relief throws long shadows."""


def essentials(clip: str, with_ball: bool = True) -> Dict:
    """Table, marker card, and the mirror ball."""
    if clip == "wire":
        top = matte(texture(wood((0.62, 0.53, 0.42), (0.42, 0.34, 0.25), 21, 7)))
    else:
        top = glossy(texture(wood((0.56, 0.33, 0.17), (0.27, 0.13, 0.06), 4, 7)), 0.42, specular=0.35)
    side = glossy((0.3, 0.16, 0.08), 0.5)
    shapes: Dict = {
        "table": quad((0, 0, TABLE), (0.8, 0, 0), (0, 0.6, 0), bsdf=top),
        "table_body": box((0, 0, TABLE - 0.0155), (1.6, 1.2, 0.03), side),
        "card": quad((0, 0, 0), (CARD / 2, 0, 0), (0, CARD / 2, 0), bsdf=matte(texture(card(), "nearest"))),
        "card_edge": box((0, 0, TABLE / 2 - 1e-5), (CARD, CARD, -TABLE - 2e-5), matte(PAPER)),
    }
    for k, (x, y) in enumerate([(-0.74, -0.54), (0.74, -0.54), (-0.74, 0.54), (0.74, 0.54)]):
        shapes[f"leg{k}"] = box((x, y, -0.385), (0.06, 0.06, 0.71), side)
    if with_ball:
        shapes["probe"] = ball(BALL, BALL_RADIUS, mirror(BALL_REFLECTANCE))
    return shapes


def book(name: str, at: tuple[float, float, float], size: tuple[float, float, float], turn: float, color: Any) -> Dict:
    """A closed book lying flat, its spine along its own +x side."""
    w, d, h = size
    cover = glossy(color, 0.55)
    frame = turned(at, turn)

    def part(offset: tuple[float, float, float], extent: tuple[float, float, float], bsdf: Dict) -> Dict:
        return {"type": "cube", "to_world": frame @ turned(offset, 0, [e / 2 for e in extent]), "bsdf": bsdf}

    return {
        f"{name}_low": part((0, 0, 0.00125), (w, d, 0.0025), cover),
        f"{name}_high": part((0, 0, h - 0.00125), (w, d, 0.0025), cover),
        f"{name}_spine": part((w / 2 - 0.00125, 0, h / 2), (0.0025, d, h - 0.004), cover),
        f"{name}_pages": part((-0.001, 0, h / 2), (w - 0.009, d - 0.008, h - 0.005), matte((0.7, 0.65, 0.54))),
    }


def pencil(folder: pathlib.Path, name: str, at: tuple[float, float, float], turn: float, color: Any) -> Dict:
    """A six-sided pencil lying on one of its flats."""
    lie = turned(at, turn) @ mi.ScalarTransform4f().translate([0, 0, 0.0031]).rotate([0, 1, 0], 90).rotate(
        [0, 0, 1], 30
    )
    parts = {
        "rubber": ([(0, 0), (0.0033, 0), (0.0035, 0.012)], (0.62, 0.27, 0.24), 24, 0.6, 0.0),
        "ferrule": ([(0.0036, 0.011), (0.0036, 0.024)], (0.75, 0.6, 0.3), 24, 0.3, 1.0),
        "body": ([(0.0036, 0.024), (0.0036, 0.155)], color, 6, 0.3, 0.0),
        "point": ([(0.0034, 0.155), (0.0011, 0.17)], (0.62, 0.42, 0.24), 24, 0.7, 0.0),
        "lead": ([(0.0011, 0.17), (0.0002, 0.176)], (0.06, 0.06, 0.065), 24, 0.4, 0.0),
    }
    return {
        f"{name}_{k}": grid_mesh(folder, f"{name}_{k}", lathe(profile, sides), glossy(paint, rough, metal), lie)
        for k, (profile, paint, sides, rough, metal) in parts.items()
    }


def mug(folder: pathlib.Path, at: tuple[float, float], turn: float, color: Any) -> Dict:
    """A mug with its handle toward its own +x, half full of coffee."""
    glaze = glossy(color, 0.18)
    outer = [(0, 0), (0.034, 0), (0.038, 0.004), (0.0395, 0.05), (0.0395, 0.088), (0.0385, 0.091), (0.036, 0.0905)]
    inner = [(0.0355, 0.088), (0.0355, 0.01), (0.03, 0.006), (0, 0.006)]
    grip = spline([(0.037, 0, 0.072), (0.056, 0, 0.074), (0.066, 0, 0.055), (0.06, 0, 0.031), (0.037, 0, 0.022)], 10)
    place = turned((*at, TABLE), turn)
    return {
        "mug": grid_mesh(folder, "mug", lathe(outer + inner), glaze, place),
        "mug_grip": grid_mesh(folder, "mug_grip", tube(grip, 0.0052), glaze, place),
        "coffee": {
            "type": "disk",
            "to_world": turned((*at, 0.066), 0, 0.0356),
            "bsdf": glossy((0.045, 0.02, 0.01), 0.08),
        },
    }


def plant(folder: pathlib.Path, at: tuple[float, float]) -> Dict:
    """A succulent in a clay pot."""
    clay = [
        (0, 0),
        (0.028, 0),
        (0.037, 0.055),
        (0.041, 0.055),
        (0.042, 0.07),
        (0.038, 0.07),
        (0.036, 0.058),
        (0, 0.058),
    ]
    shapes: Dict = {"pot": grid_mesh(folder, "pot", lathe(clay), matte((0.5, 0.22, 0.12)), turned((*at, TABLE)))}
    for k in range(34):
        level = k / 33  # outer leaves first, lying flat; inner ones short and upright
        tilt, length = 18 + 62 * level, 0.048 * (1 - 0.5 * level)
        lie = turned((*at, 0.064 + 0.01 * level), 137.5 * k) @ mi.ScalarTransform4f().rotate([0, 1, 0], 90 - tilt)
        place = lie @ mi.ScalarTransform4f().scale([0.45 * length, length, length])
        green = np.array([0.17, 0.3, 0.16]) * (0.75 + 0.6 * level) + (0.1 * (k % 3 == 0), 0.02 * (k % 2), 0.03)
        leaf = [(0, 0), (0.1, 0.1), (0.16, 0.3), (0.25, 0.6), (0.25, 0.75), (0.16, 0.92), (0, 1)]
        shapes[f"leaf{k}"] = grid_mesh(folder, f"leaf{k}", lathe(leaf, 20), glossy(green, 0.4), place)
    return shapes


def cable(folder: pathlib.Path, name: str, points: list[tuple[float, float]], radius: float, color: Any) -> Dict:
    """A cable lying on the table through ``points``."""
    path = spline([(x, y, TABLE + radius) for x, y in points])
    return {name: grid_mesh(folder, name, tube(path, radius), glossy(color, 0.5), None)}


def clutter(clip: str, folder: pathlib.Path) -> Dict:
    """What stands and lies on the desk. Only the tea tin of ``desk`` is known to the scene files."""
    if clip == "wire":
        wire = [
            (-0.3, -0.2),
            (-0.16, -0.1),
            (-0.02, -0.14),
            (0.08, -0.1),
            (0.14, -0.02),
            (0.2, 0.06),
            (0.16, 0.13),
            (0.07, 0.12),
            (0.06, 0.2),
            (0.2, 0.28),
        ]
        thin = [
            (0.34, -0.16),
            (0.24, -0.09),
            (0.12, -0.15),
            (0.2, -0.19),
            (0.27, -0.13),
            (0.22, -0.04),
            (0.3, 0.03),
            (0.42, 0.0),
        ]
        return cable(folder, "wire", wire, 0.0036, (0.72, 0.7, 0.66)) | cable(
            folder, "thin", thin, 0.0022, (0.55, 0.2, 0.12)
        )
    shapes = (
        mug(folder, (0.27, 0.17), -40, (0.62, 0.58, 0.5))
        if clip == "desk"
        else mug(folder, (-0.02, 0.19), 200, (0.14, 0.2, 0.3))
    )
    shapes |= plant(folder, (-0.2, 0.27) if clip == "desk" else (-0.24, 0.22))
    if clip == "desk":
        tin_sides = glossy((0.16, 0.27, 0.22), 0.35)
        at, (w, d, h) = np.array(PROXY["at"]), PROXY["size"]
        a = np.radians(PROXY["turn"])
        right, back = np.array([np.cos(a), np.sin(a), 0]), np.array([-np.sin(a), np.cos(a), 0])
        shapes["tin"] = box(PROXY["at"], PROXY["size"], tin_sides, PROXY["turn"])
        shapes["tin_face"] = quad(
            at - back * (d / 2 + 1e-4), right * w / 2, (0, 0, h / 2), bsdf=glossy(texture(tin()), 0.35)
        )
        shapes |= book("red", (-0.36, 0.13, TABLE), (0.15, 0.21, 0.024), 14, (0.42, 0.09, 0.06))
        shapes |= book("blue", (-0.365, 0.135, TABLE + 0.024), (0.13, 0.19, 0.017), -6, (0.08, 0.15, 0.28))
        shapes["pad"] = box((0.3, -0.1, TABLE + 0.003), (0.14, 0.2, 0.006), matte((0.6, 0.56, 0.48)), -14)
        a = np.radians(-14)
        shapes["pad_page"] = quad(
            (0.3, -0.1, TABLE + 0.0062),
            0.07 * np.array([np.cos(a), np.sin(a), 0]),
            0.1 * np.array([-np.sin(a), np.cos(a), 0]),
            bsdf=matte(texture(page())),
        )
        shapes |= pencil(folder, "pencil", (0.03, -0.12, TABLE), 17, (0.75, 0.42, 0.04))
        shapes |= cable(
            folder,
            "cable",
            [
                (-0.6, -0.02),
                (-0.42, -0.03),
                (-0.3, -0.1),
                (-0.2, -0.14),
                (-0.12, -0.1),
                (-0.09, -0.15),
                (-0.16, -0.21),
                (-0.28, -0.24),
            ],
            0.0026,
            (0.07, 0.07, 0.08),
        )
    else:
        shapes |= book("red", (0.33, 0.05, TABLE), (0.15, 0.21, 0.024), 24, (0.42, 0.09, 0.06))
        shapes |= pencil(folder, "pencil", (0.04, -0.13, TABLE), 12, (0.75, 0.42, 0.04))
    return shapes


# ---- clips ---------------------------------------------------------------------------------------


def ease(t: float, start: float, stop: float) -> float:
    """0 before ``start``, 1 after ``stop``, smooth between."""
    s = float(np.clip((t - start) / (stop - start), 0, 1))
    return s * s * (3 - 2 * s)


def orbit(
    azimuth: float, distance: float, height: float, target: tuple[float, float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Eye and target of a camera at ``distance`` (in the plane) and ``height``; azimuth 0 looks along +y."""
    a = np.radians(azimuth)
    return np.array([target[0] + distance * np.sin(a), target[1] - distance * np.cos(a), height]), np.array(target)


def desk_camera(t: float) -> tuple[np.ndarray, np.ndarray]:
    s = ease(t, 0, 1)
    return orbit(
        -16 + 40 * s,
        0.62 - 0.05 * np.sin(np.pi * t),
        0.42 + 0.05 * np.sin(2 * np.pi * t),
        (0.03, 0.03 - 0.01 * s, 0.025),
    )


def wire_camera(t: float) -> tuple[np.ndarray, np.ndarray]:
    return orbit(-10 + 24 * ease(t, 0, 1), 0.54, 0.46 - 0.04 * t, (0.03, 0.0, 0.0))


def darken_camera(t: float) -> tuple[np.ndarray, np.ndarray]:
    return orbit(8 - 20 * ease(t, 0, 1), 0.74, 0.4 + 0.02 * np.sin(2 * np.pi * t), (0.02, 0.08, 0.06))


@dataclass(frozen=True)
class Clip:
    """One clip: its length, its camera and how its lamps change."""

    frames: int
    """Number of frames at 24 per second."""
    camera: Callable[[float], tuple[np.ndarray, np.ndarray]]
    """Eye and target at time 0 to 1, world metres."""
    levels: Callable[[float], dict[str, float]]
    """Factor on each lamp's radiance at time 0 to 1."""


def desk_levels(t: float) -> dict[str, float]:
    """A cloud passes, dusk falls for a moment, the ceiling lamp comes up, daylight returns."""
    cloud = 1 - 0.25 * np.sin(np.pi * ease(t, 0.08, 0.3)) ** 2
    return {
        "window": cloud * (1 - 0.8 * ease(t, 0.36, 0.5) + 0.8 * ease(t, 0.82, 0.97)),
        "ceiling_lamp": ease(t, 0.46, 0.58) * (1 - 0.6 * ease(t, 0.84, 0.98)),
    }


CLIPS = {
    "desk": Clip(120, desk_camera, desk_levels),
    "wire": Clip(72, wire_camera, lambda t: {"window": 1.0, "table_lamp": 1.0}),
    "darken": Clip(72, darken_camera, lambda t: {"window": 1.0, "globe": 1.0}),
}
SCENES = {
    "desk": "desk",
    "torus": "desk",
    "mirror": "desk",
    "wire_coincident": "wire",
    "wire_opposing": "wire",
    "darken": "darken",
}
"""The clip that each bundled scene plays."""
BUNDLED = {"desk": 24, "torus": 84, "mirror": 24, "wire_coincident": 36, "wire_opposing": 36, "darken": 36}
"""Frame of each scene whose truth is bundled: daylight, ceiling lamp, daylight; the light of the others is still."""


# ---- the virtual objects of a scene file, for truth -----------------------------------------------


def leaving_share(exponent: float, count: int = 512) -> np.ndarray:
    """Share of a Phong lobe above the surface, by the cosine of the mirror direction, 0 to 1 in ``count`` steps.

    The mean over the lobe's own cosine, cos = u^(1 / (n + 1)), of the share of that cone which lies above.
    """
    cosine = ((np.arange(4096) + 0.5) / 4096) ** (1 / (exponent + 1))
    sine = np.sqrt(1 - cosine**2)
    up = np.linspace(0, 1, count)[:, None]
    # Around the mirror direction a ray rises to up * cosine + sqrt(1 - up^2) * sine * cos(turn).
    lowest = -up * cosine / np.maximum(np.sqrt(1 - up**2) * sine, 1e-9)
    return (np.arccos(np.clip(lowest, -1, 1)) / np.pi).mean(axis=1)


@functools.cache
def register_phong() -> str:
    """Name of a BSDF that is ``warp_ar.kernels.materials``' Phong; Mitsuba has none.

    Lambert's, beside a lobe of the radiance form: what is seen is the mean of what arrives, weighted by cos^n of the
    angle to the mirror direction, over the part of the lobe that leaves the surface.
    """
    import drjit as dr

    class Phong(mi.BSDF):  # type: ignore[misc]
        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.diffuse, self.specular = (mi.Color3f(props[name]) for name in ("diffuse", "specular"))
            self.exponent = props["exponent"]
            self.leaving = mi.Float(leaving_share(self.exponent).astype(np.float32))
            flags = mi.BSDFFlags.DiffuseReflection, mi.BSDFFlags.GlossyReflection
            self.m_components = [flag | mi.BSDFFlags.FrontSide for flag in flags]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def lobe(self, si: Any, wo: Any) -> Any:
            """Density of the lobe over directions that leave the surface; 0 below it."""
            mirrored = mi.reflect(si.wi)
            place = dr.maximum(mi.Frame3f.cos_theta(mirrored), 0) * (dr.width(self.leaving) - 1)
            low = dr.minimum(mi.UInt32(place), dr.width(self.leaving) - 2)
            below, above = (dr.gather(mi.Float, self.leaving, low + k) for k in (0, 1))
            share = dr.lerp(below, above, place - low)
            power = dr.power(dr.maximum(dr.dot(mirrored, wo), 0), self.exponent)
            return dr.select(mi.Frame3f.cos_theta(wo) > 0, (self.exponent + 1) / (2 * dr.pi) * power / share, 0)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any) -> Any:
            scattered = mi.warp.square_to_cosine_hemisphere(sample2)
            cosine = dr.power(sample2.x, 1 / (self.exponent + 1))
            sine, turn = dr.safe_sqrt(1 - cosine * cosine), 2 * dr.pi * sample2.y
            around = mi.Vector3f(sine * dr.cos(turn), sine * dr.sin(turn), cosine)
            glossy = sample1 < 0.5
            bs = mi.BSDFSample3f()
            bs.wo = dr.select(glossy, mi.Frame3f(mi.reflect(si.wi)).to_world(around), scattered)
            bs.pdf = self.pdf(ctx, si, bs.wo, active)
            bs.eta = 1.0
            bs.sampled_component = dr.select(glossy, mi.UInt32(1), mi.UInt32(0))
            bs.sampled_type = dr.select(
                glossy, mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            )
            active &= bs.pdf > 0
            return bs, dr.select(active, self.eval(ctx, si, bs.wo, active) / bs.pdf, 0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            active &= (mi.Frame3f.cos_theta(si.wi) > 0) & (mi.Frame3f.cos_theta(wo) > 0)
            value = self.diffuse * mi.warp.square_to_cosine_hemisphere_pdf(wo)
            return dr.select(active, value + self.specular * self.lobe(si, wo), 0)

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            active &= (mi.Frame3f.cos_theta(si.wi) > 0) & (mi.Frame3f.cos_theta(wo) > 0)
            # Not divided by the share that leaves: rays into the surface are lost, and weighted so.
            place = dr.dot(mi.reflect(si.wi), wo)
            glossy = (self.exponent + 1) / (2 * dr.pi) * dr.power(dr.maximum(place, 0), self.exponent)
            return dr.select(active, 0.5 * (glossy + mi.warp.square_to_cosine_hemisphere_pdf(wo)), 0)

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def to_string(self) -> str:
            return f"Phong[exponent={self.exponent}]"

    mi.register_bsdf("phong", Phong)
    return "phong"


def virtual_material(material: Dict) -> Dict:
    model = material["model"]
    if model == "metallic_roughness":
        return glossy(material["base_color"], material["roughness"], material["metallic"])
    if model == "phong":
        return {"type": register_phong()} | {
            "diffuse": rgb(material["diffuse"]),
            "specular": rgb(material["specular"]),
            "exponent": float(material["shininess"]),
        }
    return mirror(material["base_color"]) if model == "mirror" else matte(material["base_color"])


def virtual_object(item: Dict, folder: pathlib.Path) -> Dict:
    t = mi.ScalarTransform4f()
    rx, ry, rz = item.get("rotate", (0, 0, 0))
    place = (
        t.translate(item.get("at", [0, 0, 0]))
        @ t.rotate([0, 0, 1], rz)
        @ t.rotate([0, 1, 0], ry)
        @ t.rotate([1, 0, 0], rx)
    )
    place = place @ t.scale(item.get("scale", 1.0))
    bsdf = virtual_material(item["material"])
    if item["shape"] == "mesh":
        return {
            "type": "ply",
            "filename": str(HERE / item["file"]),
            "to_world": place,
            "bsdf": {"type": "twosided", "bsdf": bsdf},
        }
    if item["shape"] == "sphere":
        return {"type": "sphere", "to_world": place @ t.scale(item["radius"]), "bsdf": bsdf}
    if item["shape"] == "box":
        return {"type": "cube", "to_world": place @ t.scale([s / 2 for s in item["size"]]), "bsdf": bsdf}
    u, v = np.meshgrid(*(np.linspace(0, 2 * np.pi, n) for n in (193, 97)), indexing="ij")
    v = -v[:, :-1]
    u = u[:, :-1]
    ring = item["major_radius"] + item["minor_radius"] * np.cos(v)
    return grid_mesh(
        folder,
        "torus",
        np.stack([ring * np.cos(u), ring * np.sin(u), item["minor_radius"] * np.sin(v)], -1),
        bsdf,
        place,
    )


def virtual_light(light: Dict) -> Dict:
    power = rgb(np.array(light["color"]) * light["intensity"])
    if light["kind"] == "point":
        return {"type": "point", "position": light["at"], "intensity": power}
    if light["kind"] == "spot":
        aim = mi.ScalarTransform4f().look_at(origin=light["at"], target=light["target"], up=[0.1, 1, 0.2])
        return {
            "type": "spot",
            "to_world": aim,
            "intensity": power,
            "cutoff_angle": light["outer_angle"],
            "beam_width": light["inner_angle"],
        }
    raise ValueError(f"truth is not made for lights of kind {light['kind']!r}")


# ---- rendering -----------------------------------------------------------------------------------


class Renderer:
    """One Mitsuba scene whose camera and lamps move."""

    def __init__(self, clip: str, spp: int, virtual: Dict | None = None, with_ball: bool = True) -> None:
        self.clip, self.spp = clip, spp
        with tempfile.TemporaryDirectory() as name:
            folder = pathlib.Path(name)
            content = environment(clip) | essentials(clip, with_ball) | clutter(clip, folder)
            for k, item in enumerate((virtual or {}).get("object", [])):
                content[f"object{k}"] = virtual_object(item, folder)
            for k, light in enumerate((virtual or {}).get("light", [])):
                content[f"light{k}"] = virtual_light(light)
            self.scene = mi.load_dict({"type": "scene", **content})
        self.integrator = mi.load_dict(PATH)
        self.guides = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
        self.lamps = mi.traverse(self.scene)
        self.base = {}
        for lamp in CLIPS[clip].levels(0.0):
            key = next(
                k for k in (f"{lamp}.emitter.radiance.data", f"{lamp}.emitter.radiance.value") if k in self.lamps
            )
            self.base[lamp] = (key, type(self.lamps[key])(self.lamps[key]))

    def light(self, t: float) -> None:
        """Set every lamp to its level at time ``t``."""
        for lamp, level in CLIPS[self.clip].levels(t).items():
            key, value = self.base[lamp]
            self.lamps[key] = value * float(level)
        self.lamps.update()

    def frame(self, t: float, seed: int) -> np.ndarray:
        """Linear camera values ``(HEIGHT, WIDTH, 3)`` at time ``t``."""
        self.light(t)
        eye, target = CLIPS[self.clip].camera(t)
        sensor = mi.load_dict(
            {
                "type": "perspective",
                "fov": float(np.degrees(2 * np.arctan(WIDTH / 2 / FOCAL))),
                "fov_axis": "x",
                "near_clip": 0.01,
                "to_world": mi.ScalarTransform4f().look_at(origin=list(eye), target=list(target), up=[0, 0, 1]),
                "film": {
                    "type": "hdrfilm",
                    "width": WIDTH,
                    "height": HEIGHT,
                    "pixel_format": "rgb",
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": "independent"},
            }
        )
        color = mi.render(self.scene, sensor=sensor, integrator=self.integrator, spp=self.spp, seed=seed)
        guides = np.array(mi.render(self.scene, sensor=sensor, integrator=self.guides, spp=GUIDE_SPP, seed=seed))
        albedo, normal = np.clip(guides[..., -6:-3], 0, 1), guides[..., -3:]
        return pyoidn.denoise(np.array(color), albedo=albedo, normal=np.ascontiguousarray(normal), hdr=True)

    def environment(self, t: float, height: int = 256, rounds: int = 64) -> np.ndarray:
        """Light arriving at the ball's centre, latlong ``(height, 2 height, 3)``; render it without the ball."""
        import drjit as dr

        self.light(t)
        integrator = mi.load_dict(PATH)
        count = height * height * 2
        total = np.zeros((count, 3))
        sampler = mi.load_dict({"type": "independent"})
        per_round = max(1, self.spp // rounds) if self.spp >= rounds else 1
        index = dr.arange(mi.UInt32, count * per_round) // per_round
        for k in range(min(rounds, self.spp)):
            sampler.seed(1000 + k, count * per_round)
            row = mi.Float(index // (2 * height)) + sampler.next_1d()
            column = mi.Float(index % (2 * height)) + sampler.next_1d()
            theta, phi = dr.pi * row / height, (column / height - 1) * dr.pi
            direction = mi.Vector3f(dr.sin(theta) * dr.cos(phi), dr.sin(theta) * dr.sin(phi), dr.cos(theta))
            rays = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(*BALL), direction))
            radiance, _, _ = integrator.sample(self.scene, sampler, rays)
            total += np.array(radiance).T.reshape(count, per_round, 3).mean(1)
        return (total / min(rounds, self.spp)).reshape(height, 2 * height, 3).astype(np.float32)


def encode(linear: np.ndarray) -> np.ndarray:
    """Clip at 1, sRGB-encode, round to 8 bit."""
    x = np.clip(linear, 0, 1)
    return np.round(np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055) * 255).astype(np.uint8)


def pose(clip: str, t: float) -> tuple[np.ndarray, np.ndarray]:
    """R and t that map marker-frame points X to camera points R X + t (OpenCV: x right, y down, z ahead)."""
    eye, target = CLIPS[clip].camera(t)
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    return rotation, -rotation @ eye


def write_video(path: pathlib.Path, images: Iterator[np.ndarray], crf: int) -> None:
    """H.264, 4:2:0, BT.709, every second a key frame."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.options = {"crf": str(crf), "preset": "veryslow", "g": str(FPS)}
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))


def times(clip: str, frames: int | None) -> list[float]:
    """Times 0 to 1 of a clip's frames, all of them or ``frames`` spread evenly."""
    count = frames or CLIPS[clip].frames
    return [k / max(1, count - 1) for k in range(count)]


def make_clip(clip: str, options: argparse.Namespace) -> None:
    """Render one clip to ``OUT/CLIP.mp4``, and single frames as PNG if asked."""
    renderer = Renderer(clip, options.spp)
    started, moments = time.time(), times(clip, options.frames)
    images = []
    for k, t in enumerate(moments):
        images.append(encode(renderer.frame(t, k)))
        if options.stills and k % options.stills == 0:
            cv2.imwrite(str(options.out / f"{clip}_{k:04d}.png"), images[-1][..., ::-1])
    path = options.out / f"{clip}.mp4"
    write_video(path, iter(images), options.crf)
    print(f"{path}: {len(moments)} frames, {path.stat().st_size} bytes, {time.time() - started:.1f} s", flush=True)


def make_truth(name: str, options: argparse.Namespace) -> None:
    """Frames first, middle and last of a scene with its virtual objects really there, under ``TRUTH/NAME``."""
    clip = SCENES[name]
    scene = tomllib.loads((HERE / f"{name}.toml").read_text())
    moments = times(clip, options.frames)
    chosen = sorted({0, len(moments) // 2, len(moments) - 1})
    folder = options.truth / name
    objects, lights = scene.get("object", []), scene.get("light", [])
    versions = {"camera": {}}
    versions |= {"object": {"object": objects}} if objects else {}
    versions |= {"light": {"light": lights}} if lights else {}
    versions |= {"both": {"object": objects, "light": lights}} if objects and lights else {}
    for version, virtual in versions.items():
        renderer = Renderer(clip, options.spp, virtual)
        for k in chosen:
            linear = renderer.frame(moments[k], 5000 + k)
            for place, scale in ((version, 1.0),) + ((("dark_50", 0.5),) if version == "camera" else ()):
                (folder / place).mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(folder / place / f"{k:04d}.png"), encode(linear * scale)[..., ::-1])
    renderer = Renderer(clip, options.spp, with_ball=False)
    (folder / "env").mkdir(exist_ok=True)
    for k in chosen:
        np.save(folder / "env" / f"{k:04d}.npy", renderer.environment(moments[k]).astype(np.float16))
    poses = [
        dict(zip(("R", "t"), (p.tolist() for p in pose(clip, t)), strict=True)) | {"frame": k}
        for k, t in enumerate(moments)
    ]
    levels = [CLIPS[clip].levels(t) for t in moments]
    case = {
        "name": name,
        "clip": clip,
        "frames": len(moments),
        "truth_frames": chosen,
        "dark": [0.5],
        "poses": poses,
        "levels": levels,
    }
    (folder / "case.json").write_text(json.dumps(case, indent=1))
    print(f"{folder}: frames {chosen}", flush=True)


def bundle_truth(name: str, options: argparse.Namespace) -> None:
    """One frame of a scene as it should look, opaque where that differs from the camera's frame."""
    clip, index = SCENES[name], BUNDLED[name]
    scene = tomllib.loads((HERE / f"{name}.toml").read_text())
    moment, scale = times(clip, None)[index], scene.get("exposure", {}).get("scale", 1.0)
    virtual = {kind: scene.get(kind, []) for kind in ("object", "light")}
    camera = Renderer(clip, options.spp).frame(moment, 5000 + index)
    plain = encode(camera)
    if scale == 1.0:
        truth = encode(Renderer(clip, options.spp, virtual).frame(moment, 5000 + index))
        # As warp_ar.accuracy.metrics.changed_region, but finer and wider: faint shadows and light end softly.
        difference = np.abs(truth.astype(np.float32) - plain).max(-1) / 255
        region, reach = cv2.GaussianBlur(difference, (0, 0), 3.0) > 0.01, 15
    else:
        truth, region, reach = encode(camera * scale), (plain >= 254).any(-1), 5
    alpha = cv2.dilate(region.astype(np.uint8) * 255, np.ones((reach, reach), np.uint8))
    path = HERE / "truth" / f"{name}_{index:04d}.png"
    path.parent.mkdir(exist_ok=True)
    picture = np.where(alpha[..., None] > 0, truth, 0)[..., ::-1]
    cv2.imwrite(str(path), np.concatenate([picture, alpha[..., None]], -1), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(f"{path}: {(alpha > 0).mean():.1%} of the picture, {path.stat().st_size} bytes", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variant", default="cuda_ad_rgb", help="Mitsuba variant: cuda_ad_rgb or llvm_ad_rgb")
    parser.add_argument("--clip", action="append", choices=sorted(CLIPS), help="clip to render (default: all)")
    parser.add_argument(
        "--scene",
        action="append",
        choices=sorted(SCENES),
        help="with --truth or --bundle: scene to render (default: all)",
    )
    parser.add_argument("--frames", type=int, help="render this many frames, spread over the clip's whole motion")
    parser.add_argument("--spp", type=int, default=512, help="samples per pixel (default 512)")
    parser.add_argument("--crf", type=int, default=17, help="quality of H.264, lower is better (default 17)")
    parser.add_argument("--stills", type=int, default=0, help="also write every so many frames as PNG")
    parser.add_argument("--out", type=pathlib.Path, default=HERE / "clips", help="folder of the clips")
    parser.add_argument("--truth", type=pathlib.Path, help="render truth into this folder instead of clips")
    parser.add_argument("--bundle", action="store_true", help="render the truth that is bundled instead of clips")
    options = parser.parse_args()
    mi.set_variant(options.variant)
    if options.bundle:
        for name in options.scene or SCENES:
            bundle_truth(name, options)
        return
    if options.truth:
        for name in options.scene or SCENES:
            make_truth(name, options)
        return
    options.out.mkdir(parents=True, exist_ok=True)
    for clip in options.clip or CLIPS:
        make_clip(clip, options)


if __name__ == "__main__":
    main()
