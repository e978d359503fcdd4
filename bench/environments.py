"""Environment maps for benchmarks and tests of filters."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import warp as wp

from warp_ar.kernels.environment.pyramid import reduce_latlong

HEIGHTS = (32, 64, 128, 256)
"""Numbers of rows of the maps with which stages of the environment are measured."""


def random_map(height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return random radiance with a few bright texels, (rows, 2 rows, 3), and a mask of known texels, all but 15 %."""
    shape = (height, 2 * height)
    rng = np.random.default_rng(0)
    radiance = np.float32(rng.uniform(0, 1, (*shape, 3)) ** 4)
    return radiance, np.float32(rng.random(shape) > 0.15)


def made_up_environment(height: int) -> np.ndarray:
    """Return an environment with dim walls, a window, a lamp of four degrees and a sun of half a degree.

    Args:
        height: Smallest number of rows; the map has at least 512.

    Returns:
        Radiance, float32 (rows, 2 rows, 3).
    """
    fine = max(height, 512)
    theta = np.pi * (np.arange(fine)[:, None] + 0.5) / fine
    phi = (np.arange(2 * fine)[None, :] + 0.5) * np.pi / fine - np.pi
    direction = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi], -1)
    radiance = 0.1 + 0.05 * direction @ np.array([[0.5, 0.2, 0.1], [0.0, 0.3, 0.0], [0.6, 0.5, 0.4]])
    window = (np.abs(theta - 1.3) < 0.3) & (np.abs(phi - 1.0) < 0.4)
    radiance[window] = (3.0, 3.5, 4.0)
    for degrees, axis, color in (
        (4.0, (-0.48, 0.36, 0.8), (200.0, 150.0, 90.0)),
        (0.53, (0.6, -0.64, 0.48), (2e4, 1.9e4, 1.7e4)),
    ):
        radiance[direction @ np.array(axis) > np.cos(np.radians(degrees / 2))] = color
    return radiance.astype(np.float32)


def environments(height: int, device: Any) -> dict[str, wp.array]:
    """Return environments of ``height`` rows by name: the generated one, and those in WARP_AR_SHARED/hdri."""
    images = {"made up": made_up_environment(height)}
    for path in sorted(Path(os.environ.get("WARP_AR_SHARED", ""), "hdri").glob("*.exr")):
        images[path.stem] = OpenEXR.File(str(path)).channels()["RGB"].pixels.astype(np.float32)
    result = {}
    for name, image in images.items():
        small = wp.zeros((height, 2 * height), dtype=wp.vec3, device=device)
        reduce_latlong(wp.array(np.ascontiguousarray(image), dtype=wp.vec3, device=device), small)
        result[name] = small
    return result
