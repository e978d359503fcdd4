"""A small scene whose layers are known: a camera with distortion that moves, an object that moves, proxies, a ball."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from tests.kernel_rig import look_at
from warp_ar.engine.pipeline import Pipeline, Result
from warp_ar.scene import Camera, LambertMaterial, Light, MetallicRoughnessMaterial, Object, Probe, Proxy, Scene
from warp_ar.scene.description import Animation
from warp_ar.scene.materials import MirrorMaterial

SIZE = (64, 48)
BALL = Probe((-0.1, 0.03, 0.05), 0.03)


def make_scene(**changes: Any) -> Scene:
    scene = Scene(
        camera=Camera(*SIZE, 70.0, 72.0, 31.0, 24.5, (0.1, -0.05, 0.002, -0.001, 0.01)),
        probes=(BALL,),
        proxies=(Proxy("plane", size=(0.5, 0.4)), Proxy("box", at=(0.0, 0.1, 0.03), size=(0.1, 0.05, 0.06))),
        objects=(
            Object("sphere", radius=0.04, at=(0.08, 0.0, 0.04), material=LambertMaterial((0.5, 0.4, 0.3))),
            Object(
                "box",
                size=(0.06, 0.06, 0.06),
                at=(0.0, -0.02, 0.03),
                rotate=(0.0, 0.0, 20.0),
                material=MetallicRoughnessMaterial((0.9, 0.8, 0.4), 1.0, 0.3),
                animate=Animation(turn=(0.0, 0.0, 90.0), sway=(0.02, 0.0, 0.01), period=1.0),
            ),
            Object("sphere", radius=0.02, at=(0.0, 0.16, 0.03), material=MirrorMaterial((0.9, 0.9, 0.9))),
        ),
        lights=(Light("point", 0.2, at=(0.1, -0.1, 0.3)),),
    )
    return dataclasses.replace(scene, **changes)


POSES = (look_at((0.05, -0.35, 0.3)), look_at((0.06, -0.34, 0.3)), look_at((0.06, -0.34, 0.3)))
TIMES = (0.0, 0.1, 0.15)


def make_frame(seed: int = 0) -> np.ndarray:
    """A picture with all codes, and patches that clip."""
    frame = np.random.default_rng(seed).integers(0, 256, (SIZE[1], SIZE[0], 3)).astype(np.uint8)
    frame[10:20, 20:40] = 255
    return frame


def run(pipeline: Pipeline, count: int = len(POSES)) -> list[Result]:
    """Frames with known poses; pictures and layers are read at once, for they hold until the next call."""
    results = []
    for pose, seconds, seed in zip(POSES[:count], TIMES, range(count), strict=False):
        result = pipeline(make_frame(seed), time_seconds=seconds, pose=pose)
        _ = result.image, result.layers
        results.append(result)
    return results
