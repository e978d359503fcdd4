"""Geometry, materials and lamps of the bundled clips: a furnished room, the desk, and clutter on it."""

from __future__ import annotations

import pathlib
from typing import Any

import mitsuba as mi
import numpy as np
from make_shapes import (
    Dict,
    ball,
    box,
    glossy,
    grid_mesh,
    lathe,
    matte,
    mirror,
    quad,
    rgb,
    spline,
    texture,
    tube,
    turned,
)
from make_textures import CARD, PAPER, card, page, tin, view, wood

TABLE = -0.0004
"""Height of the table top, metres: the marker is printed on a card of 0.4 mm, whose upper face is z = 0."""
BALL, BALL_RADIUS, BALL_REFLECTANCE = (-0.12, 0.03, 0.0346), 0.035, (0.85, 0.85, 0.87)
PROXY = {"at": (0.0, 0.21, 0.0446), "size": (0.2, 0.075, 0.09), "turn": 9.0}
"""The tea tin behind the marker, which the scene files model as a box."""
ENVIRONMENT = {"x": (-1.7, 2.3), "y": (-2.6, 0.85), "z": (-0.74, 1.75)}


def window(name: str, center: Any, right: Any, up: Any, radiance: np.ndarray) -> Dict:
    """Return a window: an emitting view with a white frame and a cross of bars, a little inside the wall."""
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


def walls_and_furniture() -> Dict:
    """Return the walls and the furniture of the room, without its bookcase."""
    (x0, x1), (y0, y1), (z0, z1) = ENVIRONMENT["x"], ENVIRONMENT["y"], ENVIRONMENT["z"]
    cx, cy, cz, hx, hy, hz = (x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2, (x1 - x0) / 2, (y1 - y0) / 2, (z1 - z0) / 2
    plaster = matte((0.72, 0.68, 0.6))
    floor = glossy(texture(wood((0.34, 0.22, 0.13), (0.16, 0.09, 0.05), 11, 12, (1024, 1024))), 0.4)
    return {
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


def bookcase() -> Dict:
    """Shelves on the near wall, with the spines of books."""
    y0 = ENVIRONMENT["y"][0]
    shapes: Dict = {}
    rng = np.random.default_rng(8)
    spines = [
        (0.45, 0.12, 0.08),
        (0.1, 0.2, 0.3),
        (0.6, 0.5, 0.3),
        (0.12, 0.24, 0.14),
        (0.68, 0.65, 0.58),
        (0.5, 0.3, 0.08),
    ]
    for shelf in range(4):
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
    return shapes


def emitting(radiance: Any) -> Dict:
    """Return the material of a lamp that emits ``radiance``."""
    return {"bsdf": matte(0.7), "emitter": {"type": "area", "radiance": rgb(radiance)}}


def lamps_of(clip: str) -> Dict:
    """Return every lamp of a clip at level 1, by the names that the clip's levels use."""
    x0, (y1, z1) = ENVIRONMENT["x"][0], (ENVIRONMENT["y"][1], ENVIRONMENT["z"][1])
    shapes: Dict = {}
    if clip == "desk":
        shapes |= window("window", (x0 + 0.01, 0.0, 0.8), (0, 0.75, 0), (0, 0, 0.68), 10.5 * view(3))
        shapes["ceiling_lamp"] = {
            "type": "disk",
            "to_world": turned((0.75, -0.65, z1 - 0.06), 0, 0.2) @ mi.ScalarTransform4f().rotate([1, 0, 0], 180),
            **emitting(30.0 * np.array([1.0, 0.72, 0.42])),
        }
    elif clip == "wire":
        shapes |= window("window", (x0 + 0.01, 0.0, 0.8), (0, 0.75, 0), (0, 0, 0.68), 0.3 * view(3) * (0.55, 0.75, 1.2))
        shapes["table_lamp"] = ball(LAMP, 0.045, {}) | emitting(780.0 * np.array([1.0, 0.86, 0.66]))
    else:
        shapes |= window("window", (-0.55, y1 - 0.01, 0.72), (0.45, 0, 0), (0, 0, 0.66), 9.0 * view(3))
        shapes["globe"] = ball((0.2, 0.24, 0.135), 0.055, {}) | emitting(14.0 * np.array([1.0, 0.8, 0.52]))
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


def environment(clip: str) -> Dict:
    """Walls, floor, furniture and the lamps of a clip."""
    return walls_and_furniture() | bookcase() | lamps_of(clip)


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


def wires(folder: pathlib.Path) -> Dict:
    """Return two cables, which no scene file models."""
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


def desk_clutter(folder: pathlib.Path) -> Dict:
    """The tea tin, books, a pad, a pencil and a cable."""
    shapes: Dict = {}
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
    return shapes


def clutter(clip: str, folder: pathlib.Path) -> Dict:
    """Return the objects on the desk. Scene files model none of them but the tea tin of ``desk``."""
    if clip == "wire":
        return wires(folder)
    shapes = (
        mug(folder, (0.27, 0.17), -40, (0.62, 0.58, 0.5))
        if clip == "desk"
        else mug(folder, (-0.02, 0.19), 200, (0.14, 0.2, 0.3))
    )
    shapes |= plant(folder, (-0.2, 0.27) if clip == "desk" else (-0.24, 0.22))
    if clip == "desk":
        shapes |= desk_clutter(folder)
    else:
        shapes |= book("red", (0.33, 0.05, TABLE), (0.15, 0.21, 0.024), 24, (0.42, 0.09, 0.06))
        shapes |= pencil(folder, "pencil", (0.04, -0.13, TABLE), 12, (0.75, 0.42, 0.04))
    return shapes
